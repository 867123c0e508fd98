import subprocess
import sys
from collections import OrderedDict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import warp, warp_boxes, warp_mask, warp_points
from torchrefract.labels.targets import warp_labels

tv = pytest.importorskip("torchvision.tv_tensors", reason="torchvision is in the extra test")
F = pytest.importorskip("torchvision.transforms.v2.functional", reason="torchvision is in the extra test")
v2 = pytest.importorskip("torchvision.transforms.v2", reason="torchvision is in the extra test")

SIZE = (36, 64)
PLAIN_FORMATS = ["XYXY", "XYWH", "CXCYWH"]
ROTATED_FORMATS = ["XYWHR", "CXCYWHR", "XYXYXYXY"]


class Sample(NamedTuple):
    image: Any
    target: Any


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def wave(pixels, waves) -> Tensor:
    """(2, H, W), px, a smooth flow."""
    return waves(*pixels(*SIZE), 4.0, 15.0)[0].float()


def hflip() -> Tensor:
    x = torch.arange(SIZE[1]).float().expand(SIZE)
    return torch.stack([SIZE[1] - 1 - 2 * x, 0 * x])


def vflip() -> Tensor:
    y = torch.arange(SIZE[0]).float()[:, None].expand(SIZE)
    return torch.stack([0 * y, SIZE[0] - 1 - 2 * y])


def boxes_of(rows: Any, form: str = "XYXY", **options: Any) -> Any:
    boxes = tv.BoundingBoxes(torch.as_tensor(rows), format="XYXY", canvas_size=SIZE, **options)
    return F.convert_bounding_box_format(boxes, new_format=tv.BoundingBoxFormat[form])


def rotated_of(form: str) -> Any:
    rows = torch.tensor([[20.0, 18.0, 8.0, 5.0, 20.0], [40.0, 12.0, 6.0, 9.0, -65.0], [30.0, 20.0, 7.0, 4.0, 0.0]])
    boxes = tv.BoundingBoxes(rows, format="CXCYWHR", canvas_size=SIZE)
    return F.convert_bounding_box_format(boxes, new_format=tv.BoundingBoxFormat[form])


def corner_set(boxes: Any) -> Tensor:
    """(N, 4, 2): the corners of rotated boxes, from the lowest along a slanted line to the highest."""
    corners = F.convert_bounding_box_format(boxes, new_format=tv.BoundingBoxFormat.XYXYXYXY)
    corners = corners.as_subclass(Tensor).reshape(-1, 4, 2)
    order = (corners[..., 0] + 0.37 * corners[..., 1]).argsort(dim=1)
    return corners.gather(1, order[..., None].expand(-1, -1, 2))


def detection() -> dict[str, Any]:
    """A sample with three boxes, of which the flip of a shift by 20 px leaves two."""
    boxes = boxes_of([[30.0, 5.0, 50.0, 20.0], [2.0, 3.0, 12.0, 9.0], [15.0, 20.0, 30.0, 30.0]])
    masks = torch.zeros(3, *SIZE, dtype=torch.uint8)
    for i, (x1, y1, x2, y2) in enumerate(boxes.long().tolist()):
        masks[i, y1:y2, x1:x2] = 1
    return {"boxes": boxes, "labels": torch.tensor([7, 8, 9]), "masks": tv.Mask(masks), "image_id": 42}


SHIFT = torch.tensor([20.0, 0.0]).view(2, 1, 1).expand(2, *SIZE)


@pytest.mark.parametrize("form", PLAIN_FORMATS)
@pytest.mark.parametrize(("flow", "flip"), [(hflip(), "horizontal_flip"), (vflip(), "vertical_flip")])
@pytest.mark.parametrize("dtype", [torch.float32, torch.int64])
def test_boxes_are_flipped_as_torchvision_flips_them(form, flow, flip, dtype):
    boxes = boxes_of(torch.tensor([[10, 20, 30, 32], [0, 0, 64, 36], [1, 2, 7, 6]]).to(dtype), form)
    moved = warp_labels(boxes, flow)
    assert_close(moved.as_subclass(Tensor), getattr(F, flip)(boxes).as_subclass(Tensor), rtol=0, atol=2e-4)
    assert (type(moved), moved.format, moved.canvas_size, moved.dtype) == (type(boxes), boxes.format, SIZE, dtype)


@pytest.mark.parametrize("form", ROTATED_FORMATS)
@pytest.mark.parametrize(("flow", "flip"), [(hflip(), "horizontal_flip"), (vflip(), "vertical_flip")])
def test_rotated_boxes_are_flipped_as_torchvision_flips_them(form, flow, flip):
    boxes = rotated_of(form)
    moved = warp_labels(boxes, flow)
    # The rectangles are the same; which of its corners comes first is not.
    assert_close(corner_set(moved), corner_set(getattr(F, flip)(boxes)), rtol=0, atol=1e-3)
    assert moved.format == boxes.format


@pytest.mark.parametrize("form", ROTATED_FORMATS)
def test_rotated_boxes_stay_without_a_flow(form):
    boxes = rotated_of(form)
    moved = warp_labels(boxes, torch.zeros(2, *SIZE))
    assert_close(moved.as_subclass(Tensor), boxes.as_subclass(Tensor), rtol=0, atol=1e-3)


def test_rotated_boxes_hold_the_warped_outline(wave):
    boxes = rotated_of("XYXYXYXY")
    corners = boxes.as_subclass(Tensor).reshape(-1, 4, 2)
    t = torch.linspace(0, 1, 50)[:, None]
    outline = torch.cat([corners[:, k, None] * (1 - t) + corners[:, (k + 1) % 4, None] * t for k in range(4)], dim=1)
    landed = warp_points(outline.reshape(1, -1, 2) - 0.5, wave[None])[0].view(outline.shape) + 0.5
    moved = warp_labels(boxes, wave).as_subclass(Tensor).reshape(-1, 4, 2)
    origin, axes = moved[:, :1], torch.stack([moved[:, 1] - moved[:, 0], moved[:, 3] - moved[:, 0]], dim=1)
    assert_close((axes[:, 0] * axes[:, 1]).sum(dim=1), torch.zeros(3), rtol=0, atol=1e-3)
    share = ((landed - origin)[:, :, None] * axes[:, None]).sum(dim=-1) / axes.square().sum(dim=-1)[:, None]
    assert share.min() > -0.01
    assert share.max() < 1.01
    # Each side touches it.
    assert share.amin(dim=1).max() < 0.01
    assert share.amax(dim=1).min() > 0.99


@pytest.mark.parametrize(("flow", "flip"), [(hflip(), "horizontal_flip"), (vflip(), "vertical_flip")])
@pytest.mark.parametrize("dtype", [torch.float32, torch.int64])
def test_keypoints_are_flipped_as_torchvision_flips_them(flow, flip, dtype):
    rows = torch.tensor([[[3, 4], [0, 0]], [[63, 35], [20, 30]], [[11, 7], [0, 35]]]).to(dtype)
    keypoints = tv.KeyPoints(rows, canvas_size=SIZE)
    moved = warp_labels(keypoints, flow)
    assert_close(moved.as_subclass(Tensor), getattr(F, flip)(keypoints).as_subclass(Tensor), rtol=0, atol=1e-4)
    assert (type(moved), moved.canvas_size, moved.dtype) == (type(keypoints), SIZE, dtype)


@pytest.mark.parametrize("flow", [hflip(), vflip()])
def test_images_and_masks_are_flipped_as_torchvision_flips_them(flow):
    flip = "horizontal_flip" if flow[0].any() else "vertical_flip"
    sample = [
        tv.Image(torch.randint(0, 256, (3, *SIZE), generator=generator(), dtype=torch.uint8)),
        tv.Video(torch.randint(0, 256, (2, 3, *SIZE), generator=generator(), dtype=torch.uint8)),
        tv.Mask(torch.randint(0, 20, SIZE, generator=generator())),
        tv.Mask(torch.rand(5, *SIZE, generator=generator()) > 0.5),
    ]
    for leaf, moved in zip(sample, warp_labels(sample, flow), strict=True):
        assert type(moved) is type(leaf)
        assert torch.equal(moved, getattr(F, flip)(leaf))


def test_labels_follow_as_the_plain_functions_say(wave):
    image, mask = torch.rand(3, *SIZE, generator=generator()), torch.randint(0, 9, (1, *SIZE), generator=generator())
    points, boxes = torch.tensor([[20.0, 10.0], [33.3, 21.7]]), torch.tensor([[10.0, 8.0, 30.0, 25.0]])
    sample = {
        "image": tv.Image(image),
        "mask": tv.Mask(mask),
        "points": tv.KeyPoints(points, canvas_size=SIZE),
        "boxes": boxes_of(boxes),
    }
    moved = warp_labels(sample, wave, padding="border", interpolation="bicubic", mask_fill=255, drop=False)
    assert torch.equal(moved["image"], warp(image, wave, padding="border", interpolation="bicubic")[0])
    assert torch.equal(moved["mask"], warp_mask(mask, wave, fill=255))
    assert torch.equal(moved["points"].as_subclass(Tensor), warp_points(points, wave)[0])
    assert torch.equal(moved["boxes"].as_subclass(Tensor), warp_boxes(boxes - 0.5, wave)[0] + 0.5)


def test_floating_masks_are_soft_on_demand(wave):
    mask = torch.rand(2, *SIZE, generator=generator())
    assert torch.equal(warp_labels(tv.Mask(mask), wave, soft_masks=True), warp_mask(mask, wave, soft=True))
    assert torch.equal(warp_labels(tv.Mask(mask), wave), warp_mask(mask, wave))
    whole = tv.Mask(mask > 0.5)
    assert torch.equal(warp_labels(whole, wave, soft_masks=True), warp_mask(mask > 0.5, wave))


def test_the_nesting_stays_and_what_is_plain_passes():
    image, ids = (
        tv.Image(torch.randint(0, 256, (3, *SIZE), generator=generator(), dtype=torch.uint8)),
        torch.tensor([1, 2]),
    )
    array = np.arange(3)
    sample = Sample(
        image=OrderedDict(a=[image, (image, None)], b="name"),
        target={"ids": ids, "n": 3, "scale": 1.5, "path": Path("a/b"), "array": array, "empty": [], "flag": True},
    )
    moved = warp_labels(sample, hflip())
    assert type(moved) is Sample
    assert type(moved.image) is OrderedDict
    assert list(moved.image) == ["a", "b"]
    assert type(moved.image["a"][1]) is tuple
    assert torch.equal(moved.image["a"][1][0], F.horizontal_flip(image))
    assert moved.image["a"][1][1] is None
    assert moved.target["ids"] is ids
    assert moved.target["array"] is array
    rest = {key: moved.target[key] for key in ("n", "scale", "path", "empty", "flag")}
    assert rest == {"n": 3, "scale": 1.5, "path": Path("a/b"), "empty": [], "flag": True}


@pytest.mark.parametrize(
    "wrapped", [lambda d: d, lambda d: (tv.Image(torch.rand(3, *SIZE, generator=generator())), d), lambda d: {"x": [d]}]
)
def test_labels_and_masks_go_with_their_boxes(wrapped):
    sample = detection()
    moved = warp_labels(wrapped(sample), SHIFT)
    while not (isinstance(moved, dict) and "boxes" in moved):
        moved = moved["x"] if isinstance(moved, dict) else moved[-1]
    assert moved["boxes"].tolist() == [[10.0, 5.0, 30.0, 20.0], [0.0, 20.0, 10.0, 30.0]]
    assert moved["labels"].tolist() == [7, 9]
    assert torch.equal(moved["masks"], warp_mask(sample["masks"].as_subclass(Tensor)[[0, 2]], SHIFT))
    assert moved["image_id"] == 42
    assert type(moved["masks"]) is tv.Mask


def test_limits_drop_boxes_too():
    moved = warp_labels(detection(), SHIFT, min_visibility=0.7)
    assert moved["labels"].tolist() == [7]
    moved = warp_labels(detection(), SHIFT, min_area=200)
    assert moved["labels"].tolist() == [7]
    moved = warp_labels(detection(), SHIFT, clip=False)
    assert moved["boxes"].tolist() == [[10.0, 5.0, 30.0, 20.0], [-5.0, 20.0, 10.0, 30.0]]


def test_without_dropping_torchvision_sanitizes_the_same_sample():
    sample = detection()
    kept = warp_labels(sample, SHIFT, drop=False)
    assert kept["labels"] is sample["labels"]
    assert kept["boxes"].shape == (3, 4)
    assert kept["boxes"][1, :2].tolist() == kept["boxes"][1, 2:].tolist()
    sane, dropped = v2.SanitizeBoundingBoxes()(kept), warp_labels(sample, SHIFT)
    for key in ("boxes", "labels", "masks"):
        assert torch.equal(sane[key], dropped[key])


@pytest.mark.parametrize("form", ROTATED_FORMATS)
def test_rotated_boxes_that_are_not_seen_are_dropped_or_have_no_area(form):
    flow = torch.tensor([25.0, 0.0]).view(2, 1, 1).expand(2, *SIZE)
    sample = {"boxes": rotated_of(form), "labels": torch.arange(3)}
    assert warp_labels(sample, flow)["labels"].tolist() == [1, 2]
    degenerate = corner_set(warp_labels(sample, flow, drop=False)["boxes"])
    assert (degenerate[0] - degenerate[0, :1]).abs().max() < 1e-4
    assert (degenerate[1] - degenerate[1, :1]).abs().max() > 1


def test_the_getter_says_what_goes_with_the_boxes():
    sample = detection() | {"iscrowd": torch.tensor([0, 1, 2])}
    moved = warp_labels(sample, SHIFT, labels_getter=lambda s: (s["labels"], s["iscrowd"]))
    assert (moved["labels"].tolist(), moved["iscrowd"].tolist()) == ([7, 9], [0, 2])
    moved = warp_labels(sample, SHIFT, labels_getter=None)
    assert (len(moved["boxes"]), len(moved["labels"]), len(moved["masks"])) == (2, 3, 2)
    moved = warp_labels({"boxes": sample["boxes"], "my_Label": sample["labels"]}, SHIFT)
    assert moved["my_Label"].tolist() == [7, 9]
    moved = warp_labels([sample["boxes"], sample["labels"]], SHIFT, labels_getter=lambda s: s[1])
    assert moved[1].tolist() == [7, 9]
    assert len(warp_labels(sample["boxes"], SHIFT)) == 2


def test_keypoints_that_are_not_seen_lie_off_the_canvas_and_are_told():
    points = tv.KeyPoints(torch.tensor([[[30.0, 10.0], [5.0, 10.0]], [[50.0, 30.0], [0.0, 0.0]]]), canvas_size=SIZE)
    for shape in [(2, 2), (2, 2, 1)]:
        flags = torch.full(shape, 2)
        moved = warp_labels({"points": points, "visibility": flags, "other": flags}, SHIFT)
        assert moved["visibility"].flatten().tolist() == [2, 0, 2, 0]
        assert moved["other"] is flags
    assert moved["points"].tolist() == [[[10.0, 10.0], [-15.0, 10.0]], [[30.0, 30.0], [-20.0, 0.0]]]
    hole = torch.zeros(2, *SIZE)
    hole[:, 5:15, 25:35] = torch.nan
    moved = warp_labels(points, hole)
    assert moved.tolist() == [[[-1.0, -1.0], [5.0, 10.0]], [[50.0, 30.0], [0.0, 0.0]]]
    singles = tv.wrap(moved.as_subclass(Tensor).reshape(-1, 2), like=moved)
    assert v2.SanitizeKeyPoints()({"points": singles})["points"].tolist() == [[5.0, 10.0], [50.0, 30.0], [0.0, 0.0]]


def test_keypoints_on_the_outer_half_of_the_border_pixels_are_on_the_canvas():
    rows = torch.tensor([[63.4, 20.0], [30.0, 35.4], [-0.4, -0.4], [63.6, 20.0], [5.0, 36.0]])
    points, flags = tv.KeyPoints(rows, canvas_size=SIZE), torch.ones(5)
    moved = warp_labels({"points": points, "visible": flags}, torch.zeros(2, *SIZE))
    assert torch.equal(moved["points"], points)
    assert moved["visible"].tolist() == [1, 1, 1, 0, 0]
    mirrored = warp_labels(points, hflip())
    assert_close(mirrored[:3].as_subclass(Tensor), F.horizontal_flip(points)[:3].as_subclass(Tensor))


def test_a_list_of_samples_has_a_flow_for_each():
    flows = torch.stack([SHIFT, hflip()])
    samples = [(tv.Image(torch.rand(3, *SIZE, generator=generator())), detection()) for _ in range(2)]
    for i, (image, target) in enumerate(warp_labels(samples, flows)):
        alone = warp_labels(samples[i], flows[i])
        assert torch.equal(image, alone[0])
        assert all(torch.equal(target[key], alone[1][key]) for key in ("boxes", "labels", "masks"))


def test_a_batch_of_maps_has_a_flow_for_each():
    flows = torch.stack([SHIFT, hflip()])
    sample = {
        "image": tv.Image(torch.rand(2, 3, *SIZE, generator=generator())),
        "video": tv.Video(torch.rand(2, 4, 3, *SIZE, generator=generator())),
        "mask": tv.Mask(torch.randint(0, 5, (2, *SIZE), generator=generator())),
        "points": tv.KeyPoints(torch.rand(2, 3, 2, generator=generator()) * 30, canvas_size=SIZE),
    }
    moved = warp_labels(sample, flows)
    for key, leaf in moved.items():
        for i in range(2):
            alone = tv.wrap(sample[key].as_subclass(Tensor)[i], like=sample[key])
            assert torch.equal(leaf[i], warp_labels(alone, flows[i])), key


def test_none_of_boxes_masks_or_keypoints_stay_none():
    sample = {
        "boxes": boxes_of(torch.zeros(0, 4)),
        "labels": torch.zeros(0, dtype=torch.int64),
        "masks": tv.Mask(torch.zeros(0, *SIZE, dtype=torch.bool)),
        "points": tv.KeyPoints(torch.zeros(0, 17, 2), canvas_size=SIZE),
    }
    moved = warp_labels(sample, SHIFT)
    for key, leaf in sample.items():
        assert (type(moved[key]), moved[key].shape, moved[key].dtype) == (type(leaf), leaf.shape, leaf.dtype)


def test_gradients_reach_soft_labels_and_the_flow(wave):
    flow = wave.clone().requires_grad_()
    points = tv.KeyPoints(torch.tensor([[20.0, 10.0]]), canvas_size=SIZE)
    moved = warp_labels({"points": points, "boxes": boxes_of([[10.0, 8.0, 30.0, 25.0]])}, flow)
    for leaf in (moved["points"], moved["boxes"]):
        (gradient,) = torch.autograd.grad(leaf.as_subclass(Tensor).sum(), flow)
        assert gradient.isfinite().all()
        assert gradient.abs().sum() > 0.5


def test_unknown_types_raise_and_are_named():
    class Skeleton(tv.TVTensor):
        """Of torchvision's kind, and none of its types."""

    class Tagged(Tensor):
        """A tensor of somebody's own type."""

    class Polygons:
        """No tensor at all."""

    picture = pytest.importorskip("PIL.Image", reason="pillow is in the extra train").new("RGB", (SIZE[1], SIZE[0]))
    for leaf in (
        torch.rand(3, 2).as_subclass(Skeleton),
        torch.rand(2).as_subclass(Tagged),
        Polygons(),
        picture,
        {1, 2},
    ):
        with pytest.raises(TypeError, match=f"target must hold .*, got .*{type(leaf).__name__}"):
            warp_labels({"x": [1, leaf]}, SHIFT)


def test_a_subclass_of_a_known_type_is_moved_and_kept():
    class Road(tv.Mask):
        """A mask by another name."""

    mask = torch.randint(0, 5, SIZE, generator=generator()).as_subclass(Road)
    moved = warp_labels(mask, hflip())
    assert type(moved) is Road
    assert torch.equal(moved.as_subclass(Tensor), mask.as_subclass(Tensor).flip(-1))


BOXES = boxes_of([[1.0, 2.0, 3.0, 4.0]])
SMALL = tv.KeyPoints(torch.zeros(1, 2), canvas_size=(5, 5))


@pytest.mark.parametrize(
    ("target", "options", "kind", "rule"),
    [
        (1, {"flow": torch.zeros(5, 6)}, ValueError, r"flow must have shape \(2, H, W\)"),
        (1, {"flow": 3}, TypeError, "flow must be a tensor, got int"),
        (1, {"min_area": -1}, ValueError, "min_area must be"),
        (1, {"min_visibility": 2}, ValueError, "min_visibility must be"),
        (1, {"clip": None}, TypeError, "clip must be True or False"),
        (1, {"drop": "no"}, TypeError, "drop must be True or False"),
        (1, {"soft_masks": 1}, TypeError, "soft_masks must be True or False"),
        (1, {"labels_getter": "ids"}, ValueError, "labels_getter must be 'default', a function or None, got 'ids'"),
        (1, {"padding": "wrap"}, ValueError, "padding must be one of"),
        (1, {"interpolation": "cubic"}, ValueError, "interpolation must be one of"),
        (1, {"min_size": 3}, TypeError, "min_size"),
        (tv.Mask(torch.zeros(5, 5)), {}, ValueError, "Mask must have the size of the flow"),
        (tv.Mask(torch.zeros(SIZE)), {"mask_fill": torch.inf}, ValueError, "fill must be"),
        (SMALL, {}, ValueError, r"KeyPoints must have the canvas of the flow, \(36, 64\), got \(5, 5\)"),
        ([BOXES, torch.arange(1)], {}, ValueError, "target must hold boxes in a dict with their labels"),
        ({"boxes": BOXES, "labels": torch.arange(2)}, {}, ValueError, "labels must have one row for each of the 1"),
        ({"boxes": BOXES, "labels": "car"}, {}, TypeError, "labels must be a tensor for boxes to be dropped, got str"),
        ({"boxes": BOXES, "labels": [3]}, {}, TypeError, "labels must be a tensor for boxes to be dropped, got list"),
        ([{"boxes": BOXES, "Label": ()}], {}, TypeError, "label must be a tensor for boxes to be dropped, got tuple"),
        ({"boxes": BOXES, "labels": {"a": torch.ones(1)}}, {}, TypeError, "labels must be a tensor .*, got dict"),
        ({"p": tv.KeyPoints(torch.zeros(1, 2), canvas_size=SIZE), "visible": torch.ones(2)}, {}, ValueError, "visible"),
        ([1, 2, 3], {"flow": SHIFT[None]}, ValueError, "target must have one sample for each of the 1 flows, got 3"),
        ({"boxes": BOXES}, {"flow": SHIFT[None]}, ValueError, "target must be a list of samples to hold boxes"),
        (tv.Mask(torch.zeros(SIZE)), {"flow": SHIFT[None]}, ValueError, "target must have a batch of 1 like flow"),
    ],
)
def test_what_does_not_fit_raises(target, options, kind, rule):
    options = {"flow": SHIFT} | options
    with pytest.raises(kind, match=rule):
        warp_labels(target, **options)


def test_torchvision_is_not_imported_for_plain_targets():
    code = """
import sys, torch
from torchrefract.labels.targets import warp_labels
assert warp_labels({"id": 3}, torch.zeros(2, 4, 5)) == {"id": 3}
assert not any(name.split(".")[0] == "torchvision" for name in sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)

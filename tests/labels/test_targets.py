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
    """Return a smooth flow, (2, H, W), px."""
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
    """Return the corners of rotated boxes, (N, 4, 2), sorted along a slanted line."""
    corners = F.convert_bounding_box_format(boxes, new_format=tv.BoundingBoxFormat.XYXYXYXY)
    corners = corners.as_subclass(Tensor).reshape(-1, 4, 2)
    order = (corners[..., 0] + 0.37 * corners[..., 1]).argsort(dim=1)
    return corners.gather(1, order[..., None].expand(-1, -1, 2))


def detection() -> dict[str, Any]:
    """Return a sample with three boxes, of which SHIFT leaves two."""
    boxes = boxes_of([[30.0, 5.0, 50.0, 20.0], [2.0, 3.0, 12.0, 9.0], [15.0, 20.0, 30.0, 30.0]])
    masks = torch.zeros(3, *SIZE, dtype=torch.uint8)
    for i, (x1, y1, x2, y2) in enumerate(boxes.long().tolist()):
        masks[i, y1:y2, x1:x2] = 1
    return {"boxes": boxes, "labels": torch.tensor([7, 8, 9]), "masks": tv.Mask(masks), "image_id": 42}


SHIFT = torch.tensor([20.0, 0.0]).view(2, 1, 1).expand(2, *SIZE)


@pytest.mark.quick
@pytest.mark.parametrize("form", PLAIN_FORMATS)
@pytest.mark.parametrize(
    ("flow", "flip", "dtype"),
    [(hflip(), "horizontal_flip", torch.float32), (vflip(), "vertical_flip", torch.int64)],
)
def test_boxes_are_flipped_like_in_torchvision(form, flow, flip, dtype):
    boxes = boxes_of(torch.tensor([[10, 20, 30, 32], [0, 0, 64, 36], [1, 2, 7, 6]]).to(dtype), form)
    warped = warp_labels(boxes, flow)
    assert_close(warped.as_subclass(Tensor), getattr(F, flip)(boxes).as_subclass(Tensor), rtol=0, atol=2e-4)
    assert (type(warped), warped.format, warped.canvas_size, warped.dtype) == (type(boxes), boxes.format, SIZE, dtype)


@pytest.mark.parametrize("form", ROTATED_FORMATS)
@pytest.mark.parametrize(("flow", "flip"), [(hflip(), "horizontal_flip"), (vflip(), "vertical_flip")])
def test_rotated_boxes_are_flipped_like_in_torchvision(form, flow, flip):
    boxes = rotated_of(form)
    warped = warp_labels(boxes, flow)
    # The rectangles agree; the order of their corners does not.
    assert_close(corner_set(warped), corner_set(getattr(F, flip)(boxes)), rtol=0, atol=1e-3)
    assert warped.format == boxes.format


def test_rotated_boxes_are_the_tightest_around_their_warped_outline(wave):
    boxes = rotated_of("XYXYXYXY")
    corners = boxes.as_subclass(Tensor).reshape(-1, 4, 2)
    t = torch.linspace(0, 1, 50)[:, None]
    outline = torch.cat([corners[:, k, None] * (1 - t) + corners[:, (k + 1) % 4, None] * t for k in range(4)], dim=1)
    outline_points = warp_points(outline.reshape(1, -1, 2) - 0.5, wave[None])[0].view(outline.shape) + 0.5
    warped = warp_labels(boxes, wave).as_subclass(Tensor).reshape(-1, 4, 2)
    origin, axes = warped[:, :1], torch.stack([warped[:, 1] - warped[:, 0], warped[:, 3] - warped[:, 0]], dim=1)
    assert_close((axes[:, 0] * axes[:, 1]).sum(dim=1), torch.zeros(3), rtol=0, atol=1e-3)
    share = ((outline_points - origin)[:, :, None] * axes[:, None]).sum(dim=-1) / axes.square().sum(dim=-1)[:, None]
    assert share.min() > -0.01
    assert share.max() < 1.01
    # Each side touches the outline.
    assert share.amin(dim=1).max() < 0.01
    assert share.amax(dim=1).min() > 0.99


@pytest.mark.parametrize(("flow", "flip"), [(hflip(), "horizontal_flip"), (vflip(), "vertical_flip")])
@pytest.mark.parametrize("dtype", [torch.float32, torch.int64])
def test_keypoints_are_flipped_like_in_torchvision(flow, flip, dtype):
    rows = torch.tensor([[[3, 4], [0, 0]], [[63, 35], [20, 30]], [[11, 7], [0, 35]]]).to(dtype)
    keypoints = tv.KeyPoints(rows, canvas_size=SIZE)
    warped = warp_labels(keypoints, flow)
    assert_close(warped.as_subclass(Tensor), getattr(F, flip)(keypoints).as_subclass(Tensor), rtol=0, atol=1e-4)
    assert (type(warped), warped.canvas_size, warped.dtype) == (type(keypoints), SIZE, dtype)


@pytest.mark.parametrize("flow", [hflip(), vflip()])
def test_images_and_masks_are_flipped_like_in_torchvision(flow):
    flip = "horizontal_flip" if flow[0].any() else "vertical_flip"
    sample = [
        tv.Image(torch.randint(0, 256, (3, *SIZE), generator=generator(), dtype=torch.uint8)),
        tv.Video(torch.randint(0, 256, (2, 3, *SIZE), generator=generator(), dtype=torch.uint8)),
        tv.Mask(torch.randint(0, 20, SIZE, generator=generator())),
        tv.Mask(torch.rand(5, *SIZE, generator=generator()) > 0.5),
    ]
    for leaf, warped in zip(sample, warp_labels(sample, flow), strict=True):
        assert type(warped) is type(leaf)
        assert torch.equal(warped, getattr(F, flip)(leaf))


def test_each_kind_of_label_matches_its_plain_function(wave):
    image, mask = torch.rand(3, *SIZE, generator=generator()), torch.randint(0, 9, (1, *SIZE), generator=generator())
    points, boxes = torch.tensor([[20.0, 10.0], [33.3, 21.7]]), torch.tensor([[10.0, 8.0, 30.0, 25.0]])
    sample = {
        "image": tv.Image(image),
        "mask": tv.Mask(mask),
        "points": tv.KeyPoints(points, canvas_size=SIZE),
        "boxes": boxes_of(boxes),
    }
    warped = warp_labels(sample, wave, padding="border", interpolation="bicubic", mask_fill=255, drop=False)
    assert torch.equal(warped["image"], warp(image, wave, padding="border", interpolation="bicubic")[0])
    assert torch.equal(warped["mask"], warp_mask(mask, wave, fill=255))
    assert torch.equal(warped["points"].as_subclass(Tensor), warp_points(points, wave)[0])
    assert torch.equal(warped["boxes"].as_subclass(Tensor), warp_boxes(boxes - 0.5, wave)[0] + 0.5)


def test_soft_masks_apply_to_floating_masks_only(wave):
    mask = torch.rand(2, *SIZE, generator=generator())
    assert torch.equal(warp_labels(tv.Mask(mask), wave, soft_masks=True), warp_mask(mask, wave, soft=True))
    assert torch.equal(warp_labels(tv.Mask(mask), wave), warp_mask(mask, wave))
    binary = tv.Mask(mask > 0.5)
    assert torch.equal(warp_labels(binary, wave, soft_masks=True), warp_mask(mask > 0.5, wave))


def test_nesting_and_plain_values_are_kept():
    image, ids = (
        tv.Image(torch.randint(0, 256, (3, *SIZE), generator=generator(), dtype=torch.uint8)),
        torch.tensor([1, 2]),
    )
    array = np.arange(3)
    sample = Sample(
        image=OrderedDict(a=[image, (image, None)], b="name"),
        target={"ids": ids, "n": 3, "scale": 1.5, "path": Path("a/b"), "array": array, "empty": [], "flag": True},
    )
    warped = warp_labels(sample, hflip())
    assert type(warped) is Sample
    assert type(warped.image) is OrderedDict
    assert list(warped.image) == ["a", "b"]
    assert type(warped.image["a"][1]) is tuple
    assert torch.equal(warped.image["a"][1][0], F.horizontal_flip(image))
    assert warped.image["a"][1][1] is None
    assert warped.target["ids"] is ids
    assert warped.target["array"] is array
    rest = {key: warped.target[key] for key in ("n", "scale", "path", "empty", "flag")}
    assert rest == {"n": 3, "scale": 1.5, "path": Path("a/b"), "empty": [], "flag": True}


@pytest.mark.parametrize(
    "wrapped", [lambda d: d, lambda d: (tv.Image(torch.rand(3, *SIZE, generator=generator())), d), lambda d: {"x": [d]}]
)
def test_dropped_boxes_take_their_labels_and_masks_along(wrapped):
    sample = detection()
    warped = warp_labels(wrapped(sample), SHIFT)
    while not (isinstance(warped, dict) and "boxes" in warped):
        warped = warped["x"] if isinstance(warped, dict) else warped[-1]
    assert warped["boxes"].tolist() == [[10.0, 5.0, 30.0, 20.0], [0.0, 20.0, 10.0, 30.0]]
    assert warped["labels"].tolist() == [7, 9]
    assert torch.equal(warped["masks"], warp_mask(sample["masks"].as_subclass(Tensor)[[0, 2]], SHIFT))
    assert warped["image_id"] == 42
    assert type(warped["masks"]) is tv.Mask


def test_boxes_below_the_limits_are_dropped():
    warped = warp_labels(detection(), SHIFT, min_visibility=0.7)
    assert warped["labels"].tolist() == [7]
    warped = warp_labels(detection(), SHIFT, min_area=200)
    assert warped["labels"].tolist() == [7]
    warped = warp_labels(detection(), SHIFT, clip=False)
    assert warped["boxes"].tolist() == [[10.0, 5.0, 30.0, 20.0], [-5.0, 20.0, 10.0, 30.0]]


@pytest.mark.parametrize("form", PLAIN_FORMATS)
def test_a_box_of_integers_that_rounding_leaves_no_area_is_dropped(form):
    boxes = boxes_of([[6.0, 4.0, 7.0, 10.0], [30.0, 6.0, 50.0, 20.0]])
    boxes = v2.functional.convert_bounding_box_format(boxes, new_format=form)
    x = torch.arange(SIZE[1]).float().expand(SIZE)
    flow = torch.stack([1.5 * x, torch.zeros(SIZE)])  # the first box becomes 0.4 px wide
    for dtype, labels in ((torch.float32, [7, 8]), (torch.int64, [8])):
        sample = {"boxes": tv.wrap(boxes.as_subclass(Tensor).to(dtype), like=boxes), "labels": torch.tensor([7, 8])}
        assert warp_labels(sample, flow)["labels"].tolist() == labels


def test_drop_matches_the_sanitizer_of_torchvision():
    sample = detection()
    kept = warp_labels(sample, SHIFT, drop=False)
    assert kept["labels"] is sample["labels"]
    assert kept["boxes"].shape == (3, 4)
    assert kept["boxes"][1, :2].tolist() == kept["boxes"][1, 2:].tolist()
    sane, dropped = v2.SanitizeBoundingBoxes()(kept), warp_labels(sample, SHIFT)
    for key in ("boxes", "labels", "masks"):
        assert torch.equal(sane[key], dropped[key])


@pytest.mark.parametrize("form", ROTATED_FORMATS)
def test_invisible_rotated_boxes_are_dropped_or_get_zero_area(form):
    flow = torch.tensor([25.0, 0.0]).view(2, 1, 1).expand(2, *SIZE)
    sample = {"boxes": rotated_of(form), "labels": torch.arange(3)}
    assert warp_labels(sample, flow)["labels"].tolist() == [1, 2]
    degenerate = corner_set(warp_labels(sample, flow, drop=False)["boxes"])
    assert (degenerate[0] - degenerate[0, :1]).abs().max() < 1e-4
    assert (degenerate[1] - degenerate[1, :1]).abs().max() > 1


def test_all_rows_of_dropped_boxes_are_removed():
    sample = detection()
    rows = {
        "area": torch.tensor([300.0, 60.0, 150.0]),
        "iscrowd": torch.tensor([[0], [1], [0]]),
        "points": tv.KeyPoints(torch.rand(3, 17, 2, generator=generator()) * 20, canvas_size=SIZE),
        "scores": np.array([0.9, 0.8, 0.7]),
        "names": ["car", "dog", "sign"],
        "tracks": [[1, 2], [3], [4, 5, 6]],
    }
    of_image = {"image_id": torch.tensor([7, 7, 7]), "orig_size": (3, 36, 64), "camera_matrix": torch.eye(3)}
    # Of the whole image by the names that MMDetection and Ultralytics give.
    of_image |= dict.fromkeys(("ori_shape", "pad_shape", "resized_shape", "canvas_size", "resolution"), (36, 64, 3))
    of_image |= {"scale_factor": [1.0, 1.0, 1.0], "ratio_pad": ((1.0, 1.0), (0.0, 0.0), (0.0, 0.0))}
    other = {"semantic": tv.Mask(torch.zeros(SIZE)), "image": tv.Image(torch.rand(3, *SIZE)), "ids": torch.arange(4)}
    warped = warp_labels(sample | rows | of_image | other, SHIFT)
    for key, value in (rows | {key: sample[key] for key in ("boxes", "labels", "masks")}).items():
        assert len(warped[key]) == 2, key
        assert type(warped[key]) is type(value)
    assert warped["area"].tolist() == [300, 150]
    assert warped["iscrowd"].tolist() == [[0], [0]]
    assert warped["scores"].tolist() == [0.9, 0.7]
    assert warped["names"] == ["car", "sign"]
    assert warped["tracks"] == [[1, 2], [4, 5, 6]]
    assert all(warped[key] is value for key, value in of_image.items())
    assert warped["image"].shape == (3, *SIZE)
    assert warped["ids"] is other["ids"]


@pytest.mark.parametrize("name", ["semantic_mask", "sem_seg", "depth"])
def test_a_map_of_the_image_stays_though_its_only_box_leaves_the_frame(name):
    boxes = tv.BoundingBoxes(torch.tensor([[0.0, 0, 2, 2]]), format="XYXY", canvas_size=SIZE)
    warped = warp_labels({"boxes": boxes, name: tv.Mask(torch.ones(1, *SIZE))}, SHIFT)
    assert (len(warped["boxes"]), warped[name].shape) == (0, (1, *SIZE))


@pytest.mark.parametrize("is_list", [False, True])
def test_lanes_stay_though_there_are_as_many_as_boxes(is_list):
    points = torch.full((3, 5, 2), 20.0)
    lanes = [tv.KeyPoints(of, canvas_size=SIZE) for of in points] if is_list else tv.KeyPoints(points, canvas_size=SIZE)
    warped = warp_labels(detection() | {"lanes": lanes, "lane_ids": torch.tensor([0, 1, 2])}, SHIFT)
    assert (len(warped["boxes"]), len(warped["lanes"]), warped["lane_ids"].tolist()) == (2, 3, [0, 2])
    assert warped["lanes"][1][0].tolist() == [0, 20]


def test_lists_with_a_dict_mask_or_tensor_for_each_box_lose_those_of_dropped_boxes():
    sample, generated = detection(), generator()
    points = [tv.KeyPoints(torch.rand(17, 2, generator=generated) * 20, canvas_size=SIZE) for _ in range(3)]
    rows = {
        "attributes": [{"occluded": 0, "parts": [1]}, {"occluded": 1}, {"occluded": 2}],
        "tracks": (torch.tensor(5), torch.tensor(6), torch.tensor(7)),
        "instances": [tv.Mask(mask) for mask in sample["masks"]],
        "pose": [{"points": of, "visible": torch.ones(17)} for of in points],
    }
    others = {"cameras": [{"name": name} for name in "abc"], "pairs": [torch.arange(3), {"a": 1}, 7], "two": [{}, {}]}
    warped = warp_labels(sample | rows | others, SHIFT)
    assert warped["attributes"] == [{"occluded": 0, "parts": [1]}, {"occluded": 2}]
    assert warped["tracks"] == (rows["tracks"][0], rows["tracks"][2])
    assert all(map(torch.equal, warped["instances"], warped["masks"]))
    for pose, expected in zip(warped["pose"], (points[0], points[2]), strict=True):
        moved = warp_labels({"points": expected, "visible": torch.ones(17)}, SHIFT)
        assert all(torch.equal(pose[name], moved[name]) for name in moved)
    assert warped["cameras"] == others["cameras"]
    assert warped["pairs"][0].tolist() == [0, 2]  # rows of a tensor, not entries of the list
    assert (len(warped["pairs"]), len(warped["two"])) == (3, 2)
    getter = warp_labels(sample | rows, SHIFT, labels_getter=lambda inputs: inputs["tracks"])
    assert (len(getter["tracks"]), len(getter["attributes"]), len(getter["labels"])) == (2, 3, 3)
    assert len(warp_labels(sample | rows, SHIFT, drop=False)["attributes"]) == 3


def test_a_matrix_that_loses_rows_with_the_boxes_is_warned_of():
    sample = detection() | {"K": torch.eye(3)}
    with pytest.warns(UserWarning, match=r"target\['K'\] has as many rows as there are boxes and lost those"):
        assert warp_labels(sample, SHIFT)["K"].shape == (2, 3)
    assert warp_labels(sample, 0 * SHIFT)["K"].shape == (3, 3)  # no box is removed, and nothing is said


def test_several_sets_of_boxes_take_the_rows_of_their_own_dict():
    far, near = boxes_of([[1.0, 1.0, 9.0, 9.0], [30.0, 5.0, 50.0, 20.0]]), boxes_of([[30.0, 5.0, 50.0, 20.0]] * 2)
    sample = {"car": {"boxes": far, "labels": torch.arange(2)}, "sign": {"boxes": near, "labels": torch.arange(2)}}
    warped = warp_labels(sample, SHIFT)
    assert warped["car"]["labels"].tolist() == [1]
    assert warped["sign"]["labels"].tolist() == [0, 1]
    assert warp_labels({"ann": {"boxes": far}, "labels": torch.arange(2)}, SHIFT)["labels"].tolist() == [1]


def test_labels_getter_selects_the_tensors_to_filter():
    sample = detection() | {"iscrowd": torch.tensor([0, 1, 2]), "ids": torch.arange(3)}
    warped = warp_labels(sample, SHIFT, labels_getter=lambda s: (s["labels"], s["iscrowd"]))
    assert (warped["labels"].tolist(), warped["iscrowd"].tolist()) == ([7, 9], [0, 2])
    assert warped["ids"] is sample["ids"]
    warped = warp_labels(sample, SHIFT, labels_getter=None)
    assert (len(warped["boxes"]), len(warped["labels"]), len(warped["masks"])) == (2, 3, 2)
    warped = warp_labels({"boxes": sample["boxes"], "my_Label": sample["labels"]}, SHIFT)
    assert warped["my_Label"].tolist() == [7, 9]
    warped = warp_labels([sample["boxes"], sample["labels"]], SHIFT)
    assert warped[1].tolist() == [7, 9]
    assert len(warp_labels(sample["boxes"], SHIFT)) == 2


def test_invisible_keypoints_lie_off_the_canvas_and_clear_their_visibility():
    points = tv.KeyPoints(torch.tensor([[[30.0, 10.0], [5.0, 10.0]], [[50.0, 30.0], [0.0, 0.0]]]), canvas_size=SIZE)
    for shape in [(2, 2), (2, 2, 1)]:
        flags = torch.full(shape, 2)
        warped = warp_labels({"points": points, "visibility": flags, "other": flags}, SHIFT)
        assert warped["visibility"].flatten().tolist() == [2, 0, 2, 0]
        assert warped["other"] is flags
    assert warped["points"].tolist() == [[[10.0, 10.0], [-15.0, 10.0]], [[30.0, 30.0], [-20.0, 0.0]]]
    hole = torch.zeros(2, *SIZE)
    hole[:, 5:15, 25:35] = torch.nan
    warped = warp_labels(points, hole)
    assert warped.tolist() == [[[-1.0, -1.0], [5.0, 10.0]], [[50.0, 30.0], [0.0, 0.0]]]
    singles = tv.wrap(warped.as_subclass(Tensor).reshape(-1, 2), like=warped)
    assert v2.SanitizeKeyPoints()({"points": singles})["points"].tolist() == [[5.0, 10.0], [50.0, 30.0], [0.0, 0.0]]


@pytest.mark.parametrize("key", ["visible", "keypoints_visible"])
def test_the_visibility_of_keypoints_is_cleared_in_arrays_and_lists_too(key):
    points = tv.KeyPoints(torch.tensor([[30.0, 10.0], [5.0, 10.0]]), canvas_size=SIZE)
    for flags, expected in (([True, True], [True, False]), ((2, 1), (2, 0))):
        moved = warp_labels({"points": points, key: flags}, SHIFT)[key]
        assert (type(moved), moved) == (type(expected), expected)
    array = warp_labels({"points": points, key: np.array([2, 2])}, SHIFT)[key]
    assert type(array) is np.ndarray
    assert array.tolist() == [2, 0]


@pytest.mark.parametrize(
    ("entry", "kind"),
    [
        ({"gt_bboxes": torch.zeros(2, 4)}, "BoundingBoxes"),
        ({"boxes_xyxy": [[1.0, 2, 3, 4]]}, "BoundingBoxes"),
        ({"box2d": {"x1": 1.0, "y1": 2.0, "x2": 3.0, "y2": 4.0}}, "BoundingBoxes"),
        ({"object": [{"bndbox": {"xmin": "1", "ymin": "2", "xmax": "3", "ymax": "4"}}]}, "BoundingBoxes"),
        ({"face_landmarks": np.zeros((5, 2))}, "KeyPoints"),
        ({"lanes": [[[1, 2], [3, 4]]]}, "KeyPoints"),
        ({"polygons": [[1.0, 2, 3, 4, 5, 6]]}, "Mask"),
        ({"masks": [{"counts": b"1", "size": [36, 64]}]}, "Mask"),
    ],
)
def test_plain_positions_under_names_of_other_data_sets_raise(entry, kind):
    with pytest.raises(TypeError, match=f"target.* must be a {kind} of torchvision to move with the image, got"):
        warp_labels(entry, SHIFT)


def test_names_that_only_resemble_those_of_positions_pass():
    target = {
        "num_keypoints": torch.zeros(2, 1),
        "boxes_3d": torch.zeros(2, 7),
        "box_scores": torch.zeros(2, 3),
        "keypoint_names": [["nose"], ["eye"]],
        "lanes": torch.arange(3),
        "size": {"width": "64", "height": "36"},
        "counts": torch.arange(4),
        "segmentation": {"name": "road"},
        "x": 3.0,
    }
    assert warp_labels(target, SHIFT) == target


def test_keypoints_on_the_outer_half_of_border_pixels_are_visible():
    rows = torch.tensor([[63.4, 20.0], [30.0, 35.4], [-0.4, -0.4], [63.6, 20.0], [5.0, 36.0]])
    points, flags = tv.KeyPoints(rows, canvas_size=SIZE), torch.ones(5)
    warped = warp_labels({"points": points, "visible": flags}, torch.zeros(2, *SIZE))
    assert torch.equal(warped["points"], points)
    assert warped["visible"].tolist() == [1, 1, 1, 0, 0]
    mirrored = warp_labels(points, hflip())
    assert_close(mirrored[:3].as_subclass(Tensor), F.horizontal_flip(points)[:3].as_subclass(Tensor))


def test_a_list_of_samples_takes_one_flow_each():
    flows = torch.stack([SHIFT, hflip()])
    samples = [(tv.Image(torch.rand(3, *SIZE, generator=generator())), detection()) for _ in range(2)]
    for i, (image, target) in enumerate(warp_labels(samples, flows)):
        alone = warp_labels(samples[i], flows[i])
        assert torch.equal(image, alone[0])
        assert all(torch.equal(target[key], alone[1][key]) for key in ("boxes", "labels", "masks"))


def test_a_batch_of_labels_takes_one_flow_each():
    flows = torch.stack([SHIFT, hflip()])
    sample = {
        "image": tv.Image(torch.rand(2, 3, *SIZE, generator=generator())),
        "video": tv.Video(torch.rand(2, 4, 3, *SIZE, generator=generator())),
        "mask": tv.Mask(torch.randint(0, 5, (2, *SIZE), generator=generator())),
        "points": tv.KeyPoints(torch.rand(2, 3, 2, generator=generator()) * 30, canvas_size=SIZE),
    }
    warped = warp_labels(sample, flows)
    for key, leaf in warped.items():
        for i in range(2):
            alone = tv.wrap(sample[key].as_subclass(Tensor)[i], like=sample[key])
            assert torch.equal(leaf[i], warp_labels(alone, flows[i])), key


def test_empty_boxes_masks_and_keypoints_stay_empty():
    sample = {
        "boxes": boxes_of(torch.zeros(0, 4)),
        "labels": torch.zeros(0, dtype=torch.int64),
        "masks": tv.Mask(torch.zeros(0, *SIZE, dtype=torch.bool)),
        "points": tv.KeyPoints(torch.zeros(0, 17, 2), canvas_size=SIZE),
    }
    warped = warp_labels(sample, SHIFT)
    for key, leaf in sample.items():
        assert (type(warped[key]), warped[key].shape, warped[key].dtype) == (type(leaf), leaf.shape, leaf.dtype)
    sample["boxes"] = tv.BoundingBoxes([], format="XYXY", canvas_size=SIZE)  # (1, 0), which torchvision passes on
    warped = warp_labels(sample, SHIFT)
    assert [tuple(warped[key].shape) for key in ("boxes", "labels", "points")] == [(1, 0), (0,), (0, 17, 2)]


def test_gradients_of_rotated_boxes_are_those_of_finite_differences(wave):
    rotated = rotated_of("XYXYXYXY")  # torchvision converts the other formats in place, and PyTorch raises
    boxes = tv.wrap(rotated.as_subclass(Tensor).double(), like=rotated)

    def positions(strength: Tensor) -> Tensor:
        moved = warp_labels({"boxes": boxes}, strength * wave.double(), drop=False)["boxes"].as_subclass(Tensor)
        return (moved * torch.linspace(1, 2, moved.numel()).double().view(moved.shape)).sum()

    strength, step = torch.tensor(0.7, dtype=torch.float64, requires_grad=True), 1e-5
    (gradient,) = torch.autograd.grad(positions(strength), strength)
    difference = (positions(strength + step) - positions(strength - step)).item() / (2 * step)
    assert gradient.item() == pytest.approx(difference, rel=1e-4)


def test_gradients_reach_the_flow_through_keypoints_and_boxes(wave):
    flow = wave.clone().requires_grad_()
    points = tv.KeyPoints(torch.tensor([[20.0, 10.0]]), canvas_size=SIZE)
    warped = warp_labels({"points": points, "boxes": boxes_of([[10.0, 8.0, 30.0, 25.0]])}, flow)
    for leaf in (warped["points"], warped["boxes"]):
        (gradient,) = torch.autograd.grad(leaf.as_subclass(Tensor).sum(), flow)
        assert gradient.isfinite().all()
        assert gradient.abs().sum() > 0.5


@pytest.mark.parametrize("form", PLAIN_FORMATS)
def test_boxes_of_torchvision_raise_in_warp_boxes(form, wave):
    with pytest.raises(TypeError, match=r"got BoundingBoxes of torchvision, .* pass them to warp_labels"):
        warp_boxes(boxes_of([[10.0, 12.0, 24.0, 20.0]], form), wave)


def test_unsupported_types_raise_a_type_error():
    class Skeleton(tv.TVTensor):
        """Derive from the base class, not from one of its types."""

    class Tagged(Tensor):
        """Derive from Tensor outside torchvision."""

    class Polygons:
        """Hold no tensor."""

    picture = pytest.importorskip("PIL.Image", reason="pillow is in the extra train").new("RGB", (SIZE[1], SIZE[0]))
    for leaf in (
        torch.rand(3, 2).as_subclass(Skeleton),
        torch.rand(2).as_subclass(Tagged),
        Polygons(),
        picture,
        {1, 2},
    ):
        with pytest.raises(TypeError, match=f"target must hold .* got .*{type(leaf).__name__}"):
            warp_labels({"x": [1, leaf]}, SHIFT)


def test_subclasses_of_tv_tensors_are_warped_and_keep_their_type():
    class Road(tv.Mask):
        """Rename a mask."""

    mask = torch.randint(0, 5, SIZE, generator=generator()).as_subclass(Road)
    warped = warp_labels(mask, hflip())
    assert type(warped) is Road
    assert torch.equal(warped.as_subclass(Tensor), mask.as_subclass(Tensor).flip(-1))


BOXES = boxes_of([[1.0, 2.0, 3.0, 4.0]])
SMALL = tv.KeyPoints(torch.zeros(1, 2), canvas_size=(5, 5))


@pytest.mark.parametrize(
    ("target", "options", "error", "message"),
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
        (SMALL, {}, ValueError, r"KeyPoints must have the canvas size of the flow, \(36, 64\), got \(5, 5\)"),
        (
            {"a": BOXES, "b": BOXES, "labels": torch.arange(1)},
            {},
            ValueError,
            "target must hold each BoundingBoxes in a",
        ),
        ({"boxes": BOXES, "labels": torch.arange(2)}, {}, ValueError, "labels must have one row for each of the 1"),
        ({"boxes": BOXES, "labels": "car"}, {}, ValueError, "labels must have one row .* got 'car'"),
        ([{"boxes": BOXES, "Label": ()}], {}, ValueError, r"labels must have one row .* got \(\)"),
        ({"boxes": torch.zeros(1, 4)}, {}, TypeError, r"target\['boxes'\] must be a BoundingBoxes of torchvision"),
        (
            [{"bbox": [1.0, 2.0, 3.0, 4.0]}],
            {},
            TypeError,
            r"target\[0\]\['bbox'\] must be a Bounding.* got a plain list",
        ),
        ({"Masks": [torch.zeros(SIZE)]}, {}, TypeError, r"target\['Masks'\]\[0\] must be a Mask of torchvision"),
        ({"keypoints": np.zeros((2, 17, 3))}, {}, TypeError, r"must be a KeyPoints .* got a plain ndarray"),
        ({"segmentation": [[1.0, 2.0, 3.0, 4.0]]}, {}, TypeError, "must be a Mask of torchvision"),
        ({"segmentation": {"counts": b"1", "size": [36, 64]}}, {}, TypeError, "must be a Mask of torchvision"),
        ({"classes": torch.zeros(1, *SIZE)}, {}, TypeError, r"target\['classes'\] must be of a torchvision type"),
        ({"depth": np.zeros((*SIZE, 1))}, {}, TypeError, r"got a plain ndarray \(36, 64, 1\); pass tv_tensors.Mask"),
        ({"p": tv.KeyPoints(torch.zeros(1, 2), canvas_size=SIZE), "visible": torch.ones(2)}, {}, ValueError, "visible"),
        ([1, 2, 3], {"flow": SHIFT[None]}, ValueError, "target must have one sample for each of the 1 flows, got 3"),
        ({"boxes": BOXES}, {"flow": SHIFT[None]}, ValueError, "target must be a list of .*, got BoundingBoxes$"),
        (tv.Mask(torch.zeros(SIZE)), {"flow": SHIFT[None]}, ValueError, "target must have the batch of the flow, 1"),
    ],
)
def test_invalid_options_and_targets_raise(target, options, error, message):
    options = {"flow": SHIFT} | options
    with pytest.raises(error, match=message):
        warp_labels(target, **options)

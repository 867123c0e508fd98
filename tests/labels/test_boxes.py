from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import LensDistortion, ThinPlateSpline, warp_boxes

SIZE = (90, 140)
FRAME = [-0.5, -0.5, SIZE[1] - 0.5, SIZE[0] - 0.5]


def clipped(boxes: Tensor) -> Tensor:
    low, high = torch.tensor(FRAME[:2] * 2), torch.tensor(FRAME[2:] * 2)
    return boxes.maximum(low.to(boxes)).minimum(high.to(boxes))


@pytest.mark.quick
def test_zero_flow_only_clips_boxes_to_the_frame():
    boxes = torch.tensor(
        [
            [10.25, 20.5, 30.75, 41.0],
            [-30.0, -20.0, 12.5, 14.0],
            [100.0, 50.0, 180.0, 170.0],
            [-9.0, -9.0, 999.0, 999.0],
        ]
    )
    flow = torch.zeros(2, *SIZE)
    warped, keep = warp_boxes(boxes, flow)
    assert_close(warped, clipped(boxes), rtol=0, atol=1e-4)
    assert torch.equal(warped[0], boxes[0])
    assert keep.all()
    assert_close(warp_boxes(boxes, flow, clip=False)[0], boxes, rtol=0, atol=1e-4)


@pytest.mark.quick
def test_boxes_follow_a_shift():
    flow = torch.tensor([10.0, -5.0]).view(2, 1, 1).expand(2, *SIZE)
    boxes = torch.tensor([[20.0, 30.0, 50.0, 60.0], [4.0, 30.0, 24.0, 60.0], [2.0, 3.0, 8.0, 9.0]])
    warped, keep = warp_boxes(boxes, flow)
    assert warped[:2].tolist() == [[10.0, 35.0, 40.0, 65.0], [-0.5, 35.0, 14.0, 65.0]]
    assert keep.tolist() == [True, True, False]
    assert (warped[2, 2:] - warped[2, :2]).tolist() == [0.0, 0.0]
    unclipped, keep = warp_boxes(boxes, flow, clip=False)
    assert unclipped.tolist() == [[10.0, 35.0, 40.0, 65.0], [-6.0, 35.0, 14.0, 65.0], [-8.0, 8.0, -2.0, 14.0]]
    assert keep.tolist() == [True, True, False]


@pytest.mark.quick
def test_a_box_of_which_the_frame_leaves_less_than_a_pixel_is_not_kept():
    flow = torch.tensor([10.0, -5.0]).view(2, 1, 1).expand(2, *SIZE)
    boxes = torch.tensor([[4.0, 30.0, 9.7, 60.0], [4.0, 30.0, 10.6, 60.0], [20.0, 30.0, 20.2, 60.0]])
    assert warp_boxes(boxes, flow)[1].tolist() == [False, True, True]  # 0.2, 1.1 and all 0.2 px are left


@pytest.mark.quick
def test_a_box_without_an_area_has_no_inside():
    flow = torch.tensor([10.0, -5.0]).view(2, 1, 1).expand(2, *SIZE)
    boxes = torch.tensor([[20.0, 30.0, 20.0, 30.0], [0, 0, 0, 0], [300, 300, 300, 300], [20, 30, 20, 60]])
    warped, keep = warp_boxes(boxes, flow, clip=False)
    assert warped.tolist() == (boxes - torch.tensor([10.0, -5.0, 10.0, -5.0])).tolist()
    assert not keep.any()


def mask_bounds(box: Tensor, source: tuple[Tensor, Tensor]) -> Tensor | None:
    """Return the bounds of all output pixels that show the inside of a box, from edge to edge, or None."""
    x, y = source
    rows, columns = ((x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])).nonzero().T
    if len(rows) == 0:
        return None
    return torch.stack([columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5])


def flow_named(name: str, pixels, waves, size: tuple[int, int]) -> Tensor:
    x, y = pixels(*size)
    image = torch.zeros(1, 1, *size, dtype=torch.float64)
    if name == "long wave":
        return waves(x, y, 30.0, 150.0)[0]
    if name == "short wave":
        return waves(x, y, 2.0, 10.0)[0]
    if name == "thin-plate spline":
        return ThinPlateSpline().degrade(image, seed=3).flow[0]
    if name == "lens":
        return LensDistortion().degrade(image, seed=3).flow[0]
    folding = LensDistortion(k1_range=(-0.6, -0.6), k2_range=(0.0, 0.0), focal_range=(0.7, 0.7), frame="pad")
    with pytest.warns(UserWarning, match="fold"):
        return folding.degrade(image, seed=3).flow[0]


@pytest.mark.parametrize("name", ["long wave", "short wave", "thin-plate spline", "lens", "lens that folds"])
def test_boxes_contain_the_warped_mask_of_their_inside(pixels, waves, name, random_boxes, oracle):
    size = (180, 320)
    flow = flow_named(name, pixels, waves, size)
    x, y = pixels(*size)
    boxes = random_boxes(200, size=size)
    warped, keep = warp_boxes(boxes, flow)
    missing, excess = [], []
    for box, result, is_kept in zip(boxes, warped, keep, strict=True):
        bounds = mask_bounds(box, (x + flow[0], y + flow[1]))
        if bounds is None:
            continue
        assert is_kept
        slack = torch.cat([bounds[:2] - result[:2], result[2:] - bounds[2:]])
        missing.append(-slack.min())
        excess.append(slack.max())
    assert len(missing) > 180
    # Where the lens folds back the outline ends; beyond it, only a lattice of 49 probes a side finds the inside.
    limit = 2 * size[1] / 48 if name == "lens that folds" else 1.0
    distance = torch.stack(missing).clamp(min=0)
    oracle(f"boxes around warped masks, {name}", distance, torch.zeros_like(distance), limit)
    # Boxes are not wider than the mask either, except for slivers without a pixel center.
    assert torch.stack(excess).quantile(0.9) <= 1.5


def test_a_box_keeps_its_visible_part_where_its_outline_is_invisible(pixels):
    x, y = pixels(*SIZE)
    # The frame shows only what lies within 20 px of (70, 45), magnified twice; the flow is invalid elsewhere.
    flow = torch.stack([70 + (x - 70) / 2 - x, 45 + (y - 45) / 2 - y])
    flow[:, ((x - 70).abs() > 40) | ((y - 45).abs() > 40)] = torch.nan
    boxes = torch.tensor([[60.0, 35.0, 200.0, 55.0], [0.0, 0.0, 140.0, 90.0], [0.0, 0.0, 20.0, 20.0]]).double()
    warped, keep = warp_boxes(boxes, flow)
    assert keep.tolist() == [True, True, False]
    # An edge of 140 px has 64 samples, magnified twice.
    assert_close(warped[0], torch.tensor([50.0, 25.0, 110.0, 65.0]).double(), rtol=0, atol=2 * 140 / 63)
    # No point of this outline is visible: the probes, 3 px apart, find the inside.
    assert_close(warped[1], torch.tensor([30.0, 5.0, 110.0, 85.0]).double(), rtol=0, atol=3.0)
    assert warped.isfinite().all()


@pytest.mark.quick
def test_boxes_below_the_limits_are_not_kept():
    flow = torch.zeros(2, *SIZE)
    boxes = torch.tensor([[10.0, 10.0, 20.0, 18.0], [-10.5, 10.0, 9.5, 30.0], [5.0, 5.0, 5.0, 30.0]])
    # Areas of 80, 200 (of 400) and 0 px^2.
    for limits, expected in [
        ({"min_area": 80.0}, [True, True, False]),
        ({"min_area": 80.1}, [False, True, False]),
        ({"min_visibility": 0.499}, [True, True, False]),
        ({"min_visibility": 0.501, "clip": False}, [True, False, False]),
        ({"min_visibility": 1.0}, [True, False, False]),
        ({"min_area": 201.0, "clip": False}, [False, False, False]),
    ]:
        options: dict[str, Any] = limits
        assert warp_boxes(boxes, flow, **options)[1].tolist() == expected, limits


def test_a_batch_of_boxes_equals_its_samples(pixels, waves, random_boxes):
    flow = torch.cat([waves(*pixels(*SIZE), 8.0, 40.0), torch.full((1, 2, *SIZE), 3.0)]).float()
    boxes = random_boxes(2 * 5).float().view(2, 5, 4)
    batch = warp_boxes(boxes, flow)
    for i in range(2):
        assert all(map(torch.equal, warp_boxes(boxes[i], flow[i]), (value[i] for value in batch)))
    shared = warp_boxes(boxes, flow[:1])[0]
    assert torch.equal(shared, warp_boxes(boxes, flow[:1].expand(2, -1, -1, -1))[0])


def test_boxes_on_an_accelerator_are_warped_without_reading_values():
    # Tensors on "meta" have no values, so that reading one raises.
    boxes, flow = torch.zeros(2, 3, 4, device="meta"), torch.zeros(2, 2, *SIZE, device="meta")
    warped, keep = warp_boxes(boxes, flow)
    assert (warped.shape, keep.shape) == ((2, 3, 4), (2, 3))


def test_an_empty_list_of_boxes_stays_empty():
    boxes, keep = warp_boxes(torch.zeros(0, 4), torch.zeros(2, *SIZE))
    assert (boxes.shape, keep.shape) == ((0, 4), (0,))


FLOW = torch.zeros(2, 2, 5, 6)
BOXES = torch.zeros(2, 3, 4)


@pytest.mark.parametrize(
    ("boxes", "options", "error", "message"),
    [
        (torch.zeros(2, 3, 5), {}, ValueError, r"boxes must have shape \(B, N, 4\)"),
        (BOXES, {"min_area": -1.0}, ValueError, "min_area must be a number of at least 0"),
        (BOXES, {"min_visibility": 1.5}, ValueError, r"min_visibility must be .* \[0, 1\]"),
        (BOXES, {"clip": 1}, TypeError, "clip must be True or False"),
        (BOXES, {"samples": 1}, ValueError, "samples must be at least 2, got 1"),
        (BOXES, {"min_size": 3}, TypeError, "min_size"),
        (BOXES - torch.arange(4), {}, ValueError, "boxes must have x1 <= x2 and y1 <= y2, got -2"),
        (BOXES * torch.nan, {}, ValueError, "boxes must have x1 <= x2 and y1 <= y2, got nan"),
    ],
)
def test_invalid_boxes_and_limits_raise(boxes, options, error, message):
    with pytest.raises(error, match=message):
        warp_boxes(boxes, FLOW, **options)

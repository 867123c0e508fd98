from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import DivergenceFree, LensDistortion, ThinPlateSpline, Turbulence, warp_boxes
from torchrefract.labels.boxes import warp_outlines

SIZE = (90, 140)
FRAME = [-0.5, -0.5, SIZE[1] - 0.5, SIZE[0] - 0.5]


def test_boxes_stay_without_a_flow_and_are_clipped_to_the_frame():
    boxes = torch.tensor(
        [
            [10.25, 20.5, 30.75, 41.0],
            [-30.0, -20.0, 12.5, 14.0],
            [100.0, 50.0, 180.0, 170.0],
            [-9.0, -9.0, 999.0, 999.0],
        ]
    )
    flow = torch.zeros(2, *SIZE)
    clipped, keep = warp_boxes(boxes, flow)
    low, high = torch.tensor(FRAME[:2] * 2), torch.tensor(FRAME[2:] * 2)
    assert_close(clipped, torch.minimum(torch.maximum(boxes, low), high), rtol=0, atol=1e-4)
    assert torch.equal(clipped[0], boxes[0])
    assert keep.all()
    assert_close(warp_boxes(boxes, flow, clip=False)[0], boxes, rtol=0, atol=1e-4)


def test_boxes_follow_a_shift(pixels):
    flow = torch.tensor([10.0, -5.0]).view(2, 1, 1).expand(2, *SIZE)
    boxes = torch.tensor([[20.0, 30.0, 50.0, 60.0], [4.0, 30.0, 24.0, 60.0], [2.0, 3.0, 8.0, 9.0]])
    moved, keep = warp_boxes(boxes, flow)
    assert moved[:2].tolist() == [[10.0, 35.0, 40.0, 65.0], [-0.5, 35.0, 14.0, 65.0]]
    assert keep.tolist() == [True, True, False]
    assert (moved[2, 2:] - moved[2, :2]).tolist() == [0.0, 0.0]
    unclipped, keep = warp_boxes(boxes, flow, clip=False)
    assert unclipped.tolist() == [[10.0, 35.0, 40.0, 65.0], [-6.0, 35.0, 14.0, 65.0], [-8.0, 8.0, -2.0, 14.0]]
    assert keep.tolist() == [True, True, False]


@pytest.mark.parametrize("axis", [0, 1], ids=["x", "y"])
@pytest.mark.parametrize("clip", [True, False])
def test_boxes_follow_flips(flip, clip, random_boxes, axis):
    boxes = random_boxes(100)
    moved, _ = warp_boxes(boxes, flip(axis, *SIZE), clip=clip)
    expected = boxes.clone()
    expected[:, axis], expected[:, axis + 2] = (SIZE[1 - axis] - 1 - boxes[:, k] for k in (axis + 2, axis))
    if clip:
        frame = torch.tensor(FRAME, dtype=torch.float64)
        expected = torch.minimum(torch.maximum(expected, frame[:2].repeat(2)), frame[2:].repeat(2))
    assert_close(moved, expected, rtol=0, atol=1e-9)


def mask_bounds(box: Tensor, flow: Tensor, pixels) -> Tensor | None:
    """The bounds of all output pixels that show the inside of a box, from edge to edge, or None."""
    x, y = pixels(*flow.shape[1:])
    u, v = x + flow[0], y + flow[1]
    rows, columns = ((u >= box[0]) & (u <= box[2]) & (v >= box[1]) & (v <= box[3])).nonzero().T
    if len(rows) == 0:
        return None
    return torch.stack([columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5])


FLOWS = (
    "a long wave",
    "a wave",
    "a short wave",
    "LensDistortion",
    "Turbulence",
    "ThinPlateSpline",
    "DivergenceFree",
    "a lens that folds",
)


def flows_of_all_kinds(pixels, waves, size: tuple[int, int]) -> list[Tensor]:
    x, y = pixels(*size)
    flows = [waves(x, y, amplitude, length)[0] for amplitude, length in ((30.0, 150.0), (8.0, 40.0), (2.0, 10.0))]
    lens = LensDistortion().degrade(torch.zeros(1, 1, *size, dtype=torch.float64), seed=3).flow
    folding = LensDistortion(k1_range=(-0.6, -0.6), k2_range=(0.0, 0.0), focal_range=(0.7, 0.7))
    with pytest.warns(UserWarning, match="fold back"):
        hidden = folding.degrade(torch.zeros(1, 1, *size, dtype=torch.float64), seed=3).flow
    others = [
        effect.degrade(torch.zeros(1, 1, *size, dtype=torch.float64), seed=3).flow[0]
        for effect in (Turbulence(), ThinPlateSpline(), DivergenceFree())
    ]
    return [*flows, lens[0], *others, hidden[0]]


@pytest.mark.parametrize("which", range(len(FLOWS)), ids=FLOWS)
def test_a_thousand_boxes_hold_their_warped_masks(pixels, waves, which, random_boxes, oracle):
    size = (180, 320)
    flow = flows_of_all_kinds(pixels, waves, size)[which]
    boxes = random_boxes(1000, size=size, seed=which)
    moved, keep = warp_boxes(boxes, flow)
    lacking, loose = [], []
    for box, got, kept in zip(boxes, moved, keep, strict=True):
        bounds = mask_bounds(box, flow, pixels)
        if bounds is None:
            continue
        assert kept
        slack = torch.cat([bounds[:2] - got[:2], got[2:] - bounds[2:]])
        lacking.append(-slack.min())
        loose.append(slack.max())
    assert len(lacking) > 900
    # Where the lens folds back, the outline ends, and a lattice of 49 places a side tells what is seen beyond its end.
    bar = 2 * size[1] / 48 if FLOWS[which] == "a lens that folds" else 1.0
    lack = torch.stack(lacking).clamp(min=0)
    oracle(f"1 000 boxes under {FLOWS[which]} lack of their masks", lack, torch.zeros_like(lack), bar)
    # Nor are they wider than the mask, but for slivers that hold no pixel center.
    assert torch.stack(loose).quantile(0.9) <= 1.5


def test_an_outline_that_nowhere_lands_does_not_destroy_its_box(pixels):
    x, y = pixels(*SIZE)
    # The frame shows only what lies within 20 px of (70, 45), drawn twice as large; all else shows nothing.
    flow = torch.stack([70 + (x - 70) / 2 - x, 45 + (y - 45) / 2 - y])
    flow[:, ((x - 70).abs() > 40) | ((y - 45).abs() > 40)] = torch.nan
    boxes = torch.tensor([[60.0, 35.0, 200.0, 55.0], [0.0, 0.0, 140.0, 90.0], [0.0, 0.0, 20.0, 20.0]]).double()
    moved, keep = warp_boxes(boxes, flow)
    assert keep.tolist() == [True, True, False]
    # An edge of 140 px has 64 samples, and the frame shows it twice as large.
    assert_close(moved[0], torch.tensor([50.0, 25.0, 110.0, 65.0]).double(), rtol=0, atol=2 * 140 / 63)
    # Its outline lies wholly in what is not shown: places on a lattice of the frame, 3 px apart, tell what is.
    assert_close(moved[1], torch.tensor([30.0, 5.0, 110.0, 85.0]).double(), rtol=0, atol=3.0)
    assert moved.isfinite().all()


def test_small_and_hardly_visible_boxes_are_not_kept():
    flow = torch.zeros(2, *SIZE)
    boxes = torch.tensor([[10.0, 10.0, 20.0, 18.0], [-10.5, 10.0, 9.5, 30.0], [5.0, 5.0, 5.0, 30.0]])
    # Areas of 80, 200 (of 400) and 0 px^2.
    for limits, expected in [
        ({}, [True, True, False]),
        ({"min_area": 80.0}, [True, True, False]),
        ({"min_area": 80.1}, [False, True, False]),
        ({"min_visibility": 0.499}, [True, True, False]),
        ({"min_visibility": 0.501}, [True, False, False]),
        ({"min_visibility": 1.0}, [True, False, False]),
        ({"min_visibility": 0.501, "clip": False}, [True, False, False]),
        ({"min_area": 201.0, "clip": False}, [False, False, False]),
    ]:
        options: dict[str, Any] = limits
        assert warp_boxes(boxes, flow, **options)[1].tolist() == expected, limits


def test_extents_along_turned_axes_are_those_of_the_turned_points():
    corners = torch.tensor([[40.0, 30.0], [60.0, 30.0], [60.0, 50.0], [40.0, 50.0]]).double()[None, None]
    outlines = warp_outlines(corners, torch.zeros(1, 2, *SIZE, dtype=torch.float64), samples=9)
    axes = torch.tensor([[1.0, 1.0], [-1.0, 1.0]]).double()[None, None] / 2**0.5
    low, high = outlines.extent(axes).whole
    # x + y runs from 70 to 110, y - x from -30 to 10.
    assert_close(low[0, 0] * 2**0.5, torch.tensor([70.0, -30.0]).double(), rtol=0, atol=1e-9)
    assert_close(high[0, 0] * 2**0.5, torch.tensor([110.0, 10.0]).double(), rtol=0, atol=1e-9)


def test_gradients_of_boxes_are_those_of_finite_differences(pixels, waves):
    flow = (waves(*pixels(12, 14), 0.3, 3.0)).requires_grad_()
    boxes = torch.tensor([[[2.3, 3.6, 7.45, 8.7], [-1.8, 2.2, 3.9, 20.3]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda b, f: warp_boxes(b, f, samples=5)[0], [boxes, flow])


def test_a_batch_is_each_sample_alone_bit_for_bit(pixels, waves, random_boxes):
    x, y = pixels(*SIZE)
    flow = torch.cat([waves(x, y, 8.0, 40.0 + i) for i in range(3)] + [torch.full((1, 2, *SIZE), 3.0)]).float()
    boxes = random_boxes(4 * 5).float().view(4, 5, 4)
    whole = warp_boxes(boxes, flow)
    for i in range(4):
        alone = warp_boxes(boxes[i], flow[i])
        assert all(torch.equal(one, many[i]) for one, many in zip(alone, whole, strict=True))
    one = warp_boxes(boxes, flow[:1])[0]
    assert torch.equal(one, warp_boxes(boxes, flow[:1].expand(4, -1, -1, -1))[0])


def test_no_value_is_read_where_that_would_wait_for_a_device():
    # Tensors of this device have no values, so that reading one raises.
    boxes, flow = torch.zeros(2, 3, 4, device="meta"), torch.zeros(2, 2, *SIZE, device="meta")
    moved, keep = warp_boxes(boxes, flow)
    assert (moved.shape, keep.shape) == ((2, 3, 4), (2, 3))


def test_none_of_boxes_stay_none():
    boxes, keep = warp_boxes(torch.zeros(0, 4), torch.zeros(2, *SIZE))
    assert (boxes.shape, keep.shape) == ((0, 4), (0,))


FLOW = torch.zeros(2, 2, 5, 6)
ONE = torch.zeros(2, 5, 6)
BOXES = torch.zeros(2, 3, 4)


@pytest.mark.parametrize(
    ("call", "kind", "rule"),
    [
        (lambda: warp_boxes(torch.zeros(2, 3, 5), FLOW), ValueError, r"boxes must have shape \(B, N, 4\)"),
        (lambda: warp_boxes(BOXES, FLOW, min_area=-1.0), ValueError, "min_area must be a number of at least 0"),
        (lambda: warp_boxes(BOXES, FLOW, min_visibility=1.5), ValueError, r"min_visibility must be .* \[0, 1\]"),
        (lambda: warp_boxes(BOXES, FLOW, clip=1), TypeError, "clip must be True or False"),  # pyright: ignore[reportArgumentType]  # the point
        (lambda: warp_boxes(BOXES, FLOW, samples=1), ValueError, "samples must be at least 2, got 1"),
        (
            lambda: warp_boxes(BOXES - torch.arange(4), FLOW),
            ValueError,
            "boxes must have x1 <= x2 and y1 <= y2, got -2",
        ),
        (lambda: warp_boxes(BOXES * torch.nan, FLOW), ValueError, "boxes must have x1 <= x2 and y1 <= y2, got nan"),
    ],
)
def test_what_does_not_fit_raises(call, kind, rule):
    with pytest.raises(kind, match=rule):
        call()


def test_unknown_arguments_raise():
    options: dict[str, Any] = {"min_size": 3}
    with pytest.raises(TypeError, match="min_size"):
        warp_boxes(BOXES, FLOW, **options)

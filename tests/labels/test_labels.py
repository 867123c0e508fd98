from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import LensDistortion, warp, warp_boxes, warp_depth, warp_mask, warp_points
from torchrefract.cameras.distortion import distort_polynomial
from torchrefract.labels.boxes import warp_outlines

SIZE = (90, 140)
FRAME = [-0.5, -0.5, SIZE[1] - 0.5, SIZE[0] - 0.5]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_points(*shape: int, size: tuple[int, int] = SIZE, seed: int = 0) -> Tensor:
    """(*shape, 2), px, fp64, anywhere between the pixel centers of the frame."""
    ends = torch.tensor([size[1] - 1, size[0] - 1])
    return torch.rand(*shape, 2, generator=generator(seed), dtype=torch.float64) * ends


def random_boxes(count: int, size: tuple[int, int] = SIZE, seed: int = 0) -> Tensor:
    """(count, 4), px, fp64, some of which reach over the frame."""
    middle = random_points(count, size=size, seed=seed)
    half = torch.rand(count, 2, generator=generator(seed + 1), dtype=torch.float64) * min(size) * 0.4 + 1
    return torch.cat([middle - half, middle + half], dim=1)


def newton(shift, points: Tensor) -> Tensor:
    """q with q + shift(q) = p for an analytic flow, by 60 Newton steps in fp64 from p - shift(p)."""
    q, step = points - shift(points), 1e-5
    for _ in range(60):
        error = q + shift(q) - points
        columns = [
            (shift(q + step * way) - shift(q - step * way)) / (2 * step) + way
            for way in torch.eye(2, dtype=torch.float64)
        ]
        q = q - torch.linalg.solve(torch.stack(columns, dim=-1), error)
    assert (q + shift(q) - points).norm(dim=-1).max() < 1e-9
    return q


def hflip(pixels, height: int, width: int) -> Tensor:
    x, y = pixels(height, width)
    return torch.stack([width - 1 - 2 * x, 0 * y])


def vflip(pixels, height: int, width: int) -> Tensor:
    x, y = pixels(height, width)
    return torch.stack([0 * x, height - 1 - 2 * y])


def inside(points: Tensor, size: tuple[int, int], margin: float = 0.0) -> Tensor:
    x, y = points.unbind(-1)
    return (x >= margin) & (x <= size[1] - 1 - margin) & (y >= margin) & (y <= size[0] - 1 - margin)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(
    ("amplitude_px", "length"), [(30.0, 150.0), (12.0, 60.0), (5.0, 30.0), (1.0, 8.0), (0.02, 60.0)]
)
def test_points_land_where_60_newton_steps_on_the_analytic_flow_put_them(pixels, waves, amplitude_px, length, dtype):
    size = (180, 320)
    flow = waves(*pixels(*size), amplitude_px, length)[0].to(dtype)
    points = random_points(2000, size=size)
    exact = newton(lambda q: waves(q[:, 0], q[:, 1], amplitude_px, length)[0].T, points)
    landed, visible = warp_points(points.to(dtype), flow)
    error = (landed.double() - exact).norm(dim=1)
    print(f"largest error {error[visible].max():.1e} px")
    assert landed.dtype == dtype
    assert error[visible].max() <= 0.02
    # What lands off the frame, and that alone, is not seen.
    assert visible[inside(exact, size, 0.01)].all()
    assert not visible[~inside(exact, size, -0.03)].any()
    assert visible.float().mean() > 0.7


@pytest.mark.parametrize("seed", range(4))
def test_points_land_where_the_closed_form_of_the_lens_puts_them(seed):
    size = (180, 320)
    degraded = LensDistortion().degrade(torch.zeros(1, 3, *size), seed=seed)
    assert degraded.flow is not None
    points = random_points(2000, size=size, seed=seed)
    params = degraded.params
    middle = torch.tensor([size[1] - 1, size[0] - 1]) / 2 + params.center[0].double() * size[1]
    x, y = ((points - middle) / (params.focal[0].double() * size[1])).T
    distorted = distort_polynomial(x[None], y[None], params.coefficients.double()[..., None])
    exact = torch.cat(distorted).T * params.focal[0].double() * size[1] + middle
    landed, visible = warp_points(points.float()[None], degraded.flow)
    error = (landed[0] - exact).norm(dim=1)
    print(f"largest error {error[visible[0]].max():.1e} px, of a warp by {(exact - points).norm(dim=1).max():.0f} px")
    assert (exact - points).norm(dim=1).max() > 5
    assert error.max() <= 0.02
    assert torch.equal(visible[0], inside(exact, size))


def test_without_a_flow_points_stay_bit_for_bit():
    points = random_points(3, 50)
    landed, visible = warp_points(points, torch.zeros(3, 2, *SIZE, dtype=torch.float64))
    assert torch.equal(landed, points)
    assert visible.all()


def test_points_follow_a_shift_of_whole_pixels(pixels):
    flow = torch.tensor([7.0, -4.0]).view(2, 1, 1).expand(2, *SIZE)
    points = random_points(200).round().float()
    landed, visible = warp_points(points, flow)
    expected = points - torch.tensor([7.0, -4.0])
    assert torch.equal(landed, expected)
    assert torch.equal(visible, inside(expected, SIZE))
    assert 0.5 < visible.float().mean() < 1


@pytest.mark.parametrize("flip", [hflip, vflip])
def test_points_follow_flips_and_a_mirror_image_is_no_fold(pixels, flip):
    axis = 0 if flip is hflip else 1
    points = random_points(200)
    points[:4] = torch.tensor([[-3.0, -2.0], [500.0, 10.0], [10.0, 500.0], [-0.5, -0.5]])
    landed, visible = warp_points(points, flip(pixels, *SIZE))
    expected = points.clone()
    expected[:, axis] = SIZE[1 - axis] - 1 - points[:, axis]
    assert_close(landed, expected, rtol=0, atol=1e-9)
    assert torch.equal(visible, inside(points, SIZE))


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 3)])
def test_points_of_the_smallest_frames_follow_flips(pixels, size):
    points = random_points(5, size=size)
    landed, visible = warp_points(points, hflip(pixels, *size))
    assert_close(landed, torch.stack([size[1] - 1 - points[:, 0], points[:, 1]], dim=1), rtol=0, atol=1e-12)
    assert visible.all()


def test_points_land_through_a_rough_flow_on_its_bilinear_reading():
    flow = torch.randn(2, *SIZE, generator=generator(), dtype=torch.float64) * 0.2
    points = random_points(500)
    landed, visible = warp_points(points, flow)
    assert visible[inside(points, SIZE, 1.0)].double().mean() > 0.99
    low = landed[visible].floor().clamp(max=torch.tensor([SIZE[1] - 2.0, SIZE[0] - 2.0], dtype=torch.float64))
    tx, ty = (landed[visible] - low).T
    x, y = low.long().T
    above = flow[:, y, x] * (1 - tx) + flow[:, y, x + 1] * tx
    below = flow[:, y + 1, x] * (1 - tx) + flow[:, y + 1, x + 1] * tx
    read = above * (1 - ty) + below * ty
    assert (landed[visible] + read.T - points[visible]).norm(dim=1).max() <= 0.01


def test_points_on_a_sheet_that_is_folded_over_are_not_visible(pixels):
    x, y = pixels(40, 200)
    flow = torch.stack([-12.0 * torch.sin(x / 8), 0 * y])
    points = random_points(500, size=(40, 200))
    landed, visible = warp_points(points, flow)
    stretch = 1 - 1.5 * torch.cos(landed[:, 0] / 8)
    # Each cell of the flow has one slope, which is that of the analytic flow up to a pixel away.
    assert (stretch[visible] > -1.5 / 8).all()
    assert landed.isfinite().all()
    assert 0.5 < visible.double().mean() <= 1
    # Between x = 80 and 120 this frame shows its middle mirrored, and the points beside it nowhere else.
    mirrored = torch.where((x - 100).abs() < 20, 200 - 2 * x, 0 * x)
    alone = torch.stack([torch.linspace(82, 118, 30), torch.full((30,), 20.0)], dim=1).double()
    landed, visible = warp_points(alone, torch.stack([mirrored, 0 * y]))
    assert_close(landed[:, 0], 200 - alone[:, 0], rtol=0, atol=0.01)
    assert not visible.any()


@pytest.mark.parametrize("poison", [torch.nan, torch.inf, -torch.inf, 3e38])
def test_points_that_a_hole_in_the_flow_would_show_are_not_visible(poison):
    flow = torch.full((2, *SIZE), 5.0)
    flow[1] = 0
    flow[:, 20:40, 30:60] = poison
    points = random_points(2000).float()
    flow.requires_grad_()
    landed, visible = warp_points(points, flow)
    exact = points - torch.tensor([5.0, 0.0])
    assert landed.isfinite().all()
    x, y = exact.T
    weight = torch.minimum(x - 29, 60 - x).clamp(0, 1) * torch.minimum(y - 19, 40 - y).clamp(0, 1)
    assert 0.02 < (weight > 0.001).float().mean() < 0.1
    assert torch.equal(visible, inside(exact, SIZE) & (weight <= 0.001))
    assert_close(landed[visible], exact[visible], rtol=0, atol=1e-4)
    landed.sum().backward()
    assert flow.grad is not None
    assert flow.grad.isfinite().all()


def test_a_flow_that_is_nowhere_known_shows_nothing():
    landed, visible = warp_points(random_points(20), torch.full((2, *SIZE), torch.nan))
    assert landed.isfinite().all()
    assert not visible.any()


@pytest.mark.parametrize("far", [1e6, -1e9, 3e38, torch.inf, -torch.inf, torch.nan])
def test_points_far_outside_come_out_finite_and_not_visible(pixels, waves, far):
    flow = waves(*pixels(*SIZE), 3.0, 20.0)[0].float()
    points = torch.tensor([[far, 10.0], [10.0, far], [far, far], [70.0, 40.0]])
    landed, visible = warp_points(points, flow)
    assert landed.isfinite().all()
    assert visible.tolist() == [False, False, False, True]


def test_gradients_of_points_are_those_of_finite_differences(pixels, waves):
    size = (6, 7)
    flow = (waves(*pixels(*size), 0.3, 2.0) + torch.tensor([0.4, -0.2]).view(1, 2, 1, 1)).requires_grad_()
    points = torch.tensor([[[2.3, 2.6], [3.45, 1.7], [4.2, 3.15]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p, f: warp_points(p, f, steps=40)[0], [points, flow])


def test_gradients_of_boxes_are_those_of_finite_differences(pixels, waves):
    flow = (waves(*pixels(12, 14), 0.3, 3.0)).requires_grad_()
    boxes = torch.tensor([[[2.3, 3.6, 7.45, 8.7], [-1.8, 2.2, 3.9, 20.3]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda b, f: warp_boxes(b, f, samples=5)[0], [boxes, flow])


def test_the_gradient_is_not_paid_for_where_nobody_asks():
    points, flow = random_points(1, 3), torch.zeros(1, 2, *SIZE, dtype=torch.float64)
    assert not warp_points(points, flow)[0].requires_grad
    with torch.no_grad():
        assert not warp_points(points, flow.requires_grad_())[0].requires_grad


def test_a_batch_is_each_sample_alone_bit_for_bit(pixels, waves):
    x, y = pixels(*SIZE)
    flow = torch.cat([waves(x, y, 8.0, 40.0 + i) for i in range(3)] + [torch.full((1, 2, *SIZE), 3.0)]).float()
    points, boxes = random_points(4, 37).float(), random_boxes(4 * 5).float().view(4, 5, 4)
    whole = [*warp_points(points, flow), *warp_boxes(boxes, flow)]
    for i in range(4):
        alone = [*warp_points(points[i], flow[i]), *warp_boxes(boxes[i], flow[i])]
        assert all(torch.equal(one, many[i]) for one, many in zip(alone, whole, strict=True))
    one = warp_points(points, flow[:1])[0]
    assert torch.equal(one, warp_points(points, flow[:1].expand(4, -1, -1, -1))[0])


def test_a_compiled_graph_gives_the_points_of_the_eager_one(pixels, waves):
    flow = waves(*pixels(*SIZE), 8.0, 40.0).float()
    points = random_points(1, 64).float()
    landed, visible = warp_points(points, flow, steps=6)
    compiled, seen = torch.compile(warp_points, fullgraph=True)(points, flow, steps=6)
    # Fused multiply-adds round once where eager rounds twice.
    assert_close(compiled, landed, rtol=0, atol=1e-4)
    assert torch.equal(seen, visible)


def test_no_value_is_read_where_that_would_wait_for_a_device():
    # Tensors of this device have no values, so that reading one raises.
    points, flow = torch.zeros(2, 3, 2, device="meta"), torch.zeros(2, 2, *SIZE, device="meta")
    landed, visible = warp_points(points, flow)
    assert (landed.shape, visible.shape) == (points.shape, (2, 3))
    boxes, keep = warp_boxes(torch.zeros(2, 3, 4, device="meta"), flow)
    assert (boxes.shape, keep.shape) == ((2, 3, 4), (2, 3))


def test_half_points_are_placed_in_single_precision():
    flow = torch.full((1, 2, 8, 2000), 0.25, dtype=torch.float16)
    landed, visible = warp_points(torch.tensor([[[1500.0, 3.0]]], dtype=torch.float16), flow)
    assert landed.tolist() == [[[1499.75, 2.75]]]
    assert visible.all()


def test_whole_numbers_are_points_too():
    landed, _ = warp_points(torch.tensor([[30, 40]]), torch.full((2, *SIZE), 0.5))
    assert landed.tolist() == [[29.5, 39.5]]


def test_none_of_points_or_samples_stay_none():
    assert warp_points(torch.zeros(0, 4, 2), torch.zeros(0, 2, *SIZE))[0].shape == (0, 4, 2)
    landed, visible = warp_points(torch.zeros(2, 0, 2), torch.zeros(2, 2, *SIZE))
    assert (landed.shape, visible.shape) == ((2, 0, 2), (2, 0))
    boxes, keep = warp_boxes(torch.zeros(0, 4), torch.zeros(2, *SIZE))
    assert (boxes.shape, keep.shape) == ((0, 4), (0,))


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


@pytest.mark.parametrize("flip", [hflip, vflip])
@pytest.mark.parametrize("clip", [True, False])
def test_boxes_follow_flips(pixels, flip, clip):
    axis = 0 if flip is hflip else 1
    boxes = random_boxes(100)
    moved, _ = warp_boxes(boxes, flip(pixels, *SIZE), clip=clip)
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


def lens_and_wave_flows(pixels, waves, size: tuple[int, int]) -> list[Tensor]:
    x, y = pixels(*size)
    flows = [waves(x, y, amplitude, length)[0] for amplitude, length in ((30.0, 150.0), (8.0, 40.0), (2.0, 10.0))]
    lens = LensDistortion().degrade(torch.zeros(1, 1, *size, dtype=torch.float64), seed=3).flow
    folding = LensDistortion(k1_range=(-0.6, -0.6), k2_range=(0.0, 0.0), focal_range=(0.7, 0.7))
    with pytest.warns(UserWarning, match="fold back"):
        hidden = folding.degrade(torch.zeros(1, 1, *size, dtype=torch.float64), seed=3).flow
    assert lens is not None
    assert hidden is not None
    return [*flows, lens[0], hidden[0]]


@pytest.mark.parametrize("which", range(5))
def test_a_thousand_boxes_hold_their_warped_masks(pixels, waves, which):
    size = (180, 320)
    flow = lens_and_wave_flows(pixels, waves, size)[which]
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
    print(f"{len(lacking)} boxes lack {max(lacking):.2f} px at most and are {max(loose):.2f} px too wide at most")
    assert len(lacking) > 900
    # Where the lens folds back, the outline ends, and a lattice of 49 places a side tells what is seen beyond its end.
    assert max(lacking) <= (1 if which < 4 else 2 * size[1] / 48)
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


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int32, torch.int64, torch.bool, torch.float32])
def test_masks_take_the_nearest_class_and_the_fill_outside(pixels, waves, dtype):
    x, y = pixels(*SIZE)
    flow = waves(x, y, 12.0, 30.0)
    high, fill = (2, 1) if dtype is torch.bool else (200, 255)
    mask = torch.randint(0, high, (1, 2, *SIZE), generator=generator()).to(dtype)
    moved = warp_mask(mask, flow, fill=fill)
    columns, rows = (x + flow[0, 0]).round().long(), (y + flow[0, 1]).round().long()
    outside = (columns < 0) | (columns >= SIZE[1]) | (rows < 0) | (rows >= SIZE[0])
    expected = mask[..., rows.clamp(0, SIZE[0] - 1), columns.clamp(0, SIZE[1] - 1)]
    expected = torch.where(outside, torch.tensor(fill, dtype=dtype), expected)
    assert outside.any()
    assert moved.dtype == dtype
    # Halfway between two pixels rounding decides.
    halfway = ((x + flow[0, 0]).frac().abs() - 0.5).abs().minimum(((y + flow[0, 1]).frac().abs() - 0.5).abs()) < 1e-4
    assert torch.equal(moved[..., ~halfway], expected[..., ~halfway])
    assert torch.equal(warp_mask(mask[0], flow[0], fill=fill), moved[0])


def test_large_class_ids_are_kept():
    mask = torch.full((1, 4, 5), 2**40 + 1)
    assert torch.equal(warp_mask(mask, torch.zeros(2, 4, 5)), mask)


def test_soft_masks_mix_probabilities_and_are_filled_outside():
    mask = torch.tensor([[0.0, 1.0, 0.0, 0.5]]).view(1, 1, 1, 4)
    flow = torch.tensor([0.25, 0.0]).view(1, 2, 1, 1).expand(1, 2, 1, 4)
    assert warp_mask(mask, flow, soft=True).flatten().tolist() == [0.25, 0.75, 0.125, 0.5]
    flow = flow + torch.tensor([1.0, 0.0]).view(1, 2, 1, 1)
    assert warp_mask(mask, flow, soft=True, fill=0.2).flatten().tolist() == pytest.approx([0.75, 0.125, 0.5, 0.2])
    assert warp_mask(mask, flow).flatten().tolist() == [1.0, 0.0, 0.5, 0.0]


def test_gradients_of_soft_masks_are_those_of_finite_differences(pixels, waves):
    flow = (waves(*pixels(5, 6), 0.3, 2.0) + 0.31).requires_grad_()
    mask = torch.rand(1, 1, 5, 6, generator=generator(), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda m, f: warp_mask(m, f, soft=True), [mask, flow])


def test_depth_invents_no_distance_between_two_sides_of_an_edge(pixels, waves):
    depth = torch.where(torch.arange(SIZE[1]) < 70, 5.0, 80.0).expand(1, 1, *SIZE).contiguous()
    flow = waves(*pixels(*SIZE), 9.0, 30.0).float()
    moved, valid = warp_depth(depth, flow, fill=-1.0)
    assert set(moved.unique().tolist()) == {-1.0, 5.0, 80.0}
    assert torch.equal(moved == -1, ~valid)
    assert torch.equal(moved, warp_mask(depth, flow, fill=-1.0))
    mixed, _ = warp_depth(depth, flow, interpolation="bilinear")
    assert ((mixed > 6) & (mixed < 79)).any()


def test_the_sky_is_infinitely_far_and_unknown_depth_not_valid():
    depth = torch.tensor([[torch.inf, 3.0, torch.nan, 7.0]]).view(1, 1, 4)
    flow = torch.zeros(2, 1, 4)
    flow[0, 0, 3] = 4.0
    moved, valid = warp_depth(depth, flow, fill=9.0)
    assert moved.flatten().tolist() == [torch.inf, 3.0, 9.0, 9.0]
    assert valid.flatten().tolist() == [True, True, False, False]


def test_labels_and_images_agree_on_the_frame(pixels, waves):
    flow = waves(*pixels(*SIZE), 12.0, 30.0).float()
    _, valid = warp(torch.ones(1, 1, *SIZE), flow)
    on_frame = warp_mask(torch.ones(1, 1, *SIZE, dtype=torch.bool), flow)
    assert not (valid & ~on_frame).any()
    # A mask reaches half a pixel over the outermost centers.
    x, y = pixels(*SIZE)
    u, v = x + flow[0, 0], y + flow[0, 1]
    rim = inside(torch.stack([u, v], dim=-1), SIZE, -0.501)
    assert not (on_frame[0, 0] & ~rim).any()


FLOW = torch.zeros(2, 2, 5, 6)
ONE = torch.zeros(2, 5, 6)
BOXES = torch.zeros(2, 3, 4)


@pytest.mark.parametrize(
    ("call", "kind", "rule"),
    [
        (lambda: warp_points([1.0, 2.0], FLOW), TypeError, "points_xy must be a tensor, got list"),  # pyright: ignore
        (lambda: warp_points(torch.zeros(2, 3, 3), FLOW), ValueError, r"points_xy must have shape \(B, N, 2\)"),
        (lambda: warp_points(torch.zeros(3, 2), FLOW), ValueError, r"points_xy must have shape \(B, N, 2\)"),
        (lambda: warp_points(torch.zeros(1, 3, 2), FLOW[None]), ValueError, r"flow must have shape \(B, 2, H, W\)"),
        (lambda: warp_points(torch.zeros(3, 3, 2), FLOW), ValueError, "flow must have the batch of points_xy, 3"),
        (lambda: warp_points(torch.zeros(3, 2, dtype=torch.bool), ONE), TypeError, "points_xy must be of real"),
        (lambda: warp_points(torch.zeros(3, 2), ONE.long()), TypeError, "flow must be of a floating type"),
        (lambda: warp_points(torch.zeros(3, 2), ONE[:, :0]), ValueError, "flow must have a pixel"),
        (lambda: warp_points(torch.zeros(3, 2), ONE, steps=0), ValueError, "steps must be at least 1, got 0"),
        (lambda: warp_points(torch.zeros(3, 2), ONE, tolerance_px=0.0), ValueError, "tolerance_px must be above 0"),
        (lambda: warp_boxes(torch.zeros(2, 3, 5), FLOW), ValueError, r"boxes must have shape \(B, N, 4\)"),
        (lambda: warp_boxes(BOXES, FLOW, min_area=-1.0), ValueError, "min_area must be a number of at least 0"),
        (lambda: warp_boxes(BOXES, FLOW, min_visibility=1.5), ValueError, r"min_visibility must be .* \[0, 1\]"),
        (lambda: warp_boxes(BOXES, FLOW, clip=1), TypeError, "clip must be True or False"),  # pyright: ignore
        (lambda: warp_boxes(BOXES, FLOW, samples=1), ValueError, "samples must be at least 2, got 1"),
        (
            lambda: warp_boxes(BOXES - torch.arange(4), FLOW),
            ValueError,
            "boxes must have x1 <= x2 and y1 <= y2, got -2",
        ),
        (lambda: warp_boxes(BOXES * torch.nan, FLOW), ValueError, "boxes must have x1 <= x2 and y1 <= y2, got nan"),
        (lambda: warp_mask(torch.zeros(5, 6), ONE), ValueError, r"flow must have shape \(B, 2, H, W\)"),
        (lambda: warp_mask(torch.zeros(2, 1, 5, 7), FLOW), ValueError, "flow must have the batch and the size of mask"),
        (lambda: warp_mask(torch.zeros(1, 5, 6, dtype=torch.uint8), ONE, fill=256), ValueError, "fill must be a whole"),
        (lambda: warp_mask(torch.zeros(1, 5, 6, dtype=torch.uint8), ONE, fill=0.5), ValueError, "fill must be a whole"),
        (lambda: warp_mask(torch.zeros(1, 5, 6), ONE, fill=torch.nan), ValueError, "fill must not be NaN"),
        (lambda: warp_mask(torch.zeros(1, 5, 6).long(), ONE, soft=True), TypeError, "mask must be floating to be soft"),
        (lambda: warp_depth(torch.zeros(2, 5, 6), ONE), ValueError, "depth must have one channel"),
        (lambda: warp_depth(torch.zeros(1, 5, 6).long(), ONE), TypeError, "depth must be of a floating type"),
        (lambda: warp_depth(torch.zeros(1, 5, 6), ONE, fill=torch.inf), ValueError, "fill must be a number"),
        (
            lambda: warp_depth(torch.zeros(1, 5, 6), ONE, interpolation="bicubic"),
            ValueError,
            "interpolation must be one",
        ),
    ],
)
def test_what_does_not_fit_raises(call, kind, rule):
    with pytest.raises(kind, match=rule):
        call()


def test_unknown_arguments_raise():
    options: dict[str, Any] = {"min_size": 3}
    with pytest.raises(TypeError, match="min_size"):
        warp_boxes(BOXES, FLOW, **options)

import pytest
import torch

from torchrefract import warp, warp_depth, warp_mask

SIZE = (90, 140)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


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
    rim = (u >= -0.501) & (u <= SIZE[1] - 0.499) & (v >= -0.501) & (v <= SIZE[0] - 0.499)
    assert not (on_frame[0, 0] & ~rim).any()


FLOW = torch.zeros(2, 2, 5, 6)
ONE = torch.zeros(2, 5, 6)


@pytest.mark.parametrize(
    ("call", "kind", "rule"),
    [
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

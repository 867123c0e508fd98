import pytest
import torch

from torchrefract import (
    LensDistortion,
    Turbulence,
    warp,
    warp_depth,
    warp_mask,
    warp_optical_flow,
    warp_points,
)

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


def motion(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """(1, 2, H, W), px: what drives ahead sees, growing from a point."""
    return torch.stack([0.06 * (x - 60) + 1.5, 0.06 * (y - 40) - 0.5])[None]


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
def test_content_is_found_where_the_optical_flow_of_degraded_frames_leads(pixels, interpolation, oracle):
    x, y = pixels(*SIZE)
    first, second = (
        LensDistortion(tolerance_px=None).degrade(torch.zeros(1, 3, *SIZE).double(), seed=s) for s in (1, 2)
    )
    moved, valid = warp_optical_flow(
        motion(x, y), first.flow, second.restore_flow, restore_valid=second.restore_valid, interpolation=interpolation
    )
    # Each pixel by itself: to the clean frame, along the motion, and by the points' own inverse to the other frame.
    clean = torch.stack([x, y], dim=-1)[None] + first.flow.movedim(1, -1)
    at = clean if interpolation == "bilinear" else clean.round()
    there = clean + motion(at[0, ..., 0], at[0, ..., 1]).movedim(1, -1)
    landed, visible = warp_points(there.flatten(1, 2), second.flow)
    expected = (landed.view(1, *SIZE, 2) - torch.stack([x, y], dim=-1)).movedim(-1, 1)
    sure = valid & visible.view(1, 1, *SIZE)
    # Halfway between two pixels rounding decides, by 0.06 px.
    halfway = ((clean.frac().abs() - 0.5).abs() < 1e-6).any(dim=-1)[:, None]
    assert sure.double().mean() > 0.5
    oracle("optical flow, points", *(torch.where(sure & ~halfway, v, 0) for v in (moved, expected)), 0.01, unit="px")


def test_the_optical_flow_of_degraded_frames_leads_from_one_to_the_other(pixels):
    x, y = pixels(*SIZE)
    frame = torch.stack([torch.sin(x / 7) * torch.cos(y / 9), torch.cos(x / 11 + y / 8)])[None]
    # The second clean frame holds what is at q in the first one at q + motion(q); that is affine, so is its inverse.
    back = torch.stack([(x + 60 * 0.06 - 1.5) / 1.06 - x, (y + 40 * 0.06 + 0.5) / 1.06 - y])[None]
    then = warp(frame, back, interpolation="bicubic")[0]
    air = Turbulence(covariance="gaussian", amplitude_range=(2.0, 2.0), length_range=(30.0, 30.0), tolerance_px=None)
    one, two = (air.degrade(image, seed=seed) for seed, image in ((0, frame), (1, then)))
    moved, valid = warp_optical_flow(motion(x, y), one.flow, two.restore_flow, restore_valid=two.restore_valid)
    found, seen = warp(two.image, moved, interpolation="bicubic")
    near = (found - one.image).abs()[(valid & seen & one.valid).expand_as(frame)]
    before = (two.image - one.image).abs()[(valid & seen & one.valid).expand_as(frame)]
    assert valid.double().mean() > 0.7
    assert before.mean() > 0.1
    assert near.mean() < 0.006


def test_a_motion_that_is_not_known_or_leads_off_the_frame_is_filled():
    motions = torch.zeros(1, 2, 6, 8)
    motions[0, 0, 2, 3], motions[0, 1, 4, 4], motions[0, 0, 1, 6] = torch.nan, torch.inf, 3.0
    still, hidden = torch.zeros(1, 2, 6, 8), torch.ones(1, 1, 6, 8, dtype=torch.bool)
    hidden[0, 0, 5, 5] = False
    moved, valid = warp_optical_flow(motions, still, still, restore_valid=hidden, fill=-9.0)
    unknown = torch.zeros(1, 1, 6, 8, dtype=torch.bool)
    for row, column in ((2, 3), (4, 4), (1, 6), (5, 5)):
        unknown[0, 0, row, column] = True
    assert torch.equal(valid, ~unknown)
    assert torch.equal(moved, torch.where(unknown, -9.0, torch.zeros(())).expand_as(moved))
    for hole in (torch.nan, torch.inf):
        flow, back = still.clone(), still.clone()
        flow[0, 0, 0, 0] = back[0, 1, 5, 0] = hole
        moved_on, known = warp_optical_flow(torch.zeros(1, 2, 6, 8), flow, back, fill=-9.0)
        assert not known[0, 0, 0, 0]
        assert not known[0, 0, 5, 0]
        assert torch.equal(moved_on == -9, ~known.expand_as(moved_on))
        assert known.sum() >= 48 - 1 - 4
    alone = warp_optical_flow(motions[0], still[0], still[0], restore_valid=hidden[0], fill=-9.0)
    assert torch.equal(alone[0], moved[0])
    assert torch.equal(alone[1], valid[0])
    both = warp_optical_flow(motions.expand(2, -1, -1, -1), still, still, restore_valid=hidden, fill=-9.0)
    assert torch.equal(both[0], moved.expand(2, -1, -1, -1))


def test_gradients_of_optical_flow_are_those_of_finite_differences(pixels, waves):
    flow, back = ((waves(*pixels(5, 6), 0.3, 2.0, phase) + 0.31).requires_grad_() for phase in (0.3, 0.7))
    motions = (0.1 * torch.rand(1, 2, 5, 6, generator=generator(), dtype=torch.float64)).requires_grad_()

    def moved(m: torch.Tensor, f: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return warp_optical_flow(m, f, b, interpolation="bilinear")[0]

    assert torch.autograd.gradcheck(moved, [motions, flow, back])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"optical_flow": None}, TypeError, "optical_flow must be a tensor, got NoneType"),
        ({"optical_flow": torch.zeros(1, 3, 6, 8)}, ValueError, "optical_flow must have shape"),
        ({"optical_flow": torch.zeros(1, 2, 6, 8).long()}, TypeError, "optical_flow must be"),
        ({"flow": torch.zeros(1, 2, 6, 9)}, ValueError, "flow must have the batch and the size of optical_flow"),
        ({"restore_flow": torch.zeros(3, 2, 6, 8)}, ValueError, "restore_flow must have the batch and the size of"),
        ({"restore_valid": torch.ones(1, 1, 6, 8)}, TypeError, "restore_valid must be bool, got torch.float32"),
        ({"restore_valid": torch.ones(6, 8).bool()}, ValueError, r"restore_valid must have shape \(2, 1, 6, 8\)"),
        ({"interpolation": "bicubic"}, ValueError, "interpolation must be one of nearest, bilinear, got 'bicubic'"),
        ({"fill": torch.inf}, ValueError, "fill must be"),
    ],
)
def test_optical_flow_names_a_wrong_argument(arguments, error, message):
    good = {
        "optical_flow": torch.zeros(2, 2, 6, 8),
        "flow": torch.zeros(1, 2, 6, 8),
        "restore_flow": torch.zeros(1, 2, 6, 8),
    }
    with pytest.raises(error, match=message):
        warp_optical_flow(**{**good, **arguments})

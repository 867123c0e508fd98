import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchrefract import LensDistortion, warp_depth, warp_mask, warp_optical_flow, warp_points

SIZE = (90, 140)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.bool, torch.float32])
def test_masks_take_the_nearest_class_and_the_fill_outside(pixels, waves, dtype):
    x, y = pixels(*SIZE)
    flow = waves(x, y, 12.0, 30.0)
    high, fill = (2, 1) if dtype is torch.bool else (200, 255)
    mask = torch.randint(0, high, (1, 2, *SIZE), generator=generator()).to(dtype)
    warped = warp_mask(mask, flow, fill=fill)
    columns, rows = (x + flow[0, 0]).round().long(), (y + flow[0, 1]).round().long()
    outside = (columns < 0) | (columns >= SIZE[1]) | (rows < 0) | (rows >= SIZE[0])
    expected = mask[..., rows.clamp(0, SIZE[0] - 1), columns.clamp(0, SIZE[1] - 1)]
    expected = torch.where(outside, torch.tensor(fill, dtype=dtype), expected)
    assert outside.any()
    assert warped.dtype == dtype
    # Halfway between two pixels rounding decides.
    halfway = ((x + flow[0, 0]).frac().abs() - 0.5).abs().minimum(((y + flow[0, 1]).frac().abs() - 0.5).abs()) < 1e-4
    assert torch.equal(warped[..., ~halfway], expected[..., ~halfway])
    assert torch.equal(warp_mask(mask[0], flow[0], fill=fill), warped[0])


@pytest.mark.quick
@pytest.mark.parametrize("bits", [8, 16, 32, 64])
@pytest.mark.parametrize("sign", ["int", "uint"])
def test_ids_of_every_integer_type_keep_every_bit(bits, sign):
    dtype = getattr(torch, f"{sign}{bits}")
    largest = torch.iinfo(dtype).max
    ids = np.arange(largest - 20, largest, dtype=f"{sign}{bits}").reshape(1, 4, 5)
    warped = warp_mask(torch.from_numpy(ids), torch.tensor([2.0, 1.0]).view(2, 1, 1).expand(2, 4, 5), fill=largest)
    expected = np.full_like(ids, largest)
    expected[:, :3, :3] = ids[:, 1:, 2:]
    assert warped.dtype is dtype
    assert np.array_equal(warped.numpy(), expected)


@pytest.mark.quick
def test_soft_masks_interpolate_and_are_filled_outside():
    mask = torch.tensor([[0.0, 1.0, 0.0, 0.5]]).view(1, 1, 1, 4)
    flow = torch.tensor([0.25, 0.0]).view(1, 2, 1, 1).expand(1, 2, 1, 4)
    assert warp_mask(mask, flow, soft=True).flatten().tolist() == [0.25, 0.75, 0.125, 0.5]
    flow = flow + torch.tensor([1.0, 0.0]).view(1, 2, 1, 1)
    assert warp_mask(mask, flow, soft=True, fill=0.2).flatten().tolist() == pytest.approx([0.75, 0.125, 0.5, 0.2])
    assert warp_mask(mask, flow).flatten().tolist() == [1.0, 0.0, 0.5, 0.0]


def test_depth_is_not_mixed_across_an_edge_by_default(pixels, waves):
    depth = torch.where(torch.arange(SIZE[1]) < 70, 5.0, 80.0).expand(1, 1, *SIZE).contiguous()
    flow = waves(*pixels(*SIZE), 9.0, 30.0).float()
    warped, valid = warp_depth(depth, flow, fill=-1.0)
    assert set(warped.unique().tolist()) == {-1.0, 5.0, 80.0}
    assert torch.equal(warped == -1, ~valid)
    assert torch.equal(warped, warp_mask(depth, flow, fill=-1.0))
    mixed, _ = warp_depth(depth, flow, interpolation="bilinear")
    assert ((mixed > 6) & (mixed < 79)).any()


@pytest.mark.quick
def test_infinite_depth_is_valid_and_nan_is_not():
    depth = torch.tensor([[torch.inf, 3.0, torch.nan, 7.0]]).view(1, 1, 4)
    flow = torch.zeros(2, 1, 4)
    flow[0, 0, 3] = 4.0
    warped, valid = warp_depth(depth, flow, fill=9.0)
    assert warped.flatten().tolist() == [torch.inf, 3.0, 9.0, 9.0]
    assert valid.flatten().tolist() == [True, True, False, False]


def test_bilinear_depth_stays_where_nothing_moves_next_to_the_sky_and_unknown_depth():
    depth = torch.full((1, 1, 48, 80), 20.0)
    depth[:, :, :24], depth[:, :, 40:44, 10:20] = torch.inf, torch.nan
    for kind in (torch.float32, torch.float64):
        warped, valid = warp_depth(depth.to(kind), torch.zeros(1, 2, 48, 80), fill=-1.0, interpolation="bilinear")
        assert torch.equal(valid, ~depth.isnan())
        assert_close(warped, depth.to(kind).nan_to_num(nan=-1.0, posinf=torch.inf))


FLOW, ONE_FLOW, MAP = torch.zeros(2, 2, 5, 6), torch.zeros(2, 5, 6), torch.zeros(1, 5, 6)


@pytest.mark.parametrize(
    ("function", "arguments", "options", "error", "message"),
    [
        (warp_mask, (MAP[0], ONE_FLOW), {}, ValueError, r"flow must have shape \(B, 2, H, W\)"),
        (warp_mask, (torch.zeros(2, 1, 5, 7), FLOW), {}, ValueError, "flow must have the batch and the size of mask"),
        (warp_mask, (MAP.byte(), ONE_FLOW), {"fill": 256}, ValueError, "fill must be a whole"),
        (warp_mask, (MAP.byte(), ONE_FLOW), {"fill": 0.5}, ValueError, "fill must be a whole"),
        (warp_mask, (MAP, ONE_FLOW), {"fill": torch.nan}, ValueError, "fill must not be NaN"),
        (warp_mask, (MAP.long(), ONE_FLOW), {"soft": True}, TypeError, "mask must be floating if soft=True"),
        (warp_depth, (torch.zeros(2, 5, 6), ONE_FLOW), {}, ValueError, "depth must have one channel"),
        (warp_depth, (MAP.long(), ONE_FLOW), {}, TypeError, "depth must be of a floating type"),
        (warp_depth, (MAP, ONE_FLOW), {"fill": torch.inf}, ValueError, "fill must be a number"),
        (warp_depth, (MAP, ONE_FLOW), {"interpolation": "bicubic"}, ValueError, "interpolation must be one"),
    ],
)
def test_invalid_masks_and_depths_raise(function, arguments, options, error, message):
    with pytest.raises(error, match=message):
        function(*arguments, **options)


def expansion(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Return the optical flow of a camera that drives forward, (1, 2, H, W), px."""
    return torch.stack([0.06 * (x - 60) + 1.5, 0.06 * (y - 40) - 0.5])[None]


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
def test_optical_flow_matches_the_path_of_each_point(pixels, interpolation, oracle):
    x, y = pixels(*SIZE)
    first, second = (
        LensDistortion(tolerance_px=None).degrade(torch.zeros(1, 3, *SIZE).double(), seed=s) for s in (1, 2)
    )
    warped, valid = warp_optical_flow(
        expansion(x, y),
        first.flow,
        second.restore_flow,
        restore_valid=second.restore_valid,
        interpolation=interpolation,
    )
    # Reference: to the first clean frame, along the optical flow, and by warp_points to the second degraded frame.
    clean = torch.stack([x, y], dim=-1)[None] + first.flow.movedim(1, -1)
    sampled_at = clean if interpolation == "bilinear" else clean.round()
    destination = clean + expansion(sampled_at[0, ..., 0], sampled_at[0, ..., 1]).movedim(1, -1)
    points, visible = warp_points(destination.flatten(1, 2), second.flow)
    expected = (points.view(1, *SIZE, 2) - torch.stack([x, y], dim=-1)).movedim(-1, 1)
    both = valid & visible.view(1, 1, *SIZE)
    # Halfway between two pixels rounding decides, by 0.06 px.
    halfway = ((clean.frac().abs() - 0.5).abs() < 1e-6).any(dim=-1)[:, None]
    assert both.double().mean() > 0.5
    oracle("optical flow, points", *(torch.where(both & ~halfway, v, 0) for v in (warped, expected)), 0.01, unit="px")


def test_unknown_motion_and_motion_off_the_frame_are_filled():
    motion = torch.zeros(1, 2, 6, 8)
    motion[0, 0, 2, 3], motion[0, 1, 4, 4], motion[0, 0, 1, 6] = torch.nan, torch.inf, 3.0
    zero, mask = torch.zeros(1, 2, 6, 8), torch.ones(1, 1, 6, 8, dtype=torch.bool)
    mask[0, 0, 5, 5] = False
    warped, valid = warp_optical_flow(motion, zero, zero, restore_valid=mask, fill=-9.0)
    invalid = torch.zeros(1, 1, 6, 8, dtype=torch.bool)
    for row, column in ((2, 3), (4, 4), (1, 6), (5, 5)):
        invalid[0, 0, row, column] = True
    assert torch.equal(valid, ~invalid)
    assert torch.equal(warped, torch.where(invalid, -9.0, torch.zeros(())).expand_as(warped))
    unbatched = warp_optical_flow(motion[0], zero[0], zero[0], restore_valid=mask[0], fill=-9.0)
    assert all(torch.equal(*pair) for pair in zip(unbatched, (warped[0], valid[0]), strict=True))
    both = warp_optical_flow(motion.expand(2, -1, -1, -1), zero, zero, restore_valid=mask, fill=-9.0)
    assert torch.equal(both[0], warped.expand(2, -1, -1, -1))


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_invalid_pixels_of_both_flows_are_filled(value):
    flow, restore_flow = torch.zeros(1, 2, 6, 8), torch.zeros(1, 2, 6, 8)
    flow[0, 0, 0, 0] = restore_flow[0, 1, 5, 0] = value
    warped, valid = warp_optical_flow(torch.zeros(1, 2, 6, 8), flow, restore_flow, fill=-9.0)
    assert not valid[0, 0, 0, 0]
    assert not valid[0, 0, 5, 0]
    assert torch.equal(warped == -9, ~valid.expand_as(warped))
    assert valid.sum() >= 48 - 1 - 4


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
def test_invalid_arguments_of_optical_flow_raise(arguments, error, message):
    valid = {
        "optical_flow": torch.zeros(2, 2, 6, 8),
        "flow": torch.zeros(1, 2, 6, 8),
        "restore_flow": torch.zeros(1, 2, 6, 8),
    }
    with pytest.raises(error, match=message):
        warp_optical_flow(**{**valid, **arguments})

import dataclasses
import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.fields.depth import (
    DepthProvider,
    GroundPlaneDepth,
    LinearDepth,
    check_depth,
    depth_from_disparity,
    depth_from_inverse,
    depth_from_normalized,
    ray_distance,
)

INTRINSICS: dict[str, Any] = {"fx": 11.0, "fy": 9.0, "cx": 4.3, "cy": 2.9}


def random_in(low: float, high: float, *shape: int) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def real_depths(shared_data) -> list[Tensor]:
    """Return the depth of two real roads, interpolated from lidar."""
    paths = sorted((shared_data / "references").glob("*/depth_dense_derived_640x360.png"))
    assert len(paths) == 2
    pictures = [np.float64(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) for path in paths]
    return [torch.from_numpy(np.where(p == 65535, np.inf, p / 256))[None, None] for p in pictures]


def depth_of(provider: DepthProvider, height: int, width: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return provider(height, width, dtype=dtype, device=torch.device("cpu"))


@pytest.mark.quick
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_linear_depth_falls_row_by_row(dtype):
    expected = torch.tensor([160 * (1 - (y + 0.5) / 7) for y in range(7)], dtype=dtype).view(1, 1, 7, 1)
    assert_close(depth_of(LinearDepth(), 7, 3, dtype), expected)
    assert_close(depth_of(LinearDepth(max_depth=40), 7, 3, dtype), expected / 4)
    assert not depth_of(LinearDepth(max_depth=0.0), 7, 3, dtype).any()


@pytest.mark.parametrize("size", [(90, 160), (160, 90), (1, 1)])
def test_a_point_of_the_road_projects_to_the_row_of_its_depth(size):
    road, (height, width) = GroundPlaneDepth(camera_height=1.4, focal=0.8, horizon=0.3, far=math.inf), size
    focal, middle = 0.8 * width, (height - 1) / 2
    pitch = math.atan((middle - (0.3 * height - 0.5)) / focal)
    for y, z in enumerate(depth_of(road, height, width).flatten().tolist()):
        if z == math.inf:
            assert (y + 0.5) / height <= 0.3
            continue
        # A point of depth z, 1.4 m below the camera, in the camera's axes: ahead m on the ground, z along the axis.
        ahead = (z - 1.4 * math.sin(pitch)) / math.cos(pitch)
        down = 1.4 * math.cos(pitch) - ahead * math.sin(pitch)
        assert middle + focal * down / z == pytest.approx(y, abs=1e-9)


def test_a_horizon_above_the_frame_leaves_no_sky_and_one_below_no_road():
    assert depth_of(GroundPlaneDepth(horizon=-0.2), 20, 30).amax() < 200
    assert (depth_of(GroundPlaneDepth(horizon=1.0), 20, 30) == 200).all()


@pytest.mark.parametrize("height", [1, 720])
@pytest.mark.parametrize("horizon", [-10.0, 0.5, 10.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_depth_is_positive_and_at_most_far(height, horizon, dtype):
    depth = depth_of(GroundPlaneDepth(horizon=horizon, far=50.0), height, 33, dtype)
    assert (depth > 0).all()
    assert (depth <= 50).all()


def test_providers_are_plain_values():
    assert GroundPlaneDepth(far=200) == GroundPlaneDepth()
    assert repr(LinearDepth(max_depth=3)) == "LinearDepth(max_depth=3.0)"
    assert len({LinearDepth(), LinearDepth(max_depth=160), GroundPlaneDepth()}) == 2
    assert dataclasses.replace(GroundPlaneDepth(), horizon=0.5).horizon == 0.5


@pytest.mark.parametrize(
    ("kind", "options", "error"),
    [
        (LinearDepth, {"max_depth": -1.0}, ValueError),
        (LinearDepth, {"max_depth": math.inf}, ValueError),
        (LinearDepth, {"max_depth": "far"}, TypeError),
        (GroundPlaneDepth, {"camera_height": 0.0}, ValueError),
        (GroundPlaneDepth, {"focal": -0.9}, ValueError),
        (GroundPlaneDepth, {"focal": math.inf}, ValueError),
        (GroundPlaneDepth, {"horizon": math.nan}, ValueError),
        (GroundPlaneDepth, {"horizon": 450.0}, ValueError),
        (GroundPlaneDepth, {"far": 0.0}, ValueError),
        (GroundPlaneDepth, {"far": math.nan}, ValueError),
    ],
)
def test_arguments_out_of_range_raise(kind, options: dict[str, Any], error):
    with pytest.raises(error, match=f"{next(iter(options))} must"):
        kind(**options)


def test_the_row_of_the_horizon_is_as_far_as_the_sky():
    depth = depth_of(GroundPlaneDepth(camera_height=2.0, focal=0.8, horizon=0.45, far=math.inf), 10, 10).flatten()
    assert depth[:5].isinf().all()
    assert depth[5:].tolist() == pytest.approx([2 * math.hypot(8, 0.5) / rows for rows in range(1, 6)])


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-14), (torch.float32, 1e-6), (torch.float16, 1e-6)])
def test_the_ray_distance_is_the_length_of_the_vector_to_the_point(dtype, rtol):
    depth = random_in(1.0, 90.0, 2, 1, 6, 9).to(dtype)
    depth[1, 0, 2, 3] = math.inf
    v, u = np.mgrid[:6, :9]
    for sample in (0, 1):
        fx, fy, cx, cy = (value + sample for value in INTRINSICS.values())
        ray = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)])
        expected = torch.from_numpy(np.linalg.norm(ray, axis=0)) * depth[sample, 0].double()
        numbers = ray_distance(depth, fx=fx, fy=fy, cx=cx, cy=cy)
        assert_close(numbers[sample, 0].double(), expected, rtol=rtol, atol=0)
        tensors: dict[str, Any] = {name: value + torch.arange(2).double() for name, value in INTRINSICS.items()}
        assert_close(ray_distance(depth, **tensors)[sample, 0].double(), expected, rtol=rtol, atol=0)


def test_rows_of_one_depth_are_stretched_over_the_width():
    rows = random_in(1.0, 90.0, 1, 1, 6, 1)
    focal = torch.tensor([7.0, 12.0])
    result = ray_distance(rows, fx=focal, fy=9.0, cx=4.0, cy=2.5, width=9)
    assert torch.equal(result, ray_distance(rows.expand(2, -1, -1, 9), fx=focal, fy=9.0, cx=4.0, cy=2.5))


def test_gradients_of_the_ray_distance_match_finite_differences():
    values = [random_in(1.0, 90.0, 2, 1, 3, 4), *(value + random_in(0.0, 1.0, 2) for value in INTRINSICS.values())]

    def distance(depth, fx, fy, cx, cy):
        return ray_distance(depth, fx=fx, fy=fy, cx=cx, cy=cy)

    assert torch.autograd.gradcheck(distance, [value.requires_grad_() for value in values])


def test_the_sky_gives_the_intrinsics_no_gradient():
    depth = torch.full((1, 1, 6, 9), math.inf, dtype=torch.float64).requires_grad_()
    intrinsics: dict[str, Any] = {
        name: torch.tensor([value]).double().requires_grad_() for name, value in INTRINSICS.items()
    }
    distance = ray_distance(depth, **intrinsics)
    assert distance.isinf().all()
    for gradient in torch.autograd.grad(distance.sum(), [depth, *intrinsics.values()]):
        assert gradient.isfinite().all()


@pytest.mark.parametrize(
    ("changed", "error", "rule"),
    [
        ({"depth": torch.ones(6, 9)}, ValueError, r"depth must have shape \(B, 1, H, W\) or"),
        ({"depth": torch.ones(2, 1, 6, 9).int()}, TypeError, "depth must be of a floating type"),
        ({"width": 8}, ValueError, "depth must be 1 or 8 px wide"),
        ({"fx": 0.0}, ValueError, "fx must be above 0"),
        ({"fy": torch.tensor([9.0, -9.0])}, ValueError, "fy must be above 0, in px, got -9"),
        ({"fx": torch.tensor([9.0, math.inf])}, ValueError, "fx must be finite"),
        ({"cx": math.nan}, ValueError, "cx must not be NaN"),
        ({"cy": torch.zeros(3)}, ValueError, r"cy must be a number or have shape \(2,\), got \(3,\)"),
    ],
)
def test_invalid_intrinsics_raise(changed, error, rule):
    with pytest.raises(error, match=rule):
        ray_distance(**({"depth": torch.ones(2, 1, 6, 9)} | INTRINSICS | changed))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_converters_are_their_formulas_and_exact_at_both_ends(dtype):
    value = torch.cat([torch.tensor([0.0, 1.0]), random_in(0.0, 1.0, 20)]).to(dtype)
    v = value.double().numpy()
    with np.errstate(divide="ignore"):
        formulas = [360.5 / v, 2 + 78 * v, 1 / (v / 2 + (1 - v) / 80), 2 / v]
    result = [
        depth_from_disparity(value, focal_px=721.0, baseline=0.5),
        depth_from_normalized(value, near=2.0, far=80.0),
        depth_from_inverse(value, near=2.0, far=80.0),
        depth_from_inverse(value, near=2.0, far=math.inf),
    ]
    for depth, expected in zip(result, formulas, strict=True):
        assert_close(depth, torch.from_numpy(expected).to(dtype))
    assert result[0][0] == result[3][0] == math.inf
    assert result[1][:2].tolist() == [2.0, 80.0]
    assert result[2][:2].tolist() == [80.0, 2.0]


def test_gradients_of_the_converters_match_finite_differences_and_are_finite_at_infinity():
    functions = (
        lambda v: depth_from_disparity(100 * v, focal_px=721.0, baseline=0.5),
        lambda v: depth_from_normalized(v, near=2.0, far=80.0),
        lambda v: depth_from_inverse(v, near=2.0, far=math.inf),
    )
    for function in functions:
        assert torch.autograd.gradcheck(function, random_in(0.1, 0.9, 7).requires_grad_())
        far = torch.tensor([0.0, 1e-30, 1e-12]).requires_grad_()
        (gradient,) = torch.autograd.grad(function(far).sum(), far)
        assert gradient.isfinite().all()


@pytest.mark.parametrize("wrong", [-0.25, math.nan, -math.inf])
def test_values_outside_the_range_of_a_map_raise(wrong):
    value = torch.tensor([0.5, wrong])
    with pytest.raises(ValueError, match="disparity must be at least 0, in px, got"):
        depth_from_disparity(value, focal_px=1.0, baseline=1.0)
    for convert in (depth_from_normalized, depth_from_inverse):
        with pytest.raises(ValueError, match=r"value must be in \[0, 1\], got"):
            convert(value, near=1.0, far=2.0)
        with pytest.raises(ValueError, match=r"value must be in \[0, 1\], got 1\.5"):
            convert(torch.tensor(1.5), near=1.0, far=2.0)
        with pytest.raises(TypeError, match="value must be of a floating type"):
            convert(torch.tensor(1), near=1.0, far=2.0)
        with pytest.raises(ValueError, match="far must be above near = 2, got 2"):
            convert(value, near=2.0, far=2.0)


def error_of(depth: Tensor) -> str:
    with pytest.raises(ValueError, match="depth must be in m, not") as error:
        check_depth(depth)
    return str(error.value)


@pytest.mark.parametrize("size", [(64, 112), (96, 40)])
def test_check_depth_accepts_road_scenes_and_rejects_converted_ones(size):
    _, depth = render_road_scenes(torch.arange(8), *size)
    check_depth(depth)
    check_depth(depth.clamp(max=80.0))
    for sample in depth.split(1):
        disparity = 360.5 / sample
        assert "not disparity or inverse depth" in error_of(disparity)
        # Files of depth have 0 where it is not known, which is then infinite.
        assert "not disparity or inverse depth" in error_of(torch.where(disparity == 0, math.inf, disparity))
        assert "not normalized" in error_of(sample.amin() / sample)
        farthest = sample[sample.isfinite()].amax()
        assert "not normalized" in error_of((sample / farthest).clamp(max=1.0))
        assert "not normalized" in error_of(sample / farthest)


def test_check_depth_rejects_stored_integers_and_maps_with_holes():
    _, depth = render_road_scenes(torch.arange(4), 64, 112)
    generator = torch.Generator().manual_seed(0)
    for sample in depth.clamp(max=200.0).split(1):
        for factor in (1000, 256):
            with pytest.raises(
                ValueError, match=r"in m, got whole numbers from .* to .*; divide by 1000 if they are mill"
            ):
                check_depth((factor * sample).round())
        resized = torch.nn.functional.interpolate((1000 * sample).round(), (90, 160), mode="bilinear")
        with pytest.raises(
            ValueError, match=r"in m, got a median of .* in the lower half; divide by 1000 if it is in mi"
        ):
            check_depth(resized)
        lidar = torch.where(torch.rand(sample.shape, generator=generator) < 0.05, sample, 0)
        with pytest.raises(
            ValueError, match=r"depth must be known at each pixel, got 0 at 9[3-7] % of them; fill these"
        ):
            check_depth(lidar)
        with pytest.raises(ValueError, match=r"depth must be known at each pixel, got 0 at 100 % of them; fill these"):
            check_depth(torch.zeros_like(sample))
        check_depth(sample.round())


def test_check_depth_accepts_real_roads_and_rejects_converted_ones(shared_data):
    for depth in real_depths(shared_data):
        for kind in (torch.float64, torch.float32, torch.float16):
            check_depth(depth.to(kind))
        check_depth(depth.clamp(max=80.0))
        check_depth(depth.nan_to_num(posinf=0.0))  # as where 0 is no measurement
        assert "not disparity or inverse depth" in error_of(360.5 / depth)
        assert "not disparity or inverse depth" in error_of(1000 / depth)
        if not depth.isfinite().all():
            assert "not disparity or inverse depth" in error_of(torch.where(depth.isinf(), math.inf, 1000 / depth))


def test_check_depth_accepts_unusual_depths_in_meters():
    ramp = torch.linspace(0, 1, 200).view(1, 1, -1, 1).expand(1, 1, 200, 300)
    for depth in (0 * ramp + 0.5, 0 * ramp + 1, 1 + 149 * ramp, 150 * ramp, 160 * (1 - ramp), ramp / 0):
        check_depth(depth.nan_to_num(posinf=math.inf))
    check_depth(torch.zeros(0, 1, 4, 5))
    check_depth(torch.tensor([[[[0.0, 9.0]]]]))


def test_a_map_is_normalized_only_if_all_values_lie_in_the_unit_range():
    depth = random_in(0.0, 1.0, 1, 1, 700, 900)
    depth[0, 0, 1, 1] = 1.5  # between the rows and columns that are tested first
    check_depth(depth)
    depth[0, 0, 1, 1] = 0.5
    low, high = depth.amin().item(), depth.amax().item()
    assert error_of(depth).endswith(f"got values in [{low:g}, {high:g}]")


def test_each_sample_and_clip_is_judged_by_itself():
    depth = random_in(1.0, 90.0, 3, 1, 20, 30)
    depth[1] /= 100
    assert error_of(depth).endswith(f"got values in [{depth[1].amin():g}, {depth[1].amax():g}]")
    clips = random_in(1.0, 90.0, 2, 5, 1, 40, 30)
    check_depth(clips)
    clips[1] = torch.linspace(-60, 90, 40).clamp(min=0).double().view(40, 1)  # of a road below a horizon
    assert "not disparity or inverse depth" in error_of(clips)
    clips[1] /= 100
    assert "not normalized" in error_of(clips)


@pytest.mark.parametrize("wrong", [-1.0, math.nan, -math.inf])
def test_a_negative_or_nan_value_raises_wherever_it_lies(wrong):
    depth = random_in(1.0, 90.0, 2, 1, 300, 400)
    depth[1, 0, 1, 399] = wrong
    with pytest.raises(ValueError, match=f"range must be at least 0, in m, got {wrong:g}"):
        check_depth(depth, name="range")


def test_one_graph_vmap_and_meta_tensors_are_not_read():
    depth, focal = random_in(1.0, 90.0, 2, 1, 6, 9), torch.tensor([8.0, 9.0]).double()

    def distance(depth, fx):
        check_depth(depth)
        depth = depth_from_inverse(depth / 90, near=1.0, far=math.inf) + depth_from_normalized(
            depth / 90, near=1, far=9
        )
        depth = depth_from_disparity(depth, focal_px=9.0, baseline=0.5)
        road = GroundPlaneDepth(focal=1.0, horizon=0.2, far=50.0)(6, 9, dtype=depth.dtype, device=torch.device("cpu"))
        return ray_distance(torch.minimum(depth, road), fx=fx, fy=9.0, cx=4.0, cy=2.0)

    together = distance(depth, focal)
    assert_close(torch.compile(distance, fullgraph=True, backend="aot_eager")(depth, focal), together)
    mapped = torch.vmap(lambda depth, fx: distance(depth[None], fx)[0])(depth, focal)
    assert_close(mapped, together)
    # On a device that holds no values, reading one would raise.
    check_depth(torch.empty(2, 1, 6, 9, device="meta"))
    depth_from_disparity(torch.empty(2, 1, 6, 9, device="meta"), focal_px=9.0, baseline=0.5)


def test_a_spread_averages_inverse_depth_over_horizons():
    road = GroundPlaneDepth(camera_height=1.4, focal=1.0, horizon=0.4, far=math.inf)
    result = depth_of(dataclasses.replace(road, spread=0.15), 24, 40).flatten()
    y_h, s = 0.4 * 24 - 0.5, 0.15 * 24
    distance = 1.4 * math.hypot(40.0, 11.5 - y_h)
    shifts = np.linspace(-9, 9, 200_001)
    share = np.exp(-0.5 * shifts**2)
    share /= share.sum()
    inverse = [(share * np.maximum(y - y_h - s * shifts, 0)).sum() / distance for y in range(24)]
    assert_close(1 / result, torch.tensor(inverse, dtype=torch.float64), rtol=1e-6, atol=1e-12)
    sharp = depth_of(road, 24, 40).flatten()
    assert_close(result[-1:], sharp[-1:], rtol=1e-4, atol=0)
    assert (result[:9].isfinite() & sharp[:9].isinf()).all()
    assert (result.diff() < 0).all()

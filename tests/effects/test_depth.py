import dataclasses
import math
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from torchrefract.effects.depth import DepthProvider, GroundPlaneDepth, LinearDepth


def depth_of(provider: DepthProvider, height: int, width: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
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


def test_a_frame_of_another_resolution_shows_the_same_road():
    road = GroundPlaneDepth(horizon=0.45, far=1e4)
    small, large = depth_of(road, 90, 160).flatten(), depth_of(road, 270, 480).flatten()
    assert_close(large[1::3], small, rtol=1e-9, atol=0)
    assert (small[:40] == 1e4).all()
    assert (small[41:] < 1e4).all()


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


def test_a_provider_must_implement_call():
    with pytest.raises(TypeError, match="abstract"):
        DepthProvider()  # pyright: ignore[reportAbstractUsage]  # the abstract class is what is tested


def test_a_provider_compiles_into_one_graph():
    road = GroundPlaneDepth()

    def double(image):
        return 2 * road(*image.shape[2:], dtype=image.dtype, device=image.device)

    assert_close(
        torch.compile(double, fullgraph=True, backend="aot_eager")(torch.zeros(1, 3, 20, 30)),
        double(torch.zeros(1, 3, 20, 30)),
    )


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

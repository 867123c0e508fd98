"""Road mirages: the line, what is mirrored and what is hidden."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Compose, GroundPlaneDepth, LensDistortion, RoadMirage

HEIGHT, WIDTH, HORIZON_PX = 200, 1920, 99.5
# A focal length of 1400 px.
CALM: dict[str, Any] = {"focal": 1400 / WIDTH, "shimmer_range": (0.0, 0.0), "half_width": math.inf}


def mirage(difference: float, **options: Any) -> RoadMirage:
    arguments: dict[str, Any] = CALM | {"difference_range": (difference, difference)} | options
    return RoadMirage(**arguments)


def line_of(flow: Tensor) -> Tensor:
    """Return (W,), px below the horizon, where the share of mirrored light falls below one half."""
    below = torch.arange(HEIGHT) - HORIZON_PX
    share = (flow[0, 1] / (-2 * below[:, None]))[below > 0]  # (n, W)
    last = (share >= 0.5).sum(dim=0) - 1
    first, second = share.gather(0, last[None])[0], share.gather(0, last[None] + 1)[0]

    def logit(value: Tensor) -> Tensor:
        return (value / (1 - value)).log()

    # The edge is logistic, so its logit is linear between two rows.
    return below[below > 0][last] + logit(first) / (logit(first) - logit(second))


@pytest.mark.quick
@pytest.mark.parametrize(
    ("difference", "px", "distance"), [(5.0, 4.2, 436.0), (10.0, 5.9, 308.0), (20.0, 8.4, 218.0), (30.0, 10.2, 178.0)]
)
def test_the_line_lies_at_the_critical_angle(difference, px, distance):
    flow = mirage(difference).degrade(torch.zeros(1, 1, HEIGHT, WIDTH, dtype=torch.float64), seed=1).flow
    angle = math.sqrt(2 * 2.67e-4 * difference / 300)
    line = line_of(flow)
    assert_close(line, torch.full_like(line, 1400 * angle), rtol=0, atol=0.02)
    assert line[0].item() == pytest.approx(px, abs=0.1)
    assert 1.3 / angle == pytest.approx(distance, abs=0.6)  # m, of the road there


def test_what_is_at_the_horizon_is_mirrored_and_all_else_stays():
    image = torch.arange(HEIGHT, dtype=torch.float64).view(1, 1, HEIGHT, 1).expand(1, 1, -1, WIDTH) / 255
    rows = (255 * mirage(20.0).degrade(image, seed=1).image)[0, 0, :, 0]
    y = torch.arange(HEIGHT, dtype=torch.float64)
    below = y - HORIZON_PX
    is_mirrored, is_still = (below > 0) & (below < 7), (below <= 0) | (below > 10)
    assert_close(rows[is_mirrored], (2 * HORIZON_PX - y)[is_mirrored], rtol=0, atol=0.01)
    assert_close(rows[is_still], y[is_still], rtol=0, atol=0.01)


def test_what_the_mirage_hides_is_not_valid_and_the_rest_is_restored():
    image = torch.rand(1, 3, HEIGHT, WIDTH)
    degraded = mirage(20.0).degrade(image, seed=1)
    below = torch.arange(HEIGHT) - HORIZON_PX
    valid = degraded.restore_valid[0, 0, :, 0]
    assert not valid[(below > 0) & (below < 8)].any()
    assert valid[(below < 0) | (below > 11)].all()
    assert (degraded.restore_flow == 0).all()
    assert degraded.folding.min_determinant < 0


def test_the_edge_shimmers_slowly_along_the_road_and_in_time():
    effect = mirage(20.0, shimmer_range=(0.3, 0.3))
    clip = torch.zeros(1, 1, 1, HEIGHT, WIDTH, dtype=torch.float64).expand(-1, 31, -1, -1, -1)
    degraded = effect.degrade(clip, seed=1)
    params = degraded.params
    lines = torch.stack([line_of(flow[None]) for flow in degraded.flow[0]])
    x, t = (torch.arange(WIDTH) + 0.5) / WIDTH, torch.arange(31)[:, None, None] / 30
    angle = 2 * math.pi * (params.wave[0, :, None] * x + params.rate[0, :, None] * t) + params.phase[0, :, None]
    relative = 1 + 0.3 * math.sqrt(2 / 6) * angle.sin().sum(dim=1)
    expected = 1400 * (2 * 2.67e-4 * 20 * relative.clamp(min=0) / 300).sqrt()
    is_visible = expected > 1
    assert is_visible.double().mean() > 0.95
    assert_close(lines[is_visible], expected[is_visible], rtol=0, atol=0.05)
    assert lines.std(dim=1).min() > 0.3
    change = lines.diff(dim=0).abs().mean()
    assert 0.01 < change < 0.5  # px per frame
    assert effect.degrade(clip[:, 0], seed=1, frame=30).flow.equal(degraded.flow[:, 30])


def test_only_the_road_is_a_mirror():
    image = torch.zeros(1, 1, HEIGHT, WIDTH)
    road = mirage(20.0, half_width=4.0, vanishing=0.25).degrade(image, seed=1).flow[0, 1]
    for row, below in ((103, 3.5), (106, 6.5)):
        half = 4.0 * below / 1.3  # px: 4 m at the distance of the row
        columns = (road[row] != 0).nonzero().flatten()
        assert columns[0].item() + 0.5 == pytest.approx(480 - half, abs=1)
        assert columns[-1].item() + 0.5 == pytest.approx(480 + half, abs=1)
    # A truck at 80 m hides the road behind it.
    depth = GroundPlaneDepth(focal=1400 / WIDTH, far=math.inf)(
        HEIGHT, WIDTH, dtype=torch.float32, device=image.device
    ).repeat(1, 1, 1, WIDTH)
    depth[..., 80:120, 900:1000] = 80.0
    flow = mirage(20.0).degrade(image, seed=1, depth=depth).flow[0, 1]
    assert (flow[:, 900:1000].abs() < 1e-3).all()
    assert (flow[101:106, :900] < 0).all()


def test_a_lens_shows_the_mirage_where_it_bends_the_horizon():
    image = torch.zeros(1, 1, HEIGHT, 320, dtype=torch.float64)
    effect = Compose([mirage(20.0, focal=4.0), LensDistortion(frame="pad")])
    degraded = effect.degrade(image, seed=1)
    lens_only = LensDistortion(frame="pad", tolerance_px=None).apply(image, degraded.params.children[1]).flow
    # The mirage at the point where each pixel of the lens looks.
    x, y = torch.arange(320) + lens_only[0, 0], torch.arange(HEIGHT)[:, None] + lens_only[0, 1]
    below, angle = y - HORIZON_PX, math.sqrt(2 * 2.67e-4 * 20 / 300)
    v = torch.where(below > 0, -2 * below * torch.sigmoid((4 * 320 * angle - below) / 0.15), 0.0)
    inside = (x >= 0) & (x <= 319) & (y >= 0) & (y <= HEIGHT - 1)
    assert_close((degraded.flow - lens_only)[0, 1][inside], v[inside], rtol=0, atol=0.03)
    assert v.abs().max() > 5


def test_a_mirage_below_the_tolerance_is_not_computed():
    assert RoadMirage(difference_range=(0.0, 1e-4)).plan(64, 96).is_identity
    assert "the edge of the mirage is sharp" in str(RoadMirage().plan(1080, 1920))


def test_the_rows_that_are_computed_hold_all_of_the_mirage():
    image, effect = torch.rand(2, 3, 60, 200), RoadMirage(difference_range=(20.0, 30.0), focal=8.0, half_width=math.inf)
    params = effect.sample(image, seed=2)
    rows = effect.apply(image, params).flow
    assert rows[:, 1].abs().max() > 5
    # With a gradient, every row is computed.
    every = effect.apply(image, params._replace(difference=params.difference.requires_grad_())).flow.detach()
    assert_close(rows, every, rtol=0, atol=1e-5)
    bent = Compose([effect, LensDistortion()])
    params = bent.sample(image, seed=2)
    mirage = params.children[0]
    learned = mirage._replace(difference=mirage.difference.requires_grad_())
    every = bent.apply(image, params._replace(children=(learned, params.children[1]))).flow.detach()
    assert_close(bent.apply(image, params).flow, every, rtol=0, atol=1e-4)

import itertools
import math
import random
from typing import Any

import pytest
import torch
from torch.testing import assert_close
from torchrefract.effects.compose_plan import ComposePlan
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.plan import Plan
from torchrefract.fields.spline import evaluate_spline, fit_spline

from torchrefract import (
    Compose,
    DivergenceFree,
    LensDistortion,
    LensFlare,
    OneOf,
    Rectification,
    ThinPlateSpline,
    Turbulence,
    UniformFog,
)
from torchrefract.cameras import Camera
from torchrefract.warping.lattice import Lattice, LatticeFlow, lagrange_weights

SIZE = (96, 130)


def lens(tolerance: float | None) -> LensDistortion:
    ranges: dict[str, Any] = {"k1_range": (-0.12, -0.05), "k2_range": (0.0, 0.01), "focal_range": (0.9, 1.1)}
    return LensDistortion(**ranges, tolerance_px=tolerance)


def swirls(tolerance: float | None) -> DivergenceFree:
    return DivergenceFree(amplitude_range=(0.5, 1.0), length_range=(25.0, 40.0), tolerance_px=tolerance)


def parts(tolerance: float | None) -> list[LatticeWarp]:
    air: dict[str, Any] = {"covariance": "gaussian", "amplitude_range": (0.5, 1.0), "length_range": (20.0, 30.0)}
    plate = ThinPlateSpline(amplitude_range=(0.5, 1.0), tolerance_px=tolerance)
    return [lens(tolerance), plate, Turbulence(**air, tolerance_px=tolerance), swirls(tolerance)]


def image(batch: int = 2) -> torch.Tensor:
    return torch.rand(batch, 3, *SIZE, generator=torch.Generator().manual_seed(1))


def of_warps(plan: ComposePlan) -> list[Plan]:
    return [part for part in plan.plans if isinstance(part, Plan)]


def strides(plan: ComposePlan) -> list[int]:
    return [part.stride for part in of_warps(plan)]


@pytest.mark.parametrize("seed", range(24))
def test_the_composite_is_within_the_tolerance_everywhere(seed):
    dice = random.Random(seed)
    tolerance = dice.choice((1.0, 0.3, 0.1, 0.03))
    chosen = [dice.randrange(4) for _ in range(dice.randint(2, 4))]
    height, width = dice.randint(64, 200), dice.randint(64, 300)
    effects = Compose([parts(64.0)[i] for i in chosen], tolerance_px=tolerance)
    frame = torch.zeros(2, 1, height, width)
    found = effects.degrade(frame, seed=seed)
    exact = Compose([parts(None)[i] for i in chosen]).apply(frame, found.params)
    error = (found.flow - exact.flow).norm(dim=1).amax()
    plan = effects.planned(height, width, torch.float32)
    assert error <= plan.error_px <= tolerance
    assert tolerance < 1 or max(strides(plan)) > 1


def test_the_image_is_looked_up_along_the_composite():
    effects = Compose(parts(64.0), tolerance_px=0.1)
    x, y = torch.arange(SIZE[1]).double(), torch.arange(SIZE[0]).double()[:, None]
    ramps = torch.stack([x.expand(SIZE), y.expand(SIZE)])[None]
    found = effects.degrade(ramps, seed=3)
    # A ramp shows where it was looked up.
    seen = found.valid[:, :, 8:-8, 8:-8].expand(-1, 2, -1, -1)
    assert seen.float().mean() > 0.9
    missed = (found.image - ramps - found.flow)[:, :, 8:-8, 8:-8][seen]
    assert missed.abs().max() < 1e-9


def test_a_smaller_tolerance_asks_for_more():
    fine, coarse = (Compose(parts(64.0), tolerance_px=px).planned(1080, 1920, torch.float32) for px in (0.05, 1.0))
    assert all(a < b for a, b in zip(strides(fine), strides(coarse), strict=True))
    assert fine.error_px < coarse.error_px


def test_an_error_counts_as_much_as_the_slopes_before_it_stretch_it():
    (alone,) = of_warps(Compose([swirls(64.0)], tolerance_px=0.3).planned(540, 960, torch.float32))
    both = Compose([lens(64.0), swirls(64.0)], tolerance_px=0.3).planned(540, 960, torch.float32)
    first, behind = of_warps(both)
    assert first.slope > 0
    # One error of a chance and one that is none share in halves what knowing the composite seldom leaves: 7 tenths.
    assert both.error_px > 0.15
    assert behind.every > 1
    assert behind.tolerance_px == pytest.approx(0.7 * 0.15 / (1 + first.slope), rel=0.05)
    assert alone.tolerance_px == pytest.approx(0.3)


@pytest.mark.parametrize("effect", parts(0.1), ids=lambda effect: type(effect).__name__)
def test_slopes_are_no_steeper_than_planned(effect):
    flow = effect.degrade(torch.zeros(8, 1, 240, 320), seed=1).flow
    steepest = max(flow.diff(dim=dim).square().sum(dim=1).amax().sqrt().item() for dim in (2, 3))
    slope = effect.planned(240, 320, torch.float32).slope
    assert 0.2 * slope < steepest <= slope


@pytest.mark.parametrize("effect", parts(0.1), ids=lambda effect: type(effect).__name__)
def test_flows_are_as_smooth_as_planned(effect):
    exact = type(effect).exact(effect)
    flow = exact.degrade(torch.zeros(16, 1, 240, 320).double(), seed=1).flow
    smooth = effect.planned(240, 320, torch.float64).smooth

    def largest(values: torch.Tensor) -> float:
        return values.square().sum(dim=1).amax().sqrt().item()

    bends = max(largest(flow.diff(n=2, dim=dim)) for dim in (2, 3))
    assert 0.1 * smooth.bend < bends <= smooth.bend
    thirds = max(largest(flow.diff(n=3, dim=dim)) for dim in (2, 3))
    assert thirds <= smooth.third
    for px in (3, 4, 6):
        off = 0.0
        for first in ((0, 0), (1, 2), (2, 1)):  # where nodes lie
            known = flow[:, :, first[0] :: px, first[1] :: px]
            rows, columns = (px * (n - 3) for n in known.shape[2:])
            found = LatticeFlow(known, Lattice(rows, columns, px)).dense()
            own = flow[:, :, first[0] + px :, first[1] + px :][:, :, :rows, :columns]
            off = max(off, largest(found - own))
        assert 0.02 * smooth.cubics(px) < off <= smooth.cubics(px)
        assert smooth.cubics(px + 0.5) > smooth.cubics(px)


def test_plates_are_no_farther_off_along_axes_that_are_not_square():
    effect, (height, width), px = ThinPlateSpline(), (540, 960), 5.0
    y, x = torch.meshgrid(torch.linspace(0, height - 1, 4), torch.linspace(0, width - 1, 4), indexing="ij")
    points = torch.stack([x.flatten(), y.flatten()], dim=1).double()
    # One plate for each point that is displaced: the sum of squares is the variance for normal displacements.
    displaced = torch.eye(16, dtype=torch.float64)[:, :, None].expand(-1, -1, 2)
    spline = fit_spline(points.expand(16, -1, -1), displaced, torch.zeros(16))
    weight = lagrange_weights(6, 4, dtype=torch.float64, device=torch.device("cpu"))

    def largest(first: float, second: float) -> float:
        axes = torch.tensor([[math.cos(a), math.sin(a)] for a in (first, second)]).double()
        nodes = torch.cartesian_prod(*[torch.arange(-1.0, 3.0).double()] * 2) @ axes
        found = 0.0
        for place in torch.cartesian_prod(*[torch.arange(0.0, 1.0, 0.25).double()] * 2):  # of a point in its cell
            corner = points[:, None] - px * (place @ axes)
            known = evaluate_spline(spline, (corner + px * nodes).flatten(0, 1).expand(16, -1, -1))[..., 0].view(
                16, 16, 16
            )
            for i, j in itertools.product((1, 3, 5), repeat=2):
                at = corner[:, 0] + px / 6 * (torch.tensor([i, j]).double() @ axes)
                own = evaluate_spline(spline, at.expand(16, -1, -1))[..., 0]
                between = known @ torch.outer(weight[i], weight[j]).flatten()
                found = max(found, (own - between).square().sum(dim=0).amax().sqrt().item())
        return found

    square = largest(0.0, math.pi / 2)
    assert largest(math.pi / 4, 3 * math.pi / 4) == pytest.approx(square, rel=0.02)
    for between in (30, 45, 60, 75, 105, 150):
        assert 0.5 * square < largest(0.2, 0.2 + math.radians(between)) < square
    planned = effect.planned(height, width, torch.float64).smooth
    assert planned is not None
    assert 7 * effect.amplitude_range[1] * square <= planned.cubics(px)


def test_composites_are_known_as_seldom_as_the_tolerance_allows():
    often = dict[float, int]()
    for px in (0.03, 0.1, 0.3, 1.0, 3.0):
        plan = Compose(parts(64.0), tolerance_px=px).planned(540, 960, torch.float32)
        (often[px],) = {part.every for part in of_warps(plan)}
        assert plan.error_px <= px
        assert (f"composite      every {often[px]} px" in str(plan)) == (often[px] > 1)
    assert list(often.values()) == sorted(often.values())
    assert often[0.03] < often[0.3] < often[3.0]
    # Nothing is composed of what is looked up by itself, or has no bound.
    alone = Compose(parts(64.0)[:1], tolerance_px=1.0).planned(*SIZE, torch.float32)
    light = Compose([*parts(64.0)[:1], UniformFog(), *parts(64.0)[1:2]], tolerance_px=1.0).planned(*SIZE, torch.float32)
    sharp = Turbulence(aperture_range=(0.0, 0.0))
    rough = Compose([*parts(64.0)[:2], sharp], tolerance_px=1.0).planned(*SIZE, torch.float32)
    exact = Compose(parts(64.0), tolerance_px=None).planned(*SIZE, torch.float32)
    assert {part.every for plan in (alone, light, rough, exact) for part in of_warps(plan)} == {1}


@pytest.mark.parametrize("tolerance", [1.0, 3.0])
def test_flows_that_leave_the_frame_are_within_the_tolerance(tolerance):
    # Displacements of a tenth of the frame: at its sides earlier flows are read outside, where they have kinks.
    def far(px: float | None) -> list[LatticeWarp]:
        lens_far = LensDistortion(k1_range=(-0.3, -0.3), k2_range=(0.09, 0.09), focal_range=(0.9, 0.9), tolerance_px=px)
        plate = ThinPlateSpline(amplitude_range=(8.0, 8.0), tolerance_px=px)
        return [swirls(px), plate, lens_far]

    effects = Compose(far(64.0), tolerance_px=tolerance)
    frame = torch.zeros(3, 1, 270, 480)
    plan = effects.planned(270, 480, torch.float32)
    assert {part.every > 1 for part in of_warps(plan)} == {True}
    found = effects.degrade(frame, seed=7)
    exact = Compose(far(None)).apply(frame.double(), found.params.to(torch.float64))
    assert exact.flow.abs().max() > 20
    assert (found.flow - exact.flow).norm(dim=1).amax() <= plan.error_px <= tolerance


def test_what_follows_a_warp_of_unknown_slope_is_exact():
    unknown = Turbulence(normalize="image", tolerance_px=0.1)
    before, after = parts(0.1)[1:3]
    plan = Compose([before, unknown, after], tolerance_px=0.3).planned(*SIZE, torch.float32)
    assert strides(plan)[0] > 1
    assert strides(plan)[1:] == [1, 1]
    assert "whose slope is not known" in of_warps(plan)[2].why


@pytest.mark.parametrize("aperture", [0.0, 0.3, 3.0])
@pytest.mark.parametrize("covariance", ["exponential", "matern32", "matern52"])
def test_what_follows_rough_air_is_within_the_tolerance(covariance, aperture):
    def row(tolerance: float | None) -> list[LatticeWarp]:
        ranges: dict[str, Any] = {"amplitude_range": (0.2, 0.4), "length_range": (10.0, 20.0)}
        apertures = (aperture, aperture)
        air = Turbulence(**ranges, aperture_range=apertures, covariance=covariance, tolerance_px=tolerance)
        return [lens(tolerance), air, *parts(tolerance)[2:]]

    effects = Compose(row(64.0), tolerance_px=0.2)
    plan = effects.planned(*SIZE, torch.float32)
    found = effects.degrade(image(), seed=4)
    exact = Compose(row(None)).apply(image().double(), found.params.to(torch.float64))
    assert (strides(plan)[1] > 1) == (aperture == 3)
    assert min(strides(plan)[2:]) > 1
    assert (found.flow - exact.flow).norm(dim=1).amax() <= plan.error_px
    alone = row(0.2)[1]
    flow = alone.degrade(torch.zeros(8, 1, 240, 320), seed=1).flow
    steepest = max(flow.diff(dim=dim).square().sum(dim=1).amax().sqrt().item() for dim in (2, 3))
    slope = alone.planned(240, 320, torch.float32).slope
    assert 0.2 * slope < steepest <= 7 / 4 * slope  # which counts four deviations


@pytest.mark.parametrize("seed", range(4))
def test_what_follows_a_warp_that_is_exact_has_a_lattice_if_slopes_are_known(seed):
    def row(tolerance: float | None) -> list[LatticeWarp]:
        lens, _, air, swirls = parts(tolerance)
        return [lens, ThinPlateSpline(amplitude_range=(3.0, 4.0), tolerance_px=tolerance), air, swirls]

    effects = Compose(row(64.0), tolerance_px=0.03)
    plan = effects.planned(*SIZE, torch.float32)
    first, bent, *others = strides(plan)
    assert bent == 1
    assert min(first, *others) > 1
    # It leaves its share to the others.
    shares = [part.error_px for part in of_warps(plan)]
    assert 0.02 < plan.error_px <= 0.03
    assert shares[1] == 0
    found = effects.degrade(image(), seed=seed)
    exact = Compose(row(None)).apply(image().double(), found.params.to(torch.float64))
    assert (found.flow - exact.flow).norm(dim=1).amax() <= plan.error_px


def test_a_warp_whose_share_is_below_rounding_is_exact_and_others_are_not():
    def row(tolerance: float | None) -> list[LatticeWarp]:
        lens, _, *fields = parts(tolerance)
        return [lens, *fields]

    height, width = 64, 1920
    effects = Compose(row(64.0), tolerance_px=0.008)
    plan = effects.planned(height, width, torch.float32)
    first, *others = of_warps(plan)
    assert (first.stride, first.error_px) == (1, 0.0)
    assert "below rounding" in first.why
    assert min(other.stride for other in others) > 1
    found = effects.degrade(torch.zeros(1, 1, height, width), seed=2)
    frame = torch.zeros(1, 1, height, width, dtype=torch.float64)
    exact = Compose(row(None)).apply(frame, found.params.to(torch.float64))
    assert (found.flow - exact.flow).norm(dim=1).amax() <= plan.error_px <= 0.008


def test_an_effect_without_a_tolerance_stays_exact():
    effects = parts(0.1)
    effects[2].tolerance_px = None
    assert strides(Compose(effects, tolerance_px=0.1).planned(*SIZE, torch.float32))[2] == 1


def test_parameters_outside_the_ranges_are_exact():
    wild = Compose(parts(None)).sample(image(), seed=2)
    other = wild.children[0]._replace(coefficients=2 * wild.children[0].coefficients)
    wild = wild._replace(children=(other, *wild.children[1:]))
    found = Compose(parts(64.0), tolerance_px=0.1).apply(image(), wild)
    exact = Compose(parts(None)).apply(image(), wild)
    assert_close(found.flow, exact.flow, rtol=0, atol=1e-4)


def test_the_plan_is_printed_and_names_what_is_dropped(capsys):
    still = DivergenceFree(amplitude_range=(0.0, 0.0), tolerance_px=0.1)
    off = Turbulence(p=0.0)
    plan = Compose([*parts(0.1)[:2], UniformFog(), still, off], tolerance_px=0.1).plan(*SIZE)
    told = capsys.readouterr().out
    assert told.strip() == str(plan)
    assert strides(plan)[2:] == [0, 0]
    assert plan.resamples == 1
    lines = told.splitlines()
    assert lines[-3].split(maxsplit=1) == ["UniformFog", "at every pixel (no tolerance)"]
    assert lines[-2].split(maxsplit=1) == ["DivergenceFree", "not computed (its strength is 0)"]
    assert lines[-1].split(maxsplit=1) == ["Turbulence", "not computed (its p is 0)"]


def test_a_composition_that_is_off_computes_nothing():
    plan = Compose([Compose(parts(0.1), p=0.0)], tolerance_px=0.1).planned(*SIZE, torch.float32)
    assert strides(plan) == [0] * 4
    assert plan.resamples == 0


def test_light_between_warps_takes_two_resamples():
    first, then = parts(0.1)[:2]
    assert Compose([first, UniformFog(), then], tolerance_px=0.1).planned(*SIZE, torch.float32).resamples == 2


def test_without_a_tolerance_all_is_exact_whatever_the_effects_have():
    effects = Compose(parts(0.1), tolerance_px=None)
    plan = effects.planned(*SIZE, torch.float32)
    assert strides(plan) == [1, 1, 1, 1]
    assert plan.error_px == 0
    found = effects.degrade(image(), seed=1)
    assert torch.equal(found.flow, Compose(parts(None), tolerance_px=None).apply(image(), found.params).flow)


def test_depth_and_maps_of_light_move_along_as_with_exact_flows():
    depth = torch.linspace(1, 100, SIZE[1]).expand(2, 1, *SIZE)
    first, second, third, _ = parts(64.0)
    found = Compose([first, second, UniformFog(), third], tolerance_px=0.1).degrade(image(), seed=2, depth=depth)
    first, second, third, _ = parts(None)
    exact = Compose([first, second, UniformFog(), third]).apply(image(), found.params, depth=depth)
    seen = exact.valid[..., 4:-4, 4:-4]
    near = (found.transmission - exact.transmission)[..., 4:-4, 4:-4].abs()
    # A position that is off by little may be nearest to the next pixel, whose depth is 0.8 m greater.
    assert near[seen].mean() < 1e-3
    assert (found.flow - exact.flow).norm(dim=1).amax() <= 0.1


def test_a_sample_does_not_depend_on_the_others():
    effects = OneOf([Compose(parts(64.0)), *parts(64.0)[:2]], tolerance_px=0.1)
    together = effects.degrade(image(12), seed=5)
    gates = torch.stack([own.applied for _, own in effects.leaves(together.params)], dim=1)
    assert len(gates.unique(dim=0)) == 3
    for i in range(12):
        alone = effects.degrade(image(12)[i : i + 1], seed=5, keys=[i])
        assert torch.equal(alone.image[0], together.image[i])
        assert torch.equal(alone.flow[0], together.flow[i])


def test_one_of_several_has_the_whole_tolerance():
    plan = OneOf(parts(64.0), tolerance_px=0.1).planned(540, 960, torch.float32)
    alone = [Compose([part], tolerance_px=0.1).planned(540, 960, torch.float32) for part in parts(64.0)]
    assert strides(plan) == [strides(own)[0] for own in alone]
    assert max(strides(plan)) > 1
    assert plan.error_px == max(own.error_px for own in alone)


def test_one_of_several_beside_others_shares_with_them_alone():
    air, plate = parts(64.0)[2], parts(64.0)[1]
    both = Compose([OneOf([swirls(64.0), Turbulence(normalize="image", p=0.5)]), plate], tolerance_px=0.1)
    # A turbulence that is normalized by itself has no slope that is known, so what follows it is exact.
    first, *others = strides(both.planned(*SIZE, torch.float32))
    assert first > 1
    assert others == [1, 1]
    smooth = Compose([OneOf([Compose([swirls(64.0), air]), swirls(64.0)]), plate], tolerance_px=0.1)
    found = of_warps(smooth.planned(540, 960, torch.float32))
    row = of_warps(Compose([swirls(64.0), air, plate], tolerance_px=0.1).planned(540, 960, torch.float32))
    # The plate follows a row of two, or a single one: it gets the smaller share.
    assert [part.stride for part in found[:2]] == [part.stride for part in row[:2]]
    assert found[3].tolerance_px == pytest.approx(row[2].tolerance_px)


@pytest.mark.parametrize("seed", range(6))
def test_one_of_several_is_within_the_tolerance(seed):
    def effects(tolerance: float | None) -> Compose:
        lens, plate, air, swirls = parts(tolerance)
        return Compose([OneOf([lens, plate, Compose([air, swirls])]), parts(tolerance)[3]])

    planned = effects(64.0)
    planned.tolerance_px = 0.1
    frame = torch.zeros(6, 1, *SIZE)
    found = planned.degrade(frame, seed=seed)
    exact = effects(None).apply(frame, found.params)
    assert (found.flow - exact.flow).norm(dim=1).amax() <= planned.planned(*SIZE, torch.float32).error_px <= 0.1
    assert not torch.equal(found.flow, exact.flow)


def test_of_more_compositions_than_can_be_told_apart_all_count_as_acting_together():
    many = Compose([OneOf(parts(64.0)) for _ in range(4)], tolerance_px=1.0).planned(*SIZE, torch.float32)
    row = Compose([part for _ in range(4) for part in parts(64.0)], tolerance_px=1.0).planned(*SIZE, torch.float32)
    assert [part.tolerance_px for part in of_warps(many)] == [part.tolerance_px for part in of_warps(row)]


def test_one_of_several_is_exact_where_parameters_have_two_act():
    params = Compose(parts(None)).sample(image(), seed=2)
    found = OneOf(parts(64.0), tolerance_px=0.1).apply(image(), params)
    exact = Compose(parts(None), tolerance_px=None).apply(image(), params)
    assert torch.equal(found.flow, exact.flow)


def test_gradients_are_those_of_the_exact_composite_within_the_tolerance():
    params = Compose(parts(None)).sample(image().double(), seed=2)
    weight = torch.rand(2, 3, *SIZE, dtype=torch.float64)
    # A smooth picture: that of white noise has a gradient which is as rough.
    smooth = torch.sin(torch.arange(SIZE[1]).double() / 9).expand(2, 3, *SIZE)
    slopes = []
    for effects in (Compose(parts(64.0), tolerance_px=0.01), Compose(parts(None))):
        amplitude = params.children[2].amplitude.clone().requires_grad_()
        focal = params.children[0].focal.clone().requires_grad_()
        first, second, third, fourth = params.children
        children = (first._replace(focal=focal), second, third._replace(amplitude=amplitude), fourth)
        degraded = effects.apply(smooth, params._replace(children=children)).image
        slopes.append(torch.autograd.grad((weight * degraded).mean(), [amplitude, focal]))
    for coarse, exact in zip(*slopes, strict=True):
        assert_close(coarse, exact, rtol=0, atol=0.05 * exact.abs().max().item())


def test_one_graph_gives_the_same():
    effects = Compose([*parts(64.0), UniformFog()], tolerance_px=0.1)

    def degraded(frame: torch.Tensor, seed: torch.Tensor) -> torch.Tensor:
        return effects.degrade(frame, seed=seed).image

    compiled = torch.compile(degraded, fullgraph=True, backend="aot_eager")
    assert_close(compiled(image(), torch.tensor(4)), degraded(image(), torch.tensor(4)), rtol=0, atol=5e-4)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e6])
def test_a_tolerance_that_is_none_raises(value):
    with pytest.raises(ValueError, match="tolerance_px must"):
        Compose(parts(0.1), tolerance_px=value)


def test_a_tolerance_below_rounding_raises_and_says_what_can_be_kept():
    with pytest.raises(ValueError, match=r"tolerance_px must be at least 0.00\d+ px for float32 positions"):
        Compose(parts(0.1), tolerance_px=1e-5).plan(1080, 1920)


def test_a_share_below_rounding_is_exact():
    plan = Compose(parts(64.0), tolerance_px=0.004).planned(1080, 1920, torch.float32)
    assert 1 in strides(plan)
    assert plan.error_px <= 0.004


def test_a_plan_of_no_frame_raises():
    with pytest.raises(ValueError, match="height must be at least 1"):
        Compose(parts(0.1), tolerance_px=0.1).plan(0, 10)


def test_every_effect_has_a_plan(capsys):
    camera = Camera(width=130, height=96, fx=100.0, fy=100.0, cx=64.5, cy=47.5, coefficients=(-0.1, 0.0, 0.0, 0.0))
    for effect in (Rectification(camera), *parts(0.1), UniformFog(), LensFlare(), Compose(parts(0.1))):
        plan = effect.plan(*SIZE)
        assert (plan.height, plan.width) == SIZE
        assert capsys.readouterr().out.strip() == str(plan)
    plan = Compose([Rectification(camera, tolerance_px=None), *parts(0.1)], tolerance_px=0.1).planned(
        *SIZE, torch.float32
    )
    # The rectification is exact, and what follows it is, too.
    assert strides(plan) == [1] * 5

"""Plans of compositions: the composed flow stays within the tolerance, everywhere."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import (
    Camera,
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
from torchrefract.effects.batch_flow import WarpFlow, errors_at_nodes, flow_on_measured_lattice, lattice_error
from torchrefract.effects.thin_plate import ThinPlateParams
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.planning.composition import CompositionPlan, PlannedWarp, plan_composition
from torchrefract.planning.plan import PlanRequest, WarpPlan
from torchrefract.types import FlowBounds, Simplification
from torchrefract.warping.grid import Points
from torchrefract.warping.lattice import Lattice, LatticeFlow, pixel_lattice

SIZE = (96, 130)
CAMERA = Camera(width=320, height=240, fx=290.0, fy=290.0, cx=160.0, cy=120.0, coefficients=(-0.2, 0.05, 1e-3, 0.0))


def lens(tolerance_px: float | None) -> WarpEffect:
    ranges: dict[str, Any] = {"k1_range": (-0.12, -0.05), "k2_range": (0.0, 0.01), "focal_range": (0.9, 1.1)}
    return LensDistortion(**ranges, tolerance_px=tolerance_px)


def thin_plate(tolerance_px: float | None) -> WarpEffect:
    return ThinPlateSpline(amplitude_range=(0.5, 1.0), tolerance_px=tolerance_px)


def turbulence(tolerance_px: float | None) -> WarpEffect:
    ranges: dict[str, Any] = {"amplitude_range": (0.5, 1.0), "length_range": (20.0, 30.0)}
    return Turbulence(**ranges, covariance="gaussian", tolerance_px=tolerance_px)


def divergence_free(tolerance_px: float | None) -> WarpEffect:
    return DivergenceFree(amplitude_range=(0.5, 1.0), length_range=(25.0, 40.0), tolerance_px=tolerance_px)


def four_warps(tolerance_px: float | None) -> list[WarpEffect]:
    return [make(tolerance_px) for make in (lens, thin_plate, turbulence, divergence_free)]


def picture(batch: int = 2) -> Tensor:
    return torch.rand(batch, 3, *SIZE, generator=torch.Generator().manual_seed(1))


def distance(flow: Tensor, other: Tensor) -> float:
    """Return the largest distance of two flows, px."""
    return (flow - other).square().sum(dim=1).sqrt().max().item()


def exact_flow(effects: list[Any], image: Tensor, params: Any) -> Tensor:
    """Compute the composed flow at every pixel in float64."""
    return Compose(effects, tolerance_px=None).apply(image.double(), params.to(torch.float64)).flow


@dataclass(frozen=True)
class SharesOfBudget:
    """The error model of a flow that uses its whole budget at every pixel, and has a largest gradient."""

    gradient: float
    is_random: bool = False
    is_rough: bool = False

    def bounds(self, height: int, width: int) -> FlowBounds:
        return FlowBounds(10.0, self.gradient, lambda strides: np.zeros(np.shape(strides)))

    def simplify(self, height: int, width: int, budget_px: float) -> Simplification:
        return Simplification(budget_px, details="simplified", can_interpolate=not self.is_rough)

    def contains(self, params: Any) -> Tensor:
        return torch.tensor(True)


@pytest.mark.quick
@pytest.mark.parametrize(("can_measure", "is_rough"), [(False, False), (True, False), (True, True)])
@pytest.mark.parametrize("is_random", [False, True])
def test_shares_of_the_tolerance_allow_for_the_stretch_of_the_warps_before(is_random, can_measure, is_rough):
    gradients = (0.5, 0.2, 9.0, 0.0)
    warps = tuple(PlannedWarp(SharesOfBudget(gradient, is_random, is_rough), 4, False) for gradient in gradients)
    plan = plan_composition(warps, PlanRequest(*SIZE, 1.0, is_double=True), can_measure=can_measure)
    # d_i = d_(i+1) + f_i(p + d_(i+1)), so an error e of d_(i+1) becomes at most (1 + L_i) e.
    # Measuring sees whether they are above 4, but not for fields that are too rough for a lattice.
    stretches = [1, 1.5, 1.5 * 1.2, 4 if can_measure and not is_rough else 1.5 * 1.2 * 10]
    errors = [part.error_px * stretch for part, stretch in zip(plan.plans, stretches, strict=True)]
    assert errors == pytest.approx([errors[0]] * 4, rel=1e-9)
    total = math.hypot(*errors) if is_random else sum(errors)
    assert 0.3 < total < 0.5
    assert plan.max_gradient == pytest.approx(1.5 * 1.2 * 10 - 1)


def scaling(scale: float, error_px: float, *, has_closed_form: bool = True) -> WarpFlow:
    """Return the flow p -> scale p of two samples, whose plan says that it has an error."""

    def evaluate(params: Any, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        x, y = torch.broadcast_tensors(points.x, points.y)
        return ((scale - 1) * torch.cat([x, y], dim=1)).expand(2, -1, -1, -1), torch.ones(1, 1, 1, 1, dtype=torch.bool)

    applied = torch.ones(2, dtype=torch.bool)
    params = ThinPlateParams(applied, *[torch.ones(2, dtype=torch.float64)] * 3)
    plan = WarpPlan(*SIZE, 1.0, 4, error_px, "test")
    return WarpFlow(evaluate, params, applied, plan, has_closed_form=has_closed_form)


@pytest.mark.quick
@pytest.mark.parametrize("has_closed_form", [True, False])
@pytest.mark.parametrize(("scale", "is_exact"), [(1.5, False), (3.0, True)])
def test_samples_that_stretch_errors_beyond_their_share_are_exact(scale, is_exact, has_closed_form):
    warps = [scaling(scale, 0.0), scaling(0.9, 0.2, has_closed_form=has_closed_form)]
    (part,) = flow_on_measured_lattice(warps, stride=16, tolerance_px=1.0)
    # 0.2 px become 1.25 x 1.5 x 0.2 = 0.375 px or 0.75 px, of which half of the tolerance is allowed.
    assert (part.flow.lattice.stride == 1) == is_exact
    x = torch.arange(SIZE[1]).double()
    assert_close(part.flow.dense()[1, 0, 5], (0.9 * scale - 1) * x, rtol=0, atol=1e-9)


@pytest.mark.quick
def test_the_error_of_every_other_node_is_that_of_the_remainder():
    x = torch.arange(-9, 12, dtype=torch.float64)
    nodes = torch.zeros(2, 2, 9, 21, dtype=torch.float64)
    nodes[1, 0] = x**4
    # The cubic through -3, -1, 1 and 3 is off at 0 by 9 / 24 of the fourth derivative, and likewise elsewhere.
    expected = torch.tensor([0.0, 9.0]).double().view(2, 1, 1, 1).expand(2, 1, 9, 21)
    assert_close(errors_at_nodes(nodes), expected, rtol=0, atol=1e-9)
    assert_close(errors_at_nodes(nodes.mT), expected.mT, rtol=0, atol=1e-9)


def kink(x: Tensor, y: Tensor, at: float) -> Tensor:
    """Return the kernel r^2 ln r of a thin-plate spline with a control point at (80 + at, 80 - at / 2)."""
    square = (x - 80 - at) ** 2 + (y - 80 + at / 2) ** 2 + 1e-30
    return square * square.log() / 2


@pytest.mark.quick
@pytest.mark.parametrize("function", ["kink", "wave"])
@pytest.mark.parametrize("at", range(8))
def test_the_estimated_error_of_a_lattice_is_above_the_true_one(function, at):
    def flow(points: Points) -> Tensor:
        x, y = torch.broadcast_tensors(points.x, points.y)
        values = kink(x, y, at) if function == "kink" else torch.sin(x / 9 + y / 12 + at)
        return torch.cat([values, 0 * values], dim=1)

    lattice, pixels = Lattice(160, 160, 8, 2), pixel_lattice(160, 160)
    nodes, dense = (flow(each.points(dtype=torch.float64, device=torch.device("cpu"))) for each in (lattice, pixels))
    true = distance(LatticeFlow(nodes, lattice).dense(), dense)
    assert true < lattice_error(nodes).item() < (15 if function == "kink" else 5) * true


def planned(effects: list[WarpEffect], px: float, size: tuple[int, int] = (540, 960)) -> CompositionPlan:
    warps = [PlannedWarp(effect.error_model(), effect.rounding_ulps, effect.has_closed_form) for effect in effects]
    return plan_composition(tuple(warps), PlanRequest(*size, px, is_double=False))


@pytest.mark.quick
def test_the_lattice_of_a_composition_gets_coarser_with_the_tolerance():
    strides = []
    params = Compose(four_warps(None)).sample(torch.zeros(1, 1, 540, 960), seed=3).children
    for px in (0.01, 0.1, 1.0, 10.0):
        plan = planned(four_warps(64.0), px)
        warps = [effect.warp_flow(*each) for effect, *each in zip(four_warps(px), params, plan.plans, strict=True)]
        (part,) = flow_on_measured_lattice(warps, stride=64, tolerance_px=px)
        strides.append(part.flow.lattice.stride)
        text = str(Compose(four_warps(64.0), tolerance_px=px).plan(540, 960))
        assert f"composed flow  every {plan.stride} px or finer" in text
    assert strides == sorted(strides)
    assert strides[0] < strides[2] < strides[3] <= 64


def test_flows_that_leave_the_frame_are_within_the_tolerance():
    def effects(px: float | None) -> list[Any]:
        barrel = LensDistortion(k1_range=(-0.3, -0.3), k2_range=(0.09, 0.09), focal_range=(0.9, 0.9), tolerance_px=px)
        return [divergence_free(px), ThinPlateSpline(amplitude_range=(8.0, 8.0), tolerance_px=px), barrel]

    effect = Compose(effects(64.0), tolerance_px=1.0)
    image = torch.zeros(3, 1, 270, 480)
    plan = effect.plan(270, 480)
    assert plan.groups[0].stride > 1
    degraded = effect.degrade(image, seed=7)
    exact = exact_flow(effects(None), image, degraded.params)
    assert exact.abs().max() > 20
    assert distance(degraded.flow, exact) <= plan.error_px <= 1


@pytest.mark.parametrize("aperture", [0.0, 3.0])
def test_warps_around_rough_turbulence_are_within_the_tolerance(aperture):
    def effects(px: float | None) -> list[Any]:
        ranges: dict[str, Any] = {"amplitude_range": (0.2, 0.4), "length_range": (10.0, 20.0)}
        rough = Turbulence(**ranges, aperture_range=(aperture, aperture), tolerance_px=px)
        return [lens(px), rough, turbulence(px), divergence_free(px)]

    effect = Compose(effects(64.0), tolerance_px=0.2)
    plan = effect.plan(*SIZE)
    assert (plan.plans[1].stride > 1) == (aperture == 3)
    degraded = effect.degrade(picture(), seed=4)
    assert distance(degraded.flow, exact_flow(effects(None), picture(), degraded.params)) <= plan.error_px <= 0.2


BOUNDED: list[WarpEffect] = [*four_warps(0.1), Rectification(CAMERA, tolerance_px=0.1)]


@pytest.mark.parametrize("effect", BOUNDED, ids=lambda effect: type(effect).__name__)
def test_flows_obey_the_bounds_of_their_error_model(effect):
    flow = effect.exact().degrade(torch.zeros(8, 1, 240, 320, dtype=torch.float64), seed=1).flow
    model = effect.error_model()
    assert model is not None
    bounds = model.bounds(240, 320)
    assert bounds is not None

    def largest(values: Tensor) -> float:
        return values.square().sum(dim=1).amax().sqrt().item()

    assert largest(flow) <= bounds.max_displacement
    steepest = max(largest(flow.diff(dim=dim)) for dim in (2, 3))
    assert 0.1 * bounds.max_gradient < steepest <= bounds.max_gradient
    for px in (3, 6):
        error = 0.0
        for y, x in ((0, 0), (1, 2)):  # the first node
            nodes = flow[:, :, y::px, x::px]
            rows, columns = (px * (n - 3) for n in nodes.shape[2:])
            between = LatticeFlow(nodes, Lattice(rows, columns, px)).dense()
            error = max(error, largest(between - flow[:, :, y + px :, x + px :][:, :, :rows, :columns]))
        assert 0.02 * bounds.interpolation_error(np.array([float(px)]))[0] < error
        assert error <= bounds.interpolation_error(np.array([float(px)]))[0]


@pytest.mark.quick
def test_warps_after_an_unknown_gradient_are_exact():
    unknown = Turbulence(normalize="image", tolerance_px=0.1)
    plan = Compose([turbulence(0.1), unknown, thin_plate(0.1)], tolerance_px=0.3).plan(*SIZE)
    assert [part.stride for part in plan.plans][1:] == [1, 1]
    assert plan.plans[0].stride > 1
    assert plan.plans[2].error_px == 0


@pytest.mark.quick
def test_a_warp_whose_tolerance_is_none_stays_exact():
    effects = four_warps(0.1)
    effects[2].tolerance_px = None
    assert Compose(effects, tolerance_px=0.1).plan(*SIZE).plans[2].stride == 1


def test_a_warp_whose_share_is_below_rounding_is_exact_and_others_are_not():
    effect = Compose([lens(64.0), turbulence(64.0), divergence_free(64.0)], tolerance_px=0.004)
    plan = effect.plan(64, 1920)
    assert "below rounding" in str(plan)
    image = torch.zeros(1, 1, 64, 1920)
    degraded = effect.degrade(image, seed=2)
    exact = exact_flow([lens(None), turbulence(None), divergence_free(None)], image, degraded.params)
    assert plan.error_px <= 0.004
    assert distance(degraded.flow, exact) <= 0.004


def test_without_a_tolerance_the_composition_is_exact_whatever_its_effects_have():
    effect = Compose(four_warps(0.1), tolerance_px=None)
    plan = effect.plan(*SIZE)
    assert [part.stride for part in plan.plans] == [1, 1, 1, 1]
    assert plan.error_px == 0
    degraded = effect.degrade(picture(), seed=1)
    assert torch.equal(
        degraded.flow, Compose(four_warps(None), tolerance_px=None).apply(picture(), degraded.params).flow
    )


def test_parameters_outside_the_ranges_are_exact():
    params = Compose(four_warps(None)).sample(picture(), seed=2)
    stronger = params.children[0]._replace(coefficients=2 * params.children[0].coefficients)
    params = params._replace(children=(stronger, *params.children[1:]))
    flow = Compose([lens(64.0), *four_warps(None)[1:]], tolerance_px=0.1).apply(picture(), params).flow
    assert_close(flow, Compose(four_warps(None), tolerance_px=None).apply(picture(), params).flow, rtol=0, atol=1e-4)


@pytest.mark.quick
def test_the_plan_names_each_effect_and_whether_it_is_computed():
    still, off = DivergenceFree(amplitude_range=(0.0, 0.0)), Turbulence(p=0.0)
    plan = Compose([lens(0.1), thin_plate(0.1), UniformFog(tolerance=None), still, off], tolerance_px=0.1).plan(*SIZE)
    assert (plan.height, plan.width, plan.num_samplings) == (*SIZE, 1)
    lines = [line.split(maxsplit=1) for line in str(plan).splitlines()]
    assert [name for name, _ in lines[-5:]] == [
        "LensDistortion",
        "ThinPlateSpline",
        "UniformFog",
        "DivergenceFree",
        "Turbulence",
    ]
    assert lines[-2][1] == "not computed (it moves nothing)"


@pytest.mark.quick
@pytest.mark.parametrize(
    ("effects", "samplings"),
    [
        ([lens(0.1), thin_plate(0.1)], 1),
        ([lens(0.1), UniformFog(), thin_plate(0.1)], 2),
        ([lens(0.1), LensFlare(p=0.0), thin_plate(0.1)], 1),
        ([UniformFog(), lens(0.1)], 1),
        ([UniformFog()], 0),
        ([DivergenceFree(amplitude_range=(0.0, 0.0))], 0),
    ],
)
def test_the_plan_counts_the_samplings(effects, samplings):
    assert Compose(effects, tolerance_px=0.1).plan(*SIZE).num_samplings == samplings


def test_depth_and_maps_of_light_move_along_the_planned_flow():
    depth = torch.linspace(1, 100, SIZE[1]).expand(2, 1, *SIZE)

    def effects(px: float | None) -> list[Any]:
        return [lens(px), thin_plate(px), UniformFog(), turbulence(px)]

    degraded = Compose(effects(64.0), tolerance_px=0.1).degrade(picture(), seed=2, depth=depth)
    exact = Compose(effects(None), tolerance_px=None).apply(picture(), degraded.params, depth=depth)
    difference = (degraded.transmission - exact.transmission)[..., 4:-4, 4:-4].abs()
    # A slightly different position may be nearest to the next pixel, whose depth is 0.8 m greater.
    assert difference[exact.valid[..., 4:-4, 4:-4]].mean() < 1e-3
    assert distance(degraded.flow, exact.flow) <= 0.1


@pytest.mark.parametrize("seed", range(3))
def test_one_of_several_effects_is_within_the_tolerance(seed):
    def effects(px: float | None) -> list[Any]:
        choice = OneOf([lens(px), thin_plate(px), Compose([turbulence(px), divergence_free(px)])])
        return [choice, divergence_free(px)]

    effect = Compose(effects(64.0), tolerance_px=0.1)
    image = torch.zeros(6, 1, *SIZE)
    degraded = effect.degrade(image, seed=seed)
    exact = exact_flow(effects(None), image, degraded.params)
    assert 1e-4 < distance(degraded.flow, exact) <= effect.plan(*SIZE).error_px <= 0.1


def test_the_lattice_of_a_sample_does_not_depend_on_its_batch():
    effect = Compose(four_warps(64.0), tolerance_px=0.05)
    image = torch.zeros(6, 1, 120, 160)
    together = effect.degrade(image, seed=4).flow
    alone = torch.cat([effect.degrade(image[:1], seed=4, keys=[key]).flow for key in range(6)])
    assert distance(together, alone) <= 1e-4


def test_gradients_agree_with_those_of_the_exact_composition_within_the_tolerance():
    params = Compose(four_warps(None)).sample(picture().double(), seed=2)
    weight = torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    image = torch.sin(torch.arange(SIZE[1]).double() / 9).expand(2, 3, *SIZE)  # smooth, as its gradient has to be
    gradients = []
    for effects in (Compose(four_warps(64.0), tolerance_px=0.01), Compose(four_warps(None), tolerance_px=None)):
        amplitude = params.children[2].amplitude.clone().requires_grad_()
        focal = params.children[0].focal.clone().requires_grad_()
        first, second, third, fourth = params.children
        children = (first._replace(focal=focal), second, third._replace(amplitude=amplitude), fourth)
        degraded = effects.apply(image, params._replace(children=children)).image
        gradients.append(torch.autograd.grad((weight * degraded).mean(), [amplitude, focal]))
    for coarse, exact in zip(*gradients, strict=True):
        assert_close(coarse, exact, rtol=0, atol=0.05 * exact.abs().max().item())


def test_one_graph_gives_a_flow_within_the_tolerance():
    effect = Compose([thin_plate(64.0), thin_plate(64.0)], tolerance_px=0.1)
    compiled = torch.compile(lambda image, seed: effect.degrade(image, seed=seed).flow, fullgraph=True, backend="eager")
    exact = exact_flow([thin_plate(None)] * 2, picture(), effect.sample(picture(), seed=4))
    assert distance(compiled(picture(), torch.tensor(4)), exact) <= 0.1


@pytest.mark.quick
def test_a_lens_in_a_frame_whose_rounding_exceeds_the_default_is_exact():
    width = 11_000  # at which a lens is off by more than 0.01 px, but not other warps
    plan = Compose([lens(0.02)]).plan(2, width)
    assert (plan.plans[0].stride, plan.error_px) == (1, 0.0)
    assert Compose([lens(0.02), turbulence(0.02)]).plan(2, width).error_px <= 0.02

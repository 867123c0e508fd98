import math
import warnings
from copy import copy
from typing import Any

import numpy as np
import pytest
import tolerance
import torch
from scipy.interpolate import lagrange
from torch.testing import assert_close
from torchrefract.effects.field_plan import FieldPlan
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.plan import MOST_ULPS
from torchrefract.fields.stream import curl

from torchrefract import Compose, DivergenceFree, LensDistortion, ThinPlateSpline, Turbulence, UniformFog
from torchrefract.warping.grid import sampler_grid
from torchrefract.warping.lattice import Lattice, LatticeFlow, StreamFlow, between_nodes

SIZE = (96, 144)
ARGUMENTS: dict[str, tuple[type[LatticeWarp], dict[str, Any]]] = {
    "lens": (LensDistortion, {"k2_range": (0.09, 0.12), "focal_range": (0.9, 1.1)}),
    "plate": (ThinPlateSpline, {"amplitude_range": (0.5, 1.0)}),
    "turbulence": (Turbulence, {"covariance": "gaussian"}),
    "rough turbulence": (Turbulence, {"length_range": (10.0, 20.0), "aperture_range": (3.0, 4.0)}),
    "swirl": (DivergenceFree, {"amplitude_range": (1.0, 2.0)}),
}


def made(name: str, px: float | None) -> LatticeWarp:
    kind, arguments = ARGUMENTS[name]
    return kind(**arguments, tolerance_px=px)


WARPS = {name: made(name, 0.1) for name in ARGUMENTS}
every_warp = pytest.mark.parametrize("name", list(WARPS))


def image(batch: int = 2) -> torch.Tensor:
    return torch.rand(batch, 3, *SIZE, generator=torch.Generator().manual_seed(3))


@pytest.mark.parametrize("name", list(tolerance.CONFIGURATIONS))
@pytest.mark.parametrize("seed", range(1000, 1012))
def test_no_flow_is_farther_from_the_exact_one_than_its_tolerance(name, seed, monkeypatch):
    monkeypatch.setattr(tolerance, "LARGEST", (480, 640))
    trial = tolerance.attempt(name, seed)
    assert trial.error_px <= trial.tolerance_px
    assert trial.error_px <= trial.bound_px + 1e-3 <= trial.tolerance_px + 1e-3


@every_warp
def test_a_tolerance_makes_the_lattice_coarse_and_is_used(name):
    strides = [made(name, px).planned(*SIZE, torch.float32).stride for px in (0.01, 0.1, 1.0)]
    assert strides == sorted(strides)
    assert strides[-1] > max(strides[0], 1)
    exact, found = (made(name, px).degrade(image(), seed=1).flow for px in (None, 1.0))
    assert (exact - found).norm(dim=1).amax() > 0.01


@every_warp
def test_the_image_is_that_of_the_flow(name):
    degraded = WARPS[name].degrade(image(), seed=1)
    dense = torch.nn.functional.grid_sample(
        image(),
        sampler_grid(degraded.flow),
        align_corners=False,
        padding_mode=WARPS[name].padding,
    )
    assert_close(degraded.image, dense, rtol=0, atol=2e-4)


@every_warp
def test_a_sample_is_bit_equal_in_any_batch_and_on_any_threads(name, on_threads):
    alone = WARPS[name].degrade(image(3)[1:2], seed=5, keys=[11]).image
    for threads in (1, 2):
        on_threads(threads)
        among = WARPS[name].degrade(image(3), seed=5, keys=[4, 11, 7]).image[1:2]
        assert torch.equal(alone, among)


@every_warp
def test_given_parameters_do_as_drawn_ones(name):
    degraded = WARPS[name].degrade(image(), seed=2)
    assert torch.equal(WARPS[name].apply(image(), degraded.params).image, degraded.image)


@every_warp
def test_parameters_outside_the_ranges_are_exact(name):
    outside = {
        "lens": LensDistortion(k1_range=(-0.4, -0.38), k2_range=(0.1, 0.1)),
        "plate": ThinPlateSpline(lattice=(3, 3)),
        "turbulence": Turbulence(covariance="gaussian", length_range=(8.0, 8.0)),
        "rough turbulence": Turbulence(length_range=(30.0, 30.0), aperture_range=(3.0, 4.0)),
        "swirl": DivergenceFree(length_range=(15.0, 15.0)),
    }[name]
    params = outside.sample(image(), seed=2)
    flow = WARPS[name].apply(image(), params).flow
    assert torch.equal(flow, made(name, None).apply(image(), params).flow)
    assert not torch.equal(flow, WARPS[name].degrade(image(), seed=2).flow)


@every_warp
def test_gradients_are_those_of_the_exact_flow_within_the_tolerance(name):
    params = WARPS[name].sample(image().double(), seed=2)
    free = {key: value for key, value in params._asdict().items() if value.is_floating_point() and key != "frame"}
    leaves = {key: value.clone().requires_grad_() for key, value in free.items()}
    weight = torch.rand(2, 2, *SIZE, dtype=torch.float64)
    slopes = []
    for effect in (WARPS[name], made(name, None)):
        flow = effect.apply(image().double(), params._replace(**leaves)).flow
        found = torch.autograd.grad((weight * flow).mean(), list(leaves.values()), allow_unused=True)
        slopes.append([torch.zeros(()) if value is None else value for value in found])
    for coarse, exact in zip(*slopes, strict=True):
        assert coarse.isfinite().all()
        assert_close(coarse, exact, rtol=0, atol=0.05 * exact.abs().max().item() + 1e-9)


@every_warp
def test_clips_move_and_one_frame_alone_is_that_of_the_clip(name):
    clip = torch.rand(2, 4, 3, *SIZE)
    whole = WARPS[name].degrade(clip, seed=2)
    alone = WARPS[name].degrade(clip[:, 2], seed=2, frame=2)
    assert torch.equal(whole.image[:, 2], alone.image)
    exact = made(name, None).degrade(clip, seed=2)
    assert (whole.flow - exact.flow).norm(dim=2).amax() <= 0.1


@every_warp
def test_closed_gates_leave_the_image_alone(name):
    effect = made(name, 0.1)
    effect.p = 0.5
    degraded = effect.degrade(image(12), seed=2)
    off = ~degraded.params.applied
    assert 0 < off.sum() < 12
    assert torch.equal(degraded.image[off], image(12)[off])
    assert not degraded.flow[off].any()
    assert degraded.valid[off].all()


@every_warp
def test_one_graph_gives_the_same(name):
    compiled = torch.compile(WARPS[name].degrade, fullgraph=True, backend="aot_eager")
    assert_close(
        compiled(image(), seed=torch.tensor(4)).image, WARPS[name].degrade(image(), seed=4).image, rtol=0, atol=2e-4
    )


@every_warp
def test_effects_of_one_kind_do_not_share_the_graph_of_one_plan(name):
    double = image().double()  # in which no kernel rounds otherwise than a graph
    for effect in (WARPS[name], made(name, None)):
        compiled = torch.compile(effect, fullgraph=True, backend="eager")
        torch.manual_seed(3)
        found = compiled(double)
        torch.manual_seed(3)
        # Eigenvalues of a compiled graph are not interpolated, which fields that are may differ from by 1e-5.
        assert_close(found, effect(double), rtol=0, atol=1e-4 if name == "rough turbulence" else 1e-6)


def test_a_swirl_on_a_lattice_has_no_divergence():
    flow = WARPS["swirl"].degrade(image(), seed=1).flow
    assert WARPS["swirl"].planned(*SIZE, torch.float32).stride > 1
    u, v = flow[:, 0], flow[:, 1]
    divergence = (u[:, 1:-1, 2:] - u[:, 1:-1, :-2] + v[:, 2:, 1:-1] - v[:, :-2, 1:-1]) / 2
    assert divergence.abs().amax() < 2e-5


def test_terms_that_move_too_little_are_dropped_and_named(capsys):
    effect = LensDistortion(
        k1_range=(-0.2, -0.2), k2_range=(0.05, 0.05), k3_range=(0.0, 1e-6), s1_range=(-1e-7, 1e-7), tolerance_px=0.1
    )
    plan = effect.plan(*SIZE)
    assert capsys.readouterr().out.strip() == str(plan)
    # What stands last is left out first: thin prisms, decentring, then the highest powers of the radius.
    assert plan.kept == ("k1", "k2", "k3", "p1", "p2")
    assert [name for name, _ in plan.dropped] == ["s1"]
    assert "term dropped   s1, which moves up to" in str(plan)
    assert all(0 < moved < 0.1 for _, moved in plan.dropped)


@pytest.mark.parametrize(
    "effect",
    [
        LensDistortion(
            k1_range=(-1e-6, 1e-6), k2_range=(0.0, 0.0), p1_range=(0.0, 0.0), p2_range=(0.0, 0.0), tolerance_px=0.1
        ),
        ThinPlateSpline(amplitude_range=(0.0, 1e-4), tolerance_px=0.1),
        Turbulence(covariance="gaussian", amplitude_range=(0.0, 1e-3), tolerance_px=0.1),
        DivergenceFree(amplitude_range=(0.0, 1e-3), tolerance_px=0.1),
    ],
    ids=lambda effect: type(effect).__name__,
)
def test_what_moves_too_little_is_not_computed(effect):
    assert effect.planned(*SIZE, torch.float32).stride == 0
    frame = image()
    degraded = effect.degrade(frame, seed=3)
    assert torch.equal(degraded.image, frame)
    assert not degraded.flow.any()
    assert torch.equal(Compose([effect]).degrade(frame, seed=3).image, frame)


def test_compositions_of_lattices_are_near_the_exact_ones():
    effects = Compose([*WARPS.values(), UniformFog()])
    exact = Compose([*(made(name, None) for name in WARPS), UniformFog()])
    found, expected = effects.degrade(image(), seed=6), exact.degrade(image(), seed=6)
    # Each is off by a tenth of a pixel at most, and the slopes of the others stretch that a little.
    assert (found.flow - expected.flow).norm(dim=1).amax() <= 0.5
    assert torch.equal(effects.apply(image(), found.params).image, found.image)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e6])
def test_a_tolerance_that_is_none_raises(value):
    with pytest.raises(ValueError, match="tolerance_px must"):
        LensDistortion(tolerance_px=value)


def test_a_tolerance_below_rounding_raises_and_says_what_can_be_kept():
    effect = LensDistortion(tolerance_px=1e-5)
    rule = r"tolerance_px must be at least 0.00\d+ px for float32 positions in a frame of 1080 x 1920 px .* got 1e-05"
    with pytest.raises(ValueError, match=rule):
        effect.plan(1080, 1920)
    with pytest.raises(ValueError, match=rule):
        effect(torch.zeros(1, 1, 1080, 1920))
    assert effect.plan(1080, 1920, dtype=torch.float64).stride >= 1


@pytest.mark.parametrize("kind", [LensDistortion, ThinPlateSpline, Turbulence, DivergenceFree, Compose])
def test_the_default_is_a_fiftieth_of_a_pixel_and_exact_where_rounding_is_more(kind):
    effect = kind([DivergenceFree()]) if kind is Compose else kind()
    assert effect.tolerance_px == 0.02
    exact, found = (copy(effect) for _ in range(2))
    exact.tolerance_px = None
    ulps = getattr(effect, "ulps", MOST_ULPS)
    width = math.ceil(0.01 / (ulps * 2.0**-24)) + 1  # where rounding is half of the tolerance
    large = found.planned(2, width, torch.float32)
    assert large.error_px == 0
    assert str(large).splitlines()[1:] == str(exact.planned(2, width, torch.float32)).splitlines()[1:]
    assert found.planned(2, width - 3, torch.float32).tolerance_px == 0.02
    assert found.planned(1080, 1920, torch.float32).tolerance_px == 0.02


@pytest.mark.parametrize(("height", "width"), [(0, 10), (10, 0), (-1, 10)])
def test_a_plan_of_no_frame_raises(height, width):
    with pytest.raises(ValueError, match="must be at least 1"):
        LensDistortion(tolerance_px=0.1).plan(height, width)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 50), (40, 1), (7, 11)])
@every_warp
def test_small_frames_keep_the_tolerance(name, height, width):
    frame = torch.rand(2, 1, height, width)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exact, found = (made(name, px).degrade(frame, seed=3).flow for px in (None, 0.1))
    assert (exact - found).norm(dim=1).amax() <= 0.1


@pytest.mark.parametrize("stride", [2, 3, 8, 50])
def test_cubics_come_out_as_they_are(stride):
    lattice = Lattice(37, 53, stride)

    def cubic(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return ((x / 50) ** 3 - x / 20 + 1) * ((y / 50) ** 3 + (y / 30) ** 2 - 1)

    x, y = lattice.places(dtype=torch.float64, device=torch.device("cpu"))
    pixels = torch.arange(53.0).double(), torch.arange(37.0).double()[:, None]
    found = between_nodes(cubic(x, y), lattice)
    assert_close(found[0, 0], cubic(*pixels), rtol=0, atol=1e-9 * stride)


@pytest.mark.parametrize("stride", [2, 3, 8])
def test_a_stream_between_nodes_has_the_curl_of_psi_between_nodes(stride):
    lattice = Lattice(37, 53, stride, before=3, after=2)
    nodes = torch.randn(2, 1, *map(len, lattice.axes()), dtype=torch.float64)

    def between(count: int, size: int) -> np.ndarray:
        """(size + 2, count), by SciPy: the polynomial through the three nodes on either side of a pixel."""
        weights = np.zeros((size + 2, count))
        for row, place in zip(weights, range(-1, size + 1), strict=True):
            cell, inside = divmod(place, stride)
            row[cell + 1 : cell + 7] = [lagrange(np.arange(-2, 4), one)(inside / stride) for one in np.eye(6)]
        return weights

    rows, columns = between(nodes.shape[2], 37), between(nodes.shape[3], 53)
    psi = torch.from_numpy(rows) @ nodes @ torch.from_numpy(columns).mT
    flow = StreamFlow(nodes, lattice)
    assert_close(flow.dense(), curl(psi), rtol=0, atol=1e-12)
    assert_close(flow.sampler_grid(torch.float64), sampler_grid(flow.dense()), rtol=0, atol=1e-14)


def test_a_smooth_flow_leads_where_its_dense_form_does():
    lattice = Lattice(60, 90, 16)
    x, y = lattice.places(dtype=torch.float64, device=torch.device("cpu"))
    flow = LatticeFlow(torch.randn(2, 2, y.numel(), x.numel(), dtype=torch.float64), lattice)
    assert_close(flow.sampler_grid(torch.float64), sampler_grid(flow.dense()), rtol=0, atol=1e-13)


def test_rough_air_has_a_lattice_that_transforms_are_short_for():
    air: dict[str, Any] = {"amplitude_range": (1.2, 1.8), "length_range": (40.0, 80.0), "aperture_range": (4.0, 6.0)}
    strides = []
    for px in (0.02, 0.1, 0.3, 1.0):
        plan = Turbulence(**air, tolerance_px=px).planned(1080, 1920, torch.float32)
        assert isinstance(plan, FieldPlan)
        assert plan.modes is not None
        assert all(side % plan.stride == 0 for side in plan.modes.size)
        assert plan.error_px <= px
        strides.append(plan.stride)
    assert strides == sorted(strides)
    assert strides[-1] > strides[0] > 1
    few = Turbulence(tolerance_px=0.02).planned(256, 256, torch.float32)
    assert few.stride == 1
    assert 0 < few.error_px <= 0.02
    narrow = Turbulence(aperture_range=(0.0, 3.0)).planned(256, 256, torch.float32)
    assert narrow.stride == 1
    assert narrow.error_px == 0

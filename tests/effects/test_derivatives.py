"""Derivatives of effects and label functions, against central differences of the exact function in float64."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from helpers import random_image
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vjp, vmap

from torchrefract import (
    Camera,
    Compose,
    DivergenceFree,
    Exposure,
    HeterogeneousFog,
    LensDistortion,
    LensFlare,
    Rectification,
    RollingShutter,
    SunGlare,
    ThinPlateSpline,
    Turbulence,
    UniformFog,
    warp_boxes,
    warp_points,
)
from torchrefract.cameras import undistort
from torchrefract.effects.base import Effect
from torchrefract.fields.lens import lens_flow
from torchrefract.warping.invert import invert_flow
from torchrefract.warping.lattice import pixel_lattice

pytestmark = [
    # PyTorch's forward mode compiles scripts when it is first used.
    pytest.mark.filterwarnings("ignore:`torch.jit.script:FutureWarning"),
    pytest.mark.filterwarnings("ignore:`torch.jit.script:DeprecationWarning"),
]

STEP = 1e-3  # of the central differences, in directions of 1 % of the parameters
LARGEST = 1e-5  # relative error of a derivative
HEIGHT, WIDTH = 7, 8
LENSES = {
    "polynomial12": (-0.2, 0.05, 0.01, 0.002, 0.001, 0.001, 0.003, -0.002, 0.001, 0.002, -0.001, 0.001),
    "opencv": (-0.2, 0.1, 0.001, 0.002, 0.01, 0.02, 0.01, 0.001, 0.001, 0.001, 0.001, 0.001, 0.02, 0.03),
    "fisheye": (0.05, -0.01, 0.002, 0.001),
    "division": (-0.2,),
}
ALL_TERMS = {f"{name}_range": (-0.02, 0.02) for name in ("k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")}
SUN: dict[str, Any] = {
    **{"center_x_range": (0.3, 0.4), "center_y_range": (0.3, 0.4), "time_constant_range": (1.0, 2.0)},
    **{"luminance_range": (9.0, 20.0), "ghost_share_range": (0.01, 0.02), "ghost_radius_range": (9.0, 20.0)},
}
FOG = {"visibility_range": (20.0, 60.0), "airlight": (0.9, 0.7, 0.8), "tolerance": None}
WARPS = {  # and their parameter that has a gradient at strength zero
    "lens": (partial(LensDistortion, k1_range=(-0.3, -0.2), **ALL_TERMS), "coefficients"),
    "turbulence": (partial(Turbulence, amplitude_range=(0.3, 0.5), length_range=(3.0, 4.0)), "amplitude"),
    "thin-plate spline": (
        partial(ThinPlateSpline, amplitude_range=(0.2, 0.3), lattice=(3, 3), smoothing_range=(0.01, 0.02)),
        "displacement",
    ),
    "rolling shutter": (
        partial(RollingShutter, num_frequencies=1, roll_range=(1.0, 2.0), exposure_range=(1.0, 2.0), num_exposures=1),
        "speed",
    ),
    "divergence-free": (
        partial(DivergenceFree, amplitude_range=(0.5, 1.0), length_range=(3.0, 4.0)),
        "amplitude",
    ),
}
PHOTOMETRIC = {
    "uniform fog": lambda: UniformFog(**FOG),
    "heterogeneous fog": lambda: HeterogeneousFog(**FOG),
    "flare": lambda: LensFlare(drift_y_range=(-0.01, 0.01), strength_range=(0.2, 0.5), tolerance=None),
    "sun glare": lambda: SunGlare(**SUN),
    "exposure": lambda: Exposure(shot_range=(0.001, 0.01), read_range=(0.001, 0.01), time_constant_range=(1.0, 2.0)),
}
Function = Callable[[Tensor], Tensor]


def vector_of(params: Any) -> tuple[Tensor, Callable[[Tensor], Any]]:
    """Return the floating parameters as one vector, and the function that makes parameters of such a vector."""
    if hasattr(params, "children"):
        vectors, builds = zip(*map(vector_of, params.children), strict=True)
        sizes = [len(vector) for vector in vectors]
        return torch.cat(vectors), lambda x: params._replace(
            children=tuple(build(part) for build, part in zip(builds, x.split(sizes), strict=True))
        )
    fields = {
        name: value
        for name, value in params._asdict().items()
        if value is not None and value.is_floating_point() and value.isfinite().all()
    }

    def build(x: Tensor) -> Any:
        parts = x.split([value.numel() for value in fields.values()])
        shaped = (part.view(value.shape) for part, value in zip(parts, fields.values(), strict=True))
        return params._replace(**dict(zip(fields, shaped, strict=True)))

    return torch.cat([value.flatten() for value in fields.values()]), build


def function_of(effect: Effect, output: str, depth: Tensor | None = None) -> tuple[Function, Tensor]:
    """Return one output of an effect as a function of a vector of its parameters, and the vector."""
    image = random_image(1, 3, HEIGHT, WIDTH, dtype=torch.float64)
    params = effect.sample(image, seed=5)
    if hasattr(params, "points"):  # a spline has no second derivative at its control points, which are pixels
        params = params._replace(points=params.points + 0.3)
    vector, build = vector_of(params)

    def function(x: Tensor) -> Tensor:
        degraded = effect.apply(image, build(x), depth=depth)
        value = getattr(degraded, output)
        return (value * degraded.restore_valid if output == "restore_flow" else value).flatten()

    return function, vector


def smooth_flow() -> Tensor:
    values = torch.rand(1, 2, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return 1.3 * torch.nn.functional.interpolate(values, size=(4, 5), mode="bicubic") + 0.05


def effect_cases() -> dict[str, Callable[[], tuple[Function, Tensor]]]:
    """Return the cases by name, each a function of a vector and the vector."""
    cases = {}
    depth = torch.linspace(5, 60, HEIGHT * WIDTH, dtype=torch.float64).view(1, 1, HEIGHT, WIDTH)
    for name, (make, _) in WARPS.items():
        for output in ("flow", "restore_flow"):
            cases[f"{name}, {output}"] = lambda m=make, o=output: function_of(m(tolerance_px=None), o)
    for name, make in PHOTOMETRIC.items():
        cases[name] = lambda m=make, n=name: function_of(m(), "image", depth if "fog" in n else None)
    for model, coefficients in LENSES.items():
        camera = Camera(
            width=WIDTH, height=HEIGHT, fx=7.0, fy=7.5, cx=3.4, cy=3.2, coefficients=coefficients, model=model
        )
        for output in ("flow", "restore_flow"):
            cases[f"rectification {model}, {output}"] = lambda c=camera, o=output: function_of(
                Rectification(c, tolerance_px=None), o
            )
    warps = [WARPS[name][0] for name in ("turbulence", "lens")]
    cases["composition, flow"] = lambda: function_of(
        Compose([make(tolerance_px=None) for make in warps], tolerance_px=None), "flow"
    )
    return cases


def label_cases() -> dict[str, Callable[[], tuple[Function, Tensor]]]:
    flow = smooth_flow()
    points = torch.tensor([[[1.2, 1.4], [2.7, 0.9]]], dtype=torch.float64)
    box = torch.tensor([[[0.7, 0.8, 3.1, 2.4]]], dtype=torch.float64)

    def boxes(x: Tensor, *, clip: bool) -> Tensor:
        return warp_boxes(x[:4].view_as(box), x[4:].view_as(flow), clip=clip, samples=5)[0].flatten()

    def inverse(x: Tensor) -> Tensor:
        value, valid, _ = invert_flow(x.view_as(flow), steps=40)
        return (value * valid).flatten()

    def undistorted(x: Tensor, *, model: str) -> Tensor:
        return undistort(x[:4].view(1, 2, 2), x[None, 4:], model=model).points.flatten()

    cases: dict[str, Callable[[], tuple[Function, Tensor]]] = {
        "warp_points": lambda: (
            lambda x: warp_points(x[:4].view_as(points), x[4:].view_as(flow))[0].flatten(),
            torch.cat([points.flatten(), flow.flatten()]),
        ),
        "invert_flow": lambda: (inverse, flow.flatten()),
    }
    for clip in (True, False):
        vector = torch.cat([box.flatten(), flow.flatten()])
        cases[f"warp_boxes, clip={clip}"] = lambda c=clip, v=vector: (lambda x: boxes(x, clip=c), v)
    for model, coefficients in LENSES.items():
        vector = torch.tensor([0.3, -0.2, 0.4, 0.1, *coefficients], dtype=torch.float64)
        cases[f"undistort {model}"] = lambda m=model, v=vector: (lambda x: undistorted(x, model=m), v)
    return cases


CASES = {**effect_cases(), **label_cases()}


def error(actual: Tensor, expected: Tensor) -> float:
    assert expected.abs().max() > 0
    return ((actual - expected).abs().max() / expected.abs().max()).item()


def central_difference(function: Function, x: Tensor, direction: Tensor) -> Tensor:
    """Differentiate along a direction, to the fourth order of the step."""

    def difference(step: float) -> Tensor:
        return (function(x + step * direction) - function(x - step * direction)) / (2 * step)

    return (4 * difference(STEP / 2) - difference(STEP)) / 3


@pytest.mark.filterwarnings("ignore:.*must fit into a periodic domain:UserWarning", "ignore:.*folds:UserWarning")
@pytest.mark.parametrize("name", CASES)
def test_every_mode_gives_the_derivatives_of_the_exact_function(name):
    function, x = CASES[name]()
    generator = torch.Generator().manual_seed(3)
    direction = 0.1 * torch.randn(x.shape, generator=generator, dtype=x.dtype) * x.abs().clamp(min=0.1)
    expected = central_difference(function, x, direction)
    weights = torch.randn(expected.shape, generator=generator, dtype=x.dtype)

    def curved(x: Tensor) -> Tensor:
        return ((function(x) + 1) ** 2 * weights).sum()

    def gradient(x: Tensor, *, create_graph: bool = False) -> Tensor:
        leaf = x if create_graph else x.clone().requires_grad_()
        return torch.autograd.grad(curved(leaf), leaf, create_graph=create_graph)[0]

    with forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(function(forward_ad.make_dual(x, direction))).tangent
    assert tangent is not None

    def curvature(x: Tensor, *, create_graph: bool = False) -> Tensor:
        leaf = x if create_graph else x.clone().requires_grad_()
        slope = gradient(leaf, create_graph=True) @ direction
        return torch.autograd.grad(slope, leaf, create_graph=create_graph)[0]

    leaf = x.clone().requires_grad_()
    third = torch.autograd.grad(curvature(leaf, create_graph=True) @ direction, leaf)[0]
    forward_third = jvp(grad(lambda x: grad(curved)(x) @ direction), (x,), (direction,))[1]
    scale = x.abs().clamp(min=0.1)  # entries of the Hessian have units, so each is taken along a relative change
    expected_curvature = central_difference(gradient, x, direction) * scale
    expected_third = 2 * central_difference(curvature, x, direction / 2) * scale
    errors = {
        "forward_ad": error(tangent, expected),
        "jvp": error(jvp(function, (x,), (direction,))[1], expected),
        "jacfwd": error(jacfwd(function)(x) @ direction, expected),
        "vjp": error(vjp(function, x)[1](weights)[0] @ direction, weights @ expected),
        "double backward": error(curvature(x) * scale, expected_curvature),
        "hessian": error(hessian(curved)(x) @ direction * scale, expected_curvature),
    }
    assert max(errors.values()) <= LARGEST, errors
    third_errors = [error(value * scale, expected_third) for value in (third, forward_third)]
    # Roots of the rounded spectrum of a stream function are noise in its third derivatives with respect to its length.
    assert max(third_errors) <= (1e-3 if "divergence-free" in name else LARGEST), third_errors


def test_nested_transforms_give_the_derivatives_of_a_lens():
    points = pixel_lattice(3, 4).points(dtype=torch.float64, device=torch.device("cpu"))
    x = torch.tensor([*LENSES["polynomial12"], 4.0, 4.5, 1.4, 1.1], dtype=torch.float64)

    def total(x: Tensor) -> Tensor:
        return lens_flow(x[None, :12], x[None, 12:14], x[None, 14:], points)[0].square().sum()

    def through_vmap(x: Tensor) -> Tensor:
        return vmap(total)(x[None])[0]

    expected = torch.stack([central_difference(jacrev(total), x, direction) for direction in torch.eye(16).double()])
    for name, second in {
        "forward over forward": jacfwd(jacfwd(total)),
        "reverse over forward": jacrev(jacfwd(total)),
        "reverse over reverse": jacrev(jacrev(total)),
        "through vmap": jacfwd(jacfwd(through_vmap)),
    }.items():
        assert error(second(x), expected) <= LARGEST, name
    third = torch.stack([central_difference(hessian(total), x, torch.eye(16).double()[i]) for i in (0, 12)])
    assert error(jacrev(hessian(total))(x)[[0, 12]], third) <= LARGEST


@pytest.mark.parametrize("name", [*WARPS, "volumetric fog"])
def test_an_image_has_all_derivatives_but_forward_over_reverse_which_raises(name):
    if name in WARPS:
        function, x = function_of(WARPS[name][0](tolerance_px=None), "image")
    else:
        function, x = function_of(HeterogeneousFog(mode="ray", **FOG), "image", torch.full((1, 1, 7, 8), 30.0).double())
    direction = 0.01 * torch.randn(x.shape, generator=torch.Generator().manual_seed(3), dtype=x.dtype)
    expected = central_difference(function, x, direction)
    assert error(jvp(function, (x,), (direction,))[1], expected) <= LARGEST
    weights = torch.rand(expected.shape, generator=torch.Generator().manual_seed(4), dtype=x.dtype)
    assert error(vjp(function, x)[1](weights)[0] @ direction, weights @ expected) <= LARGEST
    with pytest.raises(NotImplementedError, match="forward AD"):
        hessian(lambda x: function(x).square().sum())(x)


@pytest.mark.parametrize("name", WARPS)
def test_forward_mode_reaches_parameters_at_strength_zero(name):
    make, field = WARPS[name]
    image = random_image(2, 3, HEIGHT, WIDTH, dtype=torch.float64)
    effect = make()
    params = effect.sample(image, seed=1)
    value = torch.zeros_like(getattr(params, field))

    def flow(value: Tensor) -> Tensor:
        return effect.apply(image, params._replace(**{field: value})).flow

    direction = torch.ones_like(value)
    forward, reverse = jvp(flow, (value,), (direction,))[1], jacrev(flow)(value).flatten(4).sum(dim=-1)
    assert forward.abs().max() > 0
    torch.testing.assert_close(forward, reverse)

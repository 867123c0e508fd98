"""Check derivatives: each mode of PyTorch against central differences of the exact function in float64.

python benchmarks/derivatives.py [--only lens,flow warp_boxes ...]

Each function takes one vector: the parameters of an effect, or the labels and the flow of a label function. A row gives
the largest relative error of forward mode (jvp, jacfwd, torch.autograd.forward_ad), of reverse mode (vjp), and of
second derivatives (backward twice, and torch.func.hessian, which is forward over reverse). "raises" is
PyTorch's NotImplementedError. An error above 1e-5 ends the command with exit code 1.
"""

import argparse
import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import hessian, jacfwd, jvp, vjp

import torchrefract as tr
from torchrefract.cameras import undistort
from torchrefract.effects.base import Effect
from torchrefract.labels.boxes import warp_polygons

Function = Callable[[Tensor], Tensor]
Case = Callable[[], tuple[Function, Tensor]]

LARGEST = 1e-5  # relative error of a derivative
HEIGHT, WIDTH = 7, 8
_STEP = 1e-3  # of the central differences, in directions of 10 % of the parameters
LENSES = {
    "polynomial12": (-0.2, 0.05, 0.01, 0.002, 0.001, 0.001, 0.003, -0.002, 0.001, 0.002, -0.001, 0.001),
    "opencv": (-0.2, 0.1, 0.001, 0.002, 0.01, 0.02, 0.01, 0.001, 0.001, 0.001, 0.001, 0.001, 0.02, 0.03),
    "fisheye": (0.05, -0.01, 0.002, 0.001),
    "division": (-0.2,),
}
_SMALL_TERMS = {f"{name}_range": (-0.02, 0.02) for name in ("k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")}
_SUN: dict[str, Any] = {
    **{"center_x_range": (0.3, 0.4), "center_y_range": (0.3, 0.4), "time_constant_range": (1.0, 2.0)},
    **{"luminance_range": (9.0, 20.0), "ghost_share_range": (0.01, 0.02), "ghost_radius_range": (9.0, 20.0)},
}
FOG: dict[str, Any] = {"visibility_range": (20.0, 60.0), "airlight": (0.9, 0.7, 0.8), "tolerance": None}
NOISE: dict[str, Any] = {
    "scales": (8.0, 32.0),
    "weights": (0.6, 0.4),
}  # each octave more takes as long, by the same code
WARPS: dict[str, Callable[..., Effect]] = {
    "lens": partial(tr.LensDistortion, k1_range=(-0.3, -0.2), **_SMALL_TERMS),
    "turbulence": partial(tr.Turbulence, amplitude_range=(0.3, 0.5), length_range=(3.0, 4.0)),
    "thin-plate spline": partial(
        tr.ThinPlateSpline, amplitude_range=(0.2, 0.3), lattice=(3, 3), smoothing_range=(0.01, 0.02)
    ),
    "rolling shutter": partial(
        tr.RollingShutter, num_frequencies=1, roll_range=(1.0, 2.0), exposure_range=(1.0, 2.0), num_exposures=1
    ),
    "divergence-free": partial(tr.DivergenceFree, amplitude_range=(0.5, 1.0), length_range=(3.0, 4.0)),
    "physical turbulence": partial(tr.PhysicalTurbulence, cn2_range=(1e-12, 2e-12)),
    "road mirage": partial(tr.RoadMirage, difference_range=(20.0, 30.0)),
}
PHOTOMETRIC: dict[str, Callable[[], Effect]] = {
    "uniform fog": lambda: tr.UniformFog(**FOG),
    "heterogeneous fog": lambda: tr.HeterogeneousFog(**FOG, **NOISE),
    "volumetric fog": lambda: tr.HeterogeneousFog(mode="ray", **FOG, **NOISE),
    "flare": lambda: tr.LensFlare(drift_y_range=(-0.01, 0.01), strength_range=(0.2, 0.5), tolerance=None),
    "sun glare": lambda: tr.SunGlare(**_SUN),
    "exposure": lambda: tr.Exposure(shot_range=(0.001, 0.01), read_range=(0.001, 0.01), time_constant_range=(1.0, 2.0)),
    "night glow": tr.NightGlow,
    "turbulence blur": partial(tr.TurbulenceBlur, cn2_range=(1e-10, 3e-10), aperture=0.05, focal=20.0, height=None),
    "vignetting": tr.Vignetting,
    "chromatic aberration": lambda: tr.ChromaticAberration(red_range=(0.01, 0.02), blue_range=(-0.02, -0.01)),
}


class Errors(NamedTuple):
    """The largest relative errors of the derivatives of one function; None where PyTorch raises."""

    name: str
    forward: float | None
    reverse: float | None
    backward_twice: float | None
    hessian: float | None

    @property
    def largest(self) -> float:
        """Return the largest of them."""
        return max(value for value in self[1:] if value is not None)

    def as_row(self) -> str:
        """Format a row of the table."""
        return f"{self.name:34}" + "".join(f"{'raises' if value is None else f'{value:.1e}':>16}" for value in self[1:])


def main() -> None:
    """Print the table, and end with exit code 1 if a derivative is wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", default=list(CASES), help="rows, all")
    args = parser.parse_args()
    if unknown := [name for name in args.only if name not in CASES]:
        parser.error(f"--only must name rows, got {unknown[0]}; there are {', '.join(CASES)}")
    head = ("forward", "reverse", "backward twice", "hessian")
    print(f"{'largest relative error':34}" + "".join(f"{title:>16}" for title in head))
    worst = 0.0
    for name in args.only:
        errors = errors_of(name)
        print(errors.as_row(), flush=True)
        worst = max(worst, errors.largest)
    print(f"largest of all: {worst:.1e}, bar {LARGEST:g}")
    if worst > LARGEST:
        raise SystemExit(1)


def errors_of(name: str) -> Errors:
    """Measure the errors of one case, along one random direction."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of folds, of fields larger than the frame, and of PyTorch's forward mode
        function, x = CASES[name]()
        direction, weights = directions_of(function, x)
        expected = central_difference(function, x, direction)
        scale = x.abs().clamp(min=0.1)  # entries of a Hessian have units, so each is taken along a relative change
        curved = curved_function(function, weights)

        def gradient(x: Tensor) -> Tensor:
            leaf = x.clone().requires_grad_()
            return torch.autograd.grad(curved(leaf), leaf)[0]

        def curvature(x: Tensor) -> Tensor:
            leaf = x.clone().requires_grad_()
            (slope,) = torch.autograd.grad(curved(leaf), leaf, create_graph=True)
            return torch.autograd.grad(slope @ direction, leaf)[0]

        second = central_difference(gradient, x, direction) * scale
        forward: list[Function] = [
            lambda x: jvp(function, (x,), (direction,))[1],
            lambda x: jacfwd(function)(x) @ direction,
            lambda x: _dual_tangent(function, x, direction),
        ]
        in_forward = [_error(mode, x, expected) for mode in forward]
        return Errors(
            name,
            None if None in in_forward else max(value for value in in_forward if value is not None),
            _error(lambda x: vjp(function, x)[1](weights)[0] @ direction, x, weights @ expected),
            _error(lambda x: curvature(x) * scale, x, second),
            _error(lambda x: hessian(curved)(x) @ direction * scale, x, second),
        )


def directions_of(function: Function, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return a random direction of 10 % of the entries of x, and random weights of the outputs."""
    generator = torch.Generator().manual_seed(3)
    direction = 0.1 * torch.randn(x.shape, generator=generator, dtype=x.dtype) * x.abs().clamp(min=0.1)
    return direction, torch.randn(function(x).shape, generator=generator, dtype=x.dtype)


def curved_function(function: Function, weights: Tensor) -> Function:
    """Return a sum of squares of the outputs, whose second derivatives hold the first ones and the second ones."""
    return lambda x: ((function(x) + 1) ** 2 * weights).sum()


def central_difference(function: Function, x: Tensor, direction: Tensor) -> Tensor:
    """Differentiate along a direction, to the fourth order of the step."""

    def difference(step: float) -> Tensor:
        return (function(x + step * direction) - function(x - step * direction)) / (2 * step)

    return (4 * difference(_STEP / 2) - difference(_STEP)) / 3


def relative_error(actual: Tensor, expected: Tensor) -> float:
    """Return the largest difference as a share of the largest value, which must not be 0."""
    if not expected.abs().max() > 0:
        raise ValueError("expected must hold a derivative other than 0, got none")
    return ((actual - expected).abs().max() / expected.abs().max()).item()


def _error(mode: Function, x: Tensor, expected: Tensor) -> float | None:
    try:
        error = relative_error(mode(x), expected)
    except NotImplementedError:
        return None
    return math.inf if math.isnan(error) else error


def _dual_tangent(function: Function, x: Tensor, direction: Tensor) -> Tensor:
    with forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(function(forward_ad.make_dual(x, direction))).tangent
    return torch.zeros_like(function(x)) if tangent is None else tangent


def vector_of(params: Any) -> tuple[Tensor, Callable[[Tensor], Any]]:
    """Return the finite floating parameters as one vector, and the function that makes parameters of such a vector."""
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
    image = torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    params = effect.sample(image, seed=5)
    if hasattr(params, "points"):  # a spline has no second derivative at its control points, which are pixels
        params = params._replace(points=params.points + 0.3)
    vector, build = vector_of(params)

    def function(x: Tensor) -> Tensor:
        degraded = effect.apply(image, build(x), depth=depth)
        value = getattr(degraded, output)
        return (value * degraded.restore_valid if output == "restore_flow" else value).flatten()

    return function, vector


def effect_cases() -> dict[str, Case]:
    """Return the cases of all effects by name."""
    cases: dict[str, Case] = {}
    depth = torch.linspace(5, 60, HEIGHT * WIDTH, dtype=torch.float64).view(1, 1, HEIGHT, WIDTH)
    for name, make in WARPS.items():
        # The restore flow of a mirage is 0, valid where the mirage moves nothing.
        for output in ("flow", "image") if name == "road mirage" else ("flow", "restore_flow", "image"):
            cases[f"{name}, {output}"] = partial(_effect_case, partial(make, tolerance_px=None), output)
    for name, make in PHOTOMETRIC.items():
        cases[name] = partial(_effect_case, make, "image", depth if "fog" in name else None)
    for model, coefficients in LENSES.items():
        camera = tr.Camera(
            width=WIDTH, height=HEIGHT, fx=7.0, fy=7.5, cx=3.4, cy=3.2, coefficients=coefficients, model=model
        )
        for output in ("flow", "restore_flow"):
            make = partial(tr.Rectification, camera, tolerance_px=None)
            cases[f"rectification {model}, {output}"] = partial(_effect_case, make, output)
    cases["composition, flow"] = lambda: function_of(
        tr.Compose([WARPS[name](tolerance_px=None) for name in ("turbulence", "lens")], tolerance_px=None), "flow"
    )
    return cases


def _effect_case(make: Callable[[], Effect], output: str, depth: Tensor | None = None) -> tuple[Function, Tensor]:
    return function_of(make(), output, depth)


def label_cases() -> dict[str, Case]:
    """Return the cases of the label functions and of inverses, by name; the vector holds the labels, then the flow."""
    values = torch.rand(1, 2, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    flow = 1.3 * torch.nn.functional.interpolate(values, size=(4, 5), mode="bicubic") + 0.05
    points = torch.tensor([[[1.2, 1.4], [2.7, 0.9]]], dtype=torch.float64)
    box = torch.tensor([[[0.7, 0.8, 3.1, 2.4]]], dtype=torch.float64)
    outline = torch.tensor([[1.2, 0.8], [2.9, 1.1], [2.4, 2.3]], dtype=torch.float64)
    maps = torch.rand(1, 2, 4, 5, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def case(value: Tensor, function: Callable[[Tensor, Tensor], Tensor]) -> Case:
        def of_vector(x: Tensor) -> Tensor:
            return function(x[: value.numel()].view_as(value), x[value.numel() :].view_as(flow)).flatten()

        return lambda: (of_vector, torch.cat([value.flatten(), flow.flatten()]))

    def inverse(x: Tensor) -> Tensor:
        value, valid, _ = tr.invert_flow(x.view_as(flow), steps=40)
        return (value * valid).flatten()

    def undistorted(x: Tensor, *, model: str) -> Tensor:
        return undistort(x[:4].view(1, 2, 2), x[None, 4:], model=model).points.flatten()

    bilinear: Any = {"interpolation": "bilinear"}
    cases: dict[str, Case] = {
        "warp_points": case(points, lambda value, flow: tr.warp_points(value, flow)[0]),
        "warp_boxes, clip=True": case(box, lambda value, flow: tr.warp_boxes(value, flow, clip=True, samples=5)[0]),
        "warp_boxes, clip=False": case(box, lambda value, flow: tr.warp_boxes(value, flow, clip=False, samples=5)[0]),
        "warp_polygons": case(outline, lambda value, flow: warp_polygons([value], flow[0])[0]),
        "warp_mask, soft=True": case(maps, lambda value, flow: tr.warp_mask(value, flow, soft=True)),
        "warp_depth, bilinear": case(
            maps[:, :1].contiguous(), lambda value, flow: tr.warp_depth(value, flow, **bilinear)[0]
        ),
        "warp_optical_flow, bilinear": case(
            maps, lambda value, flow: tr.warp_optical_flow(value, flow, 0.3 * flow, **bilinear)[0]
        ),
        "invert_flow": lambda: (inverse, flow.flatten()),
    }
    for model, coefficients in LENSES.items():
        vector = torch.tensor([0.3, -0.2, 0.4, 0.1, *coefficients], dtype=torch.float64)
        cases[f"undistort {model}"] = lambda m=model, v=vector: (partial(undistorted, model=m), v)
    return cases


CASES = {**effect_cases(), **label_cases()}

if __name__ == "__main__":
    main()

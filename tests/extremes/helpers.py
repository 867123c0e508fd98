"""Images, maps and comparisons that the tests of the stability contract share."""

import itertools
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.testing import assert_close

import torchrefract as tr
from torchrefract.effects.base import Effect

DTYPES = (torch.uint8, torch.float16, torch.bfloat16, torch.float32, torch.float64)
MAPS = ("image", "flow", "valid", "restore_flow", "restore_valid", "transmission", "extinction", "intensity")
FLOW_PX, IMAGE = 1e-4, 1e-5  # between batches, threads and workers; an image as a share of its range
SIZE = (32, 48)  # of the frames that the rectification takes
_CAMERA = tr.Camera(width=48, height=32, fx=40, fy=40, cx=23, cy=16, coefficients=(-0.2, 0.05, 0.001, 0.002))
EFFECTS: dict[str, Callable[[], Effect]] = {
    "lens": tr.LensDistortion,
    "turbulence": tr.Turbulence,
    "physical turbulence": partial(tr.PhysicalTurbulence, cn2_range=(1e-9, 1e-8)),
    "road mirage": tr.RoadMirage,
    "thin-plate spline": tr.ThinPlateSpline,
    "divergence-free": tr.DivergenceFree,
    "uniform fog": tr.UniformFog,
    "heterogeneous fog": tr.HeterogeneousFog,
    "volumetric fog": partial(tr.HeterogeneousFog, mode="ray"),
    "flare": tr.LensFlare,
    "rolling shutter": tr.RollingShutter,
    "vignetting": tr.Vignetting,
    "chromatic aberration": partial(tr.ChromaticAberration, red_range=(0.02, 0.05)),
    "sun glare": tr.SunGlare,
    "night glow": tr.NightGlow,
    "turbulence blur": partial(tr.TurbulenceBlur, cn2_range=(1e-11, 2e-11), focal=50.0),
    "exposure": partial(tr.Exposure, shot_range=(1e-4, 1e-3)),
    "compose": lambda: tr.Compose([tr.Turbulence(), tr.LensDistortion(), tr.UniformFog()]),
    "one of": lambda: tr.OneOf([tr.DivergenceFree(), tr.ThinPlateSpline(), tr.LensFlare()]),
    "rectification": partial(tr.Rectification, _CAMERA),
}
_ROUNDING = {torch.uint8: 1.0, torch.float16: 2.0**-11, torch.bfloat16: 2.0**-8}  # steps of types near 1


def random_image(*shape: int, dtype: torch.dtype = torch.float32, device: str = "cpu", seed: int = 0) -> Tensor:
    """Return uniform noise in [0, 1], or in 0 ... 255 for uint8."""
    image = torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return ((255 * image).round() if dtype is torch.uint8 else image).to(device, dtype)


def decode(stored: np.ndarray) -> np.ndarray:
    """Return linear light of values in sRGB, in [0, 1]."""
    return np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)


def encode(light: np.ndarray) -> np.ndarray:
    """Return sRGB values of linear light, in [0, 1]."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def maps_of(degraded: tr.Degraded) -> dict[str, Tensor]:
    """Return the image and all maps that the result has, by name."""
    return {name: value for name in MAPS if (value := getattr(degraded, name)) is not None}


def floating_leaves(params: Any) -> dict[str, Tensor]:
    """Return copies of the floating fields of parameters, which require a gradient."""
    fields = {name: value for name, value in params._asdict().items() if value is not None}
    return {name: value.clone().requires_grad_() for name, value in fields.items() if value.is_floating_point()}


def assert_equal_maps(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    """Raise AssertionError unless all maps have equal bits."""
    assert actual.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(actual[name], value), name


def assert_close_maps(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    """Raise AssertionError unless maps agree as they do between batches, threads and workers.

    Flows agree to 1e-4 px, or to rounding if they are longer than 10 px, and inverse flows where both are valid. Images
    agree to 1e-5 of their range, and where the flows differ to the change of the image over that distance, and over the
    rounding of a position. One mask pixel in 500 may differ, since masks are thresholds of flows.
    """
    assert actual.keys() == expected.keys()
    shift = 0.0
    if "flow" in expected:
        assert_close(actual["flow"], expected["flow"], rtol=1e-5, atol=FLOW_PX)
        shift = (actual["flow"] - expected["flow"]).abs().amax().item() if actual["flow"].numel() else 0.0
        # Sums of a pixel and flows that differ may be rounded to different positions.
        shift += max(actual["flow"].shape[-2:]) * torch.finfo(torch.float32).eps if shift else 0.0
    for name, value in expected.items():
        other = actual[name]
        assert other.shape == value.shape, name
        if value.dtype is torch.bool:
            assert (other != value).sum() <= 1 + value.numel() // 500, name
        elif name == "restore_flow":
            both = (actual["restore_valid"] & expected["restore_valid"]).expand_as(value)
            assert_close(other[both], value[both], rtol=1e-5, atol=FLOW_PX)
        elif name != "flow":
            assert_close_images(other, value, shift_px=shift)


def assert_close_images(actual: Tensor, expected: Tensor, *, shift_px: float = 0.0) -> None:
    """Raise AssertionError unless images agree to 1e-5 of their range and the rounding of their type."""
    assert actual.dtype is expected.dtype
    scale = 255 if actual.dtype is torch.uint8 else 1
    # Noise changes by at most its range from one pixel to the next, along each axis.
    tolerance = scale * (IMAGE + 2 * shift_px) + _ROUNDING.get(actual.dtype, 0.0)
    assert_close(actual.double(), expected.double(), rtol=1e-5, atol=tolerance)


def seeded(function: Callable[..., Any], *inputs: Any) -> Any:
    """Call a function from one global seed, so that an effect in it draws what it drew in the last such call."""
    torch.manual_seed(3)
    return function(*inputs)


def assert_graph_agrees(effect: Callable[[Tensor], Tensor], image: Tensor, *, backend: str = "eager") -> None:
    """Raise AssertionError unless a graph without a break draws and degrades twice as eager mode does."""
    compiled = torch.compile(effect, fullgraph=True, backend=backend)
    expected, actual = (seeded(lambda run: [run(image) for _ in range(2)], run) for run in (effect, compiled))
    assert not torch.equal(*expected)
    assert_close(actual, expected, rtol=0, atol=2e-4)


def is_in_range(image: Tensor) -> bool:
    """Return True if an image is in [0, 1], or 0 ... 255, up to the rounding of bilinear weights."""
    if image.dtype is torch.uint8:
        return True
    rounding = 4 * torch.finfo(torch.promote_types(image.dtype, torch.float32)).eps
    return bool((image >= -rounding).all() and (image <= 1 + rounding).all())


def combinations(*lists: Sequence, full: bool) -> Iterable[tuple]:
    """Return all combinations of the values, or as few of them as use each value at least once."""
    if full:
        return itertools.product(*lists)
    # Each list is shifted against the one before it in every round, so that not only equal indices meet.
    return [
        tuple(values[(i + i // len(values) * n) % len(values)] for n, values in enumerate(lists))
        for i in range(max(map(len, lists)))
    ]

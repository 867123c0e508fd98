"""Hypothesis strategies for effects with any valid arguments, and for images."""

import math
from typing import Any, NamedTuple

import pytest
import torch
from helpers import DTYPES, random_image
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy
from torch import Tensor

import torchrefract as tr
from torchrefract.effects.base import Effect
from torchrefract.fields.random_field import COVARIANCES
from torchrefract.types import Range
from torchrefract.warping.warp import INTERPOLATIONS, PADDINGS

# Other tests check these warnings of strong effects.
IGNORE_STRENGTH = pytest.mark.filterwarnings(
    "ignore:.*folds back inside the frame:UserWarning",
    "ignore:.*pixels beyond have no preimage:UserWarning",
    "ignore:Turbulence this strong folds the image:UserWarning",
    "ignore:length must fit into a periodic domain:UserWarning",
)
_MOTION = {"wind_x_range": (-1e6, 1e6), "wind_y_range": (-1e6, 1e6), "decorrelation_range": (1e-3, math.inf)}
_FOG = {"visibility_range": (1e-6, math.inf), "deviation_range": (-0.999, 0.999)}


class Domain(NamedTuple):
    """Valid arguments of an effect.

    kind: the class.
    ranges: bounds of the arguments that are ranges.
    others: strategies for the other arguments.
    """

    kind: type[Effect]
    ranges: dict[str, Range]
    others: dict[str, SearchStrategy[Any]]


def _numbers(low: float, high: float, **options: Any) -> SearchStrategy[float]:
    """Draw numbers over many powers of ten, with both ends and zero among them."""
    ends = [value for value in (low, high, 0.0) if low <= value <= high]
    near = st.floats(max(low, -3.0), min(high, 3.0)) if max(low, -3.0) <= min(high, 3.0) else st.nothing()
    return st.one_of(near, st.floats(low, high, allow_nan=False, **options), st.sampled_from(ends))


_WARP_OPTIONS = {
    "padding": st.sampled_from(PADDINGS),
    "interpolation": st.sampled_from(INTERPOLATIONS),
    "tolerance_px": st.sampled_from([None, 0.02, 0.5]),
}
_FOG_OPTIONS = {
    "airlight": st.none() | st.just("frame") | st.floats(0.0, 1.0),
    "threshold": st.floats(1e-6, 1 - 1e-6),
    "linear_light": st.booleans(),
    "tolerance": st.sampled_from([None, 0.5]),
    "depth": st.one_of(
        st.builds(tr.LinearDepth, max_depth=_numbers(0.0, 1e12)),
        st.builds(
            tr.GroundPlaneDepth,
            camera_height=_numbers(1e-308, 1e308),
            focal=_numbers(1e-308, 1e308),
            horizon=_numbers(-10.0, 10.0),
            spread=_numbers(0.0, 10.0),
            far=_numbers(1e-6, math.inf),
        ),
    ),
}
DOMAINS = {
    "lens": Domain(
        tr.LensDistortion,
        {
            **{f"{name}_range": (-100.0, 100.0) for name in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")},
            **{f"s{i}_range": (-100.0, 100.0) for i in range(1, 5)},
            "focal_range": (0.01, 1000.0),
            "aspect_range": (0.01, 100.0),
            "center_x_range": (-10.0, 10.0),
            "center_y_range": (-10.0, 10.0),
        },
        _WARP_OPTIONS,
    ),
    "turbulence": Domain(
        tr.Turbulence,
        {"amplitude_range": (0.0, 1e4), "length_range": (1e-3, 1e6), "aperture_range": (0.0, 1e4), **_MOTION},
        {
            **_WARP_OPTIONS,
            "covariance": st.sampled_from(COVARIANCES),
            "normalize": st.sampled_from(["theory", "image"]),
        },
    ),
    "thin-plate spline": Domain(
        tr.ThinPlateSpline,
        {"amplitude_range": (0.0, 1e4), "smoothing_range": (0.0, 1e12)},
        {**_WARP_OPTIONS, "lattice": st.tuples(st.integers(2, 6), st.integers(2, 6))},
    ),
    "divergence-free": Domain(
        tr.DivergenceFree,
        {"amplitude_range": (0.0, 1e4), "length_range": (1e-3, 1e6), **_MOTION},
        {
            **_WARP_OPTIONS,
            "covariance": st.sampled_from(COVARIANCES),
            "normalize": st.sampled_from(["theory", "max", "none"]),
            "steps": st.integers(1, 3),
        },
    ),
    "physical turbulence": Domain(
        tr.PhysicalTurbulence,
        {"cn2_range": (0.0, 1e-9), "wind_x_range": (-100.0, 100.0), "wind_y_range": (-100.0, 100.0)},
        {**_WARP_OPTIONS, "num_layers": st.integers(3, 8), "depth": _FOG_OPTIONS["depth"]},
    ),
    "turbulence blur": Domain(
        tr.TurbulenceBlur,
        {"cn2_range": (0.0, 1e-4)},
        {
            "aperture": st.floats(1e-4, 10.0),
            "wavelength": st.floats(1e-7, 1e-4),
            "reach": st.floats(1.0, 1e6),
            "height": st.sampled_from([None, 1.3]),
            "tolerance": st.sampled_from([None, 0.5]),
            "depth": _FOG_OPTIONS["depth"],
        },
    ),
    "road mirage": Domain(
        tr.RoadMirage,
        {
            "difference_range": (0.0, 300.0),
            "shimmer_range": (0.0, 1.0),
            "wave_range": (-1e4, 1e4),
            "rate_range": (-1e3, 1e3),
        },
        {**_WARP_OPTIONS, "num_waves": st.integers(1, 8), "depth": _FOG_OPTIONS["depth"]},
    ),
    "rolling shutter": Domain(
        tr.RollingShutter,
        {
            "speed_range": (-1000.0, 1000.0),
            "readout_range": (-200.0, 200.0),
            "exposure_range": (0.0, 200.0),
            **{f"{axis}_range": (0.0, 5.0) for axis in ("pitch", "yaw", "roll")},
            "frequency_range": (0.0, 1000.0),
        },
        {
            **_WARP_OPTIONS,
            "num_frequencies": st.integers(1, 4),
            "num_exposures": st.integers(1, 3),
            "fps": st.floats(1.0, 240.0),
            "depth": _FOG_OPTIONS["depth"],
        },
    ),
    "vignetting": Domain(tr.Vignetting, {"strength_range": (0.0, 1.0)}, {"linear_light": st.booleans()}),
    "chromatic aberration": Domain(
        tr.ChromaticAberration,
        {"red_range": (-0.1, 0.1), "blue_range": (-0.1, 0.1)},
        {"interpolation": st.sampled_from(["bilinear", "bicubic"])},
    ),
    "uniform fog": Domain(tr.UniformFog, _FOG, _FOG_OPTIONS),
    "heterogeneous fog": Domain(
        tr.HeterogeneousFog,
        {
            **_FOG,
            **_MOTION,
            "contrast_range": (0.0, 2.0),
        },
        {
            **_FOG_OPTIONS,
            "mode": st.sampled_from(["image", "ray"]),
            "scale_unit": st.sampled_from(["px", "cells"]),
            "reference_width": st.floats(1.0, 3e3),
            "normalize": st.sampled_from(["theory", "image"]),
            "mean": st.sampled_from(["image", "ensemble"]),
            "reach": st.floats(1.0, 1e5),
        },
    ),
    "flare": Domain(
        tr.LensFlare,
        {
            **{f"{name}_{axis}_range": (-1e4, 1e4) for name in ("center", "drift") for axis in "xy"},
            "radius_range": (0.0, 1e4),
            "strength_range": (0.0, 1e3),
        },
        {
            "color": st.floats(0.0, 1e3),
            "blend": st.sampled_from(["add", "screen"]),
            "clip": st.booleans(),
            "tolerance": st.sampled_from([None, 0.5]),
        },
    ),
    "sun glare": Domain(
        tr.SunGlare,
        {
            "luminance_range": (0.0, 1e9),
            "scatter_range": (0.0, 1.0),
            "scale_range": (0.01, 100.0),
            "shape_range": (0.1, 4.0),
            "ghost_radius_range": (0.01, 100.0),
            "ghost_share_range": (0.0, 1.0),
            "gamma_range": (0.0, 4.0),
            "time_constant_range": (0.0, 1e6),
            "drift_x_range": (-1e4, 1e4),
            "drift_y_range": (-1e4, 1e4),
        },
        {
            "outside": st.floats(0.0, 1.0),
            "num_ghosts": st.integers(0, 3),
            "color": st.floats(0.0, 1e3),
            "min_gain": st.floats(1 / 32, 1.0),
        },
    ),
    "night glow": Domain(
        tr.NightGlow,
        {"optical_depth_range": (0.0, 50.0), "asymmetry_range": (0.1, 1.0), "luminance_range": (0.0, 1e6)},
        {"threshold": st.floats(0.0, 0.999)},
    ),
    "exposure": Domain(
        tr.Exposure,
        {
            "target_range": (1e-3, 1.0),
            "gamma_range": (0.0, 4.0),
            "time_constant_range": (0.0, 1e6),
            "shot_range": (0.0, 1.0),
            "read_range": (0.0, 1.0),
        },
        {"min_gain": st.floats(1 / 32, 1.0), "max_gain": st.floats(1.0, 4.0), "quantize": st.booleans()},
    ),
}


@st.composite
def ranges(draw: Any, low: float, high: float) -> Range:
    """Draw a range within bounds."""
    ends = sorted((draw(_numbers(low, high)), draw(_numbers(low, high))))
    return ends[0], ends[1]


@st.composite
def options(draw: Any, name: str) -> dict[str, Any]:
    """Draw valid values for up to six arguments of an effect."""
    domain = DOMAINS[name]
    chosen = draw(st.sets(st.sampled_from(sorted([*domain.ranges, *domain.others])), max_size=6))
    given = {key: draw(ranges(*domain.ranges[key])) for key in sorted(chosen) if key in domain.ranges}
    return given | {key: draw(domain.others[key]) for key in sorted(chosen) if key in domain.others}


@st.composite
def images(draw: Any, *, dtypes: tuple[torch.dtype, ...] = DTYPES, batch: int = 3, side: int = 24) -> Tensor:
    """Draw images of any type, size and layout: noise, two levels, or a single one."""
    shape = (draw(st.integers(0, batch)), draw(st.sampled_from([1, 3, 4])), *draw(sizes(side)))
    dtype = draw(st.sampled_from(dtypes))
    values = random_image(*shape, dtype=torch.float64, seed=draw(st.integers(0, 9)))
    kind = draw(st.sampled_from(["noise", "binary", "black", "white"]))
    values = {"binary": values.round(), "black": values * 0, "white": values * 0 + 1}.get(kind, values)
    image = (255 * values).round().to(dtype) if dtype is torch.uint8 else values.to(dtype)
    return image.contiguous(memory_format=torch.channels_last) if draw(st.booleans()) else image


def sizes(side: int) -> SearchStrategy[tuple[int, int]]:
    """Draw (height, width), px; lines and single pixels are among them."""
    return st.tuples(st.integers(1, side), st.integers(1, side))


@st.composite
def cameras(draw: Any, height: int, width: int) -> tr.Camera | None:
    """Draw a pinhole camera for frames of a size, or None."""
    if draw(st.booleans()):
        return None
    fx, fy = draw(st.floats(1.0, 1e4)), draw(st.floats(1.0, 1e4))
    cx, cy = draw(st.floats(-100.0, 200.0)), draw(st.floats(-100.0, 200.0))
    return tr.Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=(0.0,) * 4)


@st.composite
def cases(draw: Any, name: str, *, fixed: dict[str, Any] | None = None, **image: Any) -> tuple[Effect, Tensor]:
    """Draw an effect with valid arguments, and images for it."""
    frames, given = draw(images(**image)), draw(options(name))
    if "airlight" in DOMAINS[name].others:
        given["camera"] = draw(cameras(*frames.shape[2:]))
    given |= fixed or {}
    if name == "flare" and not _is_reachable(tr.LensFlare(**given), frames):
        given["tolerance"] = None
    return DOMAINS[name].kind(**given), frames


def _is_reachable(flare: tr.LensFlare, frames: Tensor) -> bool:
    """Return False if the rounding of float32 exceeds the tolerance, which raises."""
    try:
        flare.plan(frames.shape[2], frames.shape[3])
    except ValueError as error:
        if "tolerance must be at least" not in str(error):
            raise
        return False
    return True

"""What fogs, flares and compositions promise."""

import math
from typing import Any

import torch
from promises import CLEAR, EFFECTS, HERE, NOTHING, REFUSED, ZERO, Row, frame

import torchrefract as tr

_NOWHERE = tr.LinearDepth(max_depth=0.0)


def _fog(depth: torch.Tensor) -> Any:
    return tr.UniformFog().degrade(frame(), seed=0, depth=depth)


def _drifts(scale: float, **options: Any) -> Any:
    return tr.HeterogeneousFog(scales=[scale], weights=[1.0], **options).degrade(frame(), seed=0)


ROWS = (
    Row(
        "fog",
        "V = inf, D_max = 0",
        "I",
        "bit for bit, of every type and size",
        NOTHING,
        {
            "V = inf": lambda: tr.UniformFog(visibility_range=CLEAR),
            "V = inf, in drifts": lambda: tr.HeterogeneousFog(visibility_range=CLEAR),
            "V = inf, in space": lambda: tr.HeterogeneousFog(visibility_range=CLEAR, mode="ray"),
            "D_max = 0": lambda: tr.UniformFog(depth=_NOWHERE),
            "D_max = 0, in drifts": lambda: tr.HeterogeneousFog(depth=_NOWHERE),
            "D_max = 0, in linear light": lambda: tr.UniformFog(depth=_NOWHERE, linear_light=True),
        },
    ),
    Row(
        "fog",
        "V = 0, below 0",
        "E",
        "the range is named",
        REFUSED,
        {
            "visibility_range = 0": lambda: tr.UniformFog(visibility_range=(0.0, 9.0)),
            "visibility_range < 0": lambda: tr.HeterogeneousFog(visibility_range=(-1.0, 9.0)),
        },
    ),
    Row(
        "fog",
        "V = 1e-3 m",
        "C",
        "the airlight, exactly, and finite gradients",
        EFFECTS + "fog.py::test_fog_as_thick_as_a_wall_is_its_airlight_with_finite_gradients",
    ),
    Row(
        "fog",
        "V between 1e30 m and the largest number",
        "I",
        "drawn as what has no end",
        HERE + "test_a_visibility_without_end_is_drawn",
    ),
    Row(
        "fog",
        "a depth that is negative or NaN, or of another shape; D_max below 0 or above 1e12 m",
        "E",
        "the depth is named",
        REFUSED,
        {
            "depth negative": lambda: _fog(torch.full((1, 1, 8, 9), -1.0)),
            "depth NaN": lambda: _fog(torch.full((1, 1, 8, 9), math.nan)),
            "depth of another shape": lambda: _fog(torch.ones(1, 1, 9, 8)),
            "max_depth < 0": lambda: tr.LinearDepth(max_depth=-1.0),
            "max_depth = 1e308": lambda: tr.LinearDepth(max_depth=1e308),
        },
    ),
    Row("fog", "a depth of inf", "C", "t = 0", EFFECTS + "fog.py::test_the_sky_is_infinitely_far"),
    Row(
        "fog in drifts",
        "a scale of 1, of 1e6, of 0.37 px",
        "M",
        "finite, and the mean extinction is kept",
        EFFECTS + "heterogeneous_fog.py::test_odd_scales_are_finite_and_keep_the_mean",
    ),
    Row(
        "fog in drifts",
        "scales of 0, below 0, none; weights below 0 or all 0",
        "E",
        "the argument is named",
        REFUSED,
        {
            "scales = 0": lambda: tr.HeterogeneousFog(scales=[0.0], weights=[1.0]),
            "scales < 0": lambda: tr.HeterogeneousFog(scales=[-4.0], weights=[1.0]),
            "scales of none": lambda: tr.HeterogeneousFog(scales=[], weights=[]),
            "weights < 0": lambda: tr.HeterogeneousFog(scales=[4.0], weights=[-1.0]),
            "weights all 0": lambda: tr.HeterogeneousFog(scales=[4.0], weights=[0.0]),
        },
    ),
    Row(
        "fog in drifts",
        "scales with more nodes than memory has room for",
        "E",
        "the shortest period is told",
        REFUSED,
        {
            "scales of a millionth": lambda: _drifts(1e-6),
            "scales that vanish": lambda: _drifts(1e-320),
            "scales of a million cells": lambda: _drifts(1e6, scale_unit="cells"),
        },
    ),
    Row(
        "fog in drifts",
        "a frame of one pixel",
        "=",
        "k = k0",
        EFFECTS + "heterogeneous_fog.py::test_a_frame_of_one_pixel_has_the_mean_extinction",
    ),
    Row(
        "flare",
        "rho = 0, beta = 0",
        "I",
        "bit for bit, of every type and size",
        NOTHING,
        {
            "rho = 0": lambda: tr.LensFlare(radius_range=ZERO),
            "beta = 0": lambda: tr.LensFlare(strength_range=ZERO),
        },
    ),
    Row(
        "flare",
        "rho < 0, beta < 0",
        "E",
        "the range is named",
        REFUSED,
        {
            "radius_range < 0": lambda: tr.LensFlare(radius_range=(-0.1, 0.2)),
            "strength_range < 0": lambda: tr.LensFlare(strength_range=(-0.1, 0.2)),
        },
    ),
    Row(
        "flare",
        "the center outside the frame",
        "=",
        "valid",
        EFFECTS + "flare.py::test_a_sun_outside_the_frame_shines_in",
    ),
    Row(
        "flare",
        "a white image",
        "C",
        "unchanged, with a gradient of zero",
        EFFECTS + "flare.py::test_a_white_image_stays_white_and_passes_no_gradient",
    ),
    Row(
        "compose",
        "several warps",
        "=",
        "one look-up, within 2e-3 px of the analytic composite",
        EFFECTS + "compose.py::test_analytic_flows_compose_to_2_thousandths_of_a_pixel",
    ),
    Row(
        "compose",
        "fog between warps",
        "=",
        "keeps its place, and its map moves along",
        EFFECTS + "compose.py::test_fog_between_warps_keeps_its_place_and_its_map_moves_along",
    ),
    Row("compose", "no effect", "E", "effects are named", REFUSED, {"effects": lambda: tr.Compose([])}),
)

"""What warps promise."""

import math
from collections.abc import Callable
from typing import Any

import torch
from promises import (
    EFFECTS,
    FLOWS,
    HERE,
    LEARNED,
    MASKED,
    NOTHING,
    PROPERTIES,
    REFUSED,
    RESAMPLE,
    TOLD,
    ZERO,
    Row,
    frame,
)

import torchrefract as tr

_NARROW: dict[str, Any] = {"focal_range": (0.5, 0.5)}


def _lens(**changed: Any) -> Any:
    params = tr.LensDistortion().sample(frame(), seed=0)
    return tr.LensDistortion().apply(frame(), params._replace(**changed))


def _lenses(**ranges: Any) -> Callable[..., tr.LensDistortion]:
    """Lenses of these numbers and no others, by the options of a warp."""
    alone: dict[str, Any] = {f"{name}_range": ZERO for name in ("k1", "k2", "p1", "p2")}
    return lambda **warp: tr.LensDistortion(**(alone | ranges | warp))


def _camera(**changed: Any) -> tr.Camera:
    numbers: dict[str, Any] = {"width": 201, "height": 201, "fx": 199.0, "fy": 199.0, "cx": 100.0, "cy": 100.0}
    numbers["coefficients"] = (0.0,) * 4
    return tr.Camera(**(numbers | changed))


def _pole() -> tr.Camera:
    return _camera(coefficients=(0.0,) * 5 + (-2.0, 0.0, 0.0))


def _plate(points: list[list[float]]) -> Any:
    params = tr.ThinPlateSpline().sample(frame(), seed=0)
    at = torch.tensor([points])
    return tr.ThinPlateSpline().apply(frame(), params._replace(points=at, displacement=at))


def _stirred(kind: Any, amplitude: float, **more: Any) -> Callable[..., Any]:
    """Random fields of a length of 9 px."""
    return lambda **warp: kind(amplitude_range=(amplitude, amplitude), length_range=(9.0, 9.0), **(more | warp))


_FOLDS = {"k1 = -0.6": _lenses(k1_range=(-0.6, -0.6), **_NARROW)}
_WILD = {"16 px": _stirred(tr.Turbulence, 16.0, aperture_range=ZERO)}
_FAR = {f"{name}, 100 px": _stirred(tr.DivergenceFree, 100.0, normalize=name) for name in ("theory", "max")}

ROWS = (
    Row(
        "warp",
        "a flow of ±1e6 px, 3e38, ±Inf, NaN; every padding, interpolation and type; backward",
        "M",
        "finite, no crash, not valid",
        FLOWS,
    ),
    Row(
        "warp",
        "a flow with such values, in a process of its own",
        "M",
        "no crash, no other pixel changes",
        RESAMPLE + "poisoned_flows_neither_crash_nor_spread_forward_or_backward",
    ),
    Row("warp", "±1e6 px", "M", "the padding, not valid", RESAMPLE + "a_million_pixels_away_lies_the_padding"),
    Row(
        "warp",
        "8K",
        "=",
        "within 1e-3 px",
        RESAMPLE + "at_8k_a_frame_that_does_not_move_stays_to_a_thousandth_of_a_pixel",
    ),
    Row(
        "warp",
        "1 x 40 000, 40 000 x 1",
        "=",
        "within 1e-3 px",
        RESAMPLE + "a_line_of_40000_pixels_that_does_not_move_stays_to_a_thousandth_of_a_pixel",
    ),
    Row(
        "warp",
        "bicubic on two levels; every padding, type and size",
        "C",
        "into the range of the values",
        HERE + "test_bicubic_stays_in_the_range_of_the_values",
    ),
    Row(
        "lens", "all coefficients 0", "I", "bit for bit, of every type, size and padding", NOTHING, {"k = 0": _lenses()}
    ),
    Row("lens", "r_max inside the frame", "M", "padded and not valid beyond it", MASKED, _FOLDS),
    Row(
        "lens",
        "pixels without a preimage, backward",
        "M",
        "finite gradients of every parameter, through both flows",
        LEARNED,
        {
            "p1 = 2": _lenses(p1_range=(2.0, 2.0)),
            "k1 = -0.6": _lenses(k1_range=(-0.6, -0.6), **_NARROW),
            "k6 = 100, f = 0.01": _lenses(
                k6_range=(100.0, 100.0), focal_range=(0.01, 0.01), center_x_range=(10.0, 10.0)
            ),
        },
    ),
    Row("lens", "r_max inside the frame", "W", "one warning, however often it is called", TOLD, _FOLDS),
    Row(
        "lens",
        "r_max inside the frame, `strict=True`",
        "E",
        "the lens is told",
        REFUSED,
        {
            "coefficients": lambda: _lenses(k1_range=(-0.6, -0.6), strict=True, **_NARROW)().degrade(
                frame(1, 3, 18, 32), seed=0
            ),
        },
    ),
    Row(
        "lens",
        "k1 = +1 ... +10",
        "M",
        "converges",
        MASKED,
        {f"k1 = {k1:g}": _lenses(k1_range=(k1, k1)) for k1 in (1.0, 3.0, 10.0)},
    ),
    Row(
        "lens",
        "k1 = +1 ... +10, every pixel",
        "M",
        "valid everywhere",
        EFFECTS + "lens.py::test_strong_pincushions_converge_everywhere",
    ),
    Row(
        "lens",
        "k1 = -1e3, 1e30; f <= 0",
        "E",
        "the range or the field is named",
        REFUSED,
        {
            "k1_range = -1e3": lambda: tr.LensDistortion(k1_range=(-1e3, 0.0)),
            "k1_range = 1e30": lambda: tr.LensDistortion(k1_range=(0.0, 1e30)),
            "focal_range = 0": lambda: tr.LensDistortion(focal_range=(0.0, 1.0)),
            "focal_range < 0": lambda: tr.LensDistortion(focal_range=(-1.0, 1.0)),
            "params.focal = 0": lambda: _lens(focal=torch.zeros(1, 2)),
            "params.coefficients = -1e3": lambda: _lens(coefficients=torch.full((1, 12), -1e3)),
            "params.coefficients = 1e30": lambda: _lens(coefficients=torch.full((1, 12), 1e30)),
            "fx of a camera": lambda: _camera(fx=0.0),
            "coefficients of a camera": lambda: _camera(coefficients=(-1e30, 0.0, 0.0, 0.0)),
        },
    ),
    Row(
        "lens",
        "OpenCV's denominator crosses 0 inside the frame",
        "E",
        "the radius is told",
        REFUSED,
        {
            "camera to rectify": lambda: tr.Rectification(_pole()),
            "camera as a lens": lambda: tr.LensDistortion.from_camera(_pole()),
            "camera to cover a frame": lambda: _pole().check_covers(),
        },
    ),
    Row(
        "lens",
        "OpenCV's vector of 14 as a polynomial",
        "E",
        "the model is named",
        REFUSED,
        {
            "params.coefficients of 14": lambda: _lens(coefficients=torch.zeros(1, 14)),
            "coefficients of 14": lambda: _camera(coefficients=(0.0,) * 14, model="polynomial12"),
        },
    ),
    Row(
        "turbulence",
        "length 0, below 0, NaN",
        "E",
        "the range or the field is named",
        REFUSED,
        {
            "length_range = 0": lambda: tr.Turbulence(length_range=(0.0, 1.0)),
            "length_range < 0": lambda: tr.Turbulence(length_range=(-1.0, 1.0)),
            "length_range NaN": lambda: tr.Turbulence(length_range=(math.nan, 1.0)),
        },
    ),
    Row(
        "turbulence",
        "length 0, below 0, NaN in `params`",
        "E",
        "the field is named",
        EFFECTS + "turbulence.py::test_air_that_is_none_raises",
    ),
    Row(
        "turbulence",
        "length 0.1 px",
        "=",
        "white noise, of the amplitude within 1 %",
        EFFECTS + "turbulence.py::test_white_noise_has_the_amplitude_too",
    ),
    Row(
        "turbulence",
        "length of ten frames",
        "M",
        "finite, and so is its gradient",
        EFFECTS + "turbulence.py::test_a_field_of_ten_frames_stays_finite",
    ),
    Row(
        "turbulence",
        "a torus over the cap of memory",
        "W",
        "clipped, and by how much is told",
        EFFECTS + "turbulence.py::test_a_length_that_no_torus_has_room_for_is_told",
    ),
    Row(
        "turbulence",
        "length 1e6 px, swirls too",
        "M",
        "the largest torus, 2^24 px; finite, and a batch is each sample alone, bit for bit on the CPU",
        PROPERTIES + "the_longest_correlations_take_the_largest_torus",
    ),
    Row(
        "turbulence",
        "each frame normalized by itself, of any size",
        "=",
        "a batch is each sample alone, bit for bit on the CPU",
        HERE + "test_what_is_normalized_by_the_frame_is_so_in_any_batch",
    ),
    Row("turbulence", "an amplitude that folds", "W", "one warning, however often it is called", TOLD, _WILD),
    Row("turbulence", "an amplitude that folds", "M", "folded pixels are not valid in `restore_flow`", MASKED, _WILD),
    Row(
        "thin plate",
        "the points stay",
        "I",
        "bit for bit, of every type, size and padding",
        NOTHING,
        {
            "amplitude 0": lambda **warp: tr.ThinPlateSpline(amplitude_range=ZERO, **warp),
        },
    ),
    Row(
        "thin plate",
        "two points the same, points on a line, two points, points at infinity",
        "E",
        "the rule of the points is told",
        REFUSED,
        {
            "points the same": lambda: _plate([[0.0, 0.0], [9.0, 0.0], [9.0, 0.0], [4.0, 4.0]]),
            "points on a line": lambda: _plate([[0.0, 0.0], [3.0, 1.0], [6.0, 2.0], [9.0, 3.0]]),
            "points too few": lambda: _plate([[0.0, 0.0], [9.0, 0.0]]),
            "points nowhere": lambda: _plate([[0.0, 0.0], [9.0, math.inf], [4.0, 4.0]]),
        },
    ),
    Row(
        "thin plate",
        "900 points",
        "=",
        "within 1e-3 px of SciPy's",
        EFFECTS + "thin_plate.py::test_nine_hundred_points_bend_the_frame_as_scipys_spline_does",
    ),
    Row(
        "thin plate",
        "a control point on a pixel",
        "=",
        "finite gradients",
        EFFECTS + "thin_plate.py::test_control_points_on_pixels_have_finite_gradients",
    ),
    Row(
        "thin plate",
        "displacements of 1e4 px",
        "M",
        "folded pixels are not valid in `restore_flow`",
        MASKED,
        {
            "1e4 px": lambda **warp: tr.ThinPlateSpline(amplitude_range=(1e4, 1e4), **warp),
        },
    ),
    Row(
        "divergence-free",
        "amplitude 0",
        "I",
        "bit for bit, of every type, size and padding",
        NOTHING,
        {
            "amplitude 0": _stirred(tr.DivergenceFree, 0.0),
        },
    ),
    Row(
        "divergence-free",
        "psi constant",
        "I",
        "no flow at all",
        "tests/fields/test_stream.py::test_a_constant_moves_nothing_at_all",
    ),
    Row(
        "divergence-free", "an amplitude that folds", "M", "folded pixels are not valid in `restore_flow`", MASKED, _FAR
    ),
    Row(
        "divergence-free",
        "an amplitude that folds",
        "M",
        "the change of areas is told",
        EFFECTS + "divergence_free.py::test_an_amplitude_that_folds_is_told_and_its_folds_are_not_valid",
    ),
)

"""The plan of a photometric effect: what it leaves out, because it cannot move a pixel by more than a tolerance.

Tolerances and errors are in levels, 1/255 of the range of an image in [0, 1]. Fog blends I t + A (1 - t), so an error e
of t moves a pixel by at most max(A, 1 - A) e; in linear light by at most the slope of the sRGB curve times that.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrefract._tensor import cached_constant
from torchrefract.fields.fog_volume import VARIANCE

LEVELS = 255.0
_SIGMAS = 7.0  # of random bounds
_ROUNDING_ULPS = 16
_STEEPEST_SRGB = 12.92  # slope of the curve from linear light to stored values in the dark
_MIN_MEAN = 0.1  # a mean extinction over the frame that may be smaller has no useful bound
_PHASES = 12
_NOISE_BOUND = math.sqrt(0.5)  # of 2-D Perlin noise; mapped to [0, 1] it is 1/2 + noise * sqrt(1/2)
_VOLUME_NOISE_BOUND = math.sqrt(0.75)  # of 3-D Perlin noise: half the diagonal of a cell


@dataclass(frozen=True)
class PhotometricRequest:
    """The frame and the tolerance that a plan is made for.

    height, width: px, of the frame.
    tolerance: largest error of the image, levels; None computes it exactly.
    is_double: True for images in float64.
    """

    height: int
    width: int
    tolerance: float | None
    is_double: bool

    def remaining(self, *, linear_light: bool = False, scale: float = 1.0) -> float:
        """Return the part of the tolerance that rounding leaves, levels; 0 without a tolerance.

        Args:
            linear_light: the image is blended in linear light.
            scale: largest value of the image.

        Raises:
            ValueError: the tolerance is smaller than twice the rounding error.
        """
        if self.tolerance is None:
            return 0.0
        rounding = LEVELS * _ROUNDING_ULPS * 2.0 ** (-53 if self.is_double else -24) * scale
        rounding *= _STEEPEST_SRGB if linear_light else 1.0
        if self.tolerance < 2 * rounding:
            kind = f"{'float64' if self.is_double else 'float32'}{' in linear light' if linear_light else ''}"
            raise ValueError(
                f"tolerance must be at least {2 * rounding:.2g} levels of 1/255 for images in {kind} (None is exact), "
                f"got {self.tolerance:g}"
            )
        return self.tolerance - rounding


@dataclass(frozen=True)
class PhotometricPlan:
    """The computation of a photometric effect for frames of one size.

    height, width: px, of the frame.
    tolerance: largest error of the image that was requested, levels of 1/255; None is exact.
    error: largest error of the image through what is left out, levels.
    reason: what decided.
    is_identity: True if the image is returned as it is.
    kept, dropped: terms that are computed, and those that are not with the largest change in levels of each.
    octaves: indices of the noises that are computed; None if the plan drops none; () is a uniform fog.
    """

    height: int
    width: int
    tolerance: float | None
    error: float
    reason: str
    is_identity: bool = False
    kept: tuple[str, ...] = ()
    dropped: tuple[tuple[str, float], ...] = ()
    octaves: tuple[int, ...] | None = None

    def summary(self) -> str:
        """Return one line: whether the effect is computed, and why."""
        return f"{'not computed' if self.is_identity else 'at every pixel'} ({self.reason})"

    def __str__(self) -> str:
        lines = [
            f"frame          {self.width} x {self.height} px",
            f"tolerance      {'none: exact' if self.tolerance is None else f'{self.tolerance:g} levels of 1/255'}",
            f"light          {self.summary()}",
            f"error at most  {self.error:.2g} levels",
        ]
        if self.kept:
            lines.append(f"terms kept     {', '.join(self.kept)}")
        lines += [f"term dropped   {name}, which changes up to {change:.2g} levels" for name, change in self.dropped]
        return "\n".join(lines)


@dataclass(frozen=True)
class FogErrorModel:
    """Bounds for all fogs that an effect draws from its ranges.

    thickness: largest mean extinction times distance; inf for an unknown depth.
    colors: all values of the airlight, in [0, 1].
    linear_light: the image is blended in linear light.
    mean_over_frame: extinctions are divided by their mean over the frame, not by that of the random field.
    periods: px, of the noises in the image; () for uniform and volumetric fog.
    weights: of the noises, of sum 1.
    contrast: largest standard deviation of ln q of a volumetric fog.
    """

    thickness: float
    colors: tuple[float, ...]
    linear_light: bool
    mean_over_frame: bool = True
    periods: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    contrast: float = 0.0

    def levels(self, error: float) -> float:
        """Return the largest change of the image for an error of t, at least that of t itself."""
        if not self.linear_light:
            return LEVELS * error
        light = [((c + 0.055) / 1.055) ** 2.4 if c > 0.04045 else c / 12.92 for c in self.colors]
        return max(LEVELS * error, _levels_of_light(error * max(max(value, 1 - value) for value in light)))


@cached_constant(maxsize=64)
def plan_uniform_fog(model: FogErrorModel, request: PhotometricRequest) -> PhotometricPlan:
    """Plan uniform fog: all of it or, if it is too thin, nothing."""
    return _without_fog(model, request, largest_ratio=1.0) or exact_plan(request, "the fog can be seen")


@cached_constant(maxsize=64)
def plan_image_fog(model: FogErrorModel, request: PhotometricRequest) -> PhotometricPlan:
    """Plan fog with noise in the image: drop the octaves of the least weight, in order.

    With q = sum of w_i s_i, s_i in [0, 1], m = <q> and an optical thickness x, t = exp(-x q / m). Octaves of the total
    weight w that are replaced by their mean change q by e <= w / 2 and m by f, so that

        |change of t| <= 1 - exp(-x e / (m - f)) + f / (m - f) max over y <= x / (m - f) of y exp(-y)

    f is 0 for the mean of the random field; over a frame it is the mean of the octaves, within 7 standard deviations.
    """
    octaves = tuple(range(len(model.periods)))
    names = [f"octave of {period:g} px" for period in model.periods]
    lowest = 0.5 - _NOISE_BOUND * min(_NOISE_BOUND, _deviation_of_mean(model, octaves, request))
    if (plan := _without_fog(model, request, largest_ratio=1 / lowest if lowest > 0 else math.inf)) is not None:
        return plan
    exact = exact_plan(request, "no octave is too faint", kept=tuple(names), octaves=octaves)
    if request.tolerance is None or lowest < _MIN_MEAN:
        return exact
    remaining = request.remaining(linear_light=model.linear_light)

    def error_without(dropped: Sequence[int]) -> float:
        weight = sum(model.weights[i] for i in dropped)
        mean = _NOISE_BOUND * min(_NOISE_BOUND * weight, _deviation_of_mean(model, dropped, request))
        smallest = lowest - mean
        if smallest <= 0:
            return math.inf
        largest = min(model.thickness, 1e12) / smallest
        y = min(1.0, largest)
        return model.levels(-math.expm1(-largest * weight / 2) + mean / smallest * y * math.exp(-y))

    faintest = sorted(octaves, key=lambda i: model.weights[i])
    count = next((n for n in octaves if error_without(faintest[: n + 1]) > remaining), len(octaves))
    if count == 0:
        return exact
    dropped = faintest[:count]
    kept = tuple(i for i in octaves if i not in dropped)
    return _plan(
        request,
        error_without(dropped),
        "octaves that are too faint are left out",
        kept=tuple(names[i] for i in kept),
        dropped=tuple((names[i], error_without([i])) for i in dropped),
        octaves=kept,
    )


@cached_constant(maxsize=64)
def plan_volumetric_fog(model: FogErrorModel, request: PhotometricRequest) -> PhotometricPlan:
    """Plan volumetric fog: all of it, uniform fog if its contrast is too faint, or nothing.

    q = exp(c g - c^2 / 2) with |g| <= G, so q / <q> lies in exp(+-2 c G) for a mean over the frame, and between
    exp(-c G - c^2 / 2) and exp(c G) otherwise, at every point and so along every ray.
    """
    deviation = math.sqrt(VARIANCE * sum(weight**2 for weight in model.weights))
    largest = model.contrast * min(_SIGMAS, _VOLUME_NOISE_BOUND / deviation)
    low, high = (-2 * largest, 2 * largest) if model.mean_over_frame else (-largest - model.contrast**2 / 2, largest)
    if (plan := _without_fog(model, request, largest_ratio=math.exp(high))) is not None:
        return plan
    if request.tolerance is None:
        return exact_plan(request, "the fog can be seen")
    x = np.geomspace(1e-6, 1, 200) * min(model.thickness, 1e5)
    changes = [np.abs(np.exp(-x * math.exp(end)) - np.exp(-x)).max() for end in (low, high)]
    error = 1.05 * model.levels(float(max(changes)))
    if error > request.remaining(linear_light=model.linear_light):
        return exact_plan(request, "its contrast can be seen")
    return _plan(request, error, "its contrast is too faint", dropped=(("contrast", error),), octaves=())


def plan_flare(light: float, request: PhotometricRequest, *, is_bounded: bool) -> PhotometricPlan:
    """Plan a flare: all of it or, if it is too faint, nothing.

    Args:
        light: largest light that it adds to any pixel.
        request: the frame and the tolerance.
        is_bounded: True if the image stays in [0, 1].
    """
    budget = request.remaining(scale=1.0 if is_bounded else max(1.0, light))
    plan = _identity_if_unseen(LEVELS * light, budget, request, name="flare", reason="it is too faint")
    return plan or exact_plan(request, "the flare can be seen")


def exact_plan(request: PhotometricRequest, reason: str = "", **terms: Any) -> PhotometricPlan:
    """Return the plan that leaves nothing out, and why; without a tolerance that is the reason."""
    return _plan(request, 0.0, "no tolerance" if request.tolerance is None else reason, **terms)


def _plan(request: PhotometricRequest, error: float, reason: str, **terms: Any) -> PhotometricPlan:
    return PhotometricPlan(request.height, request.width, request.tolerance, error, reason, **terms)


def _without_fog(model: FogErrorModel, request: PhotometricRequest, *, largest_ratio: float) -> PhotometricPlan | None:
    """The plan without any fog, if it cannot be seen where q / <q> is at most `largest_ratio`."""
    change = model.levels(-math.expm1(-model.thickness * largest_ratio)) if model.thickness > 0 else 0.0
    budget = request.remaining(linear_light=model.linear_light)
    return _identity_if_unseen(change, budget, request, name="fog", reason="it is too thin")


def _identity_if_unseen(
    change: float, budget: float, request: PhotometricRequest, *, name: str, reason: str
) -> PhotometricPlan | None:
    if change > budget:
        return None
    if change == 0:
        return _plan(request, 0.0, "its strength is 0", is_identity=True)
    return _plan(request, change, reason, is_identity=True, dropped=((name, change),))


def _deviation_of_mean(model: FogErrorModel, octaves: Sequence[int], request: PhotometricRequest) -> float:
    """7 standard deviations of the mean over the frame of the weighted octaves; 0 if the mean is that of the field."""
    if not model.mean_over_frame:
        return 0.0
    frame = (request.height, request.width)
    return _SIGMAS * math.sqrt(
        sum(model.weights[i] ** 2 * noise_mean_variance(model.periods[i], *frame) for i in octaves)
    )


def plan_turbulence_blur(change: float, ratio: float, request: PhotometricRequest) -> PhotometricPlan:
    """Plan the blur of turbulence: all of it or, if the aperture hides it, nothing.

    Args:
        change: largest change of the image, linear light.
        ratio: largest D / r0.
        request: the frame and the tolerance.
    """
    if request.tolerance is None:
        return exact_plan(request)
    budget, levels = request.remaining(linear_light=True), _levels_of_light(min(change, 1.0))
    name, reason = "blur", f"D / r0 is up to {ratio:.2g} at the reach"
    if ratio < 1 and levels > budget:
        name, budget = "blur of frames that are sharper than their aperture", math.inf
        reason += ": below 1 the diffraction of the aperture hides the blur"
    return _identity_if_unseen(levels, budget, request, name=name, reason=reason) or exact_plan(request, reason)


def _levels_of_light(x: float) -> float:
    """Return the largest change of the image in levels for a change of its linear light."""
    # The curve is concave, so two values apart by x come out apart by its value at x at most.
    return LEVELS * (_STEEPEST_SRGB * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055)


def noise_mean_variance(period: float, height: int, width: int) -> float:
    """Return the largest variance over all phases of the mean of 2-D Perlin noise over a frame.

    The mean is a sum over nodes of g_x A(x) H(y) + g_y H(x) A(y) with unit vectors g of random direction, where H and A
    are the means along an axis of h(p) and p h(p). All sizes are in px.
    """
    (hy, ay), (hx, ax) = (_squared_sums(period, size) for size in (height, width))
    return float(((ay[:, None] * hx + hy[:, None] * ax) / 2).max())


def _squared_sums(period: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """(phases,): sums over the nodes of an axis of the squared means of h(p) and p h(p)."""
    sums = []
    # Phases over a cell, and over the part of it for which the frame contains a node.
    phases = np.arange(_PHASES) / _PHASES
    for phase in (*phases, *(1 - min(size / period, 1.0) * phases)):
        position = np.arange(size) / period + phase
        node = np.floor(position).astype(int)
        p = position - node
        fade = p**3 * (p * (6 * p - 15) + 10)
        h = np.bincount(node, 1 - fade, node[-1] + 2) + np.bincount(node + 1, fade, node[-1] + 2)
        a = np.bincount(node, p * (1 - fade), node[-1] + 2) + np.bincount(node + 1, (p - 1) * fade, node[-1] + 2)
        sums.append(((h / size) @ (h / size), (a / size) @ (a / size)))
    return np.array(sums)[:, 0], np.array(sums)[:, 1]

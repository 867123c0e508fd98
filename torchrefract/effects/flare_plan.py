"""What a flare will compute under a tolerance.

The veil strength color exp(-(x - cx)^2 / (2 r^2)) exp(-(y - cy)^2 / (2 r^2)) adds at most itself to an image in [0, 1],
whatever the blend. It is largest for the largest strength, color and radius, and at the center that is nearest. Outside
the rows and the columns where it can then be seen the image is left; along an axis on which the sun drifts it may be
anywhere.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from torchrefract.planning.photometric import LEVELS, LightPlan, check_level_reachable, whole
from torchrefract.types import Range

_NOTHING = (0, 0, 0, 0)


@dataclass(frozen=True)
class Suns:
    """What flares are drawn from.

    center_x, center_y: px; None is anywhere.
    radius: px, the largest.
    strength: the largest, of the brightest color.
    worth: of the frame: larger parts are computed with all of it.
    bounded: images stay in [0, 1].
    """

    center_x: Range | None
    center_y: Range | None
    radius: float
    strength: float
    worth: float
    bounded: bool


@dataclass(frozen=True)
class FlarePlan(LightPlan):
    """A plan with the part of the frame that the flare reaches.

    part: the first row and the one behind the last, then columns likewise; None is the whole frame.
    """

    part: tuple[int, int, int, int] | None = None


@lru_cache(maxsize=256)
def flare_plan(suns: Suns, height: int, width: int, tolerance: float | None, double: bool) -> FlarePlan:
    """The plan for frames of a size, in float64 or in float32."""
    computed = whole("computed", height)
    if tolerance is None:
        return FlarePlan(height, width, None, 0.0, "no tolerance", computed)
    scale = 1.0 if suns.bounded else max(1.0, suns.strength)
    room = check_level_reachable(tolerance, linear=False, double=double, scale=scale)
    y, x = _along(suns.center_y, height, suns.radius), _along(suns.center_x, width, suns.radius)
    most = LEVELS * suns.strength
    top, bottom, above = _seen(most * x.max() * y, room)
    left, right, beside = _seen(most * y.max() * x, room)
    if top == bottom or left == right:
        error = float(most * x.max() * y.max())
        return FlarePlan(height, width, tolerance, error, "it is too faint", whole("left", height), part=_NOTHING)
    share = (bottom - top) * (right - left) / (height * width)
    if share > suns.worth:
        return FlarePlan(height, width, tolerance, 0.0, "it reaches most of the frame", computed)
    error = max(above, beside) + tolerance - room
    bands = tuple(
        band for band in (("left", 0, top), ("computed", top, bottom), ("left", bottom, height)) if band[1] < band[2]
    )
    dropped = (("the flare beyond", max(above, beside)),)
    details = (("columns", f"{left} to {right - 1} of them"),)
    part = (top, bottom, left, right)
    return FlarePlan(
        height, width, tolerance, error, "what it reaches", bands, dropped=dropped, details=details, part=part
    )


def _along(center: Range | None, size: int, radius: float) -> np.ndarray:
    """The largest that the veil can be along an axis, of 1."""
    if center is None:
        return np.ones(size)
    place = np.arange(size)
    off = np.maximum(np.maximum(center[0] - place, place - center[1]), 0)
    # The field takes smaller radii as this, too.
    return np.exp(-0.5 * np.square(off / max(radius, 1e-6)))


def _seen(levels: np.ndarray, room: float) -> tuple[int, int, float]:
    """The first place, the one behind the last, and the most that is left out."""
    seen = np.flatnonzero(levels > room)
    if not len(seen):
        return 0, 0, float(levels.max())
    start, stop = int(seen[0]), int(seen[-1]) + 1
    return start, stop, float(max(levels[:start].max(initial=0), levels[stop:].max(initial=0)))


def reach(span: Range, drift: Range, size: int) -> Range | None:
    """Px, of a center in shares of a side; anywhere if it drifts."""
    if drift != (0.0, 0.0):
        return None
    room = 1e-5 * size * max(1.0, *map(math.fabs, span))  # what rounding of given parameters may add
    return span[0] * size - 0.5 - room, span[1] * size - 0.5 + room

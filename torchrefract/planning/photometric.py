"""What an effect that changes light will do for a frame of some size, under a tolerance in levels.

A level is 1/255 of the range of an image in [0, 1]. Where an image in other light is I t + A (1 - t), an error e of t
moves it by |A - I| e <= max(A, 1 - A) e; in linear light by at most S' of the darkest that it can be times that. S, the
curve of sRGB, is steepest in the dark and concave: two values that are apart by x come out apart by S(x) at most.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from torchrefract.fields.veils import Ends

LEVELS = 255.0
# Images in float32 are off by so many units of the last place; the curve of sRGB stretches that in the dark.
_ROUNDING = {False: 16 * 2.0**-24, True: 16 * 2.0**-53}
_STEEPEST = 12.92


@dataclass(frozen=True)
class LightPlan:
    """How an effect computes light for frames of one size.

    height, width: px, of the frame.
    tolerance: how far the image may be from the exact one anywhere, levels of 1/255; None is exact.
    error: how far it is at most, levels.
    why: what decided.
    bands: (kind, first row, row behind the last), from the top; the rows of a kind are "computed", "left" as they are,
        or "filled" with the airlight.
    kept: the terms that are computed.
    dropped: those that are not, each with how far it could have moved the image, levels.
    details: what else is to be printed, by name.
    acts: any row is another than in the image that came in.
    """

    height: int
    width: int
    tolerance: float | None
    error: float
    why: str
    bands: tuple[tuple[str, int, int], ...] = ()
    kept: tuple[str, ...] = ()
    dropped: tuple[tuple[str, float], ...] = ()
    details: tuple[tuple[str, str], ...] = field(default=(), kw_only=True)
    acts: bool = field(init=False)

    def __post_init__(self) -> None:
        # Compilers read fields, not properties.
        object.__setattr__(self, "acts", any(kind != "left" for kind, _, _ in self.bands))

    def summary(self) -> str:
        """Which rows are computed, and why those."""
        return f"{self._light()} ({self.why})"

    def __str__(self) -> str:
        lines = [
            f"frame          {self.height} x {self.width} px",
            f"tolerance      {'none: exact' if self.tolerance is None else f'{self.tolerance:g} levels of 1/255'}",
            f"light          {self.summary()}",
            f"error at most  {self.error:.2g} levels",
        ]
        lines += [f"{name:<15}{value}" for name, value in self.details]
        if self.kept:
            lines.append(f"terms kept     {', '.join(self.kept)}")
        lines += [f"term dropped   {name}, which moves up to {moved:.2g} levels" for name, moved in self.dropped]
        return "\n".join(lines)

    def _light(self) -> str:
        if len(self.bands) == 1:
            return {"computed": "at every pixel", "left": "not computed", "filled": "that of the air alone"}[
                self.bands[0][0]
            ]
        return ", ".join(f"rows {start} to {stop - 1} {kind}" for kind, start, stop in self.bands)


def whole(kind: str, height: int) -> tuple[tuple[str, int, int], ...]:
    """All rows of one kind."""
    return ((kind, 0, height),)


def thicknesses(most: float) -> np.ndarray:
    """Optical thicknesses up to the largest, close enough to one another to look for the largest of a smooth bound."""
    # Beyond that nothing of any light is left.
    most = min(most, 1e5)
    least = 1e-5 * min(most, 1.0)
    return np.geomspace(least, most, 200) if least > 0 else np.zeros(1)


def check_level_reachable(tolerance: float, *, linear: bool, double: bool, scale: float = 1.0) -> float:
    """What a tolerance in levels leaves beside the rounding of the image.

    Args:
        tolerance: levels.
        linear: light is blended in linear radiance.
        double: of the type, float64 or float32.
        scale: the largest value of the image.

    Raises:
        ValueError: a tolerance that leaves nothing.
    """
    rounding = LEVELS * _ROUNDING[double] * scale * (_STEEPEST if linear else 1.0)
    if tolerance < 2 * rounding:
        kind = "float64" if double else "float32"
        raise ValueError(
            f"tolerance must be at least {2 * rounding:.2g} levels of 1/255 for images in {kind}"
            f"{' in linear light' if linear else ''} (None is exact), got {tolerance:g}"
        )
    return tolerance - rounding


def named(ends: Ends, room: float) -> tuple[tuple[str, float], ...]:
    """What ends of t leave out, each with how far that moves the image, levels."""
    names = []
    if ends.clear < 1:
        names.append((f"the fog where 1 - t < {1 - ends.clear:.2g}", room))
    if ends.opaque > 0:
        names.append((f"the scene where t < {ends.opaque:.2g}", room))
    return tuple(names)


def bands_of(left: np.ndarray, filled: np.ndarray) -> tuple[tuple[str, int, int], ...]:
    """Rows of one kind after another, from (H,) flags of what may be left and what may be filled."""
    kinds = np.where(left, "left", np.where(filled, "filled", "computed"))
    starts = [0, *(np.flatnonzero(kinds[1:] != kinds[:-1]) + 1).tolist(), len(kinds)]
    return tuple((str(kinds[start]), start, stop) for start, stop in pairwise(starts))


@dataclass(frozen=True)
class Blend:
    """How far an error of t moves an image that is blended with airlight.

    colors: of the airlight, in [0, 1].
    linear: light is blended in linear radiance.
    """

    colors: tuple[float, ...]
    linear: bool

    def left(self, t: np.ndarray) -> np.ndarray:
        """Levels, the most by which an image is moved through t."""
        color = np.array(self.colors)[:, None]
        if not self.linear:
            return LEVELS * ((1 - t) * np.maximum(color, 1 - color)).max(axis=0)
        light = _linear(color)
        return LEVELS * _stored((1 - t) * np.maximum(light, 1 - light)).max(axis=0)

    def filled(self, t: np.ndarray) -> np.ndarray:
        """Levels, the most by which an image behind t is another than the airlight."""
        color = np.array(self.colors)[:, None]
        if not self.linear:
            return LEVELS * (t * np.maximum(color, 1 - color)).max(axis=0)
        light = _linear(color)
        darker, brighter = color - _stored((1 - t) * light), _stored(light + t * (1 - light)) - color
        return LEVELS * np.maximum(darker, brighter).max(axis=0)

    def ends(self, room: float) -> Ends:
        """Where t may end, so that neither the image nor t itself moves by more than `room` levels."""
        # Both ends move an image the more, the nearer to the middle they are.
        fill = _bisected(lambda t: max(self.filled(t)[0], LEVELS * t[0]) <= room)
        return Ends(fill, 1 - _bisected(lambda loss: max(self.left(1 - loss)[0], LEVELS * loss[0]) <= room))

    def slope(self, t: np.ndarray) -> np.ndarray:
        """Levels by which a small error of t moves the image, over that error, for this t or a smaller one."""
        color = np.array(self.colors).reshape(-1, *[1] * t.ndim)
        if not self.linear:
            return np.full_like(t, LEVELS)  # the transmission itself is within the tolerance, too
        light = _linear(color)
        steepest = _slope((1 - t) * light) * np.maximum(light, 1 - light)
        return LEVELS * np.maximum(steepest, 1).max(axis=0)


def _bisected(holds: Callable[[np.ndarray], bool]) -> float:
    """The largest number in [0, 1/2] for which something holds that holds below it."""
    low, high = 0.0, 0.5
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if holds(np.array([middle])) else (low, middle)
    return low


def _linear(value: np.ndarray) -> np.ndarray:
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def _stored(value: np.ndarray) -> np.ndarray:
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-9) ** (1 / 2.4) - 0.055)


def _slope(value: np.ndarray) -> np.ndarray:
    return np.where(value <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(value, 1e-9) ** (1 / 2.4 - 1))

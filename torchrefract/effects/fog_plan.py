"""What fog of one density will compute under a tolerance.

Pixels through whose fog nothing is seen of the scene count as t = 0, those where nothing is seen of the fog as t = 1;
for rows of which that holds whatever is drawn the plan says it.

Along a row, in front of a camera, t is exp(-x sqrt(c + u)) with u = ((column - cx) / fx)^2, c = 1 + ((row - cy) / fy)^2
and x = k z, a completely monotone function of u: the derivatives alternate in sign and are largest where u is smallest.
So the polynomial through its values at the n zeros of a Chebyshev polynomial over u_low ... u_high is off by

    |error| <= 2 ((u_high - u_low) / 4)^n a_n,  exp(-x sqrt(c + u_low - v)) = sum over n of a_n v^n
    a_0 = exp(-x s),  a_1 = a_0 x / (2 s),  a_(n+2) = (x^2 a_n + (4 n + 2) (n + 1) a_(n+1)) / (4 s^2 (n + 1) (n + 2))

with s = sqrt(c + u_low); the recurrence is 4 (c - v) f'' - 2 f' = x^2 f, and all a_n fall with c.

Source: the remainder of Chebyshev interpolation; Schilling, Song and Vondracek, "Bernstein functions" (2010), theorem
3.7, for exp(-x g) of a Bernstein function g such as a root.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from torchrefract.fields.veils import NO_ENDS, Ends
from torchrefract.planning.photometric import (
    Blend,
    LightPlan,
    bands_of,
    check_level_reachable,
    named,
    thicknesses,
    whole,
)

_MOST_NODES = 8
_MARGIN = 1.02  # for what lies between the x that are looked at
_OF_COLUMNS = 0.75  # of the room, which the polynomial along rows may take


@dataclass(frozen=True)
class FogPlan(LightPlan):
    """A plan with the columns at which t is computed in each row.

    nodes: how many; None is each.
    ends: of t.
    """

    nodes: int | None = None
    ends: Ends = NO_ENDS


@dataclass(frozen=True)
class Fogs:
    """What fog of one density is made of.

    extinction: 1/m, the lowest and the highest.
    near, far: m, in each row.
    squares: of the tangents, along columns, (lowest, highest), and the lowest along rows; None where t is the same in a
        row, or of no form.
    """

    extinction: tuple[float, float]
    near: tuple[float, ...]
    far: tuple[float, ...]
    squares: tuple[float, float, float] | None
    blend: Blend


@lru_cache(maxsize=64)
def fog_plan(fogs: Fogs, height: int, width: int, tolerance: float | None, double: bool, moved: float = 0.0) -> FogPlan:
    """The plan for frames of a size, in float64 or in float32.

    moved: levels, of the tolerance, that somebody else takes.
    """
    if tolerance is None:
        return FogPlan(height, width, None, 0.0, "no tolerance", whole("computed", height))
    rounding = tolerance - check_level_reachable(tolerance, linear=fogs.blend.linear, double=double)
    room, blend = tolerance - rounding - moved, fogs.blend
    nodes, error = _nodes(fogs, _OF_COLUMNS * room)
    rest = room - error
    with np.errstate(invalid="ignore"):  # an infinite depth in clear air
        near, far = (np.nan_to_num(np.exp(-k * np.minimum(d, 1e12))) for k, d in (
            (fogs.extinction[0], np.array(fogs.near)), (fogs.extinction[1], np.array(fogs.far)),
        ))  # fmt: skip
    ends = blend.ends(rest).within(float(far.min()), float(near.max()))
    bands = bands_of(blend.left(far) <= rest, blend.filled(near) <= rest)
    if bands == whole("left", height):
        seen = float(blend.left(far).max())
        return FogPlan(height, width, tolerance, moved + seen, "it is too thin", bands, dropped=(("fog", seen),))
    dropped = named(ends, rest)
    error = tolerance if dropped else moved + error + rounding
    if nodes is None and not dropped:
        error = moved + rounding if moved else 0.0
        return FogPlan(height, width, tolerance, error, "every row is seen through fog", bands)
    details = (("columns", f"t at {nodes} of {width} in each row"),) if nodes else ()
    return FogPlan(
        height, width, tolerance, error, "what fog can move", bands,
        dropped=dropped, details=details, nodes=nodes, ends=ends,
    )  # fmt: skip


def _nodes(fogs: Fogs, room: float) -> tuple[int | None, float]:
    """How many columns suffice, and what they leave, levels."""
    if fogs.squares is None:
        return None, 0.0
    low, high, rows = fogs.squares
    square = 1 + rows + low
    x = thicknesses(fogs.extinction[1] * min(max(fogs.far), 1e12))
    steepness = fogs.blend.slope(np.exp(-x * math.sqrt(square)))
    before = np.exp(-x * math.sqrt(square))
    term = before * x / (2 * math.sqrt(square))
    for n in range(1, _MOST_NODES + 1):
        error = _MARGIN * 2 * ((high - low) / 4) ** n * float((term * steepness).max())
        if error <= room:
            return n, error
        following = (x * x * before + (4 * n - 2) * n * term) / (4 * square * n * (n + 1))
        before, term = term, following
    return None, 0.0

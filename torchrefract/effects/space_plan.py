"""What fog in drifts in space will compute under a tolerance: its drifts are computed exactly or not at all."""

import math
from functools import lru_cache, partial

import numpy as np

from torchrefract.effects.drift_plan import MARGIN, SIGMAS, DriftPlan, Drifts, ends_of, seen_of_all
from torchrefract.fields.perlin3d import VARIANCE
from torchrefract.planning.photometric import check_level_reachable, thicknesses, whole

# Of noise, in the middle of a cell: half its diagonal.
_LARGEST = math.sqrt(0.75)


@lru_cache(maxsize=256)
def space_plan(
    drifts: Drifts, contrast: float | None, height: int, width: int, tolerance: float | None, double: bool
) -> DriftPlan:
    """That of fog whose drifts are computed exactly or not at all.

    In space q = exp(c g - c^2 / 2) with |g| <= G, so that q / <q> is between exp(-2 c G) and exp(2 c G), or, of the
    ensemble, between exp(-c G - c^2 / 2) and exp(c G), at every point and so along every ray.

    Args:
        drifts: their periods are of no matter here.
        contrast: the largest; None is not known.
        height, width, tolerance, double: of the frame.
    """
    octaves = tuple(range(len(drifts.shares)))
    plan = partial(DriftPlan, height, width, tolerance)
    computed = whole("computed", height)
    if tolerance is None:
        return plan(0.0, "no tolerance", computed, fine=octaves)
    room = check_level_reachable(tolerance, linear=drifts.blend.linear, double=double)
    if contrast is None:
        ends, seldom = ends_of(drifts, room, math.inf)
        why = "each noise is stretched to its extremes"
        return plan(tolerance, why, computed, dropped=seldom, fine=octaves, ends=ends)
    root = math.sqrt(VARIANCE * sum(share**2 for share in drifts.shares))
    most = contrast * min(SIGMAS, _LARGEST * sum(drifts.shares) / root)
    low, high = (-2 * most, 2 * most) if drifts.of_image else (-most - contrast**2 / 2, most)
    if (seen := seen_of_all(drifts, math.exp(high))) <= room:
        left = whole("left", height)
        return plan(seen, "it is too thin", left, dropped=(("fog", seen),), fine=octaves)
    x = thicknesses(drifts.thickness)
    uniform = np.exp(-x)
    ends = [np.exp(-x * math.exp(end)) for end in (low, high)]
    moved = MARGIN * max(float((abs(t - uniform) * drifts.blend.slope(np.maximum(t, uniform))).max()) for t in ends)
    if moved <= room:
        return plan(moved, "its drifts are too faint", computed, dropped=(("drifts", moved),))
    ends, seldom = ends_of(drifts, room, math.exp(high))
    why = "drifts in space have no coarser form with a bound"
    return plan(tolerance, why, computed, dropped=seldom, fine=octaves, ends=ends)

"""How far a composite of flows is off where it is known every few px, by cubics between.

With phi = id + d of the flows that act later, a flow f adds f(phi(p)). Let psi be the cubic through four values of phi
along an axis, s px apart, at the place x of a pixel, and A its tangent there. The cubic through the values of f(phi) is
that of f(psi), and as it reproduces cubics, such as f'(A(x)) (psi - A),

    |error| <= error of f on a lattice of s |A'| + sum |w_j r_j| + |f'| |psi(x) - phi(x)|
    r_j = f(psi_j) - f(A_j) - f'(A(x)) (psi_j - A_j)

The last is the error of phi, as often as f stretches it. Strides from x to the nodes are u_j, the slopes of d are up to
L, its second and third derivatives up to B and C, those of f up to F and G, and |psi_j - A_j| <= B s^2 q_j, with q_j
for a second derivative that is a line between two values, as that of a cubic is between its inner nodes. The part of
r_j that is a cubic in u_j, of f'' and psi'', is reproduced, too, and of the others is left

    |r_j| <= F (1 + L) C (u_j s)^4 / 6 + F (B s^2 q_j)^2 / 2 + G ((1 + L) |u_j| s + B s^2 q_j)^2 B s^2 q_j / 2

Where f has kinks of its second derivative, and no G, f' differs by its second ones alone,

    |r_j| <= F ((1 + L) |u_j| s + B s^2 q_j) B s^2 q_j

and third differences are two of second ones. Of two axes, one after the other, the second takes on the error of the
first sum |w_j| times. What nodes are off by themselves is also taken on so often.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

from torchrefract.effects.plan import Plan, Smoothness
from torchrefract.warping.lattice import lagrange_weights

# Px between nodes, from fine to coarse.
SELDOM = (2, 3, 4, 5, 6, 8, 10, 12, 16)
# Px, which kernels leave to the border: more than what lies between nodes can be from all of them.
_MARGIN = 1.0

Error = tuple[float, bool]  # px, and whether it is one of a chance


class Share(NamedTuple):
    """A warp's part in a composite."""

    tolerance: float  # px, that its flow may be off by; 0 is exact
    plan: Plan  # for it
    stretched: float = 1.0  # how often its error counts in the composite


def errors_of(shares: Sequence[Share], every: int) -> list[Error]:
    """Of flows that are read where later ones look, in their order; inf where there is no bound."""
    if every == 1:
        return [(share.plan.error_px * share.stretched, share.plan.random) for share in shares]
    still = [share for share in shares if share.plan.stride == 0]
    found = [(share.plan.error_px * share.stretched, share.plan.random) for share in still]
    cubics, later = _cubics(every), _Later()
    for share in reversed([share for share in shares if share.plan.stride > 0]):
        plan, smooth = share.plan, share.plan.smooth
        if smooth is None or later.bend * every**2 > 4 * _MARGIN:
            return [(math.inf, False)]
        own = cubics.amplified**2 * plan.error_px
        own += smooth.cubics(every * later.stretch)
        if later.flows:  # it is read, and the exact one by lines; as known at every pixel if it is a curl
            own += ((1 + cubics.amplified**2) if plan.before > 1 else 1.0) * smooth.lines
        found.append((own * share.stretched, plan.random))
        cross = (1 + cubics.amplified) * cubics.across(smooth, later, every)
        found.append((cross * share.stretched, False))
        later = later.after(plan.slope, smooth, every)
    return found


class _Later(NamedTuple):
    """What flows that act later do together, at most."""

    flows: int = 0
    stretch: float = 1.0  # 1 + L
    bend: float = 0.0  # px per px^2
    third: float = 0.0  # px per px^3

    def after(self, slope: float, smooth: Smoothness, every: int) -> "_Later":
        """The same and one flow more."""
        bent = smooth.bend * self.stretch**2 + slope * self.bend
        third = 3 * smooth.bend * self.stretch * self.bend + smooth.third * self.stretch**3 + slope * self.third
        third = min(third, 2 * bent / every)
        return _Later(self.flows + 1, self.stretch * (1 + slope), self.bend + bent, self.third + third)


class _Cubics(NamedTuple):
    """Of cubics between nodes, for the pixels of a cell and the four nodes around, (every, 4)."""

    weight: np.ndarray  # |w_j|
    u: np.ndarray  # |u_j|
    q: np.ndarray
    amplified: float  # sum |w_j|, at the worst of the pixels

    def across(self, smooth: Smoothness, later: _Later, every: int) -> float:
        """Sum |w_j r_j|, at the worst of the pixels."""
        along, off = later.stretch * every * self.u, later.bend * every**2 * self.q
        rough = smooth.bend * (along + off) * off
        if math.isfinite(smooth.third):
            curved = later.stretch * later.third * every**4 / 6 * self.u**4 + off**2 / 2
            rough = np.minimum(rough, smooth.bend * curved + smooth.third / 2 * (along + off) ** 2 * off)
        return float((self.weight * rough).sum(axis=1).max())


@lru_cache(maxsize=16)
def _cubics(every: int) -> _Cubics:
    weight = np.abs(lagrange_weights(every, 4, dtype=torch.float64, device=torch.device("cpu")).numpy())
    t = np.arange(every)[:, None] / every
    u = np.arange(-1, 3) - t
    # The second derivative (1 - t) a + t b, summed up twice from x to a node.
    q = np.abs((1 - t) * u**2 / 2 - u**3 / 6) + np.abs(t * u**2 / 2 + u**3 / 6)
    return _Cubics(weight, np.abs(u), q, float(weight.sum(axis=1).max()))

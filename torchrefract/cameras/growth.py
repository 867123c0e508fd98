"""How far from its center a lens model is one-to-one: up to the first root of its growth.

The growth of a radial model is the derivative of the radius after distortion with respect to the radius before it, but
for a factor that is positive. For every model it is a polynomial in q, 1 + a_1 q + ... + a_n q^n.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def growth_of_powers(k: Sequence[Any]) -> list[Any]:
    """a_1 ... a_n of r (1 + sum k_i r^2i), q = r^2: d/dr is 1 + sum (2 i + 1) k_i q^i."""
    return [(2 * i + 1) * value for i, value in enumerate(k, start=1)]


def growth_of_ratio(above: Sequence[Any], below: Sequence[Any]) -> list[Any]:
    """a_1 ... a_n of r N / D, q = r^2, N = 1 + sum n_i q^i and D = 1 + sum d_i q^i alike: N D + 2 q (N' D - N D').

    The power q^(i + j) has n_i d_j (1 + 2 (i - j)).
    """
    above, below = (1.0, *above), (1.0, *below)
    powers: list[Any] = [0.0] * (len(above) + len(below) - 1)
    for i, n in enumerate(above):
        for j, d in enumerate(below):
            powers[i + j] = powers[i + j] + (1 + 2 * (i - j)) * n * d
    return powers[1:]


def first_root(a: Tensor) -> Tensor:
    """The smallest positive root of 1 + a_1 q + ... + a_n q^n, inf where there is none.

    With z = 1 / q it is the largest positive root of z^n + a_1 z^(n - 1) + ... + a_n, an eigenvalue of a companion
    matrix. A root where the polynomial only touches zero counts.

    Args:
        a: (B, n), float64.

    Returns:
        (B,), float64, without gradient.
    """
    with torch.no_grad():
        count, n = a.shape
        companion = torch.diag_embed(a.new_ones(count, n - 1), offset=-1)
        companion[:, 0] = -a
        z = torch.linalg.eigvals(companion)
        real = (z.imag.abs() <= 1e-7 * z.abs()) & (z.real > 1e-30)
        largest = torch.where(real, z.real, 0.0).amax(dim=1)
        return 1 / largest


def falls_before(a: Sequence[float], most: float) -> bool:
    """Whether 1 + a_1 q + ... is zero or below at one of 16 places up to q = most; of plain numbers, for compilers."""
    places = (most * i / 16 for i in range(1, 17))
    return any(1 + sum(value * q**i for i, value in enumerate(a, start=1)) <= 0 for q in places)

"""How well eigenvalues of a covariance are interpolated over its length."""

import math

import numpy as np

from torchrefract.fields.covariance import REACH
from torchrefract.types import Range

# nu - 1/2 of each covariance: the degree of the polynomial before its exponential.
_DEGREE = {"exponential": 0, "matern32": 1, "matern52": 2}
_MOST_NODES = 32
# Ellipses that are tried, and parts of a quarter of one on which its bound is taken to be constant.
_ELLIPSES, _PARTS = 64, 64


def nodes_needed(
    size: tuple[int, int], lengths: Range, *, kind: str, aperture: float = 0.0, share: float = 1e-10
) -> int | None:
    """How many lengths to interpolate between, for errors of so little of the variance; None for more than 32.

    The error of the field is a field itself. Where eigenvalues are off by d or less, amplitudes are by sqrt(d) or less,
    since |sqrt(x) - sqrt(y)|^2 <= |x - y|, and with the aperture's factors s_k = exp(-(k a)^2 / 2) its variance is

        sum_k (error_k s_k)^2 <= d sum_k s_k^2 <= d variance / G,  G the `mean_eigenvalue`

    of the frequencies of the torus, or of those that have all of the variance but for a small share.

    Args:
        size: (Ht, Wt), px, of the torus.
        lengths: (low, high), px.
        kind: one of COVARIANCES but the Gaussian one.
        aperture: px, the narrowest.
        share: of the variance; below 1e-13 rounding is more.
    """
    low, high = lengths
    # With lengths that have no room for sums round the torus, and others that have, eigenvalues jump.
    if kind != "exponential" and low < high and REACH[kind] * low <= min(size) < REACH[kind] * high:
        return None
    wanted = share * mean_eigenvalue(low, aperture, kind=kind)
    counts = range(1, _MOST_NODES + 1)
    return next((count for count in counts if eigenvalue_error(lengths, count, kind=kind) <= wanted), None)


def mean_eigenvalue(length: float, aperture: float, *, kind: str) -> float:
    """What the mean of the eigenvalues, weighted by exp(-(k a)^2) for an aperture a, is at least.

        max(1, 4 pi b^2 C(2 b)),  b = min(a, l),  and 1 for an aperture below 1 px

    But for shares of exp(-(pi a)^2) the mean is the sum over all points of C(h) exp(-h^2 / (4 a^2)), which grows with l
    and a. By the point h = 0 it is 1 or more. As C is convex in h^2, the mean of which is 4 b^2 or less, while the sum
    of the weights is 4 pi b^2 or more, Jensen's inequality says the rest.

    Args:
        length: px, the shortest.
        aperture: px, the narrowest.
        kind: as for `nodes_needed`.
    """
    if aperture < 1:
        return 1.0
    wide = min(aperture, length)
    return max(1.0, 4 * math.pi * wide * wide * _covariance(2 * wide / length, kind))


def eigenvalue_error(lengths: Range, nodes: int, *, kind: str) -> float:
    """How far eigenvalues are off at most, interpolated between Chebyshev points of ln(length).

    An eigenvalue is a sum of C(h / l) cos(k . p) over points p of the plane, of distances h. With u = ln(l) = v + i w,

        exp(-a),  a = c h exp(-u),  is analytic, of modulus exp(-a'),  a' = c h / L,  L = exp(v) / cos(w),  |w| < pi / 2

    and the polynomials before it have |a| = a' / cos(w) in them, so that with q = nu - 1/2 their degree

        |C| <= C(h / L) / cos(w)^q,   |eigenvalue| <= (1 + 5 L + 2 pi L^2) / cos(w)^q

    the sum over all points: one at 0, on four half axes at most 4 integral of C dh <= 5 L, and between them at most
    2 pi integral of C h dh = 2 pi L^2, as C falls. On the ellipse round [ln low, ln high], whose half width is r,

        v = ln(low high) / 2 + r cosh(t) cos(s),   w = r sinh(t) sin(s)

    it is M or less, and polynomials through n points are off by at most 4 M exp(-t (n - 1)) / (exp(t) - 1). The least
    of these bounds over t is returned.

    Args:
        lengths: (low, high), px.
        nodes: n.
        kind: as for `nodes_needed`.

    Source: Trefethen, "Approximation theory and approximation practice" (2013), theorem 8.2.
    """
    low, high = lengths
    half = math.log(high / low) / 2
    if half == 0:
        return 0.0
    widest = math.pi / 2 * (np.arange(_ELLIPSES) + 0.5)[:, None] / _ELLIPSES  # r sinh(t)
    t = np.arcsinh(widest / half)
    turn = math.pi / 2 * np.arange(_PARTS + 1) / _PARTS
    # On each part of the ellipse the largest v and the largest w.
    cosine = np.cos(widest * np.sin(turn[1:]))
    length = math.sqrt(low * high) * np.exp(half * np.cosh(t) * np.cos(turn[:-1])) / cosine
    most = ((1 + 5 * length + 2 * math.pi * length**2) / cosine ** _DEGREE[kind]).max(axis=1, keepdims=True)
    return float((4 * most * np.exp(-t * (nodes - 1)) / np.expm1(t)).min())


def _covariance(h: float, kind: str) -> float:
    """C of `covariance` for a length of 1."""
    a = math.sqrt(2 * _DEGREE[kind] + 1) * h
    return (1, 1 + a, 1 + a + a * a / 3)[_DEGREE[kind]] * math.exp(-a)

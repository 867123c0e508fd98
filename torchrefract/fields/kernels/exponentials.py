"""What numba compiles: exponentials and powers in float32, by steps that go into lanes as the C library's do not."""

import numpy as np

from torchrefract._jit import fma, horner, inlined
from torchrefract.fields.kernels.nodes import Number

_LOG2_E, _LN2 = np.float32(1.4426950408889634), np.float32(0.6931471805599453)
_PARTS_OF_LN2 = np.float32(0.693359375), np.float32(-2.12194440e-4)  # the first has few digits
# Of (exp(r) - 1 - r) / r^2, for |r| <= ln(2) / 2, to 2e-8 of r.
_REST = tuple(np.float32(1 / n) for n in (5040, 720, 120, 24, 6, 2))
_LEAST, _MOST = np.float32(-80), np.float32(89)
_HALF, _ONE, _TWO = np.float32(0.5), np.float32(1), np.float32(2)
# Of (artanh(s) / s - 1) / s^2, in s^2, for |s| <= 0.172, to 1e-9.
_ARTANH = tuple(np.float32(1 / n) for n in (11, 9, 7, 5, 3))
_ROOT_BITS = int(np.float32(0.5**0.5).view(np.int32))  # whose exponents count as that of 1


@inlined
def less_one(x: Number) -> Number:
    """exp(x) - 1."""
    x = _LEAST if x < _LEAST else x
    x = _MOST if x > _MOST else x
    n, found = _reduced(x)
    # Half of 2^n: the number itself may be too large, where the result is not.
    half = _power_of_two(n - _ONE)
    return fma(half, found, half - _HALF) * _TWO


@inlined
def exponential(x: Number) -> Number:
    """exp(x), of x in [-87, 88]."""
    n, found = _reduced(x)
    whole = _power_of_two(n)
    return fma(whole, found, whole)


@inlined
def power(x: Number, exponent: Number) -> Number:
    """x^exponent, of a normal number above 0, where the result is one, too."""
    bits = np.float32(x).view(np.int32)
    n = (bits - np.int32(_ROOT_BITS)) >> np.int32(23)  # m is in [sqrt(1/2), sqrt(2))
    m = np.int32(bits - (n << np.int32(23))).view(np.float32)
    s = (m - _ONE) / (m + _ONE)
    logarithm = _TWO * fma(s * s * s, horner(s * s, _ARTANH), s)
    return exponential(exponent * fma(np.float32(n), _LN2, logarithm))


@inlined
def _reduced(x: Number) -> tuple[Number, Number]:
    """The whole n, and exp(r) - 1, of exp(x) = 2^n exp(r)."""
    n = np.floor(fma(x, _LOG2_E, _HALF))
    r = fma(n, -_PARTS_OF_LN2[1], fma(n, -_PARTS_OF_LN2[0], x))
    return n, fma(r * r, horner(r, _REST), r)


@inlined
def _power_of_two(n: Number) -> Number:
    return np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)

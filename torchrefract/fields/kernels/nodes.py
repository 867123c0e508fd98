"""What numba compiles: the unit gradients at a row of nodes of Perlin's lattice; `octave` has the equations."""

import math

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import horner, jit
from torchrefract.noise_kernel import hashed_word

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Words = NDArray[np.uint32]
Constants = tuple[int, int, int]  # of the hash of white noise
Key = tuple[Words, float, Constants]  # its words, (4,); t / (pi decorrelation)
Number = np.float32
_HALF, _QUARTER = np.float32(0.5), np.float32(0.25)
_STEP = np.float32(2.0**-23)
# Of sin(2 pi r) / r and of cos(2 pi r), in r^2, for |r| <= 1/8: the best of their degree, to 2e-8 and 3e-8.
_SINE = tuple(map(np.float32, (-75.40206792, 81.59255355, -41.34166263, 6.28318529)))
_COSINE = tuple(map(np.float32, (-83.66591918, 64.92322861, -19.73916726, 1)))
# Of erfinv(x) / x, in w - 3.125 for w = -ln(1 - x^2) < 6.25, and in sqrt(w) - 3.25 beyond, up to w = 16.
_NEAR = (
    -3.6444120640178196996e-21, -1.685059138182016589e-19, 1.2858480715256400167e-18, 1.115787767802518096e-17,
    -1.333171662854620906e-16, 2.0972767875968561637e-17, 6.6376381343583238325e-15, -4.0545662729752068639e-14,
    -8.1519341976054721522e-14, 2.6335093153082322977e-12, -1.2975133253453532498e-11, -5.4154120542946279317e-11,
    1.051212273321532285e-09, -4.1126339803469836976e-09, -2.9070369957882005086e-08, 4.2347877827932403518e-07,
    -1.3654692000834678645e-06, -1.3882523362786468719e-05, 0.0001867342080340571352, -0.00074070253416626697512,
    -0.0060336708714301490533, 0.24015818242558961693, 1.6536545626831027356,
)  # fmt: skip
_FAR = (
    2.2137376921775787049e-09, 9.0756561938885390979e-08, -2.7517406297064545428e-07, 1.8239629214389227755e-08,
    1.5027403968909827627e-06, -4.013867526981545969e-06, 2.9234449089955446044e-06, 1.2475304481671778723e-05,
    -4.7318229009055733981e-05, 6.8284851459573175448e-05, 2.4031110387097893999e-05, -0.0003550375203628474796,
    0.00095328937973738049703, -0.0016882755560235047313, 0.0024914420961078508066, -0.0037512085075692412107,
    0.005370914553590063617, 1.0052589676941592334, 3.0838856104922207635,
)  # fmt: skip
_LN2 = math.log(2)
_SERIES = tuple(1 / (2 * n + 1) for n in range(10, -1, -1))  # of artanh(s) / s, in s^2
_ROOT_BITS = int(np.float64(math.sqrt(0.5)).view(np.int64))  # whose exponents count as that of 1


@jit
def gradients(columns: Words, row: np.uint32, key: Key, x: Floats, y: Floats) -> None:
    """(cos a, sin a), x and y (n,), of nodes in a row of the endless lattice, with hashes of their columns, (n,)."""
    words, elapsed, constants = key
    a, b, c, d = words[0], words[1], words[2], words[3]
    along = np.uint32(row * np.uint32(constants[0]))
    if elapsed == 0:
        for k in range(columns.size):
            node = hashed_word(np.uint32(columns[k] + along), c, d, constants)
            x[k], y[k] = direction(uniform(hashed_word(node, a, b, constants)))
        return
    for k in range(columns.size):
        node = hashed_word(np.uint32(columns[k] + along), c, d, constants)
        other = hashed_word(np.uint32(node + np.uint32(constants[0])), a, b, constants)
        turns = elapsed * inverse_error(2 * np.float64(uniform(other)) - 1)
        # Whole turns are dropped before the type gets narrow: after a long time they are many.
        turns = turns - np.trunc(turns) + np.float64(uniform(hashed_word(node, a, b, constants)))
        x[k], y[k] = direction(np.float32(turns - np.floor(turns + 0.5)))


@jit
def hashed_columns(number: np.uint32, first: int, place: float, step: float, key: Key, out: Words) -> None:
    """Hashes of the numbers of an octave and of its columns of nodes, out (n,).

    first, place, step: as for `drifts`.
    """
    words, _, constants = key
    a, b, c, d = words[0], words[1], words[2], words[3]
    octave = hashed_word(np.uint32(number * np.uint32(constants[0])), c, d, constants)
    for k in range(out.size):
        # Pixels two cells apart or more take two nodes each.
        column = first + k if step < 2 else first + int(np.floor(place + step * (k // 2))) + k % 2
        word = np.uint32(np.uint32(column) * np.uint32(constants[0]))
        out[k] = hashed_word(np.uint32(octave + word), a, b, constants)


@jit
def inverse_error(x: float) -> float:
    """erfinv(x), for |x| <= 1 - 2^-23, to float64's precision.

    Source: Giles, "Approximating the erfinv function", GPU Computing Gems, Jade edition (2011).
    """
    w = -logarithm((1 - x) * (1 + x))
    # Both are made and one is taken: so that several numbers are made at once.
    near, far = horner(w - 3.125, _NEAR), horner(np.sqrt(w) - 3.25, _FAR)
    return (near if w < 6.25 else far) * x


@jit
def logarithm(x: float) -> float:
    """ln x, of a normal number above 0: not by the C library, which takes one number at a time."""
    bits = np.float64(x).view(np.int64)
    exponent = (bits - _ROOT_BITS) >> 52  # m is in [sqrt(1/2), sqrt(2))
    m = np.int64(bits - (exponent << 52)).view(np.float64)
    s = (m - 1) / (m + 1)
    return exponent * _LN2 + 2 * s * horner(s * s, _SERIES)


@jit
def uniform(word: np.uint32) -> Number:
    return (np.float32(np.int32(word >> np.uint32(9))) + _HALF) * _STEP


@jit
def direction(turns: Number) -> tuple[Number, Number]:
    """Cosine and sine of 2 pi turns, of 1 at most, to 1e-7."""
    quarter = np.int32(np.floor(turns * np.float32(4) + _HALF))
    r = turns - np.float32(quarter) * _QUARTER  # exact
    z = r * r
    sine, cosine = r * horner(z, _SINE), horner(z, _COSINE)
    across = (quarter & np.int32(1)) != 0
    x, y = (sine, cosine) if across else (cosine, sine)
    # Negative are cosines in the second and third quarter, sines in the third and fourth.
    x = -x if ((quarter + np.int32(1)) & np.int32(2)) != 0 else x
    return x, -y if (quarter & np.int32(2)) != 0 else y

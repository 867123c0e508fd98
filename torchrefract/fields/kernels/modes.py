"""What numba compiles: the noise of few frequencies, times its amplitude, opposite frequencies added."""

import math

import numpy as np
from numpy.typing import NDArray

from torchrefract._jit import inlined, jit

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@jit
def amplitudes(
    length: Floats,
    aperture: Floats,
    has_aperture: bool,
    sides: Doubles,
    exponent: Doubles,
    down: Floats,
    across: Floats,
) -> None:
    """As `mode_amplitude` of `fields.modes`: down, (B, My), and across, (B, Mx).

    sides: (2,), px; exponent, (My + Mx,): what the square of a length counts times, of each frequency.
    """
    for i in range(length.size):
        square = np.float64(length[i]) * np.float64(length[i])
        if has_aperture:
            square += 2 * (np.float64(aperture[i]) * np.float64(aperture[i]))
        for axis in range(2):
            own, first = (down[i], 0) if axis == 0 else (across[i], down.shape[1])
            n = sides[axis]
            largest = math.sqrt(2 * math.pi) / n * math.sqrt(square) / (1 + 2 * math.exp(-0.5 * n * n / square))
            for k in range(own.size):
                own[k] = np.float32(math.sqrt(largest) * math.exp(exponent[first + k] * square))


@jit
def folded(noise: Floats, down: Floats, across: Floats, out: Floats) -> None:
    """The noise times its amplitude, with opposite frequencies along both axes added up as by `fields.modes`.

    noise: (B, 2, My, Mx); down, (B, My), and across, (B, Mx): its amplitude.
    out: (B, 2, My, Mx), of both fields, or (B, 1, My, Mx), of the first alone.
    """
    batch, _, count, wide = noise.shape
    middle = count // 2
    real, imaginary = np.empty(wide, np.float32), np.empty(wide, np.float32)
    for i in range(batch):
        for row in range(count):
            apart = row if row <= middle else row - middle
            above, below = middle - apart, middle + apart
            first, last = noise[i, :, above], noise[i, :, below]
            at_first, at_last = down[i, above], down[i, below]
            if row <= middle:
                for k in range(wide):
                    one, two = at_first * across[i, k], at_last * across[i, k]
                    real[k] = last[0, k] * two + first[0, k] * one
                    imaginary[k] = last[1, k] * two + first[1, k] * one
            else:
                for k in range(wide):
                    one, two = at_first * across[i, k], at_last * across[i, k]
                    real[k] = last[1, k] * two - first[1, k] * one
                    imaginary[k] = -(last[0, k] * two - first[0, k] * one)
            _fold(real, imaginary, out[i, :, row])


@inlined
def _fold(real: Floats, imaginary: Floats, out: Floats) -> None:
    """A line of both fields, or of the first alone, along its own axis."""
    middle = real.size // 2
    for k in range(middle + 1):
        out[0, k] = real[middle + k] + real[middle - k]
    for k in range(1, middle + 1):
        out[0, middle + k] = imaginary[middle + k] - imaginary[middle - k]
    if out.shape[0] > 1:
        for k in range(middle + 1):
            out[1, k] = imaginary[middle + k] + imaginary[middle - k]
        for k in range(1, middle + 1):
            out[1, middle + k] = -(real[middle + k] - real[middle - k])

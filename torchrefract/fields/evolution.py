"""How a random field on a torus drifts and changes over the frames of a clip."""

import math

import torch
from torch import Tensor

from torchrefract import random


def turn_rates(key: Tensor, size: tuple[int, int], *, dtype: torch.dtype) -> Tensor:
    """(B, Ht, Wt), standard normal: how fast the phase of each frequency of a torus turns, in 1 / decorrelation.

    Args:
        key: (B, 4), int64, of the noise that the phases belong to.
        size: (Ht, Wt), even.
        dtype: of the result.
    """
    # The words of the key in another order are another key.
    return random.white_noise(key.flip(1), size[0] * size[1] // 2).view(-1, *size).to(dtype)


def evolved(noise: Tensor, rates: Tensor, *, frame: Tensor, wind: Tensor, decorrelation: Tensor) -> Tensor:
    """The noise of a torus at a later frame, every frequency (kx, ky) turned by its own angle.

        n_t = n exp(i phase),  phase = sqrt(2) rate t / decorrelation + 2 pi (kx wind_x / Wt + ky wind_y / Ht) t

    Its field drifts by the wind, and is correlated with that of frame 0, moved along, by exp(-(t / decorrelation)^2):
    the rates are normal. Each amplitude stays what it is, so nothing pulses, and any frame is computed without the
    ones before it.

    Args:
        noise: (B, 2, Ht, Wt), real and imaginary part.
        rates: (B, Ht, Wt), of `turn_rates`.
        frame: (B,), t.
        wind: (B, 2), px per frame, to the right and down.
        decorrelation: (B,), frames, above 0; inf for a field that only drifts.
    """
    ky, kx = (torch.fft.fftfreq(n, dtype=torch.float64, device=noise.device) for n in noise.shape[2:])
    return turned(noise, rates, ky, kx, frame=frame, wind=wind, decorrelation=decorrelation)


def turned(
    noise: Tensor, rates: Tensor, ky: Tensor, kx: Tensor, *, frame: Tensor, wind: Tensor, decorrelation: Tensor
) -> Tensor:
    """The noise (B, 2, n, m) of frequencies ky, (n,), and kx, (m,), in cycles per px, as `evolved` has it."""
    shift = 2 * math.pi * (frame.double()[:, None] * wind.double())[:, :, None]
    drift_x, drift_y = shift[:, :1] * kx, shift[:, 1:].mT * ky[:, None]
    # Whole turns are taken out in float64: later frames are as exact as the first.
    drift = drift_x.remainder(2 * math.pi).to(noise.dtype) + drift_y.remainder(2 * math.pi).to(noise.dtype)
    phase = (math.sqrt(2) * frame / decorrelation)[:, None, None] * rates + drift
    cos, sin = phase.cos(), phase.sin()
    real, imaginary = noise.unbind(1)
    return torch.stack([real * cos - imaginary * sin, real * sin + imaginary * cos], dim=1)

"""The mirage over a hot road: a mirror below the horizon.

Air over a hot road is thinner, by dn = 2.67e-4 dT / T. Rays that meet it at less than theta_c = sqrt(2 dn) are totally
reflected, so a camera sees what stands at the horizon mirrored in the road beyond the distance h / theta_c.
"""

import math

import torch
from torch import Tensor

REFRACTIVITY = 2.67e-4  # n - 1 of air, times T / dT for a difference of temperature
AIR_TEMPERATURE = 300.0  # K, T
_EDGE_PX = 0.15  # scale of the logistic edge: nine tenths of the change lie within 0.9 px


def critical_angle(difference: Tensor) -> Tensor:
    """Return the largest angle between a ray and the road at which it is reflected, rad.

        theta_c = sqrt(2 dn),  dn = 2.67e-4 dT / T,  T = 300 K

    Args:
        difference: K, dT of any shape, by which the air at the road is hotter than the air at the camera.

    Source: Young, "Sunset science IV: low-altitude refraction", Astronomical Journal 127 (2004); Snell's law.
    """
    square = 2 * REFRACTIVITY / AIR_TEMPERATURE * difference
    return torch.where(square > 0, square, 1).sqrt() * (square > 0)


def shimmering_difference(
    difference: Tensor, shimmer: Tensor, *, wave: Tensor, rate: Tensor, phase: Tensor, place: Tensor, time: Tensor
) -> Tensor:
    """Return dT along the edge of the mirage, K.

        dT(x, t) = dT (1 + shimmer sqrt(2 / K) sum_k sin(2 pi (wave_k x + rate_k t) + phase_k))_+

    Args:
        difference: (N,), K, mean.
        shimmer: (N,), standard deviation relative to the mean.
        wave: (N, K), cycles per width of the frame.
        rate: (N, K), Hz.
        phase: (N, K), rad.
        place: x, widths, broadcasts to (N, 1, h, w).
        time: (N,), s, float64.

    Returns:
        (N, 1, h, w).
    """
    # Late frames have many cycles, of which float32 would lose the digits.
    cycles = rate.double() * time[:, None]
    start = phase + 2 * math.pi * (cycles - cycles.detach().floor()).to(phase.dtype)
    total = torch.zeros((), dtype=place.dtype, device=place.device)
    for k in range(wave.shape[1]):
        total = total + (2 * math.pi * wave[:, k].view(-1, 1, 1, 1) * place + start[:, k].view(-1, 1, 1, 1)).sin()
    relative = 1 + shimmer.view(-1, 1, 1, 1) * math.sqrt(2 / wave.shape[1]) * total
    return difference.view(-1, 1, 1, 1) * relative.clamp(min=0)


def road_mirage_flow(angle: Tensor, below: Tensor, is_road: Tensor, *, focal: float) -> Tensor:
    """Compute the vertical flow of a mirage, px.

        v = -2 n s((f theta_c - n) / 0.15 px) for n = y - y_h > 0 on the road, 0 elsewhere;  s(u) = 1 / (1 + exp(-u))

    The row that is seen is 2 y_h - y, as far from the horizon y_h on the other side. The edge lies at n = f theta_c.

    Args:
        angle: theta_c, rad.
        below: n, px, below the horizon.
        is_road: bool. All three broadcast to (N, 1, h, w).
        focal: f, px.

    Returns:
        (N, 1, h, w).
    """
    share = torch.sigmoid((focal * angle - below) / _EDGE_PX)
    return torch.where(is_road & (below > 0), -2 * below.clamp(min=0) * share, 0.0)

"""Divergence-free flows: the curl of a random stream function."""

import math

import torch
from torch import Tensor

from torchrefract.fields.random_field import FieldParams, Frequencies, node_positions, sample_field
from torchrefract.fields.random_field import covariance as covariance_at
from torchrefract.warping.flow import compose_flows
from torchrefract.warping.lattice import Lattice


def divergence_free_flow(
    params: FieldParams,
    amplitude: Tensor,
    *,
    covariance: str,
    frequencies: Frequencies,
    lattice: Lattice,
    normalize: str = "theory",
    steps: int = 1,
) -> tuple[Tensor, Tensor]:
    """Compute a divergence-free flow at the nodes of a lattice.

        flow = amplitude (D_y psi, -D_x psi) / scale,  D the central difference between neighboring pixels

    Args:
        params: of N stream functions psi.
        amplitude: (N,), px.
        covariance: of psi, one of COVARIANCES.
        frequencies: of the domain, whose pixel (1, 1) is pixel (0, 0) of the frame; all of them, or the lowest ones.
        lattice: where the flow is computed.
        normalize: "theory" divides by the standard deviation of a component over all draws, "max" by the longest
            displacement in the frame, "none" by 1; "max" needs a lattice of stride 1.
        steps: number of equal parts that the displacement is followed in; more than one need a lattice of stride 1.

    Returns:
        flow: (N, 2, h, w), px.
        clipped: (N,), share of the spectrum that is negative and was set to 0.

    Source: Bridson, Houriham, Nordenstam, "Curl-noise for procedural fluid flow", ACM Transactions on Graphics 26
    (2007).
    """
    rows, columns = node_positions(lattice)
    dtype = amplitude.dtype
    if lattice.stride == 1:
        rows, columns = (range(span.start, span.stop + 2) for span in (rows, columns))
        # Neighbors differ by about 1 / length of psi, whose rounding would count as often.
        psi, clipped = sample_field(params, frequencies, rows, columns, kind=covariance, dtype=torch.float64)
        flow, clipped = curl(psi[:, :1]).to(dtype), clipped.to(dtype)
    else:
        flow, clipped = sample_field(
            params, frequencies, rows, columns, kind=covariance, dtype=dtype, transform=_curl_of_waves
        )
    if normalize == "theory":
        flow = flow / curl_rms(params.length, covariance)[:, None, None, None]
    elif normalize == "max":
        first = lattice.margin
        frame = flow[:, :, first : first + lattice.height, first : first + lattice.width]
        longest = frame.square().sum(dim=1, keepdim=True).amax(dim=(2, 3), keepdim=True)
        flow = flow / longest.clamp(min=1e-24).sqrt()
    flow = part = amplitude[:, None, None, None] / steps * flow
    for _ in range(steps - 1):
        flow = compose_flows(flow, part)
    return flow, clipped


def curl(psi: Tensor) -> Tensor:
    """Compute u = D_y psi, v = -D_x psi, whose divergence D_x u + D_y v is zero up to rounding.

    D is the central difference (psi(+1) - psi(-1)) / 2 along one axis, so the two derivatives commute exactly. The
    divergence taken with another stencil does not vanish.

    Args:
        psi: (N, 1, H + 2, W + 2), px^2, with one row and one column more on each side of the frame.

    Returns:
        (N, 2, H, W), px.
    """
    u = (psi[:, :, 2:, 1:-1] - psi[:, :, :-2, 1:-1]) / 2
    v = (psi[:, :, 1:-1, :-2] - psi[:, :, 1:-1, 2:]) / 2
    return torch.cat([u, v], dim=1)


def curl_rms(length: Tensor, kind: str) -> Tensor:
    """Compute (N,), 1/px: the root mean square of each component of `curl` over all fields psi of variance 1.

    sqrt((C(0) - C(2)) / 2),  the root of the variance of a central difference; C for lengths (N,), px
    """
    two = torch.full_like(length, 2.0, dtype=torch.float64)
    return ((1 - covariance_at(two, length.double(), kind)) / 2).sqrt().to(length.dtype)


def _curl_of_waves(values: Tensor, frequencies: Frequencies) -> Tensor:
    """Turn the coefficients z (N, 2, Ky, Kx) of psi, the real part of a sum of waves, into those of u + i v.

    The central difference multiplies a wave exp(-i k . p) by -i sin k, so u + i v has the coefficients

        (-i sin ky - sin kx) exp(-i (kx + ky)) (z_k + conj z_-k) / 2,  the second factor for pixel (1, 1) of the domain
    """
    ky, kx = (
        2 * math.pi / n * k.to(values.dtype)
        for k, n in zip(frequencies.numbers(values.device), frequencies.size, strict=True)
    )
    sin_y, sin_x, phase = ky.sin()[:, None], kx.sin(), ky[:, None] + kx
    real = -sin_x * phase.cos() - sin_y * phase.sin()
    imaginary = sin_x * phase.sin() - sin_y * phase.cos()
    opposite = values.flip(2, 3)  # from -rows to rows: the frequencies -k
    a, b = (values[:, 0] + opposite[:, 0]) / 2, (values[:, 1] - opposite[:, 1]) / 2
    return torch.stack([a * real - b * imaginary, a * imaginary + b * real], dim=1)

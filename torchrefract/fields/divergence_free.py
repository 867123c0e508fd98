"""Divergence-free flows: the curl of a stream function."""

import torch
from torch import Tensor

from torchrefract.fields.covariance import covariance


def curl(psi: Tensor) -> Tensor:
    """The flow u = D_y psi, v = -D_x psi, whose divergence D_x u + D_y v is zero to round-off.

    D is the central difference (psi(+1) - psi(-1)) / 2 along one axis and, on the way, the identity along the other, so
    the two derivatives commute exactly. Only a divergence taken with the same D vanishes.

    Args:
        psi: (B, 1, H + 2, W + 2), px^2, with a row and a column of its own around the frame.

    Returns:
        (B, 2, H, W), px.
    """
    u = (psi[:, :, 2:, 1:-1] - psi[:, :, :-2, 1:-1]) / 2
    v = (psi[:, :, 1:-1, :-2] - psi[:, :, 1:-1, 2:]) / 2
    return torch.cat([u, v], dim=1)


def curl_rms(length: Tensor, kind: str) -> Tensor:
    """(B,), 1/px: the root mean square of each component of `curl` over all fields psi of variance 1.

        sqrt((C(0) - C(2)) / 2),  the variance of a central difference

    Args:
        length: (B,), the correlation length of psi, px.
        kind: of its covariance.
    """
    two = torch.full_like(length, 2.0, dtype=torch.float64)
    return ((1 - covariance(two, length.double(), kind)) / 2).sqrt().to(length.dtype)

"""Covariances of stationary isotropic random fields."""

import math

import torch
from torch import Tensor

# Lengths after which less than 4e-4 is left of each covariance.
REACH = {"exponential": 8.0, "gaussian": 5.0, "matern32": 6.0, "matern52": 6.0}
COVARIANCES = tuple(REACH)
_SMOOTHNESS = {"exponential": 0.5, "matern32": 1.5, "matern52": 2.5}  # nu of the Matern covariances


def covariance(distance: Tensor, length: Tensor, kind: str) -> Tensor:
    """Compute C(h), with C(0) = 1, at distances h in px for a correlation length l in px; the two broadcast.

        exponential  exp(-h / l)                       gaussian  exp(-h^2 / (2 l^2))
        matern32     (1 + a) exp(-a), a = sqrt(3) h / l
        matern52     (1 + a + a^2 / 3) exp(-a), a = sqrt(5) h / l

    Source: Rasmussen and Williams, "Gaussian processes for machine learning" (2006), section 4.2.
    """
    h = distance / length
    if kind == "gaussian":
        return torch.exp(-0.5 * h * h)
    if kind == "exponential":
        return torch.exp(-h)
    if kind == "matern32":
        a = math.sqrt(3) * h
        return (1 + a) * torch.exp(-a)
    a = math.sqrt(5) * h
    return (1 + a + a * a / 3) * torch.exp(-a)


def gradient_rms(length: Tensor, *, kind: str, aperture: Tensor | None = None) -> Tensor:
    """Compute (N,), 1/px: the root mean square difference of neighboring pixels of a field of variance 1.

        sqrt(2 (1 - C(1) / C(0))),  C smoothed by the aperture a twice, for which it is a sum of Gaussians:
        C(h) = sum w s / (s + 2 a^2) exp(-h^2 / (2 (s + 2 a^2))),  w and s / l^2 from `gaussian_mixture`

    Args:
        length: (N,), px.
        kind: one of COVARIANCES.
        aperture: (N,), px.
    """
    weight, scale = gaussian_mixture(kind, length.device)
    variance = length.double()[:, None].square() * scale
    spread = variance if aperture is None else variance + 2 * aperture.double()[:, None].square()
    weight = weight * variance / spread
    return (-2 * (weight * torch.expm1(-0.5 / spread)).sum(dim=1) / weight.sum(dim=1)).sqrt()


def gaussian_mixture(kind: str, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return weights (n,) and squared lengths (n,) in l^2, float64, of the Gaussian covariances that sum to a kind.

        C(h) = sum w exp(-h^2 / (2 s l^2)),  s = t / nu,  w = t^nu exp(-t) over equal steps of ln t, normalized

    Source: Rasmussen and Williams, "Gaussian processes for machine learning" (2006), section 4.2.
    """
    t = torch.ones(1, dtype=torch.float64, device=device)
    if kind == "gaussian":
        return t, t
    t = torch.arange(-60.0, 5.0, 0.5, dtype=torch.float64, device=device).exp()
    weight = t ** _SMOOTHNESS[kind] * torch.exp(-t)
    return weight / weight.sum(), t / _SMOOTHNESS[kind]

"""The light of the sun in a camera: its disk, the glare that spreads from it, and ghosts."""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._validation import eager_values, requires_grad

SUN_RADIUS = 0.265  # degrees
_SUN_AREA = math.pi * SUN_RADIUS**2
_LOG2_E = 1 / math.log(2)
_SOFT_CORE = 1e-6  # added to squared distances in scales: the gradient at the center stays finite
_GHOST_EDGE = 0.3  # share of the squared radius over which a ghost fades


class Sun(NamedTuple):
    """The sun in a camera, for N frames."""

    center: Tensor  # (N, 2), px
    luminance: Tensor  # (N,), of the disk, white being 1
    scatter: Tensor  # (N,), share of the light that the camera scatters
    scale: Tensor  # (N,), degrees
    shape: Tensor  # (N,), power of the distance
    color: Tensor  # (N, C), relative
    ghosts: Tensor  # (N, K, 3): place on the line from the principal point (0) to the sun (1), radius in degrees, share
    tints: Tensor  # (N, K, C), of the ghosts, relative


def glare_tail(squared_distance: Tensor, scatter: Tensor, scale: Tensor, shape: Tensor) -> Tensor:
    """Return the light per square degree that a camera scatters from a point of light 1.

    The glare spread is g(r) = p1 delta(r) + p2 exp(-p3 r^p4) with p1 = 1 - scatter, p3 = scale^-shape and p4 = shape.
    Its integral over the plane is 1, which gives p2 = scatter shape / (2 pi scale^2 Gamma(2 / shape)). The result is
    the second term.

    Args:
        squared_distance: r^2, square degrees.
        scatter: share of the light that is scattered, in [0, 1].
        scale: degrees, above 0, at which the glare falls to 1/e.
        shape: above 0; below 1 the glare is steep near its source and flat far away.

    Source: the form that arXiv:2404.10992 fits to consumer and industrial cameras.
    """
    peak = scatter * shape / (2 * math.pi * scale.square()) * (-torch.lgamma(2 / shape)).exp()
    # exp(-(r / scale)^shape); exp2 takes half the time of exp.
    power = (squared_distance * scale**-2).add_(_SOFT_CORE).log2().mul(shape / 2).exp2_()
    return (power * -_LOG2_E).exp2_() * peak


def sun_light(
    sun: Sun, x: Tensor, y: Tensor, *, principal_point: tuple[float, float], px_per_degree: float
) -> Callable[[slice], Tensor]:
    """Return a function that computes the light of disk, glare and ghosts at some of the rows of pixels.

    The disk has a radius of 0.265 degrees, an edge of one pixel and the light (1 - scatter) luminance. Its glare is
    that of a point of the same light. A ghost is a disk with a share of the light of the sun.

    Args:
        sun: of N frames.
        x: (W,), px, columns of the pixels.
        y: (H,), px, their rows.
        principal_point: px.
        px_per_degree: focal length times pi / 180; distances are those in the image plane.

    Returns:
        A function from a slice of y to (N, C, h, W), linear light; white is 1.

    Source: Lee and Eisemann, "Practical real-time lens-flare rendering", Computer Graphics Forum 32 (2013): ghosts as
    images of the sun in first-order optics.
    """
    luminance, scatter, scale, shape = (
        value.view(-1, 1, 1, 1) for value in (sun.luminance, sun.scatter, sun.scale, sun.shape)
    )
    across, down = _squared_distances(sun.center, x, y, px_per_degree)
    glare, color = luminance * _SUN_AREA, sun.color[:, :, None, None]
    # Of each disk: along the axes, 1 - (distance / radius)^2 in units of its edge, and its light.
    edge = px_per_degree / (2 * SUN_RADIUS)
    disks = [((SUN_RADIUS**2 - across) * edge + 0.5, down * edge, luminance * (1 - scatter) * color)]
    middle = sun.center.new_tensor(principal_point)
    for ghost, tint in zip(sun.ghosts.unbind(1), sun.tints.unbind(1), strict=True):
        radius, share = ghost[:, 1].view(-1, 1, 1, 1), ghost[:, 2].view(-1, 1, 1, 1)
        along_x, along_y = _squared_distances(torch.lerp(middle, sun.center, ghost[:, :1]), x, y, px_per_degree)
        fading, area = radius.square() * _GHOST_EDGE, math.pi * radius.square() * (1 - _GHOST_EDGE / 2)
        strength = glare * share / area * tint[:, :, None, None]
        disks.append((1 / _GHOST_EDGE - along_x / fading, along_y / fading, strength))
    # (H,) for each disk, whether a row shows it in any frame; None if all are computed.
    shows = [partial(_any_row, along_x.detach(), along_y.detach()) for along_x, along_y, _ in disks]
    rows_seen = [None if requires_grad(sun) else eager_values(of_rows, of=across) for of_rows in shows]

    def light_at(rows: slice) -> Tensor:
        light = glare_tail(across + down[:, :, rows], scatter, scale, shape) * (glare * color)
        for (along_x, along_y, strength), seen in zip(disks, rows_seen, strict=True):
            if seen is None or any(seen[rows]):
                light = torch.addcmul(light, (along_x - along_y[:, :, rows]).clamp(0, 1), strength)
        return light

    return light_at


def _any_row(along_x: Tensor, along_y: Tensor) -> Tensor:
    return (along_x.amax(dim=3) > along_y[..., 0]).any(dim=0)[0]


def _squared_distances(center: Tensor, x: Tensor, y: Tensor, px_per_degree: float) -> tuple[Tensor, Tensor]:
    """Return the squared distances from a center (N, 2) in degrees, along x, (N, 1, 1, W), and y, (N, 1, H, 1)."""
    across = ((x - center[:, :1]) / px_per_degree).square()
    down = ((y - center[:, 1:]) / px_per_degree).square()
    return across[:, None, None], down[:, None, :, None]

"""Glow around lamps in fog: light that droplets scatter forward, so that it reaches the camera from beside the lamp."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import exact_matmul, interpolate_channels, rows_at_once, without_autocast
from torchrefract._validation import eager_values, requires_grad
from torchrefract.fields.exposure import finite_image
from torchrefract.fields.srgb import linear_to_srgb, srgb_to_linear

_NODES = 320  # of the lattice along the longer side, on which light is spread
_SMOOTHING = 0.6  # nodes, standard deviation; a lattice cannot hold the peak of the glow
_CACHED_VALUES = 1 << 17  # float32 values that fit into the cache of one core
_THINNEST = 1e-6  # optical depth; the shape of the glow of thinner fog is that of this one
_LAMP = 0.85  # stored value, from which a pixel may be a lamp
_SMALLEST = 1e-30


def lamp_light(image: Tensor, threshold: float) -> Tensor:
    """Return the light of lamps at the nodes of a lattice, relative to that of a pixel of 1.

        mean over a block of max(I - threshold, 0)^2 / (1 - threshold)^2, at most 1

    Args:
        image: (N, C, H, W), stored values, I; NaN and infinite ones count as black.
        threshold: in [0, 1), from which a value counts as that of a lamp.

    Returns:
        (N, C, h, w), at the centers of blocks of one side, so that the longer side of a frame has at most 320.
    """
    stride = lattice_stride(image)

    def of_rows(band: Tensor) -> Tensor:
        excess = (band - threshold).relu_().square()
        return F.avg_pool2d(excess, stride, ceil_mode=True, count_include_pad=False)

    if len(image) == 0:
        return image[:, :, ::stride, ::stride]
    if torch.compiler.is_compiling() or requires_grad((image,)):
        light = of_rows(finite_image(image))
    else:
        each, height = image.shape[0] * image.shape[1] * image.shape[3], image.shape[2]
        count = rows_at_once(image.device, height, each=each, cached=_CACHED_VALUES, shared=True)
        count = max(stride, count // stride * stride)
        light = torch.cat([of_rows(image[:, :, start : start + count]) for start in range(0, height, count)], dim=2)
        if eager_values(lambda: light.isfinite().all(), of=light) is False:
            light = of_rows(finite_image(image))
    return (light / (1 - threshold) ** 2).clamp(max=1.0)


def unclip_lamps(image: Tensor, luminance: float | Tensor) -> Tensor:
    """Return stored values of the light before the camera clipped lamps, which may be above 1.

        x (1 + (luminance - 1) w),  w = max(I - 0.85, 0)^2 / 0.15^2,  at most 1, of the brightest channel

    Args:
        image: (N, C, H, W), stored values, I, of the linear light x.
        luminance: of a lamp of stored value 1, at least 1; a number or (N, 1, 1, 1).
    """
    excess = ((image.amax(dim=1, keepdim=True) - _LAMP) / (1 - _LAMP)).clamp(0, 1).square()
    lit = linear_to_srgb(srgb_to_linear(image) * (1 + (luminance - 1) * excess))
    return torch.where(excess > 0, lit, image)


def lattice_stride(image: Tensor) -> int:
    """Return the side in px of the blocks of `lamp_light`."""
    return -(-max(image.shape[2:]) // _NODES)


def scattering_transfer(frequency: Tensor, asymmetry: Tensor) -> Tensor:
    """Return the Fourier transform of the angles by which one droplet turns the light that reaches the camera.

        (1 - exp(-a q)) / (a q),  a = (1 - g) / sqrt(g)

    A droplet turns the light by a small angle with the Henyey-Greenstein phase function, whose transform is exp(-a q).
    An angle at the share u of the way from the lamp is u times as large at the camera; this is the mean over the way.

    Args:
        frequency: q, radians per radian, at least 0.
        asymmetry: g, mean cosine of the angle of scattering, in (0, 1].
    """
    x = frequency * (1 - asymmetry) / asymmetry.sqrt()
    is_small = x < 1e-3
    safe = torch.where(is_small, 1.0, x)
    return torch.where(is_small, 1 - x / 2 + x * x / 6, -torch.expm1(-safe) / safe)


def glow_at_nodes(light: Tensor, optical_depth: Tensor, asymmetry: Tensor, *, focal: float, stride: int) -> Tensor:
    """Return the scattered part of the light of lamps, relative to its sum: both have the same sum.

        (exp(T s) - 1) / (exp(T) - 1),  s = scattering_transfer(q, g)

    is its Fourier transform: a Poisson number of droplets, T in the mean, stands on the way. All light arrives, exp(-T)
    of it unscattered, so that the whole has the transform exp(-T (1 - s)). Light that would leave the frame is
    reflected at its border.

    Args:
        light: (N, C, h, w), at least 0.
        optical_depth: (N,), T, extinction times distance of the lamps.
        asymmetry: (N,), g of `scattering_transfer`.
        focal: px, of the frame.
        stride: px, between nodes.

    Returns:
        (N, C, h, w), at least 0.

    Source: Wells, "Loss of resolution in water as a result of multiple small-angle scattering", Journal of the Optical
    Society of America 59 (1969), for the form; Narasimhan and Nayar, "Shedding light on the weather", CVPR 2003.
    """
    optical_depth, asymmetry = (value.view(-1, 1, 1, 1) for value in (optical_depth, asymmetry))
    (down, fy), (across, fx) = (_cosines(size, light) for size in light.shape[2:])
    squared = fy.square()[:, None] + fx.square()
    frequency = (squared + _SMALLEST).sqrt() * (2 * math.pi * focal / stride)
    thickness = optical_depth.clamp(min=_THINNEST)
    transfer = torch.expm1(thickness * scattering_transfer(frequency, asymmetry)) / torch.expm1(thickness)
    transfer = transfer * torch.exp(-2 * (math.pi * _SMOOTHING) ** 2 * squared)
    with without_autocast(light.device):
        spectrum = exact_matmul(exact_matmul(down, light), across.mT)
        glow = exact_matmul(exact_matmul(down.mT, spectrum * transfer), across)
    return glow.clamp(min=0).contiguous()


def spread_glow(
    glow: Tensor, light: Tensor, strength: Tensor, *, height: int, width: int, stride: int
) -> Callable[[slice], Tensor]:
    """Return a function that interpolates glow from nodes to rows of pixels.

    The sum over the frame becomes that of the light of the lamps times a strength.

    Args:
        glow, light: (N, C, h, w), see `glow_at_nodes`.
        strength: (N,), (1 - exp(-T)) times the luminance of lamps of light 1.
        height, width: px, of the frame.
        stride: px, between nodes.

    Returns:
        A function from a slice of rows to (N, C, n, W), linear light.
    """
    rows, columns = (_pixels_of_nodes(size, stride, light) for size in (height, width))
    scattered = strength[:, None] * (light * rows[:, None] * columns).sum(dim=(2, 3))
    rows, columns = (_weights_of_nodes(size, stride, light) for size in (height, width))
    total = (glow * rows[:, None] * columns).sum(dim=(2, 3)).clamp(min=_SMALLEST)
    glow = glow * (scattered / total)[:, :, None, None]
    # Along rows at once, and to the few nodes of a column that some rows need.
    count = glow.shape[2]
    lines = interpolate_channels(glow, (count, glow.shape[3] * stride))[..., :width]
    place = ((torch.arange(height, dtype=glow.dtype, device=glow.device) + 0.5) / stride - 0.5).clamp(0, count - 1)
    above = place.long().clamp(max=max(0, count - 2))
    share = (place - above)[:, None]

    def at_rows(rows: slice) -> Tensor:
        below = (above[rows] + 1).clamp(max=count - 1)
        return torch.lerp(lines.index_select(2, above[rows]), lines.index_select(2, below), share[rows])

    return at_rows


def _pixels_of_nodes(size: int, stride: int, like: Tensor) -> Tensor:
    """Return how many pixels of a side each block has; the last may be cut."""
    nodes = torch.arange(-(-size // stride), device=like.device)
    return (size - nodes * stride).clamp(max=stride).to(like.dtype)


def _weights_of_nodes(size: int, stride: int, like: Tensor) -> Tensor:
    """Return the sum of the weights that each node has in pixels along a side: the stride, less what is cut."""
    count = -(-size // stride)
    nodes, cut = (
        torch.arange(*ends, dtype=torch.float64, device=like.device) for ends in ((0, count), (size, count * stride))
    )
    place = ((cut + 0.5) / stride - 0.5).clamp(0, count - 1)
    return (stride - (1 - (place - nodes[:, None]).abs()).clamp(min=0).sum(dim=1)).to(like.dtype)


def _cosines(size: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the orthonormal matrix of the cosine transform, (size, size), and its frequencies, cycles per node."""
    node = torch.arange(size, dtype=torch.float64, device=like.device)
    scale = (2 - (node == 0).to(node.dtype)).div(size).sqrt()
    matrix = scale[:, None] * torch.cos(math.pi / size * node[:, None] * (node + 0.5))
    return matrix.to(like.dtype), (node / (2 * size)).to(like.dtype)

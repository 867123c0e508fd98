"""Sample images along flows: the choice of a backend, and the PyTorch reference.

A flow is dense, (N or 1, 2, H, W) in px, or at the nodes of a lattice, (N or 1, 2, h, w) in px, between which cubic
Lagrange polynomials interpolate.
"""

import importlib
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import (
    assume_constant_result,
    exact_matmul,
    has_memory_format,
    is_channels_last,
    round_to_dtype,
    without_autocast,
)
from torchrefract._validation import eager_values, requires_grad, why_not_eager

PADDINGS = ("zeros", "border", "reflection")
INTERPOLATIONS = ("nearest", "bilinear", "bicubic")
BACKENDS = ("auto", "torch", "numba", "triton")
# F.grid_sample spans [-1, 1] over the frame. Positions at these limits lie outside for any padding, and keep all
# products finite. Flows on lattices are bounded at their nodes, between which cubics may overshoot.
DENSE_LIMIT, LATTICE_LIMIT = 4.0, 1e4
_LARGEST_FLOAT32_SIDE = 8192  # px; above it, float32 positions are off by more than 1/1000 px
_SMALLEST_NUMBA_FRAME = 1 << 14  # pixels; below, a call of numba costs more than it saves
_SMALLEST_SPLIT = 1 << 14  # pixels; below, a second thread costs more than it saves
_MODULES = {"numba": "numba_cpu", "triton": "triton_gpu"}
_SUPPORTED = {
    "numba": "bilinear sampling in float32 on the CPU, in eager mode",
    "triton": "bilinear sampling in float32 on a GPU, along a flow on a lattice",
}


def sample(
    image: Tensor,
    nodes: Tensor,
    *,
    stride: int = 1,
    margin: int = 0,
    padding: str,
    interpolation: str,
    backend: str = "auto",
    active: Tensor | None = None,
) -> Tensor:
    """Sample an image at p + flow(p).

    Args:
        image: (N, C, H, W), of any real type. Integers are rounded and clamped, half types are sampled in float32.
        nodes: (N or 1, 2, h, w), px, the flow at the nodes of a lattice, with cubics between them; by default at the
            pixels. Node (i, j) lies at x = (j - margin) stride, y = (i - margin) stride. NaN and infinity count as a
            position outside.
        stride: px, between nodes.
        margin: nodes before the first pixel, at least 1, or 0 with stride 1.
        padding: "zeros", "border" or "reflection".
        interpolation: "nearest", "bilinear" or "bicubic", which is clamped to the range of the image's values.
        backend: "torch", "numba", "triton", or "auto" for the fastest one that supports the arguments. Where a
            gradient is needed, torch serves.
        active: (N,), bool, samples to warp; the others come back bit for bit. None for all.

    Returns:
        (N, C, H, W), of the type and the memory format of the image.

    Raises:
        ValueError: the backend does not support the arguments.
    """
    if image.numel() == 0:
        return image.clone()
    height, width = image.shape[2:]
    lattice = {"stride": stride, "margin": margin, "height": height, "width": width}
    if stride == 1:
        nodes, margin = interpolate_nodes(nodes, **lattice), 0
    dtype = sampling_dtype(image, nodes.dtype)
    nodes, limit = nodes.to(dtype), LATTICE_LIMIT if stride > 1 else DENSE_LIMIT
    fast = backend if backend in _MODULES else "triton" if image.is_cuda else "numba"
    choice = {"backend": backend, "interpolation": interpolation, "is_lattice": stride > 1}
    module = _chosen(fast, image, nodes, **choice)
    if module is not None:
        source = image if fast == "numba" and image.dtype is torch.uint8 else image.to(dtype)
        weights = None
        if stride > 1:
            weights = lagrange_weights(stride, dtype=dtype, device=nodes.device)
            nodes = _finite(nodes, limit * max(height, width))
        options = {"margin": margin, "padding": padding, "limit": limit, "active": active}
        return _like(module.sample_lattice(source, nodes, weights, **options), image)
    if stride == 1:
        grid = sampler_grid(nodes)
    else:
        # The positions of the pixels are linear, so the cubics keep them when they are added at the nodes.
        y, x = (stride * (torch.arange(n, dtype=dtype, device=nodes.device) - margin) for n in nodes.shape[2:])
        positions = _finite(_to_sampler(nodes, x, y[:, None], height=height, width=width), limit)
        grid = interpolate_nodes(positions, **lattice).movedim(1, -1)
    return _by_torch(image, grid, dtype, padding=padding, interpolation=interpolation, active=active)


def sampling_dtype(image: Tensor, dtype: torch.dtype) -> torch.dtype:
    """Return the type of positions for an image (N, C, H, W) and a flow of `dtype`: float32 or float64."""
    # A half type holds no coordinate, and the CPU sampler of half types is wrong above 2^15 pixels.
    needs_double = max(image.shape[2:]) > _LARGEST_FLOAT32_SIDE or image.dtype in (torch.int32, torch.int64)
    return torch.float64 if needs_double or torch.float64 in (image.dtype, dtype) else torch.float32


def sampler_grid(flow: Tensor) -> Tensor:
    """Return p + flow(p), (N, 2, H, W) in px, as (N, H, W, 2), finite, in the coordinates of F.grid_sample.

    x' = (2 x + 1) / W - 1 + 2 u / W,  y' likewise with v and H  (align_corners=False)
    """
    height, width = flow.shape[2:]
    y, x = (torch.arange(n, dtype=flow.dtype, device=flow.device) for n in (height, width))
    return _finite(_to_sampler(flow, x, y[:, None], height=height, width=width), DENSE_LIMIT).movedim(1, -1)


def grid_sample(source: Tensor, grid: Tensor, *, padding: str, interpolation: str) -> Tensor:
    """Sample a source (N, C, H, W) along a finite grid (N or 1, n, m, 2) by F.grid_sample, on all threads."""
    batch, (height, width) = source.shape[0], grid.shape[1:3]
    grid = grid.expand(batch, -1, -1, -1)
    options: dict[str, Any] = {"mode": interpolation, "padding_mode": padding, "align_corners": False}
    parts = _num_parts(source, height * width)
    if parts == 1:
        return F.grid_sample(source, grid, **options)
    # The CPU sampler threads over the batch alone, so bands of rows become a batch.
    rows = -(-height // parts)
    if rows * parts > height:
        grid = F.pad(grid, (0, 0, 0, 0, 0, rows * parts - height))
    repeated = source[:, None].expand(-1, parts, -1, -1, -1).reshape(batch * parts, *source.shape[1:])
    out = F.grid_sample(repeated, grid.reshape(batch * parts, rows, width, 2), **options)
    return out.unflatten(0, (batch, parts)).movedim(1, 2).flatten(2, 3)[:, :, :height]


def lagrange_weights(stride: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the weights of the four nodes around the pixels of a cell.

        w_j(t) = prod_(k != j) (t - k) / (j - k),  j, k = -1 ... 2,  t = 0, 1/stride, 2/stride ...

    Args:
        stride: px, between nodes.
        dtype, device: of the result.

    Returns:
        (stride, 4).
    """
    t = torch.arange(stride, dtype=torch.float64, device=device) / stride
    return torch.stack(lagrange_basis(t), dim=1).to(dtype)


def lagrange_basis(t: Any) -> list[Any]:
    """Evaluate each of the four weights of `lagrange_weights` at a number, an array or a tensor t, in its shape."""
    below, above, far = t + 1, t - 1, t - 2
    outer, inner = t * below, above * far
    return [t * inner / -6, below * inner / 2, outer * far / -2, outer * above / 6]


def interpolate_nodes(nodes: Tensor, *, stride: int, margin: int, height: int, width: int) -> Tensor:
    """Interpolate a lattice of nodes at every pixel, along rows and then along columns.

    Cubics, and so linear functions, are exact. Elsewhere, with the derivatives along each axis,

        |error| <= 9/384 stride^4 (max |f_xxxx| + 5/4 max |f_yyyy|)

    Args:
        nodes: (N, C, h, w), one every `stride` px.
        stride: px, between nodes.
        margin: nodes before the first pixel, at least 1, or 0 with stride 1.
        height, width: px, of the frame.

    Returns:
        (N, C, H, W).

    Source: the remainder of Lagrange's interpolation; de Boor, "A practical guide to splines" (1978), chapter 2.
    """
    if stride == 1:
        return nodes[..., margin : margin + height, margin : margin + width]
    rows, columns = -(-height // stride) + 3, -(-width // stride) + 3
    nodes = nodes[..., margin - 1 : margin - 1 + rows, margin - 1 : margin - 1 + columns]
    weights = lagrange_weights(stride, dtype=nodes.dtype, device=nodes.device)
    with without_autocast(nodes.device):  # half types would round positions to several px
        lines = exact_matmul(nodes.unfold(3, 4, 1), weights.mT).flatten(3)[..., :width]
        # One product a cell: with a matrix on the left, matmul would copy the lines to fold them into one matrix.
        return exact_matmul(weights[None], lines.unfold(2, 4, 1).mT).flatten(2, 3)[:, :, :height]


def _num_parts(source: Tensor, pixels: int) -> int:
    if source.device.type != "cpu" or torch.compiler.is_compiling() or pixels < _SMALLEST_SPLIT:
        return 1
    # The backward pass keeps one gradient image a band.
    return max(1, min(torch.get_num_threads() // len(source), 4 if source.requires_grad else pixels))


def _by_torch(
    image: Tensor, grid: Tensor, dtype: torch.dtype, *, padding: str, interpolation: str, active: Tensor | None
) -> Tensor:
    source = image.to(dtype)
    sampled = grid_sample(source, grid, padding=padding, interpolation=interpolation)
    if interpolation == "bicubic":
        sampled = _clamp_to_range(sampled, source, padding)
    sampled = _like(sampled, image)
    return sampled if active is None else torch.where(active.view(-1, 1, 1, 1), sampled, image)


def _to_sampler(flow: Tensor, x: Tensor, y: Tensor, *, height: int, width: int) -> Tensor:
    """Convert (x, y) + flow from px to the coordinates of F.grid_sample."""
    u, v = flow.split(1, dim=1)
    return torch.cat([(2 * x + 1) / width - 1 + u * (2 / width), (2 * y + 1) / height - 1 + v * (2 / height)], dim=1)


def _finite(values: Tensor, limit: float) -> Tensor:
    """Clamp values to [-limit, limit], and replace NaN by `limit`."""
    # With border padding, one NaN in a grid ends the process in the backward pass of F.grid_sample.
    is_bounded = lambda: torch.stack(values.aminmax()).abs().amax() <= limit  # noqa: E731 - used once
    if values.numel() == 0 or eager_values(is_bounded, of=values):
        return values
    return values.nan_to_num(nan=limit, posinf=limit, neginf=-limit).clamp(-limit, limit)


def _clamp_to_range(sampled: Tensor, source: Tensor, padding: str) -> Tensor:
    # As bounds, pixels that are not finite would spread over the image.
    is_finite = source.isfinite()
    low = torch.where(is_finite, source, torch.inf).amin(dim=(2, 3), keepdim=True)
    high = torch.where(is_finite, source, -torch.inf).amax(dim=(2, 3), keepdim=True)
    if padding == "zeros":
        low, high = low.clamp(max=0), high.clamp(min=0)
    return torch.where(sampled.isfinite(), sampled.clamp(low, high), sampled)


def _like(values: Tensor, image: Tensor) -> Tensor:
    """Convert values to the type and the memory format of an image; those of integers are rounded."""
    if values.dtype is not image.dtype and not image.is_floating_point():
        values = round_to_dtype(values, image.dtype)
    layout = torch.channels_last if is_channels_last(image) and has_memory_format(values) else torch.contiguous_format
    return values.to(image.dtype).contiguous(memory_format=layout)


def _chosen(name: str, image: Tensor, flow: Tensor, *, backend: str, interpolation: str, is_lattice: bool) -> Any:
    """Return the module of a backend that samples the image, or None; raise if the caller chose it and it cannot.

    The flow is of the `sampling_dtype` of the image.
    """
    if backend not in ("auto", name) or requires_grad((image, flow)):
        return None
    if backend == "auto" and (name == "triton") != image.is_cuda:
        return None
    if name == "numba" and backend == "auto" and image.shape[2] * image.shape[3] < _SMALLEST_NUMBA_FRAME:
        return None
    why = module = None
    if interpolation != "bilinear":
        why = f"{interpolation} interpolation"
    elif not is_lattice and name == "triton":
        why = "a dense flow"
    elif flow.dtype is torch.float64:
        why = f"{str(image.dtype).removeprefix('torch.')} of {tuple(image.shape[2:])} px, which needs float64"
    elif name == "numba":
        why = why_not_eager(image) or why_not_eager(flow)
    elif image.device.type != "cuda":
        why = f"a tensor on {image.device.type}"
    if why is None:
        module = _backend(name)
        why = f"no {name} installed" if module is None else module.why_unsupported(image, flow)
    if why is not None and backend == name:
        raise ValueError(f"backend={name!r} supports {_SUPPORTED[name]}, got {why}; use backend='auto'")
    return module if why is None else None


@assume_constant_result
def _backend(name: str) -> Any:
    """Return the module of a backend, or None if its package is not installed."""
    try:  # on the first use, since the imports take a second
        return importlib.import_module(f"torchrefract.ops.{_MODULES[name]}")
    except ImportError:
        return None

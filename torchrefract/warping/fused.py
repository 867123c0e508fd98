"""Looking an image up by numba's kernels: positions and look-up in one pass, to the bits of F.grid_sample."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefract import _compiled as compiled
from torchrefract._tensor import is_channels_last
from torchrefract._threads import share
from torchrefract._validation import requires_grad, why_not_eager
from torchrefract.warping.followed import FollowedFlow, of_lines
from torchrefract.warping.grid import FAR, Positions, pixel_axes, sampler_axes
from torchrefract.warping.grid_sample import PADDINGS, by_grid_sample, gradients_by_grid_sample
from torchrefract.warping.lattice import LatticeFlow
from torchrefract.warping.mixed import Flow, MixedFlow, PartFlow, grid_of, known

_MOST_BANDS = 4  # of a frame whose gradient is scattered: each of them has a frame of its own
_Kernel = Callable[[int, int], None]
# Channels, height and width; how far pixels are apart; source and out, as the kernels have them.
_Images = tuple[torch.Size, int, np.ndarray, np.ndarray]


def obstacle(source: Tensor, flow: Flow | Positions, *, interpolation: str) -> str | None:
    """Why no kernel can look a source up along a flow, None where one can."""
    if interpolation != "bilinear":
        return f"for {interpolation} interpolation"
    positions = flow.grid if isinstance(flow, Positions) else known(flow)
    if source.dtype is torch.uint8:
        return why_not_eager(source) or compiled.obstacle(positions)
    return compiled.obstacle(source, positions)


def looked_up(source: Tensor, flow: Flow | Positions, *, padding: str) -> Tensor:
    """What F.grid_sample reads of a source (B, C, H, W), bilinear, of which `obstacle` has nothing to say.

    A grid of positions may have another size than the source. Bytes are rounded to the nearest; nothing may learn from
    them.
    """
    if not requires_grad((source, flow)):
        return _filled(source, flow, padding)
    grid = None
    if flow.requires_grad:
        grid = flow.grid if isinstance(flow, Positions) else grid_of(flow, source.dtype)
    return _LookedUp.apply(source, grid, flow.detach(), padding)


class _LookedUp(torch.autograd.Function):
    """The look-up with the gradients of F.grid_sample; the grid has those of a flow that learns, else it is None."""

    @staticmethod
    def forward(ctx: Any, source: Tensor, grid: Tensor | None, flow: Flow | Positions, padding: str) -> Tensor:
        ctx.save_for_backward(source, grid)
        ctx.flow, ctx.padding = flow, padding
        return _filled(source.detach(), flow if grid is None else Positions(grid.detach()), padding)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        source, grid = ctx.saved_tensors
        if grid is None and not torch.is_grad_enabled():
            return _scattered(gradients[0], source.shape, ctx.flow, ctx.padding), None, None, None
        if grid is None:
            grid = ctx.flow.grid if isinstance(ctx.flow, Positions) else grid_of(ctx.flow, source.dtype)
        needed, options = ctx.needs_input_grad[:2], {"padding": ctx.padding, "interpolation": "bilinear"}
        if torch.is_grad_enabled():  # for gradients of these
            plain = partial(by_grid_sample, **options)
            found = compiled.gradients_of(plain, (source, grid), needed, gradients[0])
        else:
            found = gradients_by_grid_sample(source, grid, gradients[0], needed=needed, padding=ctx.padding)
        return *found, None, None


def _scattered(upstream: Tensor, shape: torch.Size, flow: Flow | Positions, padding: str) -> Tensor:
    """The gradient of a source (B, C, H, W) that was looked up, from that of what was found."""
    batch, threads = shape[0], torch.get_num_threads()
    bands = max(1, min(threads // batch, _MOST_BANDS))
    found = upstream.new_zeros(batch, bands, shape[1:].numel())
    values, into = upstream.contiguous().view(batch, -1).numpy(), found.numpy()
    for rows, own in _parts(flow, batch):
        form, along = _along(own, len(rows))
        kernel = getattr(compiled.kernels("warping.kernels.scatter"), f"scatter_{form}")
        work = partial(kernel, values, tuple(shape[1:]), rows.numpy(), *along, PADDINGS.index(padding))
        share(lambda start, stop, work=work: work(start, stop, into), len(rows) * bands, least=1)
    return (found[:, 0] if bands == 1 else found.sum(dim=1)).view(shape)


def _filled(source: Tensor, flow: Flow | Positions, padding: str) -> Tensor:
    height, width = flow.grid.shape[1:3] if isinstance(flow, Positions) else source.shape[2:]
    batch, channels = source.shape[:2]
    last = is_channels_last(source)
    pixels = source.movedim(1, -1) if last else source.contiguous()
    # Not `empty_like`, which gives a frame of one pixel other strides.
    shape = (height, width, channels) if last else (channels, height, width)
    out = source.new_empty(batch, *shape)
    images = (source.shape[1:], channels if last else 1, pixels.reshape(batch, -1).numpy(), out.view(batch, -1).numpy())
    for rows, own in _parts(flow, batch):
        kernel = _kernel(images, rows, own, PADDINGS.index(padding))
        share(kernel, len(rows) * height, least=compiled.SMALLEST // width + 1)
    return out.movedim(-1, 1) if last else out


def _parts(flow: Flow | Positions, batch: int) -> Iterator[tuple[Tensor, PartFlow | Positions]]:
    """The rows of a batch that have their flow in one form."""
    if isinstance(flow, MixedFlow):
        yield from flow.parts
    else:
        yield torch.arange(batch), flow


def _kernel(images: _Images, rows: Tensor, flow: PartFlow | Positions, padding: int) -> _Kernel:
    """What looks rows up, of the pictures that are told, along a flow."""
    (channels, height, width), step, source, out = images
    form, along = _along(flow, len(rows))
    kernel = getattr(compiled.kernels("warping.kernels.look_up"), f"look_up_{form}")
    work = partial(kernel, source, (channels, height, width, step), rows.numpy(), *along, padding)
    return lambda start, stop: work(start, stop, out)


def _along(flow: PartFlow | Positions, rows: int) -> tuple[str, tuple[Any, ...]]:
    """How kernels are called that look along a flow of so many rows, and with what."""
    if isinstance(flow, FollowedFlow) and len(flow.nodes) == rows:
        return "followed", flow.trail[:3]
    values, flows = compiled.of_batch(flow.grid.movedim(-1, 1) if isinstance(flow, Positions) else known(flow))
    if len(flows) != rows:  # F.grid_sample raises, too; a kernel would read what is not there
        raise ValueError(f"flow must have a row for each of {rows} images, got {len(flows)}")
    if isinstance(flow, LatticeFlow):
        return "lattice", of_lines(flow.with_nodes(values).lines(values.dtype), flows)
    return "dense", _of_pixels(values, flows, whole=isinstance(flow, Positions))


def _of_pixels(values: Tensor, flows: np.ndarray, *, whole: bool) -> tuple[Any, ...]:
    """Of positions as a whole, or of the flows that make them."""
    height, width = values.shape[2:]
    x, y, scale = values.new_zeros(width), values.new_zeros(height), (1.0, 1.0)
    if not whole:
        size = {"height": height, "width": width}
        x, y = sampler_axes(*pixel_axes(**size, dtype=values.dtype, device=values.device), **size)
        scale = 2 / width, 2 / height
    ends = map(np.float32, (*scale, FAR))
    return values.numpy(), flows, x.flatten().numpy(), y.flatten().numpy(), *ends

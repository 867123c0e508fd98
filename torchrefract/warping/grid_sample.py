"""The one call of F.grid_sample, on all threads."""

import torch
import torch.nn.functional as F
from torch import Tensor

PADDINGS = ("zeros", "border", "reflection")
INTERPOLATIONS = ("nearest", "bilinear", "bicubic")
# The kernel of this pair alone rounds by the layout of its grid, which bands of rows change.
WHOLE = ("bicubic", "reflection")
# Below this many output pixels a second thread costs more than it brings.
_SMALLEST_SPLIT = 1 << 14


def by_grid_sample(source: Tensor, grid: Tensor, *, padding: str, interpolation: str) -> Tensor:
    """What F.grid_sample reads of a source (B, C, H, W) along its grid (B, n, m, 2), with all threads."""
    parts = 1 if (interpolation, padding) == WHOLE else _parts(source, grid)
    if parts == 1:
        return F.grid_sample(source, grid, mode=interpolation, padding_mode=padding, align_corners=False)
    repeated, bands = _apart(source, grid, parts)
    out = F.grid_sample(repeated, bands, mode=interpolation, padding_mode=padding, align_corners=False)
    return _together(out, len(source))[:, :, : grid.shape[1]]


def gradients_by_grid_sample(
    source: Tensor, grid: Tensor, gradient: Tensor, *, needed: tuple[bool, bool], padding: str
) -> tuple[Tensor | None, Tensor | None]:
    """The gradients of a bilinear look-up that are needed, of the source and of the grid, without a look-up."""
    parts, batch = _parts(source, grid), len(source)
    repeated, bands = _apart(source, grid, parts)
    rows = bands.shape[1]
    gradient = F.pad(gradient, (0, 0, 0, parts * rows - gradient.shape[2]))
    gradient = gradient.unflatten(2, (parts, rows)).movedim(2, 1).flatten(0, 1)
    options = (0, PADDINGS.index(padding), False, list(needed))
    of_source, of_grid = torch.ops.aten.grid_sampler_2d_backward(gradient, repeated, bands, *options)
    return (
        of_source.unflatten(0, (batch, parts)).sum(dim=1) if needed[0] else None,
        of_grid.unflatten(0, (batch, parts)).flatten(1, 2)[:, : grid.shape[1]] if needed[1] else None,
    )


def _parts(source: Tensor, grid: Tensor) -> int:
    """In how many bands of rows a frame is looked up."""
    # The CPU sampler threads over the batch alone: bands of rows as a batch give the same bits on all threads.
    if source.device.type != "cpu" or torch.compiler.is_compiling() or grid.shape[1] * grid.shape[2] < _SMALLEST_SPLIT:
        return 1
    threads = torch.get_num_threads() // source.shape[0]
    # The backward pass keeps one gradient image a band, so a long gradient caps the bands.
    return max(1, min(threads, 4 if source.requires_grad else grid.shape[1]))


def _apart(source: Tensor, grid: Tensor, parts: int) -> tuple[Tensor, Tensor]:
    """The source, once for each band, and the bands of the grid, as a batch."""
    batch, height, width = grid.shape[:3]
    rows = -(-height // parts)
    if rows * parts > height:
        grid = F.pad(grid, (0, 0, 0, 0, 0, rows * parts - height))
    repeated = source[:, None].expand(-1, parts, -1, -1, -1).reshape(batch * parts, *source.shape[1:])
    return repeated, grid.reshape(batch * parts, rows, width, 2)


def _together(out: Tensor, batch: int) -> Tensor:
    """(B, C, n, m) of bands as a batch."""
    return out.unflatten(0, (batch, -1)).movedim(1, 2).flatten(2, 3)

"""A mask looked up along a flow."""

from torch import Tensor

from torchrefract._validation import eager_values
from torchrefract.warping.grid import near_border, pixel_axes, sampler_grid_at
from torchrefract.warping.warp import sampled, sampler_dtype


def mixes_only(good: Tensor, flow: Tensor) -> Tensor:
    """(B, 1, H, W), bool: all pixels that a look-up along the flow mixes are good, but for weights below 1/1000.

    What lies outside the frame is not good.

    Args:
        good: (B, 1, H, W), bool.
        flow: (B, 2, H, W), px.
    """
    dtype, (height, width) = sampler_dtype(flow, flow.dtype), flow.shape[2:]
    source, flow = good.to(dtype), flow.detach().to(dtype)
    x, y = pixel_axes(height, width, dtype=dtype, device=flow.device)

    def at(rows: slice, columns: slice) -> Tensor:
        part = flow[..., rows, columns], x[..., columns], y[..., rows, :]
        grid = sampler_grid_at(*part, height=height, width=width)
        return sampled(source, grid, padding="zeros", interpolation="bilinear") > 0.999

    rim = _rim(source)
    # A look-up mixes pixels that are less than 1 px away.
    return at(slice(None), slice(None)) if rim is None else near_border(flow, rim + 2, at)


def _rim(good: Tensor) -> int | None:
    """Px, from the border, beyond which a mask (B, 1, H, W) is 1 everywhere, if that is a narrow rim."""
    height, width = good.shape[2:]
    if good.numel() == 0:
        return None
    across = eager_values(lambda: good[:, 0, height // 2].amin(dim=0), of=good)
    down = eager_values(lambda: good[..., width // 2].amin(dim=0)[0], of=good)
    if across is None or down is None or not (1 in across and 1 in down):
        return None
    rim = max(max(line.index(1), line[::-1].index(1)) for line in (across, down))
    while 8 * rim < min(height, width):
        if good[..., rim : height - rim, rim : width - rim].amin() == 1:
            return rim
        rim = 2 * rim + 1
    return None

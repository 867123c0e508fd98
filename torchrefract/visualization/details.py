"""Details of a contact sheet: parts of a frame at full resolution, and its flow as arrows."""

import math
from typing import NamedTuple

import torch
from matplotlib.axes import Axes
from torch import Tensor

from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose

_ROAD = 0.75  # row of the middle of the road's detail, as a share of the height
_LARGEST_SHARE = 3  # a detail is at most 1 / 3 as wide as the frame
_SPACING = 24  # px of display from arrow to arrow
_LONGEST = 1.5  # length of the longest arrow, in spacings
_COLOR = (0.8, 0.0, 0.1)


class FlowArrows(NamedTuple):
    """The motion of the content of a frame, at points of the displayed image."""

    x: Tensor  # (N,), px of the display
    y: Tensor  # (N,)
    u: Tensor  # (N,), px of the display, already enlarged
    v: Tensor  # (N,)
    enlargement: float  # length of an arrow / length of the motion in the displayed image
    longest: float  # motion, px of the frame


def detail_rows(effect: Effect) -> tuple[float, float]:
    """Return the rows of the horizon and of the road, as shares of the height.

    The horizon is that of the effect, or of the first of a composition that has one; else half of the height.
    """
    leaves = effect.effects if isinstance(effect, Compose) else [effect]
    horizons = (getattr(leaf, "horizon", None) for leaf in leaves)
    return next((h for h in horizons if isinstance(h, float) and 0 <= h <= 1), 0.5), _ROAD


def cut_detail(image: Tensor, row: float, *, height: int, width: int) -> Tensor:
    """Cut out a window around the middle column, and enlarge its pixels by a whole number, at least 1.

    Args:
        image: (1, 3, H, W), floating; values outside [0, 1] are clamped.
        row: middle of the window, as a share of H; the window is moved into the image.
        height, width: of the display, px; the window is at most a third as wide as the image.

    Returns:
        (3, h, w), float32 in [0, 1], on the CPU, with h <= height and w <= width.
    """
    rows, columns = image.shape[2:]
    factor = max(1, math.ceil(_LARGEST_SHARE * width / columns))
    h, w = min(rows, max(1, height // factor)), min(columns, max(1, width // factor))
    top, left = round(row * rows - h / 2), (columns - w) // 2
    top = min(max(0, top), rows - h)
    factor = max(1, min(height // h, width // w))
    window = image[0, :, top : top + h, left : left + w].detach().float().cpu().clamp(0, 1)
    return window.repeat_interleave(factor, dim=1).repeat_interleave(factor, dim=2)


def flow_arrows(flow: Tensor, valid: Tensor, *, height: int, width: int) -> FlowArrows | None:
    """Choose arrows of the motion -flow at points of the displayed image; None for a flow of 0 or without valid points.

    Args:
        flow: (1, 2, H, W), px; pixel x shows the content of x + flow(x).
        valid: (1, 1, H, W), bool.
        height, width: of the displayed image, px.
    """
    rows, columns = flow.shape[2:]
    y = torch.arange(min(_SPACING, height) // 2, height, _SPACING)
    x = torch.arange(min(_SPACING, width) // 2, width, _SPACING)
    y, x = (value.flatten() for value in torch.meshgrid(y, x, indexing="ij"))
    at = (y * rows // height, x * columns // width)
    keep = valid[0, 0].cpu()[at]
    motion = -flow[0].detach().float().cpu()[:, at[0][keep], at[1][keep]]
    longest = motion.norm(dim=0).amax().item() if keep.any() else 0.0
    if longest == 0:
        return None
    reduction = width / columns
    enlargement = _round_down(_LONGEST * _SPACING / (longest * reduction))
    u, v = enlargement * reduction * motion
    return FlowArrows(x[keep] + 0.5, y[keep] + 0.5, u, v, enlargement, longest)


def draw_arrows(axes: Axes, arrows: FlowArrows) -> None:
    """Draw arrows on the axes of a displayed image."""
    axes.quiver(
        *(value.numpy() for value in arrows[:4]), angles="xy", scale_units="xy", scale=1, color=_COLOR, width=0.004
    )


def _round_down(value: float) -> float:
    """Round a positive number down to one digit."""
    power = 10.0 ** math.floor(math.log10(value))
    return math.floor(value / power + 1e-6) * power

"""The sky of a road frame: its pixels, a point in it, and whether it is that of the night."""

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import highest_nearby, interpolate_channels
from torchrefract._validation import why_not_eager
from torchrefract.fields.srgb import luma

_NODES = 192  # of the lattice along the longer side
_MAX_RANGE = 0.06  # of the luma in a smooth neighborhood of three by three nodes
_MIN_LUMA, _ABOVE_MEDIAN = 0.5, 0.05  # of a gray or white sky; streets at night and most roads are darker
_MIN_BLUE, _MIN_BLUE_LUMA = 0.1, 0.3  # blue minus red, and luma, of a blue sky
_MIN_CONTRAST = 0.15  # of the mean luma of a gray or white sky to that of the rest; that of a road is below 0.1
_MAX_SHADE = 0.25  # of the luma of a gray or white sky, below its mean
_MIN_SHARE = 0.02  # of the frame
_MIN_BLUE_SHARE = 0.05  # of the sky; below, the blue is glass that mirrors it
_MAX_NIGHT_LUMA, _MIN_NIGHT_SHARE = 0.3, 0.05  # of a sky at night
_MIN_DAY_LUMA, _MIN_DAY_SHARE = 0.35, 0.1  # of the upper third by day, and of smooth nodes above the luma of the night
_BLACK, _MAX_BAR = 0.06, 0.17  # of a bar or line above a frame, largest value, and share of the height
_AROUND, _MAX_DARKER = 15, 0.12  # nodes, and difference of a channel, from the color of the sky around a pixel
_GROWTHS, _MAX_DIFFERENCE = 3, 0.06  # steps, and difference of a channel, from the sky around to more of it
_SWEEPS = 3  # each goes around one corner
_MAX_KEPT = 1 << 23  # values of an image
_F = TypeVar("_F", bound=Callable[..., Any])


class Sky(NamedTuple):
    """The sky at the nodes of a lattice, which are the upper left pixels of blocks.

    nodes: (N, 1, h, w), bool: the node shows the sky.
    stride: px, the side of a block.
    darkness: (N,), share of the frame that is dark, smooth and connected to the top row; 0 if there is a sky.
    """

    nodes: Tensor
    stride: int
    darkness: Tensor

    @property
    def is_night(self) -> Tensor:
        """Return (N,), bool: the darkness exceeds 5 %.

        Of the frames that this was made for, these are 89 % of those at night and 2 % of those by day.
        """
        return self.darkness > _MIN_NIGHT_SHARE


def _keep_latest(function: _F) -> _F:
    """Keep the latest result of a function of an image without a gradient, for an image of equal values on the CPU.

    Several effects of a scene, and each severity, look for the sky of one frame. Results must not be written to.
    """
    latest: list[tuple[Tensor, Any]] = []

    @wraps(function)
    def result(image: Tensor) -> Any:
        if why_not_eager(image) is not None or image.numel() > _MAX_KEPT:
            return function(image)
        for kept, value in latest:
            if kept.dtype is image.dtype and torch.equal(kept, image):
                return value
        # Tensors made in inference mode cannot be used outside of it.
        with torch.inference_mode(False), torch.no_grad():
            kept = torch.empty_like(image).copy_(image)
            value = function(kept)
        latest[:] = [(kept, value)]
        return value

    return cast(_F, result)


@_keep_latest
def sky_mask(image: Tensor) -> Tensor:
    """Return the pixels that show the sky: connected to the top row, smooth, and bright or blue.

    The frame, below a black bar if there is one, is judged at the nodes of a lattice. A node is a candidate if the luma
    of its eight neighbors and itself lies within 0.06, and if its luma is above 0.5 and 0.05 above the median, or if
    blue exceeds red by 0.1 and the luma 0.3. The candidates that are connected to the top row are the sky, if they
    cover 2 % of the frame and are blue or, in the mean, 0.15 brighter than the rest. So a road seen from above, a frame
    at night and a frame without sky have none. Nodes that are not blue, and darker than the mean of the sky by 0.25,
    are left out: concrete, or a road in haze. Three times, smooth nodes at most 7 nodes from the sky join it: those
    that differ from it there by less than 0.06 in each channel, which finds the haze at the horizon, and sky that poles
    cut off; and, if 5 % of the sky are blue, those of a paler blue, which finds blue sky that clouds cut off. A pixel
    at these nodes, next to them, or above them in its column is then sky unless one of its channels is darker by 0.12
    than the sky around it: this follows trees and poles, and fills clouds.

    Args:
        image: (N, C, H, W), stored values (sRGB) in [0, 1], or uint8. Three channels are red, green and blue; other
            numbers of channels have no blue.

    Returns:
        (N, 1, H, W), bool. It has no gradient. Each image is judged alone.
    """
    image = image.detach()
    mask, stride, _ = find_sky(image)
    nodes = _without_bar(_nodes(image, stride))
    is_smooth, is_pale = _is_smooth(luma(nodes)) & ~_is_shaded(nodes, mask), _is_pale(nodes, mask)
    for _ in range(_GROWTHS):
        nearby, is_near = _mean_nearby(mask, nodes)
        is_equal = (nodes - nearby).abs().amax(dim=1, keepdim=True) < _MAX_DIFFERENCE
        mask = mask | is_near & is_smooth & (is_equal | is_pale)
    nearby, is_near = _mean_nearby(mask, nodes)
    color, weight = torch.where(is_near, nearby, _mean_where(mask, nodes)), mask.float()
    color = torch.where(mask, torch.minimum(color, nodes), color)  # of blue sky between white clouds
    is_above = weight.flip(2).cummax(dim=2).values.flip(2)
    size = (image.shape[2], image.shape[3])
    candidate = F.interpolate(torch.maximum(is_above, highest_nearby(weight)), size) > 0
    pixels = image.float() / 255 if image.dtype is torch.uint8 else image.float()
    darker = (interpolate_channels(color, size) - pixels).amax(dim=1, keepdim=True)
    return candidate & (darker < _MAX_DARKER)


@_keep_latest
def find_sky(image: Tensor) -> Sky:
    """Return the sky at the nodes of a lattice, before smooth nodes around join it; see `sky_mask`."""
    stride = max(1, max(image.shape[2:]) // _NODES)
    shown = _nodes(image.detach(), stride)
    nodes = _without_bar(shown)
    y = luma(nodes)
    blue = _blue(nodes)
    is_smooth = _is_smooth(y)
    median = y.flatten(1).median(dim=1).values.view(-1, 1, 1, 1)
    is_bright = y > (median + _ABOVE_MEDIAN).clamp(min=_MIN_LUMA)
    sky = _connected_to_top(is_smooth & (is_bright | (blue > _MIN_BLUE) & (y > _MIN_BLUE_LUMA)))
    contrast = _mean_where(sky, y) - _mean_where(~sky, y)
    is_sky = (contrast > _MIN_CONTRAST) | (_mean_where(sky, blue) > _MIN_BLUE)
    is_sky = is_sky & (_share(sky) >= _MIN_SHARE)
    dark = _connected_to_top(is_smooth & (y < _MAX_NIGHT_LUMA))
    is_sky_node = sky & is_sky & ~_is_shaded(nodes, sky) & (shown.amax(dim=1, keepdim=True) > _BLACK)
    return Sky(is_sky_node, stride, (~is_sky * _share(dark)).view(-1))


def is_day(image: Tensor) -> Tensor:
    """Return (N,), bool: the frames have a sky, or are bright above and smooth, as roads that are seen from above.

    Frames are as for `sky_mask`. Frames by day that are dark above count as night, and those at night in which a sky
    is taken for one of the day as day.
    """
    sky = find_sky(image)
    y = luma(_nodes(image.detach(), sky.stride))
    upper = y[:, :, : max(1, y.shape[2] // 3)].flatten(1).median(dim=1).values
    lit = _share(_is_smooth(y) & (y > _MAX_NIGHT_LUMA)).view(-1)
    return sky.nodes.flatten(1).any(dim=1) | ((upper > _MIN_DAY_LUMA) & (lit > _MIN_DAY_SHARE) & ~sky.is_night)


def sky_point(sky: Sky, u: Tensor, *, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return a random point of the sky, at least a block away from everything else.

    Args:
        sky: of N frames.
        u: (N, 3), uniform in (0, 1): the first number chooses a block, the others a point in it.
        height, width: px, of the frames.

    Returns:
        (N, 2), x and y in widths and heights from the upper left corner of the frame, and (N,), bool, False for frames
        without such a point.
    """
    inner = 1 - highest_nearby(1 - sky.nodes.to(u.dtype))
    counted = inner.flatten(1).cumsum(dim=1)
    index = (counted <= u[:, :1] * counted[:, -1:]).sum(dim=1).clamp(max=counted.shape[1] - 1)
    columns = sky.nodes.shape[3]
    x, y = index % columns + u[:, 1], index.div(columns, rounding_mode="floor") + u[:, 2]
    return torch.stack([sky.stride * x / width, sky.stride * y / height], dim=1), counted[:, -1] > 0


def _nodes(image: Tensor, stride: int) -> Tensor:
    """Return the values of an image (N, C, H, W) at the nodes, (N, C, h, w), in [0, 1]; NaN is 0."""
    nodes = image[:, :, ::stride, ::stride]
    nodes = nodes.float() / 255 if image.dtype is torch.uint8 else nodes.float()
    return nodes.contiguous().nan_to_num(nan=0.0).clamp(0, 1)


def _without_bar(nodes: Tensor) -> Tensor:
    """Continue the nodes below a black bar at the top, up to a sixth of the height, over the bar and its rim."""
    height = nodes.shape[2]
    first = (nodes.amax(dim=(1, 3)) > _BLACK).to(torch.uint8).argmax(dim=1)  # 0 if all rows are black
    first = torch.where((first > 0) & (first < _MAX_BAR * height), first + 1, 0)
    row = torch.arange(height, device=nodes.device).maximum(first[:, None])
    return nodes.gather(2, row[:, None, :, None].expand_as(nodes))


def _blue(nodes: Tensor) -> Tensor:
    """Return blue minus red, (N, 1, h, w), and 0 for an image that has no three channels."""
    return nodes[:, 2:] - nodes[:, :1] if nodes.shape[1] == 3 else torch.zeros_like(nodes[:, :1])


def _is_shaded(nodes: Tensor, sky: Tensor) -> Tensor:
    """Return the nodes that are not blue and darker than clouds in the sky, as concrete and roads are."""
    y = luma(nodes)
    return (y < _mean_where(sky, y) - _MAX_SHADE) & (_blue(nodes) < _MIN_BLUE)


def _is_pale(nodes: Tensor, sky: Tensor) -> Tensor:
    """Return the nodes with a blue between that of the sky and white; none, if little of the sky is blue."""
    y, blue = luma(nodes), _blue(nodes)
    is_blue = blue > _MIN_BLUE
    blue_sky = sky & is_blue
    is_pale = (y > _mean_where(blue_sky, y) - _MAX_DIFFERENCE) & (blue < _mean_where(blue_sky, blue) + _MAX_DIFFERENCE)
    return is_blue & is_pale & (_share(blue_sky) > _MIN_BLUE_SHARE * _share(sky))


def _connected_to_top(candidate: Tensor) -> Tensor:
    """Return the part of a mask (N, 1, H, W) that a few sweeps along columns and rows reach from its top row."""
    reached = candidate.clone()
    reached[:, :, 1:] = False
    runs = [_runs(candidate, dim) for dim in (2, 3)]
    for _ in range(_SWEEPS):
        for run in runs:
            count = run.new_zeros(len(run), candidate.shape[2:].numel() + max(candidate.shape))
            count = count.scatter_add(1, run, reached.flatten(1).to(run.dtype))
            reached = candidate & (count.gather(1, run) > 0).view_as(candidate)
    return reached


def _runs(candidate: Tensor, dim: int) -> Tensor:
    """Return the number, (N, H W), of the run of successive candidates along a dimension to which a node belongs."""
    size, lines = candidate.shape[dim], candidate.shape[5 - dim]
    first = (size + 1) * torch.arange(lines, device=candidate.device)
    return ((~candidate).cumsum(dim) + (first if dim == 2 else first[:, None])).flatten(1)


def _mean_where(mask: Tensor, value: Tensor) -> Tensor:
    """Return (N, 1, 1, 1), the mean of a value (N, 1, H, W) over a mask, 0 over an empty one."""
    weight = mask.to(value.dtype)
    return (weight * value).sum(dim=(2, 3), keepdim=True) / weight.sum(dim=(2, 3), keepdim=True).clamp(min=1)


def _is_smooth(y: Tensor) -> Tensor:
    """Return where the luma (N, 1, H, W) of a node and its neighbors differs little."""
    return highest_nearby(y) + highest_nearby(-y) < _MAX_RANGE


def _mean_nearby(mask: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean of a value (N, C, H, W) over the part of a mask around each node, and where there is one."""
    weight = mask.to(value.dtype)
    total = torch.cat([value * weight, weight], dim=1)
    for dim, border in ((2, (0, 0, _AROUND // 2 + 1, _AROUND // 2)), (3, (_AROUND // 2 + 1, _AROUND // 2))):
        size, up_to = total.shape[dim], F.pad(total, border).cumsum(dim)
        total = up_to.narrow(dim, _AROUND, size) - up_to.narrow(dim, 0, size)
    return total[:, :-1] / total[:, -1:].clamp(min=1), total[:, -1:] > 0


def _share(mask: Tensor) -> Tensor:
    return mask.float().mean(dim=(2, 3), keepdim=True)

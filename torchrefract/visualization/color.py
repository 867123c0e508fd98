"""Pictures of fields: flow by the color wheel, transmission by a color map, a checkerboard to bend, and marks on it."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

_RED_TO_RED = ((1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1), (1, 0, 1), (1, 0, 0))
_HUES = (0, 15, 21, 25, 36, 49, 55)  # of the 55 hues of a turn: yellow is the 15th, green the 21st, ...
# Viridis at 0, 1/8, ..., 1.
_VIRIDIS = (
    (0.267, 0.005, 0.329),
    (0.279, 0.175, 0.483),
    (0.230, 0.322, 0.546),
    (0.173, 0.449, 0.558),
    (0.128, 0.567, 0.551),
    (0.158, 0.684, 0.502),
    (0.369, 0.789, 0.383),
    (0.678, 0.864, 0.190),
    (0.993, 0.906, 0.144),
)
_GRAY = 0.5
_BEYOND = 0.75  # brightness of a motion longer than the scale
_STRIPES = (0.86, 0.62)
_FOLD = (1.0, 0.0, 1.0)
_FOLD_SHARE = 0.75


def flow_to_rgb(flow: Tensor, *, max_px: float | None = None) -> Tensor:
    """The flow as colors: hue by direction, saturation by magnitude, white where nothing moves.

        hue = 55 atan2(v, u) / (2 pi) mod 55,  r = |flow| / max_px
        rgb = 1 - r (1 - wheel(hue)) if r <= 1, else 0.75 wheel(hue)

    Right is red, down yellow, left azure, up violet. The 55 hues close into a circle, without the seam that the
    original program leaves by spreading 54 of them over the turn.

    Args:
        flow: (B, 2, H, W), px.
        max_px: px, the magnitude drawn in full color; None for the largest finite one of the batch, at least 1e-6 px.

    Returns:
        (B, 3, H, W), in [0, 1], float32 or with a float64 flow float64; gray where the magnitude is not finite.

    Source: Baker, Scharstein, Lewis, Roth, Black, Szeliski, "A database and evaluation methodology for optical flow",
    IJCV 92 (2011).
    """
    _check_map("flow", flow, channels=2)
    if max_px is not None and not 0 < max_px < math.inf:
        raise ValueError(f"max_px must be a finite number above 0, got {max_px}")
    u, v = _at_least_float32(flow).unbind(1)
    magnitude = torch.hypot(u, v)
    finite = magnitude.isfinite()
    u, v, magnitude = (torch.where(finite, value, 0) for value in (u, v, magnitude))
    # A tensor, since some devices divide by a number through its reciprocal, and then max_px / max_px may exceed 1.
    full = _largest(magnitude) if max_px is None else magnitude.new_full((), max_px)
    r = (magnitude / full).unsqueeze(1)
    hue = (torch.atan2(v, u) * (55 / (2 * math.pi))).remainder(55)
    color = _interpolate(hue, hue.new_tensor(_HUES), hue.new_tensor(_RED_TO_RED))
    color = torch.where(r <= 1, 1 - r * (1 - color), _BEYOND * color)
    return torch.where(finite.unsqueeze(1), color, _GRAY)


def full_color_px(flow: Tensor, valid: Tensor) -> float:
    """A round `max_px` for `flow_to_rgb`: the longest flow that is valid, rounded up to two digits.

    Args:
        flow: (B, 2, H, W), px.
        valid: (B, 1, H, W), bool, the pixels that count; what is not finite never does.

    Returns:
        px; 1 where nothing that counts moves.
    """
    _check_map("flow", flow, channels=2)
    _check_mask("valid", valid, flow)
    u, v = _at_least_float32(flow).unbind(1)
    magnitude = torch.hypot(u, v)
    return rounded_up(F.pad(magnitude[valid[:, 0] & magnitude.isfinite()], (0, 1)).amax().item())


def rounded_up(value: float) -> float:
    """A number for a legend: the value rounded up to two digits, 1 for 0.

        digits = 1 - floor(log10(value)),  rounded_up = ceil(value 10^digits) / 10^digits

    Args:
        value: 0 or above, and finite.
    """
    if not 0 <= value < math.inf:
        raise ValueError(f"value must be a finite number of at least 0, got {value}")
    if value == 0:
        return 1.0
    digits = 1 - math.floor(math.log10(value))
    # What has two digits stays as it is, whatever the last bit of the product.
    return math.ceil(round(value * 10.0**digits, 6)) / 10.0**digits


def flow_wheel(size: int) -> Tensor:
    """The legend of `flow_to_rgb`: each place has the color of the flow that points there from the center.

        rgb(u, v) = flow_to_rgb((u, v), max_px=1),  u = (2 i + 1) / size - 1 in column i, v likewise in row j

    Args:
        size: px, side of the picture and diameter of the disc.

    Returns:
        (3, size, size), in [0, 1], float32; white outside the disc.

    Source: as `flow_to_rgb`.
    """
    _check_size("size", size)
    axis = (2 * torch.arange(size, dtype=torch.float32) + 1) / size - 1
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    rgb = flow_to_rgb(torch.stack([u, v])[None], max_px=1.0)[0]
    return torch.where(torch.hypot(u, v) <= 1, rgb, 1.0)


def transmission_to_rgb(transmission: Tensor) -> Tensor:
    """The transmission as colors, even to the eye: violet at 0 (opaque), teal at 1/2, yellow at 1 (clear).

        rgb = linear between nine colors of viridis, at 0, 1/8, ..., 1

    Args:
        transmission: (B, 1, H, W), in [0, 1]; what lies outside has the color of the nearer end.

    Returns:
        (B, 3, H, W), in [0, 1], float32 or with a float64 transmission float64; gray where it is NaN.

    Source: viridis, by Smith, van der Walt and Firing (2015), released under CC0.
    """
    _check_map("transmission", transmission, channels=1)
    value = _at_least_float32(transmission)[:, 0]
    known = ~value.isnan()
    knots = torch.linspace(0, 1, len(_VIRIDIS), dtype=value.dtype, device=value.device)
    color = _interpolate(torch.where(known, value, 0).clamp(0, 1), knots, value.new_tensor(_VIRIDIS))
    return torch.where(known.unsqueeze(1), color, _GRAY)


def checkerboard(height: int, width: int, *, cell: int = 32) -> Tensor:
    """A black and white checkerboard, white at the top left: straight lines that show what a flow bends.

        image(row, column) = 1 if floor(row / cell) + floor(column / cell) is even, else 0

    Args:
        height: px.
        width: px.
        cell: px, side of a square.

    Returns:
        (1, 3, height, width), 0 or 1, float32.
    """
    for name, value in (("height", height), ("width", width), ("cell", cell)):
        _check_size(name, value)
    rows, columns = torch.arange(height) // cell, torch.arange(width) // cell
    white = (rows[:, None] + columns) % 2 == 0
    return white.float().expand(1, 3, -1, -1).contiguous()


def hatch_invalid(image: Tensor, valid: Tensor) -> Tensor:
    """The picture with gray stripes over what is not valid.

        stripe(row, column) = 0.86 if (row + column) mod period < period / 2, else 0.62,  period = max(8, side / 40)

    The side is the longer one. A pixel of the picture takes the valid flag that lies under its center.

    Args:
        image: (B, 3, H, W), floating in [0, 1], in the pixels that it is drawn with.
        valid: (B, 1, h, w), bool, of any size.

    Returns:
        (B, 3, H, W), of the type of the image.
    """
    _check_map("image", image, channels=3)
    _check_mask("valid", valid, image, any_size=True)
    height, width = image.shape[2:]
    period = max(8, max(height, width) // 40)
    diagonal = torch.arange(height, device=image.device)[:, None] + torch.arange(width, device=image.device)
    stripes = torch.where(diagonal % period < period // 2, *_STRIPES).to(image.dtype)
    kept = F.interpolate(valid.to(image.device, torch.float32), (height, width), mode="nearest-exact") > 0
    return torch.where(kept, image, stripes)


def mark_folded(image: Tensor, folded: Tensor) -> Tensor:
    """The picture with magenta over the folded pixels.

        out = 0.25 image + 0.75 (1, 0, 1)

    A pixel of the picture is marked if any of those that it covers is folded, so that a thin fold outlives shrinking.

    Args:
        image: (B, 3, H, W), floating in [0, 1], in the pixels that it is drawn with.
        folded: (B, 1, h, w), bool, of any size, such as `jacobian_determinant(flow) <= 0`.

    Returns:
        (B, 3, H, W), of the type of the image.
    """
    _check_map("image", image, channels=3)
    _check_mask("folded", folded, image, any_size=True)
    marked = F.adaptive_max_pool2d(folded.to(image.device, torch.float32), image.shape[2:]) > 0
    return torch.where(marked, torch.lerp(image, image.new_tensor(_FOLD).view(3, 1, 1), _FOLD_SHARE), image)


def _largest(magnitude: Tensor) -> Tensor:
    """() or the floor of 1e-6, which an empty batch has too."""
    return F.pad(magnitude.flatten(), (0, 1), value=1e-6).amax()


def _interpolate(value: Tensor, knots: Tensor, colors: Tensor) -> Tensor:
    """(B, 3, H, W): `colors` (K, 3) at the `knots` (K,), linear in between, for a (B, H, W) inside the knots."""
    right = torch.bucketize(value.contiguous(), knots).clamp(min=1)
    left = right - 1
    share = (value - knots[left]) / (knots[right] - knots[left])
    return torch.lerp(colors[left], colors[right], share.unsqueeze(-1)).movedim(-1, 1)


def _at_least_float32(value: Tensor) -> Tensor:
    return value.detach().to(torch.promote_types(value.dtype, torch.float32))


# Written out here, since this module and _checks share a layer and may not import each other.
def _check_map(name: str, value: Tensor, *, channels: int) -> None:
    if value.ndim != 4 or value.shape[1] != channels:
        raise ValueError(f"{name} must have shape (B, {channels}, H, W), got {tuple(value.shape)}")
    if not value.is_floating_point():
        raise TypeError(f"{name} must be of a floating type, got {value.dtype}")


def _check_mask(name: str, value: Tensor, like: Tensor, *, any_size: bool = False) -> None:
    size = tuple(value.shape[2:]) if any_size else tuple(like.shape[2:])
    if value.ndim != 4 or value.shape != (like.shape[0], 1, *size):
        size_text = "h, w" if any_size else f"{size[0]}, {size[1]}"
        raise ValueError(f"{name} must have shape ({like.shape[0]}, 1, {size_text}), got {tuple(value.shape)}")
    if value.dtype is not torch.bool:
        raise TypeError(f"{name} must be of type bool, got {value.dtype}")


def _check_size(name: str, value: int) -> None:
    if value < 1:
        raise ValueError(f"{name} must be at least 1, got {value}")

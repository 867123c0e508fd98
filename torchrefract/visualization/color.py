"""Colors of maps: optical flow by the color wheel, transmission by a color map, marks on a picture."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._validation import check_count, check_flow, check_map, check_positive

_WHEEL_COLORS = ((1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1), (1, 0, 1), (1, 0, 0))
_WHEEL_HUES = (0, 15, 21, 25, 36, 49, 55)  # position of each color among the 55 hues of the wheel
_VIRIDIS = (  # at 0, 1/8, ..., 1
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
_NOT_FINITE = 0.5
_BEYOND_SCALE = 0.75
_STRIPES = (0.86, 0.62)
_MAGENTA = (1.0, 0.0, 1.0)
_MAGENTA_SHARE = 0.75


def flow_to_rgb(flow: Tensor, *, max_px: float | None = None) -> Tensor:
    """Color a flow: hue by direction, saturation by magnitude, white for no motion.

    Right is red, down yellow, left azure, up violet. The 55 hues close into a circle; the original program spreads 54
    of them over the turn and leaves a seam.

    Args:
        flow: (B, 2, H, W), px.
        max_px: magnitude of full color, px, above 0; None for the largest finite magnitude of the batch, at least
            1e-6 px.

    Returns:
        (B, 3, H, W), in [0, 1], float32, or float64 for a float64 flow; gray where the flow is not finite.

    Raises:
        ValueError: if the flow has another shape or max_px is not a finite number above 0.
        TypeError: if the flow is not floating.

        hue = 55 atan2(v, u) / (2 pi) mod 55,  r = |flow| / max_px
        rgb = 1 - r (1 - wheel(hue)) if r <= 1, else 0.75 wheel(hue)

    Source: Baker, Scharstein, Lewis, Roth, Black, Szeliski, "A database and evaluation methodology for optical flow",
    IJCV 92 (2011).
    """
    check_flow("flow", flow)
    if max_px is not None:
        check_positive("max_px", max_px)
    u, v = _to_float(flow).unbind(1)
    magnitude = torch.hypot(u, v)
    finite = magnitude.isfinite()
    u, v, magnitude = (torch.where(finite, value, 0) for value in (u, v, magnitude))
    # Padded by the floor, so that an empty batch has a maximum too. As a tensor, because a device may divide by a
    # Python number through its reciprocal, and then max_px / max_px can exceed 1.
    largest = F.pad(magnitude.flatten(), (0, 1), value=1e-6).amax()
    scale = largest if max_px is None else magnitude.new_full((), max_px)
    r = (magnitude / scale).unsqueeze(1)
    hue = (torch.atan2(v, u) * (55 / (2 * math.pi))).remainder(55)
    color = _interpolate(hue, hue.new_tensor(_WHEEL_HUES), hue.new_tensor(_WHEEL_COLORS))
    color = torch.where(r <= 1, 1 - r * (1 - color), _BEYOND_SCALE * color)
    return torch.where(finite.unsqueeze(1), color, _NOT_FINITE)


def flow_wheel(size: int) -> Tensor:
    """Draw the legend of `flow_to_rgb`: each pixel has the color of the flow that points to it from the center.

    Returns (3, size, size), in [0, 1], float32; white outside the disc, whose diameter is the size, px.

        rgb(u, v) = flow_to_rgb((u, v), max_px=1),  u = (2 column + 1) / size - 1,  v = (2 row + 1) / size - 1
    """
    axis = (2 * torch.arange(check_count("size", size), dtype=torch.float32) + 1) / size - 1
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    rgb = flow_to_rgb(torch.stack([u, v])[None], max_px=1.0)[0]
    return torch.where(torch.hypot(u, v) <= 1, rgb, 1.0)


def full_color_px(flow: Tensor, valid: Tensor) -> float:
    """Choose a round `max_px` for `flow_to_rgb`: the largest finite magnitude of valid pixels, rounded up; else 1.

    Args:
        flow: (B, 2, H, W), px.
        valid: (B, 1, H, W), bool.
    """
    check_flow("flow", flow)
    _check_mask("valid", valid, flow)
    u, v = _to_float(flow).unbind(1)
    magnitude = torch.hypot(u, v)
    return round_up(F.pad(magnitude[valid[:, 0] & magnitude.isfinite()], (0, 1)).amax().item())


def round_up(value: float) -> float:
    """Round a finite number of at least 0 up to two digits; 0 becomes 1.

    digits = 1 - floor(log10(value)),  result = ceil(value 10^digits) / 10^digits
    """
    if not 0 <= value < math.inf:
        raise ValueError(f"value must be a finite number of at least 0, got {value}")
    if value == 0:
        return 1.0
    digits = 1 - math.floor(math.log10(value))
    # A number of two digits stays as it is, although its product with a power of ten may be off by the last bit.
    return math.ceil(round(value * 10.0**digits, 6)) / 10.0**digits


def transmission_to_rgb(transmission: Tensor) -> Tensor:
    """Color a transmission by viridis: violet at 0 (opaque), teal at 1/2, yellow at 1 (clear).

    Args:
        transmission: (B, 1, H, W), in [0, 1]; values outside get the color of the nearer end.

    Returns:
        (B, 3, H, W), in [0, 1], float32, or float64 for a float64 transmission; gray where it is NaN.

        rgb = linear interpolation of nine colors of viridis, at 0, 1/8, ..., 1

    Source: viridis, by Smith, van der Walt and Firing (2015), released under CC0.
    """
    check_map("transmission", transmission, channels=1)
    value = _to_float(transmission)[:, 0]
    is_number = ~value.isnan()
    knots = torch.linspace(0, 1, len(_VIRIDIS), dtype=value.dtype, device=value.device)
    color = _interpolate(torch.where(is_number, value, 0).clamp(0, 1), knots, value.new_tensor(_VIRIDIS))
    return torch.where(is_number.unsqueeze(1), color, _NOT_FINITE)


def checkerboard(height: int, width: int, *, cell: int = 32) -> Tensor:
    """Draw a black and white checkerboard, white at the top left, whose straight lines show what a flow bends.

    Args:
        height, width: of the image, px.
        cell: side of a square, px.

    Returns:
        (1, 3, height, width), 0 or 1, float32.

        image(row, column) = 1 if floor(row / cell) + floor(column / cell) is even, else 0
    """
    for name, value in (("height", height), ("width", width), ("cell", cell)):
        check_count(name, value)
    rows, columns = torch.arange(height) // cell, torch.arange(width) // cell
    white = (rows[:, None] + columns) % 2 == 0
    return white.float().expand(1, 3, -1, -1).contiguous()


def hatch_invalid(image: Tensor, valid: Tensor) -> Tensor:
    """Cover invalid pixels with gray diagonal stripes.

    Args:
        image: (B, 3, H, W), floating, in [0, 1], at the size of display.
        valid: (B, 1, h, w), bool, of any size; a pixel of the image takes the flag under its center.

    Returns:
        (B, 3, H, W), of the type of the image.

        stripe(row, column) = 0.86 if (row + column) mod period < period / 2, else 0.62
        period = max(8, max(H, W) / 40)
    """
    check_map("image", image, channels=3)
    _check_mask("valid", valid, image, any_size=True)
    height, width = image.shape[2:]
    period = max(8, max(height, width) // 40)
    diagonal = torch.arange(height, device=image.device)[:, None] + torch.arange(width, device=image.device)
    stripes = torch.where(diagonal % period < period // 2, *_STRIPES).to(image.dtype)
    visible = F.interpolate(valid.to(image.device, torch.float32), (height, width), mode="nearest-exact") > 0
    return torch.where(visible, image, stripes)


def mark_folded(image: Tensor, folded: Tensor) -> Tensor:
    """Tint folded pixels magenta.

    A pixel of the image is tinted if any of the mask's pixels that it covers is folded: thin folds stay visible in a
    reduced picture.

    Args:
        image: as for `hatch_invalid`, and so is the result.
        folded: (B, 1, h, w), bool, of any size, such as `jacobian_determinant(flow) <= 0`.

        out = 0.25 image + 0.75 (1, 0, 1)
    """
    check_map("image", image, channels=3)
    _check_mask("folded", folded, image, any_size=True)
    marked = F.adaptive_max_pool2d(folded.to(image.device, torch.float32), image.shape[2:]) > 0
    magenta = image.new_tensor(_MAGENTA).view(3, 1, 1)
    return torch.where(marked, torch.lerp(image, magenta, _MAGENTA_SHARE), image)


def _interpolate(value: Tensor, knots: Tensor, colors: Tensor) -> Tensor:
    """Interpolate colors (K, 3) at knots (K,) linearly: (B, H, W) within the knots -> (B, 3, H, W)."""
    right = torch.bucketize(value.contiguous(), knots).clamp(min=1)
    left = right - 1
    share = (value - knots[left]) / (knots[right] - knots[left])
    return torch.lerp(colors[left], colors[right], share.unsqueeze(-1)).movedim(-1, 1)


def _to_float(value: Tensor) -> Tensor:
    """Detach and convert half types to float32, in which squares do not overflow."""
    return value.detach().to(torch.promote_types(value.dtype, torch.float32))


def _check_mask(name: str, value: Tensor, image: Tensor, *, any_size: bool = False) -> None:
    size = tuple(value.shape[2:]) if any_size else tuple(image.shape[2:])
    if value.ndim != 4 or value.shape != (image.shape[0], 1, *size):
        size_text = "h, w" if any_size else f"{size[0]}, {size[1]}"
        raise ValueError(f"{name} must have shape ({image.shape[0]}, 1, {size_text}), got {tuple(value.shape)}")
    if value.dtype is not torch.bool:
        raise TypeError(f"{name} must be of type bool, got {value.dtype}")

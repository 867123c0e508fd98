"""Fog taken away, where something is left of the light."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor
from torchrefract._validation import check_color, check_flag, check_values, color_per_channel
from torchrefract.effects.door import Layout, check_image, enter, leave
from torchrefract.effects.rows import expand_batch
from torchrefract.fields.depth import check_floating
from torchrefract.fields.fog import linear_to_srgb, srgb_to_linear


def remove_fog(
    image: Tensor, transmission: Tensor, airlight: float | Sequence[float] | Tensor, *, linear_light: bool = False
) -> tuple[Tensor, Tensor]:
    """The image without its fog, and where that could be found: the inverse of every fog in closed form.

        J = A + (I - A) / t where t >= 1/255, else I

    A floating result is not clamped, so an image with noise may leave [0, 1].

    Args:
        image: (B, C, H, W), (C, H, W) or (B, T, C, H, W), floating or uint8, which is converted, rounded and clamped.
        transmission: t in [0, 1], (B, 1, H, W), (1, H, W) or (B, T, 1, H, W), or what broadcasts to it.
        airlight: A, color of the fog: one number in [0, 1], or one for each channel; (C,) or (B, C) as a tensor.
        linear_light: the fog was blended in radiance, not in stored values (sRGB).

    Returns:
        image of the same shape, type and memory format, and valid, (B, 1, H, W) beside it, bool: t >= 1/255.

    Raises:
        ValueError: shapes that do not fit; a transmission outside [0, 1] or NaN (on the CPU); an airlight out of range.
        TypeError: an image that is neither floating nor uint8, a transmission that is no floating tensor.
    """
    layout = check_image(image)
    check_flag("linear_light", linear_light)
    foggy, t = enter(image), _rows(transmission, image, layout)
    t = t.to(foggy.dtype)
    a = _airlight(airlight, foggy, layout)
    valid = t >= 1 / 255
    clean = _clear(foggy, torch.where(valid, t, 1), a, linear_light)
    clean = torch.where(valid & (t < 1), clean, foggy)
    valid = valid.expand(foggy.shape[0], 1, *foggy.shape[2:])
    return leave(clean, image, foggy), layout.unrolled(valid)


def _clear(image: Tensor, t: Tensor, airlight: Tensor, linear_light: bool) -> Tensor:
    if not linear_light:
        return torch.lerp(airlight, image, 1 / t)
    return linear_to_srgb(torch.lerp(srgb_to_linear(airlight), srgb_to_linear(image), 1 / t))


def _rows(t: Tensor, image: Tensor, layout: Layout) -> Tensor:
    """(N, 1, H or 1, W or 1)."""
    full = (*layout.lead, 1, *image.shape[-2:])
    shape = check_floating("transmission", t).shape
    if len(shape) != len(full) or any(side not in (1, most) for side, most in zip(shape, full, strict=True)):
        raise ValueError(f"transmission must broadcast to {full}, as the image has it, got {tuple(shape)}")
    check_values("transmission", "be in [0, 1]", t, lambda v: (v >= 0) & (v <= 1))
    return t.expand(*layout.lead, -1, -1, -1).reshape(layout.rows, *shape[-3:])


def _airlight(airlight: float | Sequence[float] | Tensor, image: Tensor, layout: Layout) -> Tensor:
    """What broadcasts to the rows of the image, of their type."""
    batch, channels = layout.batch, image.shape[1]
    if isinstance(airlight, Tensor):
        if airlight.shape not in ((channels,), (1, channels), (batch, channels)):
            raise ValueError(
                f"airlight must have shape ({channels},) or ({batch}, {channels}), got {tuple(airlight.shape)}"
            )
        check_values("airlight", "be finite", airlight, torch.isfinite)
        return expand_batch(airlight.to(image.dtype).view(-1, channels), layout.rows)[:, :, None, None]
    numbers = color_per_channel("airlight", check_color("airlight", airlight, high=1.0), channels)
    return as_device_tensor(numbers, dtype=image.dtype, device=image.device)[:, None, None]

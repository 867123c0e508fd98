"""How masks and depth follow a flow."""

import numbers

import torch
from torch import Tensor

from torchrefract._checks import check_choice, check_flag, check_flow, check_number, check_tensor
from torchrefract.warping.grid import field_dtype
from torchrefract.warping.resample import look_up


def warp_mask(mask: Tensor, flow: Tensor, *, fill: float = 0, soft: bool = False) -> Tensor:
    """The mask looked up along a backward flow: each pixel takes the class of the nearest one.

    Args:
        mask: (B, C, H, W) or (C, H, W), whole numbers up to 2^53, bool or floating.
        flow: (B, 2, H, W) or (1, 2, H, W), px; (2, H, W) for an unbatched mask.
        fill: what stands where the nearest pixel lies off the frame, a value that the mask's type can hold.
        soft: mix the four pixels around, for probabilities in a floating mask.

    Returns:
        The mask in its shape and type.

    Raises:
        ValueError: shapes that do not fit, a fill that the type cannot hold.
        TypeError: an argument that is no tensor, a soft mask that is not floating.
    """
    check_tensor("mask", mask)
    check_tensor("flow", flow)
    check_flag("soft", soft)
    if soft and not mask.is_floating_point():
        raise TypeError(f"mask must be floating to be soft, got {mask.dtype}")
    if mask.ndim == 3 and flow.ndim == 3:
        return warp_mask(mask[None], flow[None], fill=fill, soft=soft)[0]
    _check_map("mask", mask, flow)
    _check_fill(fill, mask.dtype)
    moved, on_frame = _follow(mask, flow, "bilinear" if soft else "nearest")
    return torch.where(on_frame, moved, torch.full_like(moved, fill))


def warp_depth(
    depth: Tensor, flow: Tensor, *, fill: float = 0.0, interpolation: str = "nearest"
) -> tuple[Tensor, Tensor]:
    """The depth looked up along a backward flow, and where there is one.

    Args:
        depth: (B, 1, H, W) or (1, H, W), m, floating; inf is the sky, NaN is not known.
        flow: (B, 2, H, W) or (1, 2, H, W), px; (2, H, W) for an unbatched depth.
        fill: what stands where there is no depth, m, finite.
        interpolation: "nearest", or "bilinear", which invents distances between the two sides of an edge.

    Returns:
        depth in its shape and type, without NaN, and valid, bool, of that shape: the nearest pixel lies on the frame
        and its depth (all that are mixed) is known.

    Raises:
        ValueError: shapes that do not fit, an unknown interpolation, a fill that is not finite.
        TypeError: an argument that is no floating tensor.
    """
    check_tensor("depth", depth)
    check_tensor("flow", flow)
    if depth.ndim == 3 and flow.ndim == 3:
        moved, valid = warp_depth(depth[None], flow[None], fill=fill, interpolation=interpolation)
        return moved[0], valid[0]
    _check_map("depth", depth, flow)
    if depth.shape[1] != 1:
        raise ValueError(f"depth must have one channel, got {tuple(depth.shape)}")
    if not depth.is_floating_point():
        raise TypeError(f"depth must be of a floating type, got {depth.dtype}")
    check_choice("interpolation", interpolation, ("nearest", "bilinear"))
    _check_fill(fill, depth.dtype)
    moved, on_frame = _follow(depth, flow, interpolation)
    valid = on_frame & ~moved.isnan()
    return torch.where(valid, moved, torch.full_like(moved, fill)), valid


def _follow(value: Tensor, flow: Tensor, interpolation: str) -> tuple[Tensor, Tensor]:
    """The map looked up, and where the nearest pixel lies on the frame."""
    flow = flow.to(field_dtype(value.dtype)).expand(value.shape[0], -1, -1, -1)
    everywhere = torch.ones_like(flow[:, :1])
    on_frame = look_up(everywhere, flow, padding="zeros", interpolation="nearest") > 0.5
    return look_up(value, flow, padding="border", interpolation=interpolation), on_frame


def _check_map(name: str, value: Tensor, flow: Tensor) -> None:
    check_flow("flow", flow)
    if value.ndim != 4:
        raise ValueError(f"{name} must have shape (B, C, H, W) beside a batched flow, got {tuple(value.shape)}")
    if value.is_complex():
        raise TypeError(f"{name} must be real, got {value.dtype}")
    if value.shape[2:] != flow.shape[2:] or flow.shape[0] not in (1, value.shape[0]):
        raise ValueError(
            f"flow must have the batch and the size of {name} {tuple(value.shape)}, got {tuple(flow.shape)}"
        )


def _check_fill(fill: float, dtype: torch.dtype) -> None:
    if dtype.is_floating_point:
        check_number("fill", fill)
        return
    low, high = (0, 1) if dtype is torch.bool else (torch.iinfo(dtype).min, torch.iinfo(dtype).max)
    if not isinstance(fill, int | numbers.Integral) or not low <= fill <= high:
        raise ValueError(f"fill must be a whole number in [{low}, {high}] for {dtype}, got {fill}")

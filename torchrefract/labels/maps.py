"""How masks, depth and optical flow follow a flow."""

import numbers
from typing import Any

import torch
from torch import Tensor

from torchrefract._validation import check_choice, check_flag, check_flow, check_number, check_tensor
from torchrefract.warping.compose import compose_flows
from torchrefract.warping.grid import field_dtype, inside
from torchrefract.warping.resample import sample_image


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


def warp_optical_flow(
    optical_flow: Tensor,
    flow: Tensor,
    restore_flow: Tensor,
    *,
    restore_valid: Tensor | None = None,
    fill: float = 0.0,
    interpolation: str = "nearest",
) -> tuple[Tensor, Tensor]:
    """The optical flow between two degraded frames, from that between the clean ones, and where it is known.

        moved(p) = c(p) + restore_flow(p + c(p)),  c(p) = flow(p) + optical_flow(p + flow(p))

    What is at p in the first degraded frame is at p + flow(p) in the clean one, moves on by the optical flow there, and
    is then found in the second degraded frame. Frames that one lens has seen take `flow` and `restore_flow` of one
    `Degraded`; of a clip `flow` is that of each frame and `restore_flow` that of the next.

    Args:
        optical_flow: (B, 2, H, W) or (2, H, W), px, floating, from the first clean frame to the second; NaN and inf are
            not known.
        flow: of the first frame, (B, 2, H, W) or (1, 2, H, W), px; (2, H, W) for an unbatched optical flow.
        restore_flow: of the second frame, likewise.
        restore_valid: of the second frame, (B, 1, H, W) or (1, 1, H, W), bool; (1, H, W) for an unbatched optical flow.
            None is everywhere.
        fill: what stands where the optical flow is not known, px, finite.
        interpolation: of the optical flow, "nearest", or "bilinear", which mixes the motions of the two sides of an
            edge; `restore_flow` is read bilinearly.

    Returns:
        moved, in the shape and type of the optical flow, without NaN, and valid, (B, 1, H, W) or (1, H, W), bool: the
        content comes from the clean frame, its motion is known, and leads to where the second degraded frame shows it.

    Raises:
        ValueError: shapes that do not fit, an unknown interpolation, a fill that is not finite.
        TypeError: an argument that is no tensor, an optical flow that is not floating, a mask that is not bool.
    """
    named = {"optical_flow": optical_flow, "flow": flow, "restore_flow": restore_flow}
    for name, value in named.items():
        check_tensor(name, value)
    if optical_flow.ndim == 3 and flow.ndim == 3 and restore_flow.ndim == 3:
        known = None if restore_valid is None else restore_valid[None]
        options: dict[str, Any] = {"restore_valid": known, "fill": fill, "interpolation": interpolation}
        moved, valid = warp_optical_flow(*(value[None] for value in named.values()), **options)
        return moved[0], valid[0]
    check_flow("optical_flow", optical_flow)
    for name in ("flow", "restore_flow"):
        _check_map("optical_flow", optical_flow, named[name], name=name)
    check_choice("interpolation", interpolation, ("nearest", "bilinear"))
    _check_fill(fill, optical_flow.dtype)
    flow, restore_flow = (_beside(optical_flow, value) for value in (flow, restore_flow))
    motion, valid = _follow(optical_flow, flow, interpolation)
    valid = valid & motion.isfinite().all(dim=1, keepdim=True)
    there = flow + torch.where(valid, motion, 0)
    valid = valid & inside(there)
    if restore_valid is not None:
        known = _checked_valid(restore_valid, restore_flow)
        valid = valid & (sample_image(known, there, padding="zeros", interpolation="nearest") > 0.5)
    moved = compose_flows(restore_flow, there).to(optical_flow.dtype)
    valid = valid & moved.isfinite().all(dim=1, keepdim=True)
    return torch.where(valid, moved, fill), valid


def _beside(value: Tensor, flow: Tensor) -> Tensor:
    """A flow in the type of fields beside a map, one for each sample of it."""
    return flow.to(field_dtype(value.dtype)).expand(value.shape[0], -1, -1, -1)


def _checked_valid(restore_valid: Tensor, restore_flow: Tensor) -> Tensor:
    """(B, 1, H, W), 1 where the mask is true, in the type of the flow."""
    check_tensor("restore_valid", restore_valid)
    if restore_valid.dtype is not torch.bool:
        raise TypeError(f"restore_valid must be bool, got {restore_valid.dtype}")
    batch, _, *size = restore_flow.shape
    if restore_valid.shape not in ((batch, 1, *size), (1, 1, *size)):
        raise ValueError(
            f"restore_valid must have shape {(batch, 1, *size)} beside this flow, got {tuple(restore_valid.shape)}"
        )
    return restore_valid.to(restore_flow.dtype).expand(batch, -1, -1, -1)


def _follow(value: Tensor, flow: Tensor, interpolation: str) -> tuple[Tensor, Tensor]:
    """The map looked up, and where the nearest pixel lies on the frame."""
    flow = _beside(value, flow)
    everywhere = torch.ones_like(flow[:, :1])
    on_frame = sample_image(everywhere, flow, padding="zeros", interpolation="nearest") > 0.5
    return sample_image(value, flow, padding="border", interpolation=interpolation), on_frame


def _check_map(what: str, value: Tensor, flow: Tensor, *, name: str = "flow") -> None:
    check_flow(name, flow)
    if value.ndim != 4:
        raise ValueError(f"{what} must have shape (B, C, H, W) beside a batched flow, got {tuple(value.shape)}")
    if value.is_complex():
        raise TypeError(f"{what} must be real, got {value.dtype}")
    if value.shape[2:] != flow.shape[2:] or flow.shape[0] not in (1, value.shape[0]):
        raise ValueError(
            f"{name} must have the batch and the size of {what} {tuple(value.shape)}, got {tuple(flow.shape)}"
        )


def _check_fill(fill: float, dtype: torch.dtype) -> None:
    if dtype.is_floating_point:
        check_number("fill", fill)
        return
    low, high = (0, 1) if dtype is torch.bool else (torch.iinfo(dtype).min, torch.iinfo(dtype).max)
    if not isinstance(fill, int | numbers.Integral) or not low <= fill <= high:
        raise ValueError(f"fill must be a whole number in [{low}, {high}] for {dtype}, got {fill}")

"""Masks, depth maps and optical flow that follow a backward flow."""

import numbers
from typing import Any

import torch
from torch import Tensor

from torchrefract._validation import check_choice, check_flag, check_flow, check_number, check_tensor, eager_values
from torchrefract.warping.flow import compose_flows
from torchrefract.warping.grid import field_dtype, inside
from torchrefract.warping.warp import sample_image

# Types of the same bits, as torch.gather, and before PyTorch 2.15 torch.where, take no unsigned ones but uint8.
_SIGNED = {torch.uint16: torch.int16, torch.uint32: torch.int32, torch.uint64: torch.int64}

_NO_WEIGHT = 1e-3  # of a pixel without a finite value, up to which it does not count


def warp_mask(mask: Tensor, flow: Tensor, *, fill: float = 0, soft: bool = False) -> Tensor:
    """Warp a segmentation mask along a backward flow: each pixel takes the class of the nearest input pixel.

    Args:
        mask: (B, C, H, W) or (C, H, W), an integer type, bool or floating; integers keep every bit.
        flow: (B, 2, H, W) or (1, 2, H, W), px; (2, H, W) for an unbatched mask.
        fill: value of pixels whose nearest input pixel lies outside the frame; the dtype of the mask must hold it.
        soft: interpolate bilinearly instead, for probabilities in a floating mask.

    Returns:
        The warped mask, of the same shape and dtype.

    Raises:
        ValueError: if shapes do not fit, or the dtype cannot hold `fill`.
        TypeError: if an argument is not a tensor, or a soft mask is not floating.
    """
    check_tensor("mask", mask)
    check_tensor("flow", flow)
    check_flag("soft", soft)
    if soft and not mask.is_floating_point():
        raise TypeError(f"mask must be floating if soft=True, got {mask.dtype}")
    if mask.ndim == 3 and flow.ndim == 3:
        return warp_mask(mask[None], flow[None], fill=fill, soft=soft)[0]
    _check_map("mask", mask, flow)
    _check_fill(fill, mask.dtype)
    warped, in_frame = _warp_map(mask, flow, "bilinear" if soft else "nearest")
    outside = torch.full_like(warped, fill)
    if mask.dtype in _SIGNED:
        return torch.where(in_frame, _bits(warped), _bits(outside)).view(mask.dtype)
    return torch.where(in_frame, warped, outside)


def warp_depth(
    depth: Tensor, flow: Tensor, *, fill: float = 0.0, interpolation: str = "nearest"
) -> tuple[Tensor, Tensor]:
    """Warp a depth map along a backward flow.

    Args:
        depth: (B, 1, H, W) or (1, H, W), m, floating; inf is the sky, NaN is unknown.
        flow: as for `warp_mask`.
        fill: value of invalid pixels, m, finite.
        interpolation: "nearest", or "bilinear", which mixes the distances on both sides of an edge.

    Returns:
        depth: the warped depth map, of the same shape and dtype, without NaN.
        valid: bool, of the same shape: the nearest input pixel lies in the frame, and no depth used is NaN. If
            interpolated, NaN and inf count from a weight of 1/1000 on.

    Raises:
        ValueError, TypeError: as for `warp_mask`; an unknown interpolation, a `fill` that is not finite.
    """
    check_tensor("depth", depth)
    check_tensor("flow", flow)
    if depth.ndim == 3 and flow.ndim == 3:
        warped, valid = warp_depth(depth[None], flow[None], fill=fill, interpolation=interpolation)
        return warped[0], valid[0]
    _check_map("depth", depth, flow)
    if depth.shape[1] != 1:
        raise ValueError(f"depth must have one channel, got {tuple(depth.shape)}")
    if not depth.is_floating_point():
        raise TypeError(f"depth must be of a floating type, got {depth.dtype}")
    check_choice("interpolation", interpolation, ("nearest", "bilinear"))
    _check_fill(fill, depth.dtype)
    warped, in_frame = _warp_map(depth, flow, interpolation)
    valid = in_frame & ~warped.isnan()
    return torch.where(valid, warped, torch.full_like(warped, fill)), valid


def warp_optical_flow(
    optical_flow: Tensor,
    flow: Tensor,
    restore_flow: Tensor,
    *,
    restore_valid: Tensor | None = None,
    fill: float = 0.0,
    interpolation: str = "nearest",
) -> tuple[Tensor, Tensor]:
    """Convert the optical flow between two clean frames to the optical flow between the two degraded frames.

        warped(p) = c(p) + restore_flow(p + c(p)),  c(p) = flow(p) + optical_flow(p + flow(p))

    Pixel p of the first degraded frame shows the clean position p + flow(p). The optical flow moves that position to
    the second clean frame, and `restore_flow` maps it to the second degraded frame. If one lens degraded both frames,
    take `flow` and `restore_flow` from one `Degraded`; for a clip, take `restore_flow` from the next frame.

    Args:
        optical_flow: (B, 2, H, W) or (2, H, W), px, floating, from the first clean frame to the second; NaN and inf are
            unknown.
        flow, restore_flow: as for `warp_mask`; of the first frame, and the restore flow of the second.
        restore_valid: validity of `restore_flow`, (B, 1, H, W) or (1, 1, H, W), bool; (1, H, W) for an unbatched
            optical flow. None means valid everywhere.
        fill, interpolation: of the optical flow, as for `warp_depth`, in px; `restore_flow` is always interpolated
            bilinearly.

    Returns:
        warped: the optical flow between the degraded frames, of the same shape and dtype, without NaN.
        valid: (B, 1, H, W) or (1, H, W), bool: the pixel shows a part of the clean frame, its motion is known, and the
            second degraded frame shows where it leads.

    Raises:
        ValueError, TypeError: as for `warp_depth`; a mask that is not bool.
    """
    flows = {"optical_flow": optical_flow, "flow": flow, "restore_flow": restore_flow}
    for name, value in flows.items():
        check_tensor(name, value)
    if optical_flow.ndim == 3 and flow.ndim == 3 and restore_flow.ndim == 3:
        mask = None if restore_valid is None else restore_valid[None]
        options: dict[str, Any] = {"restore_valid": mask, "fill": fill, "interpolation": interpolation}
        warped, valid = warp_optical_flow(*(value[None] for value in flows.values()), **options)
        return warped[0], valid[0]
    check_flow("optical_flow", optical_flow)
    for name in ("flow", "restore_flow"):
        _check_map("optical_flow", optical_flow, flows[name], flow_name=name)
    check_choice("interpolation", interpolation, ("nearest", "bilinear"))
    _check_fill(fill, optical_flow.dtype)
    flow, restore_flow = (_flow_for(optical_flow, value) for value in (flow, restore_flow))
    motion, valid = _warp_map(optical_flow, flow, interpolation)
    valid = valid & motion.isfinite().all(dim=1, keepdim=True)
    displacement = flow + torch.where(valid, motion, 0)
    valid = valid & inside(displacement)
    if restore_valid is not None:
        mask = _validity(restore_valid, restore_flow)
        valid = valid & (sample_image(mask, displacement, padding="zeros", interpolation="nearest") > 0.5)
    warped = compose_flows(restore_flow, displacement).to(optical_flow.dtype)
    valid = valid & warped.isfinite().all(dim=1, keepdim=True)
    return torch.where(valid, warped, fill), valid


def _flow_for(value: Tensor, flow: Tensor) -> Tensor:
    """Return the flow with the batch of a map, in the dtype of coordinates."""
    return flow.to(field_dtype(value.dtype)).expand(value.shape[0], -1, -1, -1)


def _validity(restore_valid: Tensor, restore_flow: Tensor) -> Tensor:
    """Check a mask and return it as (B, 1, H, W) in the dtype of the flow."""
    if check_tensor("restore_valid", restore_valid).dtype is not torch.bool:
        raise TypeError(f"restore_valid must be bool, got {restore_valid.dtype}")
    batch, _, *size = restore_flow.shape
    if restore_valid.shape not in ((batch, 1, *size), (1, 1, *size)):
        raise ValueError(f"restore_valid must have shape {(batch, 1, *size)}, got {tuple(restore_valid.shape)}")
    return restore_valid.to(restore_flow.dtype).expand(batch, -1, -1, -1)


def _warp_map(value: Tensor, flow: Tensor, interpolation: str) -> tuple[Tensor, Tensor]:
    """Return the warped map and the mask of pixels whose nearest input pixel lies in the frame."""
    flow = _flow_for(value, flow)
    ones = torch.ones_like(flow[:, :1])
    in_frame = sample_image(ones, flow, padding="zeros", interpolation="nearest") > 0.5
    if not value.is_floating_point() and value.dtype.itemsize >= 4:
        return _nearest_integers(value, flow), in_frame
    if interpolation == "nearest" or eager_values(value.isfinite().all, of=value):
        return sample_image(value, flow, padding="border", interpolation=interpolation), in_frame
    # NaN and infinity times a weight of 0 are NaN, so their weights are sampled on their side.
    parts = [torch.where(value.isfinite(), value, 0), value.isnan().to(value.dtype), value.isinf().to(value.dtype)]
    sampled = sample_image(torch.cat(parts, dim=1), flow, padding="border", interpolation="bilinear")
    finite, nan, infinite = sampled.chunk(3, dim=1)
    mixed = torch.where(infinite > _NO_WEIGHT, torch.inf, finite)
    return torch.where(nan > _NO_WEIGHT, torch.nan, mixed), in_frame


def _nearest_integers(value: Tensor, flow: Tensor) -> Tensor:
    """Sample integers of 32 or 64 bits, which the sampler's floating types cannot hold, by the indices of pixels."""
    height, width = value.shape[2:]
    index = torch.arange(height * width, dtype=torch.float64, device=value.device).view(1, 1, height, width)
    index = index.expand(flow.shape[0], -1, -1, -1)
    index = sample_image(index, flow, padding="border", interpolation="nearest").long().flatten(2)
    chosen = _bits(value).flatten(2).gather(2, index.expand(-1, value.shape[1], -1))
    return chosen.view(value.shape).view(value.dtype)


def _bits(value: Tensor) -> Tensor:
    return value.view(_SIGNED.get(value.dtype, value.dtype))


def _check_map(name: str, value: Tensor, flow: Tensor, *, flow_name: str = "flow") -> None:
    """Raise unless `value` is a real map (B, C, H, W) and the flow fits it."""
    check_flow(flow_name, flow)
    if value.ndim != 4:
        raise ValueError(f"{name} must have shape (B, C, H, W) for a batched flow, got {tuple(value.shape)}")
    if value.is_complex():
        raise TypeError(f"{name} must be real, got {value.dtype}")
    if value.shape[2:] != flow.shape[2:] or flow.shape[0] not in (1, value.shape[0]):
        raise ValueError(
            f"{flow_name} must have the batch and the size of {name} {tuple(value.shape)}, got {tuple(flow.shape)}"
        )


def _check_fill(fill: float, dtype: torch.dtype) -> None:
    """Raise unless the dtype can hold the fill value."""
    if dtype.is_floating_point:
        check_number("fill", fill)
        return
    low, high = (0, 1) if dtype is torch.bool else (torch.iinfo(dtype).min, torch.iinfo(dtype).max)
    if not isinstance(fill, int | numbers.Integral) or not low <= fill <= high:
        raise ValueError(f"fill must be a whole number in [{low}, {high}] for {dtype}, got {fill}")

"""Labels of torchvision, in any nesting, that follow a flow."""

import datetime
import enum
import importlib
import math
import numbers
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from torchrefract._validation import check_choice, check_flag, check_tensor, eager_bool
from torchrefract.labels.boxes import check_policy, warp_boxes, warp_outlines
from torchrefract.labels.maps import warp_mask
from torchrefract.labels.points import STEPS, TOLERANCE_PX, check_rows, land, on_frame
from torchrefract.labels.rows import companions, hide, is_tv, kept, siblings_of, wrapped
from torchrefract.warping.resample import INTERPOLATIONS, PADDINGS, warp

# What rides along with a sample and has no place in the image.
_PLAIN = (
    *(type(None), str, bytes, numbers.Number, np.generic, np.ndarray),
    *(enum.Enum, os.PathLike, datetime.date, datetime.time, datetime.timedelta),
)
_SAMPLES = 64


class _Options(NamedTuple):
    min_area: float = 0.0
    min_visibility: float = 0.0
    clip: bool = True
    drop: bool = True
    soft_masks: bool = False
    mask_fill: float = 0
    padding: str = "zeros"
    interpolation: str = "bilinear"
    leave: bool = False  # samples as they are that the flow leaves where they are


class _Moved(NamedTuple):
    value: Any
    flags: Tensor | None = None  # of boxes: which to keep; of keypoints: which are visible


def warp_labels(
    target: Any,
    flow: Tensor,
    *,
    min_area: float = 0.0,
    min_visibility: float = 0.0,
    clip: bool = True,
    drop: bool = True,
    labels_getter: str | Callable[[Any], Any] | None = "default",
    soft_masks: bool = False,
    mask_fill: float = 0,
    padding: str = "zeros",
    interpolation: str = "bilinear",
) -> Any:
    """The target in its nesting, with all that has a place in the image moved along a flow.

    `Image`, `Video`, `Mask`, `BoundingBoxes` of every format and `KeyPoints` of torchvision follow the flow and come
    back as what they were. Plain tensors, arrays, numbers, strings, paths, dates and None pass through; anything else
    raises. Boxes are measured from the edge of the first pixel and keypoints from its center, as torchvision's flips
    and clamps do. Boxes and keypoints of whole numbers are rounded.

    Boxes that the limits reject are dropped as by `SanitizeBoundingBoxes`, which reads values and so waits for an
    accelerator: with them go their rows of the labels and of the instance masks, (N, H, W), in the same dict. With
    `drop` off they stay, without an area. A rotated box is the smallest around its warped outline that has the
    direction of its warped top and bottom. A keypoint that is not seen lies off the canvas: where it lands, or else
    at (-1, -1); a plain tensor "visible" or "visibility" in the same dict, with an entry for each keypoint, is zeroed.

    Args:
        target: dicts, lists, tuples and named tuples in any nesting.
        flow: (2, H, W), px, backward, the flow of one sample; or (B, 2, H, W) for a batch, which is either a list or
            tuple of B samples, or anything else whose tensors have a leading dimension B (boxes never do).
        min_area, min_visibility, clip: as for `warp_boxes`.
        drop: remove the boxes that are not worth keeping, instead of leaving them without an area.
        labels_getter: what is dropped along: "default", the tensor under the key "labels", or else under one that
            contains "label", beside the boxes in a dict; a function of a sample that returns one or several tensors;
            None, nothing.
        soft_masks: look floating masks up bilinearly.
        mask_fill: what masks show outside.
        padding, interpolation: of images and videos, as for `warp`.

    Raises:
        TypeError: something in the target that could not be moved and is not plain; labels of boxes to drop that are
            no tensor.
        ValueError: shapes that do not fit, options out of their range, boxes to drop outside of a dict, where
            what belongs to them cannot be known (boxes alone may be dropped).
    """
    check_tensor("flow", flow)
    if flow.ndim not in (3, 4) or flow.shape[-3] != 2:
        raise ValueError(f"flow must have shape (2, H, W) or (B, 2, H, W), got {tuple(flow.shape)}")
    check_policy(min_area, min_visibility, clip)
    check_flag("drop", drop)
    check_flag("soft_masks", soft_masks)
    check_choice("padding", padding, PADDINGS)
    check_choice("interpolation", interpolation, INTERPOLATIONS)
    if labels_getter is not None and labels_getter != "default" and not callable(labels_getter):
        raise ValueError(f"labels_getter must be 'default', a function or None, got {labels_getter!r}")
    options = _Options(min_area, min_visibility, clip, drop, soft_masks, mask_fill, padding, interpolation)
    return _warp_target(target, flow, options, labels_getter)


def follow(target: Any, flow: Tensor) -> Any:
    """As by `warp_labels`, but labels of a sample that stays where it is are neither clipped nor filtered."""
    return _warp_target(target, flow, _Options(leave=True), "default")


def _warp_target(target: Any, flow: Tensor, options: _Options, labels_getter: Any) -> Any:
    if flow.ndim == 4 and type(target) in (list, tuple):
        if len(target) != flow.shape[0]:
            raise ValueError(f"target must have one sample for each of the {flow.shape[0]} flows, got {len(target)}")
        samples = zip(target, flow, strict=True)
        return type(target)(_warp_sample(sample, one, options, labels_getter) for sample, one in samples)
    return _warp_sample(target, flow, options, labels_getter)


def _warp_sample(sample: Any, flow: Tensor, options: _Options, labels_getter: Any) -> Any:
    still = (flow == 0).flatten(-3).all(dim=-1) if options.leave else None
    if still is not None and eager_bool(still.all, of=still):
        return sample
    pairs, spec = pytree.tree_flatten_with_path(sample)
    paths, leaves = [path for path, _ in pairs], [leaf for _, leaf in pairs]
    moved = [_move(leaf, flow, options) for leaf in leaves]
    if still is not None and eager_bool(still.any, of=still) is not False:
        moved = [_left(leaf, one, still) for leaf, one in zip(leaves, moved, strict=True)]
    values = [one.value for one in moved]
    for i, one in enumerate(moved):
        if one.flags is None:
            continue
        siblings = siblings_of(paths, i)
        if not is_tv(leaves[i], "BoundingBoxes"):
            hide(values, leaves, siblings, one.flags)
        elif options.drop:
            for k in companions(sample, paths, leaves, siblings, i, labels_getter):
                values[k] = kept(values[k], one.flags)
    return pytree.tree_unflatten(values, spec)


def _left(leaf: Any, moved: _Moved, still: Tensor) -> _Moved:
    """What is moved of a leaf, but for the samples, () or (B,), that stay where they are."""
    if moved.value is leaf:
        return moved

    def rows(value: Tensor) -> Tensor:
        return still.to(value.device).view(*still.shape, *[1] * (value.ndim - still.ndim))

    before, after = (value.as_subclass(Tensor) for value in (leaf, moved.value))
    flags = None if moved.flags is None else moved.flags | rows(moved.flags)
    return _Moved(wrapped(torch.where(rows(after), before, after), leaf), flags)


def _move(leaf: Any, flow: Tensor, options: _Options) -> _Moved:
    """One leaf of a sample, moved; flow is (2, H, W), or (B, 2, H, W) for leaves with a leading B."""
    if is_tv(leaf, "Image") or is_tv(leaf, "Video"):
        maps = _as_batch(leaf, flow)
        image, _ = warp(maps, _batched(flow), padding=options.padding, interpolation=options.interpolation)
        return _Moved(wrapped(image.reshape(leaf.shape), leaf))
    if is_tv(leaf, "Mask"):
        maps, soft = _as_batch(leaf, flow), options.soft_masks and leaf.is_floating_point()
        mask = warp_mask(maps, _batched(flow), fill=options.mask_fill, soft=soft)
        return _Moved(wrapped(mask.reshape(leaf.shape), leaf))
    if is_tv(leaf, "KeyPoints"):
        return _move_keypoints(leaf, flow)
    if is_tv(leaf, "BoundingBoxes"):
        return _move_boxes(leaf, flow, options)
    if type(leaf) in (Tensor, torch.nn.Parameter) or (isinstance(leaf, _PLAIN) and not isinstance(leaf, Tensor)):
        return _Moved(leaf)
    kind = f"{type(leaf).__module__}.{type(leaf).__qualname__}"
    raise TypeError(f"target must hold what is known how to move, or plain values, got {kind}")


def _move_keypoints(keypoints: Any, flow: Tensor) -> _Moved:
    _check_canvas(keypoints, flow)
    plain, batch = keypoints.as_subclass(Tensor), _batched(flow)
    _check_batch(plain, flow)
    rows = plain.reshape(batch.shape[0], plain[..., 0].numel() // batch.shape[0], 2)
    check_rows("keypoints", rows, batch, 2)
    points, found, upright = land(rows, batch, STEPS, TOLERANCE_PX)
    # A keypoint may lie on the outer half of a pixel at the border, which has no center beyond it.
    on_canvas = on_frame(points, batch, 0.5)
    visible = found & upright & on_canvas
    points = torch.where((visible | ~on_canvas)[..., None], points, -1)
    value = _cast(points.reshape(plain.shape), plain.dtype)
    return _Moved(wrapped(value, keypoints), visible.reshape(plain.shape[:-1]))


def _move_boxes(boxes: Any, flow: Tensor, options: _Options) -> _Moved:
    _check_canvas(boxes, flow)
    if flow.ndim == 4:
        raise ValueError(f"target must be a list of samples to hold boxes beside a batch of flows, got {type(boxes)}")
    plain = boxes.as_subclass(Tensor)
    plain = plain if plain.is_floating_point() else plain.to(flow.dtype)
    if boxes.format.name in ("XYWHR", "CXCYWHR", "XYXYXYXY"):
        moved, keep = _move_rotated(plain, boxes.format.name, flow, options)
    else:
        corners = _convert(plain, boxes.format.name, "XYXY") - 0.5
        policy = {"min_area": options.min_area, "min_visibility": options.min_visibility}
        moved, keep = warp_boxes(corners, flow, clip=options.clip, samples=_SAMPLES, **policy)
        if not options.drop:
            moved = torch.where(keep[:, None], moved, moved[:, :2].repeat(1, 2))
        moved = _convert(moved + 0.5, "XYXY", boxes.format.name)
    return _Moved(wrapped(_cast(moved, boxes.dtype), boxes), keep)


def _move_rotated(plain: Tensor, form: str, flow: Tensor, options: _Options) -> tuple[Tensor, Tensor]:
    corners = _convert(plain, form, "XYXYXYXY").reshape(1, -1, 4, 2) - 0.5
    outlines = warp_outlines(corners, flow[None], samples=_SAMPLES)
    axes = _axes(outlines.points, outlines.found, corners)
    extent = outlines.extent(axes)
    keep = extent.keep(options.min_area, options.min_visibility)
    low, high = extent.clipped if options.clip else extent.whole
    if not options.drop:
        high = torch.where(keep[..., None], high, low)
    ends = torch.stack([low, torch.stack([high[..., 0], low[..., 1]], dim=-1), high], dim=2)
    ends = torch.cat([ends, torch.stack([low[..., 0], high[..., 1]], dim=-1)[:, :, None]], dim=2)
    # Back from the box's own axes: the transpose of a rotation.
    moved = (ends[..., None] * axes[:, :, None]).sum(dim=-2)
    return _convert(moved[0].flatten(1) + 0.5, "XYXYXYXY", form), keep[0]


def _axes(points: Tensor, found: Tensor, corners: Tensor) -> Tensor:
    """(B, N, 2, 2), unit vectors along and across the warped boxes: along the first edge and against the third."""
    steps = points.diff(dim=3) * (found[..., 1:] & found[..., :-1])[..., None]
    along = steps[:, :, 0].sum(dim=2) - steps[:, :, 2].sum(dim=2)
    before = corners[:, :, 1] - corners[:, :, 0]
    along = torch.where(_length(along) > 1e-6, along, before.to(along.dtype))
    still = torch.tensor([1.0, 0.0], dtype=along.dtype, device=along.device)
    along = torch.where(_length(along) > 1e-6, along, still)
    along = along / _length(along)
    return torch.stack([along, torch.stack([-along[..., 1], along[..., 0]], dim=-1)], dim=2)


def _length(vector: Tensor) -> Tensor:
    return vector.detach().square().sum(dim=-1, keepdim=True).sqrt()


def _convert(boxes: Tensor, old: str, new: str) -> Tensor:
    convert = importlib.import_module("torchvision.transforms.v2.functional").convert_bounding_box_format
    return convert(boxes, old_format=old, new_format=new)


def _cast(value: Tensor, dtype: torch.dtype) -> Tensor:
    return value.to(dtype) if dtype.is_floating_point else value.round().to(dtype)


def _batched(flow: Tensor) -> Tensor:
    return flow if flow.ndim == 4 else flow[None]


def _as_batch(leaf: Any, flow: Tensor) -> Tensor:
    """The maps of a leaf (..., H, W) as channels, (B, C, H, W), B being that of the flow or 1."""
    plain = leaf.as_subclass(Tensor)
    if plain.shape[-2:] != flow.shape[-2:]:
        size = f"{tuple(flow.shape[-2:])}, got {tuple(plain.shape)}"
        raise ValueError(f"{type(leaf).__name__} must have the size of the flow, {size}")
    _check_batch(plain, flow)
    channels = math.prod(plain.shape[:-2]) // (flow.shape[0] if flow.ndim == 4 else 1)
    return plain.reshape(_batched(flow).shape[0], channels, *plain.shape[-2:])


def _check_batch(plain: Tensor, flow: Tensor) -> None:
    if flow.ndim == 4 and (plain.ndim < 3 or plain.shape[0] != flow.shape[0]):
        raise ValueError(f"target must have a batch of {flow.shape[0]} like flow, got {tuple(plain.shape)}")


def _check_canvas(leaf: Any, flow: Tensor) -> None:
    if tuple(leaf.canvas_size) != tuple(flow.shape[-2:]):
        size = f"{tuple(flow.shape[-2:])}, got {tuple(leaf.canvas_size)}"
        raise ValueError(f"{type(leaf).__name__} must have the canvas of the flow, {size}")

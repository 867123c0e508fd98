"""Labels in torchvision's tensor types, in any nesting, that follow a backward flow."""

import datetime
import enum
import importlib
import math
import numbers
import os
import sys
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from torchrefract._validation import check_choice, check_flag, check_tensor, eager_values, warn
from torchrefract.labels.boxes import check_box_limits, warp_boxes, warp_outlines
from torchrefract.labels.maps import warp_mask
from torchrefract.labels.plain_values import check_moves, name_of
from torchrefract.labels.points import check_coordinates, in_frame, solve_points
from torchrefract.warping.warp import INTERPOLATIONS, PADDINGS, warp

# Formats of rotated boxes, by their names in torchvision.
ROTATED = ("XYWHR", "CXCYWHR", "XYXYXYXY")
# Values without a position in the image, which pass unchanged.
_PLAIN = (
    *(type(None), str, bytes, numbers.Number, np.generic, np.ndarray),
    *(enum.Enum, os.PathLike, datetime.date, datetime.time, datetime.timedelta),
)
_VISIBILITY_KEYS = ("visible", "visibility", "visibilities", "keypoints_visible", "keypoint_visibility")
# Parts of names of values that describe the image or the camera, never one box.
_OF_IMAGE = ("image", "img", "orig", "camera", "intrinsic", "extrinsic", "calib")
_OF_IMAGE += ("_shape", "canvas", "resolution", "scale_factor", "ratio_pad")
_MOVES_WITH_IMAGE = ("semantic", "sem_seg", "depth", "lane", "polyline")  # of masks, points and lists of them


class _Options(NamedTuple):
    min_area: float = 0.0
    min_visibility: float = 0.0
    clip: bool = True
    drop: bool = True
    labels_getter: str | Callable[[Any], Any] | None = "default"
    soft_masks: bool = False
    mask_fill: float = 0
    padding: str = "zeros"
    interpolation: str = "bilinear"
    keep_unmoved: bool = False  # return samples whose flow is zero unchanged


class _Warped(NamedTuple):
    value: Any
    flags: Tensor | None = None  # of boxes: the boxes to keep; of keypoints: the visible ones


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
    """Warp all labels of a nested target along a backward flow.

    `Image`, `Video`, `Mask`, `BoundingBoxes` of every format and `KeyPoints` of torchvision are warped and keep their
    type. Plain tensors, arrays, numbers, strings, paths, dates and None pass unchanged. Boxes are measured from the
    edge of the first pixel and keypoints from its center, as in torchvision's flips and clamps. Integer boxes and
    keypoints are rounded.

    With `drop`, boxes below the limits are removed as by `SanitizeBoundingBoxes`, together with their rows of every
    tensor, array and list that has as many rows as there are boxes, as labels, areas, keypoints, instance masks,
    (N, H, W), and lists of a dict, mask or tensor for each box. They lie anywhere in the sample or, if it holds several
    `BoundingBoxes`, in the dict, list or tuple of the boxes. Images stay as they are, and so do sizes and values whose
    name says that they belong to the image or to the camera, as "image_id", and semantic masks, depth and lanes.
    `labels_getter` replaces this rule.
    Dropping reads values, so it waits for an accelerator. Without `drop`, these boxes stay and have zero area.

    A rotated box becomes the smallest box around its warped outline that has the direction of the warped top and bottom
    edges. An invisible keypoint gets its position off the canvas, or (-1, -1) if it has none. A plain tensor, array or
    list "visible", "visibility" or "keypoints_visible" in the same dict, with one entry for each keypoint, is set to
    zero for invisible keypoints.

    Args:
        target: nested dicts, lists, tuples and named tuples.
        flow: (2, H, W), px, backward, for one sample; or (B, 2, H, W) for a batch. A batch is a list or tuple of B
            samples, or any other target whose tensors have a leading dimension B (not for boxes).
        min_area, min_visibility, clip: see `warp_boxes`.
        drop: remove boxes that `warp_boxes` does not keep, instead of giving them zero area.
        labels_getter: what to filter together with the boxes and the instance masks: "default" takes all that have
            one row for each box; a function takes the sample and returns one tensor or several; None takes nothing.
        soft_masks: interpolate floating masks bilinearly.
        mask_fill: value of masks outside the frame.
        padding, interpolation: of images and videos, see `warp`.

    Returns:
        The warped target, in the same nesting.

    Raises:
        TypeError: if the target holds an unsupported type, or a plain value under a name such as boxes, gt_bboxes,
            masks, polygons, lanes or keypoints, or of the size of the frame, which would not move.
        ValueError: if shapes do not fit, an option is out of range, or it is not clear which rows belong to a box.
    """
    check_tensor("flow", flow)
    if flow.ndim not in (3, 4) or flow.shape[-3] != 2:
        raise ValueError(f"flow must have shape (2, H, W) or (B, 2, H, W), got {tuple(flow.shape)}")
    check_box_limits(min_area, min_visibility, clip)
    check_flag("drop", drop)
    check_flag("soft_masks", soft_masks)
    check_choice("padding", padding, PADDINGS)
    check_choice("interpolation", interpolation, INTERPOLATIONS)
    check_labels_getter(labels_getter)
    options = _Options(
        min_area, min_visibility, clip, drop, labels_getter, soft_masks, mask_fill, padding, interpolation
    )
    return _warp_target(target, flow, options)


def warp_moved_labels(target: Any, flow: Tensor, labels_getter: Any = "default", *, mask_fill: float = 0) -> Any:
    """Warp labels like `warp_labels`, but return samples whose flow is zero unchanged: neither clipped nor dropped."""
    options = _Options(keep_unmoved=True, labels_getter=check_labels_getter(labels_getter), mask_fill=mask_fill)
    return _warp_target(target, flow, options)


def check_labels_getter(labels_getter: Any) -> Any:
    """Return `labels_getter` if it is "default", a function or None."""
    if labels_getter is not None and labels_getter != "default" and not callable(labels_getter):
        raise ValueError(f"labels_getter must be 'default', a function or None, got {labels_getter!r}")
    return labels_getter


def is_tv_tensor(value: Any, *names: str) -> bool:
    """Return True if a value has a torchvision type of one of the names; torchvision is not imported for it."""
    module = sys.modules.get("torchvision.tv_tensors")
    return isinstance(value, tuple([getattr(module, name, ()) for name in names]))


def wrap_like(value: Tensor, like: Any) -> Any:
    """Return the tensor in the torchvision type, and with the metadata, of `like`."""
    return sys.modules["torchvision.tv_tensors"].wrap(value, like=like)


def _warp_target(target: Any, flow: Tensor, options: _Options) -> Any:
    if flow.ndim == 4 and type(target) in (list, tuple):
        if len(target) != flow.shape[0]:
            raise ValueError(f"target must have one sample for each of the {flow.shape[0]} flows, got {len(target)}")
        return type(target)(_warp_sample(*pair, options) for pair in zip(target, flow, strict=True))
    return _warp_sample(target, flow, options)


def _warp_sample(sample: Any, flow: Tensor, options: _Options) -> Any:
    pairs, spec = pytree.tree_flatten_with_path(sample, is_leaf=_is_plain_list)
    paths, leaves = [path for path, _ in pairs], [leaf for _, leaf in pairs]
    for i, (path, leaf) in enumerate(pairs):
        siblings = {name: leaves[k] for name, k in _siblings(paths, i).items()}
        check_moves(path, leaf, siblings, (flow.shape[-2], flow.shape[-1]))
    counts = {leaf.shape[0] for leaf in leaves if is_tv_tensor(leaf, "BoundingBoxes")} if options.drop else set()
    if counts:
        pairs, spec = pytree.tree_flatten_with_path(
            sample, is_leaf=lambda node: _is_plain_list(node) or _has_entries_of_boxes(node, counts)
        )
        paths, leaves = [path for path, _ in pairs], [leaf for _, leaf in pairs]
    is_zero = (flow == 0).flatten(-3).all(dim=-1) if options.keep_unmoved else None
    if is_zero is not None and eager_values(is_zero.all, of=is_zero):
        return sample
    warped = [_warp_leaf(leaf, flow, options) for leaf in leaves]
    if is_zero is not None and eager_values(is_zero.any, of=is_zero) is not False:
        warped = [_restore_unmoved(leaf, one, is_zero) for leaf, one in zip(leaves, warped, strict=True)]
    values = [one.value for one in warped]
    boxes = [i for i, leaf in enumerate(leaves) if is_tv_tensor(leaf, "BoundingBoxes") and leaf.shape != (1, 0)]
    for i, one in enumerate(warped):
        if one.flags is not None and i not in boxes:
            _clear_visibility(values, leaves, _siblings(paths, i), one.flags)
    for i in boxes if options.drop else []:
        flags = cast(Tensor, warped[i].flags)
        for k in _rows_of_boxes(sample, paths, leaves, boxes, i, options.labels_getter):
            if options.labels_getter == "default" and _looks_like_camera_matrix(leaves[k]) and not flags.all():
                warn(
                    f"target{pytree.keystr(paths[k])} has as many rows as there are boxes and lost those of removed "
                    "boxes; if it is a matrix of the camera, say so in its name ('camera_...') or pass labels_getter"
                )
            values[k] = _select(values[k], flags)
    return pytree.tree_unflatten(values, spec)


def _is_plain_list(node: Any) -> bool:
    """Return True for a list or tuple, of any depth, that holds plain values only."""
    return type(node) in (list, tuple) and all(_is_plain_value(value) or _is_plain_list(value) for value in node)


def _has_entries_of_boxes(node: Any, counts: set[int]) -> bool:
    """Return True for a list or tuple, of one of these lengths, of dicts or tensors that may belong to a box each."""
    if type(node) not in (list, tuple) or len(node) not in counts:
        return False
    if all(isinstance(entry, dict) for entry in node):
        return not any(is_tv_tensor(leaf, "BoundingBoxes") for leaf in pytree.tree_leaves(node))
    return all(
        isinstance(entry, Tensor)
        and _num_rows(entry) != len(node)
        and not is_tv_tensor(entry, "BoundingBoxes", "Image", "Video")
        for entry in node
    )


def _is_plain_value(value: Any) -> bool:
    return isinstance(value, _PLAIN) and not isinstance(value, Tensor)


def _restore_unmoved(leaf: Any, warped: _Warped, is_zero: Tensor) -> _Warped:
    """Replace the samples, () or (B,), whose flow is zero by the original ones."""
    if warped.value is leaf or isinstance(leaf, list | tuple):  # the entries of a list are restored one by one
        return warped

    def mask(value: Tensor) -> Tensor:
        return is_zero.to(value.device).view(*is_zero.shape, *[1] * (value.ndim - is_zero.ndim))

    before, after = (value.as_subclass(Tensor) for value in (leaf, warped.value))
    flags = None if warped.flags is None else warped.flags | mask(warped.flags)
    return _Warped(wrap_like(torch.where(mask(after), before, after), leaf), flags)


def _warp_leaf(leaf: Any, flow: Tensor, options: _Options) -> _Warped:
    """Warp one leaf of a sample; flow is (2, H, W), or (B, 2, H, W) for leaves with a leading dimension B."""
    if is_tv_tensor(leaf, "Image", "Video"):
        sampling = {"padding": options.padding, "interpolation": options.interpolation}
        return _Warped(wrap_like(warp(_as_batch(leaf, flow), _batched(flow), **sampling)[0].reshape(leaf.shape), leaf))
    if is_tv_tensor(leaf, "Mask"):
        soft = options.soft_masks and leaf.is_floating_point()
        mask = warp_mask(_as_batch(leaf, flow), _batched(flow), fill=options.mask_fill, soft=soft)
        return _Warped(wrap_like(mask.reshape(leaf.shape), leaf))
    if is_tv_tensor(leaf, "KeyPoints"):
        return _warp_keypoints(leaf, flow)
    if is_tv_tensor(leaf, "BoundingBoxes"):
        return _warp_bounding_boxes(leaf, flow, options)
    if type(leaf) in (Tensor, torch.nn.Parameter) or _is_plain_value(leaf) or _is_plain_list(leaf):
        return _Warped(leaf)
    if type(leaf) in (list, tuple):
        return _Warped(type(leaf)(_warp_sample(entry, flow, options) for entry in leaf))
    kind = f"{type(leaf).__module__}.{type(leaf).__qualname__}"
    raise TypeError(f"target must hold tv_tensors of torchvision or plain values, got {kind}")


def _warp_keypoints(keypoints: Any, flow: Tensor) -> _Warped:
    _check_canvas(keypoints, flow)
    plain, batch = keypoints.as_subclass(Tensor), _batched(flow)
    _check_batch(plain, flow)
    rows = plain.reshape(batch.shape[0], plain[..., 0].numel() // batch.shape[0], 2)
    check_coordinates("keypoints", rows, batch, 2)
    points, converged, upright = solve_points(rows, batch)
    # A keypoint may lie on the outer half of a border pixel.
    on_canvas = in_frame(points, batch, 0.5)
    visible = converged & upright & on_canvas
    points = torch.where((visible | ~on_canvas)[..., None], points, -1)
    value = _cast(points.reshape(plain.shape), plain.dtype)
    return _Warped(wrap_like(value, keypoints), visible.reshape(plain.shape[:-1]))


def _warp_bounding_boxes(boxes: Any, flow: Tensor, options: _Options) -> _Warped:
    _check_canvas(boxes, flow)
    if flow.ndim == 4:
        raise ValueError("target must be a list of samples if it holds boxes and flow is a batch, got BoundingBoxes")
    plain = boxes.as_subclass(Tensor)
    if plain.shape == (1, 0):  # torchvision makes this of an empty list
        return _Warped(boxes)
    if len(plain) == 0:
        return _Warped(boxes, torch.ones(0, dtype=torch.bool, device=plain.device))
    plain = plain if plain.is_floating_point() else plain.to(flow.dtype)
    if boxes.format.name in ROTATED:
        warped, keep = _warp_rotated_boxes(plain, boxes.format.name, flow, options)
        warped = _cast(warped, boxes.dtype)
    else:
        corners = convert_boxes(plain, boxes.format.name, "XYXY") - 0.5
        warped, keep = warp_boxes(
            corners, flow, min_area=options.min_area, min_visibility=options.min_visibility, clip=options.clip
        )
        if not options.drop:
            warped = torch.where(keep[:, None], warped, warped[:, :2].repeat(1, 2))
        warped = _cast(convert_boxes(warped + 0.5, "XYXY", boxes.format.name), boxes.dtype)
        size = warped[:, 2:] - warped[:, :2] if boxes.format.name == "XYXY" else warped[:, 2:]
        keep = keep & (size > 0).all(dim=1)  # rounding can close a narrow box
    return _Warped(wrap_like(warped, boxes), keep)


def _warp_rotated_boxes(plain: Tensor, form: str, flow: Tensor, options: _Options) -> tuple[Tensor, Tensor]:
    corners = convert_boxes(plain, form, "XYXYXYXY").reshape(1, -1, 4, 2) - 0.5
    outlines = warp_outlines(corners, flow[None])
    axes = _box_axes(outlines.points, outlines.converged, corners)
    extent = outlines.extent(axes)
    keep = extent.keep(options.min_area, options.min_visibility)
    low, high = extent.clipped if options.clip else extent.unclipped
    if not options.drop:
        high = torch.where(keep[..., None], high, low)
    (x1, y1), (x2, y2) = low.unbind(-1), high.unbind(-1)
    rectangle = torch.stack([x1, y1, x2, y1, x2, y2, x1, y2], dim=-1).unflatten(-1, (4, 2))
    # The transpose of a rotation is its inverse: back from coordinates along the axes.
    warped = (rectangle[..., None] * axes[:, :, None]).sum(dim=-2)
    return convert_boxes(warped[0].flatten(1) + 0.5, "XYXYXYXY", form), keep[0]


def _box_axes(points: Tensor, converged: Tensor, corners: Tensor) -> Tensor:
    """Return unit vectors, (B, N, 2, 2), along the top and bottom edges of warped boxes and across them."""
    steps = points.diff(dim=3) * (converged[..., 1:] & converged[..., :-1])[..., None]
    along = steps[:, :, 0].sum(dim=2) - steps[:, :, 2].sum(dim=2)
    # A box without a visible edge keeps its direction, and a box without a size gets that of the x axis.
    original = (corners[:, :, 1] - corners[:, :, 0]).to(along.dtype)
    x_axis = torch.tensor([1.0, 0.0], dtype=along.dtype, device=along.device)
    for default in (original, x_axis):
        along = torch.where(along.norm(dim=-1, keepdim=True) > 1e-6, along, default)
    along = along / along.norm(dim=-1, keepdim=True)
    return torch.stack([along, torch.stack([-along[..., 1], along[..., 0]], dim=-1)], dim=2)


def _siblings(paths: list[Any], i: int) -> dict[str, int]:
    """Return the indices of the leaves in the dict of leaf i, by their keys in lower case."""
    path = paths[i]
    if not path or not isinstance(path[-1], pytree.MappingKey):
        return {}
    return {str(other[-1].key).lower(): k for k, other in enumerate(paths) if other[:-1] == path[:-1]}


def _rows_of_boxes(
    sample: Any, paths: list[Any], leaves: list[Any], boxes: list[int], i: int, labels_getter: Any
) -> list[int]:
    """Return the indices of the boxes i and of all leaves that have one row for each box."""
    count, parent = leaves[i].shape[0], paths[i][:-1]
    near = [k for k, path in enumerate(paths) if len(boxes) == 1 or path[: len(parent)] == parent]
    rows = [k for k in near if k not in boxes and _num_rows(leaves[k]) == count]
    rows = [k for k in rows if not is_tv_tensor(leaves[k], "Mask") or leaves[k].ndim > 2]
    rows = [k for k in rows if not (_moves(leaves[k]) and any(part in name_of(paths[k]) for part in _MOVES_WITH_IMAGE))]
    if callable(labels_getter):
        given = labels_getter(sample)
        labels = [] if given is None else [given, *given] if isinstance(given, list | tuple) else [given]
        chosen = [k for k, leaf in enumerate(leaves) if any(leaf is label for label in labels)]
        for k in chosen:
            _check_rows(leaves[k], count)
        return sorted({i, *chosen, *(k for k in rows if is_tv_tensor(leaves[k], "Mask"))})
    if labels_getter is None:
        return [i, *(k for k in rows if is_tv_tensor(leaves[k], "Mask"))]
    rows = [k for k in rows if not _is_of_image(name_of(paths[k]))]
    rivals = [k for k in boxes if k != i and leaves[k].shape[0] == count and paths[k][:-1] == parent]
    if rivals and rows:
        raise ValueError(
            f"target must hold each BoundingBoxes in a dict with its labels if drop=True, got {1 + len(rivals)} of "
            f"{count} boxes in one; nest them, or pass labels_getter"
        )
    if len(boxes) == 1:
        names = {k: name_of(paths[k]) for k in near}
        labels = [k for k in near if names[k] == "labels"] or [k for k in near if "label" in names[k]][:1]
        for k in labels:
            _check_rows(leaves[k], count)
    return [i, *rows]


def _moves(leaf: Any) -> bool:
    """Return True for masks, keypoints, and lists with entries that may hold them."""
    is_list = type(leaf) in (list, tuple) and not _is_plain_list(leaf)
    return is_list or is_tv_tensor(leaf, "Mask", "KeyPoints")


def _num_rows(leaf: Any) -> int | None:
    """Return the length of a tensor, array or list along its first dimension; None for other values and images."""
    if is_tv_tensor(leaf, "Image", "Video"):
        return None
    if isinstance(leaf, Tensor | np.ndarray):
        return leaf.shape[0] if leaf.ndim else None
    return len(leaf) if type(leaf) in (list, tuple) else None


def _looks_like_camera_matrix(leaf: Any) -> bool:
    is_plain = type(leaf) in (Tensor, np.ndarray) and tuple(leaf.shape) in ((3, 3), (3, 4), (4, 4))
    return is_plain and "float" in str(leaf.dtype)


def _is_of_image(name: str) -> bool:
    return name in ("size", "shape") or any(part in name for part in _OF_IMAGE)


def _check_rows(labels: Any, count: int) -> None:
    if _num_rows(labels) != count:
        got = tuple(labels.shape) if hasattr(labels, "shape") else repr(labels)
        raise ValueError(f"labels must have one row for each of the {count} boxes, got {got}")


def _select(value: Any, keep: Tensor) -> Any:
    """Return the rows to keep."""
    if isinstance(value, list | tuple):
        return type(value)(row for row, kept in zip(value, keep.tolist(), strict=True) if kept)
    if isinstance(value, np.ndarray):
        return value[keep.cpu().numpy()]
    rows = value.as_subclass(Tensor)[keep.to(value.device)]
    return rows if type(value) in (Tensor, torch.nn.Parameter) else wrap_like(rows, value)


def _clear_visibility(values: list[Any], leaves: list[Any], siblings: dict[str, int], visible: Tensor) -> None:
    """Set the visibility of invisible keypoints to zero, in place in the list of values."""
    for key in _VISIBILITY_KEYS:
        k = siblings.get(key)
        kind = None if k is None else type(leaves[k])
        if k is None or kind not in (Tensor, np.ndarray, list, tuple):
            continue
        before = leaves[k] if kind is Tensor else torch.as_tensor(leaves[k], device="cpu")
        if before.shape not in (visible.shape, (*visible.shape, 1)):
            shapes = f"{tuple(visible.shape)}, got {tuple(before.shape)}"
            raise ValueError(f"{key} must have one entry for each keypoint, {shapes}")
        after = before * visible.to(before.device).view(before.shape)
        values[k] = after if kind is Tensor else after.numpy() if kind is np.ndarray else kind(after.tolist())


def convert_boxes(boxes: Tensor, old: str, new: str) -> Tensor:
    """Convert boxes between two formats of torchvision, by their names."""
    convert = importlib.import_module("torchvision.transforms.v2.functional").convert_bounding_box_format
    return convert(boxes, old_format=old, new_format=new)


def _cast(value: Tensor, dtype: torch.dtype) -> Tensor:
    return value.to(dtype) if dtype.is_floating_point else value.round().to(dtype)


def _batched(flow: Tensor) -> Tensor:
    return flow if flow.ndim == 4 else flow[None]


def _as_batch(leaf: Any, flow: Tensor) -> Tensor:
    """Return a leaf (..., H, W) as (B, C, H, W), where B is the batch of the flow or 1."""
    plain = leaf.as_subclass(Tensor)
    if plain.shape[-2:] != flow.shape[-2:]:
        size = f"{tuple(flow.shape[-2:])}, got {tuple(plain.shape)}"
        raise ValueError(f"{type(leaf).__name__} must have the size of the flow, {size}")
    _check_batch(plain, flow)
    batch = _batched(flow).shape[0]
    return plain.reshape(batch, math.prod(plain.shape[:-2]) // batch, *plain.shape[-2:])


def _check_batch(plain: Tensor, flow: Tensor) -> None:
    if flow.ndim == 4 and (plain.ndim < 3 or plain.shape[0] != flow.shape[0]):
        raise ValueError(f"target must have the batch of the flow, {flow.shape[0]}, got {tuple(plain.shape)}")


def _check_canvas(leaf: Any, flow: Tensor) -> None:
    if tuple(leaf.canvas_size) != tuple(flow.shape[-2:]):
        size = f"{tuple(flow.shape[-2:])}, got {tuple(leaf.canvas_size)}"
        raise ValueError(f"{type(leaf).__name__} must have the canvas size of the flow, {size}")

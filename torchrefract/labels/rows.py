"""What belongs together in a sample: the rows of labels and masks beside boxes, the flags beside keypoints."""

import sys
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

_VISIBILITY = ("visible", "visibility")


def siblings_of(paths: list[Any], i: int) -> dict[str, int]:
    """The places of the leaves that are in one dict with leaf i, by their keys in lower case."""
    place = paths[i]
    if not place or not isinstance(place[-1], pytree.MappingKey):
        return {}
    return {str(path[-1].key).lower(): k for k, path in enumerate(paths) if path[:-1] == place[:-1]}


def companions(
    sample: Any, paths: list[Any], leaves: list[Any], siblings: dict[str, int], i: int, labels_getter: Any
) -> list[int]:
    """The places of the boxes at i and of all that has a row for each of them."""
    count = leaves[i].shape[0]
    masks = [k for k in siblings.values() if is_tv(leaves[k], "Mask") and leaves[k].ndim > 2]
    rows = [i, *(k for k in masks if leaves[k].shape[0] == count)]
    if labels_getter is None or (labels_getter == "default" and leaves[i] is sample):
        return rows
    if callable(labels_getter):
        found = labels_getter(sample)
        found = [] if found is None else found if isinstance(found, list | tuple) else [found]
        rows += [k for k, leaf in enumerate(leaves) if any(leaf is one for one in found)]
    elif not siblings:
        raise ValueError("target must hold boxes in a dict with their labels to drop some, got them outside of one")
    else:
        beside = pytree.key_get(sample, paths[i][:-1])
        rows += _labels({str(key).lower(): value for key, value in beside.items()}, siblings)
    for k in rows:
        if leaves[k].shape[:1] != (count,):
            raise ValueError(f"labels must have one row for each of the {count} boxes, got {tuple(leaves[k].shape)}")
    return sorted(set(rows))


def _labels(beside: Mapping[str, Any], siblings: Mapping[str, int]) -> list[int]:
    keys = ["labels"] if "labels" in beside else [key for key in beside if "label" in key][:1]
    for key in keys:
        if not isinstance(beside[key], Tensor):
            kind = type(beside[key]).__name__
            raise TypeError(f"{key} must be a tensor for boxes to be dropped, got {kind}")
    return [siblings[key] for key in keys]


def kept(value: Any, keep: Tensor) -> Any:
    """The rows to keep."""
    if type(value) in (Tensor, torch.nn.Parameter):
        return value[keep.to(value.device)]
    return wrapped(value.as_subclass(Tensor)[keep.to(value.device)], value)


def hide(values: list[Any], leaves: list[Any], siblings: dict[str, int], visible: Tensor) -> None:
    for key in _VISIBILITY:
        k = siblings.get(key)
        if k is None or type(leaves[k]) is not Tensor:
            continue
        if leaves[k].shape not in (visible.shape, (*visible.shape, 1)):
            shapes = f"{tuple(visible.shape)}, got {tuple(leaves[k].shape)}"
            raise ValueError(f"{key} must have one entry for each keypoint, {shapes}")
        values[k] = values[k] * visible.to(values[k].device).view(leaves[k].shape)


def is_tv(leaf: Any, name: str) -> bool:
    """Whether a leaf is of a type of torchvision, without importing it: nobody has its tensors who has not."""
    kind = getattr(sys.modules.get("torchvision.tv_tensors"), name, None)
    return kind is not None and isinstance(leaf, kind)


def wrapped(value: Tensor, like: Any) -> Any:
    return sys.modules["torchvision.tv_tensors"].wrap(value, like=like)

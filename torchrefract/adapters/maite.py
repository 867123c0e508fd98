"""Effects as augmentations of MAITE, whose protocols are structural: nothing of it is imported."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefract._validation import check_whole, type_name
from torchrefract.effects.base import Effect
from torchrefract.labels.boxes import warp_boxes
from torchrefract.labels.targets import is_tv_tensor
from torchrefract.random import key_of


@dataclass(frozen=True)
class MaiteDetections:
    """An `ObjectDetectionTarget` of MAITE, in arrays or tensors.

    boxes: (N, 4), px, x1, y1, x2, y2 from the edge of the first pixel, floating.
    labels: (N, ...).
    scores: (N,) or (N, classes).
    """

    boxes: Any
    labels: Any
    scores: Any


class MaiteAugmentation:
    """Make an effect an `Augmentation` of MAITE, for object detection and image classification.

    The key of a datum is `key_of(str(id))` of its metadata, so its draw depends on the seed and its id alone, in any
    batch and order. Arrays stay arrays, and tensors stay tensors on their device.

    Args:
        effect: the effect. Images are uint8, or floating in [0, 1].
        seed: of the draws, an integer.
        id: of `metadata`, and name of the entry that each datum gets; None is "torchrefract." and the class of the
            effect.

    Raises:
        TypeError: effect is not one of torchrefract; seed is not an integer.
    """

    def __init__(self, effect: Effect, *, seed: int = 0, id: str | None = None):
        if not isinstance(effect, Effect):
            raise TypeError(f"effect must be an effect of torchrefract, got {type_name(effect)}")
        self.effect = effect
        self.seed = check_whole("seed", seed)
        self.metadata: Any = {"id": f"torchrefract.{type(effect).__name__}" if id is None else id}

    def __call__(
        self, batch: tuple[Sequence[Any], Sequence[Any], Sequence[Any]], /
    ) -> tuple[list[Any], list[Any], list[Any]]:
        """Degrade images and move their boxes; change nothing in place.

        Boxes become the smallest boxes around the part of their warped outlines in the frame, see `warp_boxes`. Those
        that leave it go with their labels and scores. Effects without a flow keep all targets.

        Args:
            batch: images (C, H, W); their targets, which have boxes (N, 4), labels (N, ...) and scores (N, ...), or are
                scores of classes (classes,); and their metadata.

        Returns:
            The images; the targets, `MaiteDetections` in place of moved ones; and the metadata, each with an entry
            {"seed": seed, "key": key}, so that `effect.degrade(image, seed=seed, keys=[key])` repeats the draw.

        Raises:
            ValueError, TypeError: lists of different lengths; metadata without an id, or with the entry of an
                augmentation of the same id; an invalid image or target, such as a mask; names the datum.
        """
        if len({*map(len, batch)}) > 1:
            counts = "{}, {} and {}".format(*map(len, batch))
            raise ValueError(f"batch must have as many images as targets and metadata, got {counts}")
        data = [self._degrade(*datum) for datum in zip(*batch, strict=True)]
        return [image for image, _, _ in data], [target for _, target, _ in data], [about for _, _, about in data]

    def _degrade(self, image: Any, target: Any, about: Mapping[str, Any]) -> tuple[Any, Any, dict[str, Any]]:
        name = self.metadata["id"]
        if "id" not in about:
            raise ValueError(f"metadata must have an id, got {', '.join(map(str, about)) or 'none'}")
        if name in about:
            raise ValueError(f"metadata must not have {name} yet, got datum {about['id']!r}; use another id and seed")
        key = key_of(str(about["id"]))
        try:
            tensor = _to_tensor(image)
            if tensor.ndim != 3:
                raise ValueError(f"image must have shape (C, H, W), got {tuple(tensor.shape)}")
            degraded = self.effect.degrade(tensor, seed=self.seed, keys=[key])
            moved = _move(target, degraded.flow.detach()) if degraded.has("flow") else target
        except (ValueError, TypeError) as error:
            raise type(error)(f"datum {about['id']!r}: {error}") from error
        return _like(degraded.image, image), moved, {**about, name: {"seed": self.seed, "key": key}}


def _move(target: Any, flow: Tensor) -> Any:
    """Return a target moved along a flow (2, H, W), px."""
    if not all(hasattr(target, name) for name in ("boxes", "labels", "scores")):
        _check_classes(target)
        return target
    if is_tv_tensor(target.boxes, "BoundingBoxes") and target.boxes.format.name != "XYXY":
        raise ValueError(
            f"boxes must be x1, y1, x2, y2, as in MAITE's protocol, got BoundingBoxes in {target.boxes.format.name}; "
            "convert them by v2.functional.convert_bounding_box_format of torchvision"
        )
    boxes = _to_tensor(target.boxes)
    boxes = boxes.reshape(0, 4) if boxes.numel() == 0 else boxes
    if boxes.ndim != 2 or boxes.shape[1] != 4:
        raise ValueError(f"boxes must have shape (N, 4), got {tuple(boxes.shape)}")
    keep = torch.ones(len(boxes), dtype=torch.bool, device=flow.device)
    moved = boxes if boxes.is_floating_point() else boxes.float()
    if len(boxes) and flow.any():
        corners, keep = warp_boxes(boxes.to(flow.device) - 0.5, flow)
        moved = (corners + 0.5)[keep].to(moved)
    rows = {name: _rows(name, getattr(target, name), keep) for name in ("labels", "scores")}
    return MaiteDetections(_like(moved, target.boxes), **rows)


def _check_classes(target: Any) -> None:
    """Raise TypeError unless a target is numbers of classes, which do not move with the image."""
    array = target if isinstance(target, Tensor) else np.asarray(target)
    if array.ndim > 1 or (isinstance(array, np.ndarray) and array.dtype.kind not in "biuf"):
        got = f"{type(target).__name__} {tuple(array.shape)}"
        raise TypeError(
            f"target must have boxes, labels and scores, or be scores of classes, (classes,), got {got}; move others "
            "by torchrefract.warp_labels"
        )


def _rows(name: str, values: Any, keep: Tensor) -> Any:
    """Return the rows to keep."""
    values = values if isinstance(values, Tensor) else np.asarray(values)
    if len(values) != len(keep):
        raise ValueError(f"{name} must have a row for each of the {len(keep)} boxes, got {len(values)}")
    return values[keep.to(values.device) if isinstance(values, Tensor) else keep.cpu().numpy()]


def _to_tensor(values: Any) -> Tensor:
    """Return a tensor as it is, and anything else as a tensor of the array that it gives."""
    if isinstance(values, Tensor):
        return values
    array = np.require(values, requirements=["C", "W"])  # torch accepts no negative strides, and warns of constants
    return torch.from_numpy(array)


def _like(value: Tensor, given: Any) -> Any:
    """Return a tensor, or an array if that was given."""
    return value if isinstance(given, Tensor) else value.detach().cpu().numpy()

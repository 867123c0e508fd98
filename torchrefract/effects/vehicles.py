"""Boxes of vehicles for effects that look at them: dust is thicker behind a car."""

from collections.abc import Sequence
from typing import Any

from torch import nn

from torchrefract.labels.vehicles import LabeledBoxes, select_vehicles


def uses_boxes(effect: nn.Module) -> bool:
    """Return True if an effect, or one of a composition, depends on boxes of vehicles."""
    return any(getattr(part, "vehicle_labels", None) is not None for part in effect.modules())


def with_vehicles(effect: Any, params: Any, boxes: Sequence[LabeledBoxes]) -> Any:
    """Return the parameters of an effect with the vehicles that the boxes of each image show.

    Args:
        effect: of the parameters; a composition hands the boxes to its effects as they are, so dust comes before warps.
        params: of the effect, with B rows.
        boxes: of each of the B images.
    """
    if hasattr(params, "children"):
        pairs = zip(effect.effects, params.children, strict=True)
        return params._replace(children=tuple(with_vehicles(part, child, boxes) for part, child in pairs))
    if getattr(effect, "vehicle_labels", None) is None:
        return params
    return params._replace(vehicles=select_vehicles(boxes, effect.vehicle_labels, like=params.visibility))

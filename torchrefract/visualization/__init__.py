"""Pictures of fields and effects: colors of maps, contact sheets and animations."""

from torchrefract.visualization.color import (
    checkerboard,
    flow_to_rgb,
    flow_wheel,
    full_color_px,
    hatch_invalid,
    mark_folded,
    transmission_to_rgb,
)

__all__ = [
    "checkerboard",
    "flow_to_rgb",
    "flow_wheel",
    "full_color_px",
    "hatch_invalid",
    "mark_folded",
    "transmission_to_rgb",
]

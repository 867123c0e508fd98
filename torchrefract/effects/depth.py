"""Depth providers: the depth of a frame if no depth map is passed in."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefract._validation import check_number, check_positive
from torchrefract.fields.depth import ground_plane_depth, linear_depth


class DepthProvider(ABC):
    """The depth of a frame of any size; derive your own provider from it."""

    @abstractmethod
    def __call__(self, height: int, width: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Return the depth along the axis of the camera in m, inf for the sky.

        Args:
            height, width: px, of the frame.
            dtype, device: of the result.

        Returns:
            (1, 1, H, W), or (1, 1, H, 1) if all pixels of a row have one depth.
        """


@dataclass(frozen=True, kw_only=True)
class LinearDepth(DepthProvider):
    """The ramp over the rows of the paper: d(y) = (1 - (y + 1/2) / H) max_depth.

    max_depth: m, at the top edge of the frame, in [0, 1e12].
    """

    max_depth: float = 160.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "max_depth", check_number("max_depth", self.max_depth, low=0.0, high=1e12))

    def __call__(self, height: int, width: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Return (1, 1, H, 1), m."""
        return linear_depth(height, self.max_depth, dtype=dtype, device=device)


@dataclass(frozen=True, kw_only=True)
class GroundPlaneDepth(DepthProvider):
    """A flat road below the horizon: its depth along the axis of the camera, not along the ray of each pixel.

    camera_height: m, above the road.
    focal: focal length of a pinhole, widths of the frame.
    horizon: its position, 0 at the top edge of the frame and 1 at its bottom edge, in [-10, 10].
    spread: standard deviation of an uncertain horizon, in heights of the frame, in [0, 10]; depth then grows smoothly
        across the horizon instead of jumping there.
    far: m, the largest depth, which is that of the sky; may be inf.
    """

    camera_height: float = 1.3
    focal: float = 0.9
    horizon: float = 0.5
    spread: float = 0.0
    far: float = 200.0

    def __post_init__(self) -> None:
        for name in ("camera_height", "focal"):
            object.__setattr__(self, name, check_positive(name, getattr(self, name)))
        object.__setattr__(self, "horizon", check_number("horizon", self.horizon, low=-10.0, high=10.0))
        object.__setattr__(self, "spread", check_number("spread", self.spread, low=0.0, high=10.0))
        object.__setattr__(self, "far", check_number("far", self.far, low=1e-6, high=math.inf))

    def __call__(self, height: int, width: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Return (1, 1, H, 1), m."""
        return ground_plane_depth(
            height,
            camera_height=self.camera_height,
            focal_px=self.focal * width,
            horizon=self.horizon,
            spread=self.spread,
            far=self.far,
            dtype=dtype,
            device=device,
        )

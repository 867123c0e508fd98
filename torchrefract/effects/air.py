"""What all fogs share: the light of the air, the distance through it, and the blend of both."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchrefract._checks import check_all, check_flag, check_number
from torchrefract.cameras.models import Camera
from torchrefract.effects.color import check_color, each_channel
from torchrefract.effects.depth import DepthProvider, LinearDepth
from torchrefract.effects.rows import spread
from torchrefract.fields.depth import check_depth, ray_distance
from torchrefract.fields.fog import linear_to_srgb, srgb_to_linear, veil
from torchrefract.warping.grid import field_dtype

_PAPER_AIRLIGHT = (220 / 255, 220 / 255, 235 / 255)
_REC_709 = (0.2126, 0.7152, 0.0722)


@dataclass(frozen=True, kw_only=True)
class Air:
    """The air between the camera and the scene; fields as the arguments of `UniformFog`, checked."""

    airlight: Sequence[float] | None
    threshold: float
    depth: DepthProvider
    camera: Camera | None
    linear_light: bool

    def __post_init__(self) -> None:
        check_number("threshold", self.threshold, low=1e-6, high=1 - 1e-6)
        if not isinstance(self.depth, DepthProvider):
            raise TypeError(f"depth must be a depth provider such as LinearDepth(), got {type(self.depth).__name__}")
        if self.camera is not None and not isinstance(self.camera, Camera):
            raise TypeError(f"camera must be a Camera, got {type(self.camera).__name__}")
        check_flag("linear_light", self.linear_light)

    def light(self, image: Tensor, dtype: torch.dtype) -> Tensor:
        """(B, C): the airlight for each image of a batch."""
        batch, channels = image.shape[:2]
        if self.airlight is None:
            gray = sum(weight * value for weight, value in zip(_REC_709, _PAPER_AIRLIGHT, strict=True))
            color = _PAPER_AIRLIGHT if channels == 3 else [gray] * channels
        else:
            color = each_channel("airlight", self.airlight, channels)
        return torch.tensor([color] * batch, dtype=dtype, device=image.device).view(batch, channels)

    def distance(self, image: Tensor, depth: Tensor | None) -> Tensor:
        """(1, B or N, 1, H, 1 or W), m: how far the light comes; along the rays where the camera is known."""
        dtype, (height, width) = field_dtype(image.dtype), image.shape[2:]
        if depth is None:
            depth = self.depth(height, width, dtype=dtype, device=image.device)
        else:
            check_depth(depth)
            # Where nothing may be read, what is no depth is masked.
            depth = depth.to(dtype).nan_to_num(nan=0.0, posinf=torch.inf).clamp(min=0)
        if self.camera is None:
            return depth
        camera = self.camera.resized(width=width, height=height)
        return ray_distance(depth, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, width=width)

    def blended(self, image: Tensor, t: Tensor, airlight: Tensor) -> Tensor:
        """I t + A (1 - t), of rows (N, C, H, W), with t and the airlight (B, C) in as many rows or fewer."""
        rows = image.shape[0]
        t, airlight = spread(t, rows), spread(airlight, rows)[:, :, None, None]
        if not self.linear_light:
            return veil(image, t, airlight)
        blended = linear_to_srgb(veil(srgb_to_linear(image), t, srgb_to_linear(airlight)))
        return torch.where(t == 1, image, blended)


def make_air(
    *,
    airlight: float | Sequence[float] | None,
    threshold: float,
    depth: DepthProvider | None,
    camera: Camera | None,
    linear_light: bool,
) -> Air:
    """The air of arguments as `UniformFog` takes them."""
    color = None if airlight is None else check_color("airlight", airlight, high=1.0)
    depth = LinearDepth() if depth is None else depth
    return Air(airlight=color, threshold=threshold, depth=depth, camera=camera, linear_light=linear_light)


def check_fog_params(params: Any, image: Tensor) -> None:
    """Raise for parameters with a `visibility`, a `deviation` and an `airlight` that are no fog."""
    if params.airlight.shape != image.shape[:2]:
        raise ValueError(
            f"params.airlight must have shape {tuple(image.shape[:2])}, got {tuple(params.airlight.shape)}"
        )
    for name in ("visibility", "deviation"):
        if getattr(params, name).ndim != 1:
            raise ValueError(f"params.{name} must have shape (B,), got {tuple(getattr(params, name).shape)}")
    check_all("params.visibility", "be above 0", params.visibility, lambda v: v > 0)
    check_all("params.deviation", "be above -1", params.deviation, lambda v: (v > -1) & v.isfinite())
    check_all("params.airlight", "be finite", params.airlight, torch.isfinite)

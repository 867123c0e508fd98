"""What all fogs share: the light of the air, the distance through it, and the blend of both."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor
from torchrefract._validation import (
    check_color,
    check_flag,
    check_number,
    check_values,
    check_within,
    color_per_channel,
)
from torchrefract.cameras.models import Camera
from torchrefract.effects.depth import DepthProvider, LinearDepth
from torchrefract.effects.plan import in_ranges
from torchrefract.effects.rows import expand_batch
from torchrefract.fields.depth import check_depth, ray_distance
from torchrefract.fields.veils import Drifting, Ends, veiled, veiled_by_drifts_
from torchrefract.planning.photometric import Blend
from torchrefract.warping.grid import field_dtype

_PAPER_AIRLIGHT = (220 / 255, 220 / 255, 235 / 255)
_REC_709 = (0.2126, 0.7152, 0.0722)
_GRAY = sum(weight * value for weight, value in zip(_REC_709, _PAPER_AIRLIGHT, strict=True))
_FOCAL = 0.9  # widths, where no camera is known


@dataclass(frozen=True, kw_only=True)
class Air:
    """The air between the camera and the scene; fields as the arguments of `UniformFog`, checked."""

    airlight: tuple[float, ...] | None
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

    def __hash__(self) -> int:
        # Without the depth: not every provider has a hash.
        return hash((self.airlight, self.threshold, self.camera, self.linear_light))

    @property
    def colors(self) -> tuple[float, ...]:
        """All numbers that the airlight may have."""
        return (*_PAPER_AIRLIGHT, _GRAY) if self.airlight is None else tuple(self.airlight)

    @property
    def blend(self) -> Blend:
        """What an error of t does to an image."""
        return Blend(self.colors, self.linear_light)

    def params_in_range(self, airlight: Tensor) -> Tensor:
        """(), bool: the colors (B, C) lie between those of this air."""
        ends = (min(self.colors), max(self.colors))
        return in_ranges(airlight, [ends] * airlight.shape[1])

    def light(self, image: Tensor, dtype: torch.dtype) -> Tensor:
        """(B, C): the airlight for each image of a batch."""
        batch, channels = image.shape[:2]
        if self.airlight is None:
            color = _PAPER_AIRLIGHT if channels == 3 else [_GRAY] * channels
        else:
            color = color_per_channel("airlight", self.airlight, channels)
        return as_device_tensor([color] * batch, dtype=dtype, device=image.device).view(batch, channels)

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

    def pinhole(self, height: int, width: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Focal lengths and principal point, px; of a frame in the middle where no camera is known."""
        if self.camera is None:
            return (_FOCAL * width, _FOCAL * width), ((width - 1) / 2, (height - 1) / 2)
        camera = self.camera.resized(width=width, height=height)
        return (camera.fx, camera.fy), (camera.cx, camera.cy)

    def distance_at(self, squares: Sequence[float], image: Tensor) -> Tensor:
        """(1, 1, H, n), m, for rows of one depth, where ((column - cx) / fx)^2 is one of n numbers."""
        dtype, (height, width) = field_dtype(image.dtype), image.shape[2:]
        camera = cast(Camera, self.camera).resized(width=width, height=height)
        y = (torch.arange(height, dtype=dtype, device=image.device) - camera.cy) / camera.fy
        stretch = ((1 + y * y)[:, None] + as_device_tensor(squares, dtype=y.dtype, device=y.device)).sqrt()
        return self.depth(height, width, dtype=dtype, device=image.device) * stretch

    def blended(self, image: Tensor, t: Tensor, airlight: Tensor, ends: Ends) -> Tensor:
        """As `veiled`, of rows (N, C, H, W), with t and the airlight (B, C) in as many rows or fewer."""
        rows = image.shape[0]
        t = t if t.shape[0] == 1 else expand_batch(t, rows)
        return veiled(image, t, expand_batch(airlight, rows), ends=ends, linear=self.linear_light)

    def behind_drifts(self, image: Tensor, drifting: Drifting, airlight: Tensor, ends: Ends) -> tuple[Tensor, Tensor]:
        """As `veiled_by_drifts_`, with the airlight (B, C) in as many rows or fewer."""
        airlight = expand_batch(airlight, image.shape[0])
        return veiled_by_drifts_(image, drifting, airlight, ends=ends, linear=self.linear_light)


@lru_cache(maxsize=64)
def distances(air: Air, height: int, width: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """m, of the nearest and of the farthest pixel in each row, by the air's own depth."""
    found = air.distance(torch.empty(1, 1, height, width, dtype=torch.float64), None)[0, 0]
    return tuple(found.amin(dim=1).tolist()), tuple(found.amax(dim=1).tolist())


@lru_cache(maxsize=64)
def squares(air: Air, height: int, width: int) -> tuple[float, float, float] | None:
    """The lowest and the highest ((column - cx) / fx)^2, and the lowest ((row - cy) / fy)^2; None without a camera.

    None, too, for a depth that is not by row.
    """
    options: Any = {"dtype": torch.float64, "device": torch.device("cpu")}
    if air.camera is None or air.depth(height, width, **options).shape[3] != 1:
        return None
    camera = air.camera.resized(width=width, height=height)
    x = ((torch.arange(width, **options) - camera.cx) / camera.fx).square()
    y = ((torch.arange(height, **options) - camera.cy) / camera.fy).square()
    return x.min().item(), x.max().item(), y.min().item()


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
    check_values("params.visibility", "be above 0", params.visibility, lambda v: v > 0)
    check_values("params.deviation", "be above -1", params.deviation, lambda v: (v > -1) & v.isfinite())
    check_within("params.airlight", params.airlight, 0.0, 1.0)

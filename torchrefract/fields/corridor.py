"""Depth of a road between walls, with the sky from the frame: a stand-in where no depth map is known."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import shareable
from torchrefract._validation import check_number, check_positive, check_tensor, warn
from torchrefract.fields.depth import GroundPlaneDepth
from torchrefract.fields.sky import find_sky, sky_mask
from torchrefract.warping.grid import field_dtype

_OPEN = 0.1  # share of sky from which a frame counts as open
_DUSK = (0.03, 0.07)  # `Sky.darkness` around that of the night: `end` changes slowly in a clip
_TALL = 2.5  # heights, of a tree or a mast that hangs over the sky
_POLE = 0.03  # widths: narrower things in front of the sky hide no skyline; it is smoothed alike


@dataclass(frozen=True, kw_only=True)
class CorridorDepth:
    """The depth of a flat road between two walls along it, and of the sky that is found in the image.

        z = min(z_road(y), max(z_wall(x, y), z_skyline(x, y))),  inf in the sky
        z_wall = ((r / (f w))^2 + end^-2)^(-1/2),  r = hypot(x - x_v, max(y_h - y, 0))
        z_skyline = min(f (h - camera_height) / (y_h - y_s(x)), f (2.5 h - camera_height) / max(y_h - y, 0), far)

    The walls stand for houses, trees and slopes beside the road, which a flat road alone puts at the horizon; above the
    horizon they close in to a tunnel, since what stands far away is not seen high above it. Where the sky is seen down
    to y_s(x), what stands below it ends there: if it is h high, it is z_skyline away. So open land has no walls. Trees
    and masts that hang over that sky are 2.5 h high at most, so that their tops are near. A column without sky has no
    z_skyline, and by day a frame without sky looks at something near, such as trees or the road itself: `end` is `far`,
    or min(`far`, `closed`) there; 1 / end is linear between the two in frames of which the sky takes less than a tenth,
    or a dark sky 3 to 7 %. y_s is the lowest row of the sky around a column. Pass it as `depth=` to a fog; a depth map,
    or a network (`torchrefract.depth.from_transformers`), is better.

    Numbers out of range raise ValueError.

    camera_height, focal, horizon, spread: of the road, as for `GroundPlaneDepth`.
    side: m, w, from the camera to each wall, above 0.
    vanishing: x_v, where the road vanishes, 0 at the left edge of the frame and 1 at its right edge, in [-10, 10].
    height: m, h, of what stands beside the road, above `camera_height`.
    far: m, the largest depth outside of the sky.
    closed: m, the largest depth of a frame by day that shows no sky.
    """

    camera_height: float = 1.3
    focal: float = 0.9
    horizon: float = 0.5
    spread: float = 0.05
    side: float = 8.0
    vanishing: float = 0.5
    height: float = 4.0
    far: float = 300.0
    closed: float = 30.0

    def __post_init__(self) -> None:
        road = self.road  # raises for invalid numbers
        for name in ("camera_height", "focal", "horizon", "spread"):
            object.__setattr__(self, name, getattr(road, name))
        for name in ("side", "far", "closed"):
            object.__setattr__(self, name, check_positive(name, getattr(self, name)))
        height = check_number("height", self.height)
        if height <= self.camera_height:
            raise ValueError(f"height must be above camera_height, {self.camera_height:g} m, got {height:g}")
        object.__setattr__(self, "height", height)
        object.__setattr__(self, "vanishing", check_number("vanishing", self.vanishing, low=-10.0, high=10.0))

    @property
    def road(self) -> GroundPlaneDepth:
        """Return the depth of the road."""
        return GroundPlaneDepth(
            camera_height=self.camera_height,
            focal=self.focal,
            horizon=self.horizon,
            spread=self.spread,
            far=math.inf,
        )

    @shareable
    def __call__(self, image: Tensor) -> Tensor:
        """Return the depth of images (B, C, H, W) in [0, 1], (B, 1, H, W), m.

        Raises:
            ValueError, TypeError: images of another shape, or no tensor.

        Warns:
            UserWarning: once for each place in the code, that the depth is assumed.
        """
        if check_tensor("image", image).ndim != 4:
            raise ValueError(f"image must have shape (B, C, H, W), got {tuple(image.shape)}")
        if not torch.compiler.is_compiling():
            warn(
                "depth is that of a road between walls; pass depth=, a map in m or torchrefract.depth."
                "from_transformers(...), for fog that knows what stands where, or horizon= if the camera looks down"
            )
        height, width = image.shape[2:]
        dtype, device = field_dtype(image.dtype), image.device
        x, y = (torch.arange(size, dtype=dtype, device=device) for size in (width, height))
        above = (self.horizon * height - 0.5 - y).clamp(min=0)
        r2 = (x - (self.vanishing * width - 0.5)).square() + above.square()[:, None]
        mask = sky_mask(image)
        seen = (mask.to(dtype).mean(dim=(1, 2, 3)) / _OPEN).clamp(max=1)
        night = (find_sky(image).darkness - _DUSK[0]) / (_DUSK[1] - _DUSK[0])
        seen = torch.maximum(seen, night.clamp(0, 1).to(dtype)).view(-1, 1, 1, 1)
        end = seen / self.far + (1 - seen) / min(self.far, self.closed)
        walls = (r2 / (self.side * self.focal * width) ** 2 + end.square()).rsqrt()
        walls = torch.maximum(walls, self._skyline(mask, y))
        road = self.road(height, width, dtype=dtype, device=device)
        return torch.minimum(road, walls).masked_fill(mask, torch.inf)

    def _skyline(self, mask: Tensor, y: Tensor) -> Tensor:
        """Return (N, 1, H, W), m, the depth of what ends at the lowest sky of its column; 0 in a column without sky."""
        height, width = mask.shape[2:]
        lowest = torch.where(mask, y[:, None], -1.0).amax(dim=2, keepdim=True)
        side = int(_POLE * width / 2)
        around = {"kernel_size": (1, 2 * side + 1), "stride": 1, "padding": (0, side)}
        lowest = F.avg_pool2d(F.max_pool2d(lowest, **around), **around, count_include_pad=False)
        above, size = self.horizon * height - 0.5, (self.height - self.camera_height) * self.focal * width
        tall = (self.height - self.camera_height) / (_TALL * self.height - self.camera_height)
        rise = torch.where(lowest < 0, torch.inf, (above - lowest).clamp(min=size / self.far))
        return size / torch.maximum(rise, tall * (above - y[:, None]))

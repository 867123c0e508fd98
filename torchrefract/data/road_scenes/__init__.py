"""Road scenes rendered from a key, with their true depth: the data source that needs no files."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchrefract._validation import check_count, check_tensor
from torchrefract.data.road_scenes.geometry import View, ground_depth, rays
from torchrefract.data.road_scenes.layout import Dice, Light, Road, draw_light, draw_road, draw_view
from torchrefract.data.road_scenes.objects import draw_groups
from torchrefract.data.road_scenes.paint import backdrop, paint_bodies
from torchrefract.data.road_scenes.visibility import Group, shadows, visibility
from torchrefract.types import Frame

_SMALLEST = 8  # px a side
# Where in a pixel its color is sampled, px from its center, on distinct rows and columns; the first gives the depth.
_OFFSETS = ((0.0, 0.0), (-0.15, -0.4), (0.4, -0.15), (0.15, 0.4), (-0.4, 0.15))


class Scene(NamedTuple):
    """All that a frame shows, for B keys."""

    road: Road
    view: View
    light: Light
    groups: list[Group]


class RoadScenes(Dataset[Frame]):
    """Rendered road scenes of the keys first, ..., first + count - 1, each with its depth.

    `size`: (height, width), px. A key and a seed make one scene, at every size; see `render_road_scenes`.
    """

    def __init__(self, count: int, *, size: Sequence[int] = (64, 112), seed: int = 0, first: int = 0):
        self.count = check_count("count", count)
        if isinstance(size, str) or not isinstance(size, Sequence) or len(size) != 2:
            raise ValueError(f"size must be (height, width), got {size!r}")
        height, width = (check_count("size", side, low=_SMALLEST) for side in size)
        self.size = (height, width)
        self.seed = check_count("seed", seed, low=-(2**63))
        self.first = check_count("first", first, low=-(2**63))

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Frame:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Frame]:
        """The frames of a batch, rendered at once: torch's DataLoader asks for them so."""
        keys = torch.tensor([self._key(index) for index in indices], dtype=torch.int64)
        if len(keys) == 0:
            return []
        image, depth = render_road_scenes(keys, *self.size, seed=self.seed)
        return [Frame(*sample) for sample in zip(image, keys, depth, strict=True)]

    def _key(self, index: int) -> int:
        if not -self.count <= index < self.count:
            raise IndexError(f"index must lie in [{-self.count}, {self.count - 1}], got {index}")
        return self.first + index % self.count


def render_road_scenes(keys: Tensor, height: int, width: int, *, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Dashcam frames of southern African roads, and their depth.

    A frame depends on its key and the seed alone: on a CPU its bits are the same for every batch and thread count.
    The color of a pixel is the mean over five rays; its depth is that of the ray through its center.

    Args:
        keys: (B,), int64, with B >= 1.
        height, width: px, at least 8. The longer of them sets the field of view, so that one scene fits all sizes.
        seed: tells apart worlds with the same keys.

    Returns:
        image: (B, 3, H, W), float32, in [0, 1]; depth: (B, 1, H, W), float32, m along the
        camera's axis, inf for the sky.
    """
    if check_tensor("keys", keys).ndim != 1 or len(keys) == 0:
        raise ValueError(f"keys must have shape (B,) with B >= 1, got {tuple(keys.shape)}")
    if keys.dtype != torch.int64:
        raise TypeError(f"keys must be int64, got {keys.dtype}")
    check_count("height", height, low=_SMALLEST)
    check_count("width", width, low=_SMALLEST)
    road, view, light, groups = draw_scene(keys, seed=seed)
    ray = rays(view, height, width, _OFFSETS)
    ground = ground_depth(view, ray)
    dark = shadows(groups, view, ray, ground, light.sun)
    depth, slot = visibility(groups, view, ray, ground)
    lit, dim = backdrop(road, light, view, (ray[0][0], ray[1][0], ray[2][0]))
    samples = torch.where(dark, dim[:, None], lit[:, None])
    paint_bodies(samples, groups, light, view, ray, depth, slot)
    # One by one: torch may sum a dimension in another order for another batch size.
    image = sum(samples.unbind(1), torch.zeros_like(lit)) / len(_OFFSETS)
    return image.movedim(0, 1).contiguous(), depth[0, :, None].clone()


def draw_scene(keys: Tensor, *, seed: int = 0) -> Scene:
    """What the frames of some keys show; `keys`: (B,), int64."""
    dice = Dice(seed, keys)
    road = draw_road(dice)
    view = draw_view(dice, road)
    return Scene(road, view, draw_light(dice), draw_groups(dice, road))

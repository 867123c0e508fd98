"""Rendered dashcam frames of southern African roads, with their true depth: clean frames without files."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchrefract._validation import check_count, check_size, check_tensor
from torchrefract.data.road_scenes.render import render
from torchrefract.data.road_scenes.scene import draw_scene
from torchrefract.types import Frame

_SMALLEST = 8  # px a side
_BITS = (1 << 64) - 1  # negative seeds and keys count modulo 2^64


class RoadScenes(Dataset[Frame]):
    """Rendered road scenes with their depth, see `render_road_scenes`.

    Args:
        count: number of scenes.
        size: (height, width), px, each at least 8.
        seed: any integer of 64 bits.
        first: key of the first scene; the others follow.
    """

    def __init__(self, count: int, *, size: Sequence[int] = (64, 112), seed: int = 0, first: int = 0):
        self.count = check_count("count", count)
        self.size = check_size("size", size)
        for side in self.size:
            check_count("size", side, low=_SMALLEST)
        self.seed = check_count("seed", seed, low=-(2**63))
        self.first = check_count("first", first, low=-(2**63))

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Frame:
        """Render a frame: image (3, H, W), key () and depth (1, H, W)."""
        if not -self.count <= index < self.count:
            raise IndexError(f"index must lie in [{-self.count}, {self.count - 1}], got {index}")
        key = torch.tensor(self.first + index % self.count)
        image, depth = render_road_scenes(key[None], *self.size, seed=self.seed)
        return Frame(image[0], key, depth[0])


def render_road_scenes(keys: Tensor, height: int, width: int, *, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Render road scenes on the CPU; a frame depends on its key and the seed alone.

    The color of a pixel is the mean of five rays. Its depth is that of the ray through its center.

    Args:
        keys: (B,), int64, B >= 1.
        height, width: px, at least 8. The longer side sets the field of view, so that a scene is alike at all sizes.
        seed: any integer of 64 bits; scenes of different seeds are independent.

    Returns:
        image: (B, 3, H, W), float32, in [0, 1], on the device of `keys`.
        depth: (B, 1, H, W), float32, m along the camera's axis; inf for the sky.

    Raises:
        ValueError: `keys` has another shape, or a side is below 8.
        TypeError: `keys` is not an int64 tensor.
    """
    if check_tensor("keys", keys).ndim != 1 or len(keys) == 0:
        raise ValueError(f"keys must have shape (B,) with B >= 1, got {tuple(keys.shape)}")
    if keys.dtype != torch.int64:
        raise TypeError(f"keys must be int64, got {keys.dtype}")
    check_count("height", height, low=_SMALLEST)
    check_count("width", width, low=_SMALLEST)
    generators = [np.random.default_rng((seed & _BITS, key & _BITS)) for key in keys.tolist()]
    images, depths = zip(*(render(draw_scene(random), height, width) for random in generators), strict=True)
    image = torch.stack([torch.from_numpy(image).permute(2, 0, 1).contiguous() for image in images])
    depth = torch.stack([torch.from_numpy(depth)[None] for depth in depths])
    return image.to(keys.device), depth.to(keys.device)

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

SIZE = (90, 140)


@pytest.fixture
def random_points() -> Callable[..., Tensor]:
    """Return a function that draws points (*shape, 2), px, float64, between the pixel centers of a frame."""

    def points(*shape: int, size: tuple[int, int] = SIZE, seed: int = 0) -> Tensor:
        last_pixel = torch.tensor([size[1] - 1, size[0] - 1])
        generator = torch.Generator().manual_seed(seed)
        return torch.rand(*shape, 2, generator=generator, dtype=torch.float64) * last_pixel

    return points


@pytest.fixture
def random_boxes(random_points) -> Callable[..., Tensor]:
    """Return a function that draws boxes (count, 4), px, float64, some of which reach over the frame."""

    def boxes(count: int, size: tuple[int, int] = SIZE, seed: int = 0) -> Tensor:
        center = random_points(count, size=size, seed=seed)
        generator = torch.Generator().manual_seed(seed + 1)
        half = torch.rand(count, 2, generator=generator, dtype=torch.float64) * min(size) * 0.4 + 1
        return torch.cat([center - half, center + half], dim=1)

    return boxes


@pytest.fixture
def flip(pixels) -> Callable[..., Tensor]:
    """Return a function that gives the flow (2, H, W), px, float64, that mirrors a frame along x (0) or y (1)."""

    def flow(axis: int, height: int, width: int) -> Tensor:
        x, y = pixels(height, width)
        return torch.stack([width - 1 - 2 * x, 0 * y] if axis == 0 else [0 * x, height - 1 - 2 * y])

    return flow

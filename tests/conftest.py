from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real frames and lenses that lies beside the checkout of a developer."""
    folder = Path(__file__).parents[1].parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"needs the real frames, and {folder} does not exist")
    return folder


@pytest.fixture
def on_threads() -> Iterator[Callable[[int], None]]:
    """Sets the number of torch's threads, for the length of a test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def waves() -> Callable[..., Tensor]:
    """A smooth flow (1, 2, H, W), fp64, at the points (x, y): amplitude_px sin(x / length), mixed over both axes."""

    def flow(x: Tensor, y: Tensor, amplitude_px: float, length: float, phase: float = 0.3) -> Tensor:
        u = amplitude_px * torch.sin(x / length + phase) * torch.cos(y / length - phase)
        v = amplitude_px * torch.cos(x / length - 2 * phase) * torch.sin(y / length + 1)
        return torch.stack([u, v])[None]

    return flow


@pytest.fixture
def pixels() -> Callable[[int, int], tuple[Tensor, Tensor]]:
    """The whole coordinates x and y of a frame, each (H, W), fp64."""

    def axes(height: int, width: int) -> tuple[Tensor, Tensor]:
        rows, columns = torch.arange(height).double(), torch.arange(width).double()
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        return x, y

    return axes

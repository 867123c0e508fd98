"""Depth maps of frames in files: gray PNGs of 16 bits, or .npy arrays in m."""

import io
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import torch
from torch import Tensor

from torchrefract._io import is_remote, read_bytes, relative_name, sizes_in_store, write_file
from torchrefract._validation import UsageError
from torchrefract.data.images import fit, read_file, read_header
from torchrefract.fields.depth import check_depth

STEP = 1 / 256  # of a level of a PNG: m, or px of a deviation
_LAST = 65535  # the level of an infinite depth; 0 was not measured
_SUFFIXES = (".png", ".npy")


@dataclass(frozen=True)
class DepthFolder:
    """The depth maps of the frames of another folder, as `torchrefract.estimate_depth` writes them.

    The map of a picture a/b.jpg is a/b.png or a/b.npy, that of frame 7 of a video a/c.mp4 is a/c.mp4/000007.png.

    root: the folder, or one in a store.
    scale: m, of a level of a PNG.
    """

    root: Path
    scale: float = STEP

    def path(self, name: str, frame: int | None = None) -> Path:
        """Return the path of the map of a picture, or of a frame of a video, by its name relative to the frames."""
        stem = PurePosixPath(name)
        place = stem / f"{frame:06d}" if frame is not None else stem.with_suffix("")
        names = [f"{place}{suffix}" for suffix in _SUFFIXES]
        return self.root / next((name for name in names if self._exists(name)), names[0])

    def has(self, name: str, frame: int | None = None) -> bool:
        """Return True if the map of a frame exists; in a store, if it existed when the first map was looked for."""
        return self._exists(relative_name(self.path(name, frame), self.root))

    def size_bytes(self, path: Path) -> int:
        """Return the size of the file of an existing map."""
        return path.stat().st_size if self._stored is None else self._stored[relative_name(path, self.root)]

    def _exists(self, name: str) -> bool:
        return (self.root / name).is_file() if self._stored is None else name in self._stored

    @cached_property
    def _stored(self) -> dict[str, int] | None:
        """The maps in a store by their names, which are listed once; None for a folder on this machine."""
        if not is_remote(self.root):
            return None
        return sizes_in_store(self.root) if self.root.exists() else {}

    def check(self, frames: Iterable[tuple[str, int | None]], *, exist: bool = True) -> list[Path]:
        """Return the paths of maps; raise UsageError if two frames share one or, with `exist`, if one has none."""
        owners: dict[Path, str] = {}
        for name, frame in frames:
            path = self.find(name, frame) if exist else self.path(name, frame)
            if path in owners:
                raise UsageError(
                    f"depth must have a map for each frame, got one path, {path}, for {owners[path]} and {name}: give "
                    "the frames names that differ in more than their extension"
                )
            owners[path] = name
        return [*owners]

    def find(self, name: str, frame: int | None = None) -> Path:
        """Return the path of an existing map; raise UsageError if there is none."""
        path = self.path(name, frame)
        if not self.has(name, frame):
            raise UsageError(
                f"depth must be a folder with a map for each frame, got none for {name} in {self.root} ({path} is "
                "missing; python -m torchrefract.estimate_depth writes maps)"
            )
        return path

    def read(
        self, name: str, frame: int | None = None, *, frame_size: tuple[int, int], size: tuple[int, int] | None
    ) -> Tensor:
        """Read the map of a frame, (1, h, w), m, cropped and reduced from `frame_size` to `size` like the frame.

        Raises:
            UsageError: there is no such file, or not one of this frame.
        """
        path = self.find(name, frame)
        return crop_depth(read_depth(path, scale=self.scale)[0], frame_size, size, name=str(path))


def write_depth(path: Path, depth: Tensor) -> None:
    """Write a map (H, W), m, as a PNG of 16 bits in steps of 1/256 m; from 256 m on, it is infinite."""
    write_map(path, depth, lowest=1)


def write_map(path: Path, values: Tensor, *, lowest: int = 0) -> None:
    """Write a map (H, W) as a gray PNG of `map_levels`."""
    levels = map_levels(values.cpu().numpy(), lowest=lowest)
    write_file(path, cv2.imencode(".png", levels)[1].tobytes(), alone=True)


def map_levels(values: np.ndarray, *, lowest: int) -> np.ndarray:
    """Return the levels of a PNG, uint16, in steps of 1/256, from the lowest one; 65535 stands for larger values."""
    return np.clip(np.rint(values.astype(float) / STEP), lowest, _LAST).astype(np.uint16)


def depth_of_levels(levels: np.ndarray, scale: float = STEP) -> np.ndarray:
    """Return the depth in m, float32, of the levels of a PNG; pixels that were not measured are infinite."""
    return np.where((levels == 0) | (levels == _LAST), np.inf, levels * scale).astype(np.float32)


def read_depth(path: Path, *, scale: float = STEP) -> tuple[Tensor, float]:
    """Read a map (H, W), m, and the share of its pixels that were not measured, which are infinite.

    Raises:
        UsageError, UnreadableImageError: the file is not such a map.
    """
    if path.suffix.lower() == ".npy":
        if scale != STEP:
            raise UsageError(f"depth_scale must be left out for .npy, whose values are in m, got {scale:g} with {path}")
        stored = _read_npy(path)
        depth = np.where(stored == 0, np.inf, stored).astype(np.float32)
    else:
        stored = _read_png(path)
        depth = depth_of_levels(stored, scale)
    missing = float((stored == 0).mean())
    if missing > 0.5:
        raise UsageError(f"depth must be known in half of the pixels at least, got {path} with {missing:.1%} at 0")
    return torch.from_numpy(depth), missing


def crop_depth(depth: Tensor, frame_size: tuple[int, int], size: tuple[int, int] | None, *, name: str) -> Tensor:
    """Return a map (H', W') as (1, h, w), cropped and reduced like its frame of `frame_size`.

    Raises:
        UsageError: the map, of the file `name`, has not the shape of the frame, or is not in m, see `check_depth`.
    """
    (height, width), (rows, columns) = frame_size, depth.shape
    if 2 * abs(rows * width - columns * height) > max(height, width):
        raise UsageError(
            f"depth must be of the size of the picture, {height}x{width} (height x width), or of its shape, "
            f"got {rows}x{columns} in {name}"
        )
    try:
        check_depth(depth[None, None])
    except ValueError as error:
        raise UsageError(f"{name}: {error}") from error
    # Crop and reduce a picture of relative coordinates like the image, and sample the depth at the results: an average
    # over the edge of an object would be a distance at which there is nothing.
    position = torch.zeros(3, height, width)
    position[0] = ((torch.arange(height) + 0.5) / height)[:, None]
    position[1] = (torch.arange(width) + 0.5) / width
    y, x, _ = position if size is None else fit(position, size)
    y, x = (y * rows).long().clamp(max=rows - 1), (x * columns).long().clamp(max=columns - 1)
    return depth[y, x][None]


def _read_png(path: Path) -> np.ndarray:
    data = read_file(path)
    read_header(path, io.BytesIO(data))  # raises UnreadableImageError
    steps = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if steps is None or steps.dtype != np.uint16 or steps.ndim != 2:
        raise UsageError(f"depth must be a gray PNG of 16 bits, or a .npy in m, got {path}")
    return steps


def _read_npy(path: Path) -> np.ndarray:
    try:
        value = np.load(io.BytesIO(read_bytes(path)), allow_pickle=False)
    except OSError as error:
        raise UsageError(
            f"depth must be a file that can be read, got {path} ({error.strerror or 'damaged'})"
        ) from error
    except (ValueError, EOFError) as error:
        raise UsageError(f"depth must be an array of numbers, got {path}, which is damaged or not an array") from error
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f" or value.size == 0 or value.squeeze().ndim != 2:
        raise UsageError(f"depth must be (height, width) of floating numbers, in m, got {path}")
    return value.squeeze()

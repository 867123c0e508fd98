"""Find drives whose frames show the lens of their own camera, from which a network would learn a wrong lens."""

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

from torch import Tensor

from torchrefract.cameras.calibration import estimate_lens
from torchrefract.data.frames import FrameFolder, evenly_spaced
from torchrefract.data.images import UnreadableImageError, read_image

_MAX_DRIVES, _MAX_FRAMES = 8, 20  # that are looked at
_MIN_FRAMES = 8  # of a drive; fewer hold too few straight edges
_SMALLEST_SHIFT = 0.01  # widths


def bent_drives(frames: FrameFolder) -> dict[str, float]:
    """Estimate the lens of up to eight drives, from up to twenty frames of each, and return those that have one.

    A scene adds its lens to that of the camera, but the flow that a network learns undoes the lens of the scene alone.

    Args:
        frames: of drives with at least eight frames; shorter ones are left out.

    Returns:
        for each drive whose straight edges are bent, by its name: how far the lens shifts the left and right edge, in
        widths of the frame.
    """
    by_drive: dict[str, list[Path]] = {}
    for path, drive in zip(frames.paths, frames.drive_names, strict=True):
        by_drive.setdefault(drive, []).append(path)
    long = [drive for drive, paths in by_drive.items() if len(paths) >= _MIN_FRAMES]
    shifts = {long[i]: _edge_shift(by_drive[long[i]]) for i in evenly_spaced(len(long), _MAX_DRIVES)}
    return {drive: shift for drive, shift in shifts.items() if shift > _SMALLEST_SHIFT}


def _edge_shift(paths: Sequence[Path]) -> float:
    """Return how far the lens of a drive shifts the left and right edge, in widths; 0 if none can be distinguished."""
    images = _of_one_size([paths[i] for i in evenly_spaced(len(paths), _MAX_FRAMES)])
    if (first := next(images, None)) is None:
        return 0.0
    estimate = estimate_lens(chain([first], images))
    if not estimate.is_distorted:
        return 0.0
    focal = estimate.camera.fx / estimate.camera.width
    k1, k2, *_ = estimate.camera.coefficients
    edge = 0.5 / focal
    return abs(k1 * edge**3 + k2 * edge**5) * focal


def _of_one_size(paths: Sequence[Path]) -> Iterator[Tensor]:
    """Read the pictures that have the size of the first one; leave out those that cannot be read."""
    shape = None
    for path in paths:
        try:
            image = read_image(path)
        except UnreadableImageError:  # `FrameFolder` and the training name them
            continue
        shape = shape or image.shape
        if image.shape == shape:
            yield image

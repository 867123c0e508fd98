"""Optical flow between numbered pictures in files, moved to the degraded pictures: .flo files and PNGs of KITTI."""

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import torch

from torchrefract._validation import UsageError, first_names
from torchrefract.data.frames import list_files
from torchrefract.data.images import opened, read_file
from torchrefract.data.label_files import check_named, digest_of, files_with_suffix
from torchrefract.data.pairs.files import DamagedPairError, decode_flow, encode_flow
from torchrefract.labels.maps import warp_optical_flow
from torchrefract.types import Degraded

_UNKNOWN, _SMALLEST_UNKNOWN = 1e10, 1e9  # px, of .flo files
_MAGIC = b"PIEH"


class FlowFile(NamedTuple):
    """The optical flow from a picture to the next one, px.

    path: a .flo file, or a PNG of KITTI.
    following: name of the next picture.

    Source: Baker et al., "A database and evaluation methodology for optical flow", IJCV 2011, for .flo;
    `encode_flow` for the PNG.
    """

    path: Path
    following: str

    def move(self, first: Degraded, second: Degraded) -> bytes:
        """Return the file of the optical flow from the degraded picture to the degraded next one, (1, C, H, W) each.

        Pixels whose flow is unknown, or that leave the second picture, are unknown.

        Raises:
            ValueError: the file is damaged or of another size than the pictures.
        """
        data = read_file(self.path)
        motion, valid = self._decode(data)
        size = tuple(first.image.shape[2:])
        if valid.shape != size:
            raise ValueError(f"{self.path} must be of {size} px (height, width), as its picture, got {valid.shape}")
        if tuple(second.image.shape[2:]) != size:
            got = tuple(second.image.shape[2:])
            raise ValueError(f"{self.following} must have the size of the picture before, {size}, got {got}")
        if not first.has("flow"):
            return data
        moved, valid = warp_optical_flow(
            torch.from_numpy(np.where(valid, motion, np.float32(np.nan)))[None],
            first.flow,
            second.restore_flow,
            restore_valid=second.restore_valid,
        )
        return self._encode(moved[0].numpy(), valid[0, 0].numpy())

    def _decode(self, data: bytes) -> tuple[np.ndarray, np.ndarray]:
        """Return the flow (2, H, W), float32, px, and where it is known, (H, W), bool."""
        if self.path.suffix == ".png":
            try:
                return decode_flow(data)
            except DamagedPairError as error:
                raise ValueError(f"{self.path}: {error}") from error
        width, height = np.frombuffer(data[4:12].ljust(8, b"\0"), "<i4").tolist()
        if data[:4] != _MAGIC or min(width, height) < 1 or len(data) != 12 + 8 * width * height:
            raise ValueError(f"{self.path} is not a complete .flo file")
        flow = np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2).transpose(2, 0, 1).astype(np.float32)
        return flow, np.asarray((np.abs(flow) < _SMALLEST_UNKNOWN).all(axis=0))  # False for NaN

    def _encode(self, flow: np.ndarray, valid: np.ndarray) -> bytes:
        if self.path.suffix == ".png":
            return encode_flow(flow, valid)
        height, width = valid.shape
        values = np.where(valid, flow, _UNKNOWN).transpose(1, 2, 0).astype("<f4")
        return _MAGIC + np.array([width, height], "<i4").tobytes() + values.tobytes()


class FlowFolder(NamedTuple):
    """A folder of optical flows, each under the name of the picture where it starts."""

    root: Path
    suffix: str

    def of(self, name: str) -> FlowFile | None:
        """Return the flow of a picture; None if it has none, as the last one of a drive."""
        path, following = self.root / PurePosixPath(name).with_suffix(self.suffix), next_picture(name)
        return FlowFile(path, following) if following and path.is_file() else None

    def digest(self) -> str:
        """Return a SHA-256 digest of the names and contents of the files."""
        return digest_of(self.root, self.suffix)

    def check(self, names: Sequence[str]) -> None:
        """Raise UsageError if a flow is of none of the pictures, or leads to none of them."""
        files = files_with_suffix(self.root, self.suffix)
        pictures = {PurePosixPath(name).with_suffix(self.suffix).as_posix(): name for name in names}
        check_named(files - pictures.keys(), self.root)
        starts = sorted(pictures[file] for file in files)
        if missing := [name for name in starts if next_picture(name) not in {*names}]:
            raise UsageError(
                f"source must hold the picture after each that has an optical flow, got none after "
                f"{first_names(missing)}; give pictures consecutive numbers, or remove the flows that lead to none"
            )


def next_picture(name: str) -> str | None:
    """Return the name of a picture with the last number of its stem raised by 1; None for a name without a number."""
    path = PurePosixPath(name)
    stem = re.sub(r"[0-9]+(?=[^0-9]*$)", lambda match: f"{int(match[0]) + 1:0{len(match[0])}d}", path.stem)
    return None if stem == path.stem else path.with_name(stem + path.suffix).as_posix()


def read_flows(path: Path) -> FlowFolder | None:
    """Find the optical flows of a folder: .flo files, or PNGs of three channels of 16 bits; None if it holds none.

    Raises:
        UsageError: the folder holds other labels too.
    """
    files = list(list_files(path)) if path.is_dir() else []
    kinds = {file.suffix for file in files if file.suffix in (".flo", ".png", ".txt")}
    is_kitti = any(file.suffix == ".png" and _is_flow(file) for file in files)
    if ".flo" not in kinds and not is_kitti:
        return None
    if len(kinds) > 1:
        raise UsageError(f"labels must be a folder of one kind, got {' and '.join(sorted(kinds))} in {path}")
    return FlowFolder(path, kinds.pop())


def _is_flow(path: Path) -> bool:
    """Return True for a PNG of red, green and blue of 16 bits, by its header."""
    with opened(path) as stream:
        return stream.read(26)[24:] == b"\x10\x02"

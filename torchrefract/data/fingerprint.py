"""What a data set is, in a few words and a hash, so that a checkpoint can tell what it was trained on."""

import hashlib
import json
from collections.abc import Iterable
from typing import Any

from torch.utils.data import Dataset

from torchrefract.data.frames import FrameFolder
from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.types import Frame, Pair


def fingerprint(frames: Dataset[Frame] | Dataset[Pair]) -> dict[str, Any]:
    """What a data set is, in plain values.

    source: what kind of set it is.
    root: where it lies; None for one that is rendered.
    frames, drives: how many there are; drives are None where they are not known.
    size: [height, width] of its first frame, px.
    license: of its frames; None where it is not known.
    sha256: of the names and sizes of its files, of the checksums of pairs, or of what scenes are rendered from.
    """
    told: dict[str, Any] = {"source": type(frames).__name__, "root": None, "drives": None, "license": None}
    lines: Iterable[str] = ()
    if isinstance(frames, FrameFolder):
        told |= {"root": str(frames.root), "drives": len(frames.drives)}
        lines = (f"{path.relative_to(frames.root).as_posix()} {path.stat().st_size}" for path in frames.paths)
    elif isinstance(frames, PairedFolder):
        rows = list(frames.rows())
        told |= {"root": str(frames.root), "drives": len({row.drive for row in rows}), "license": _license(frames)}
        lines = (f"{row.name}.{suffix} {file.sha256}" for row in rows for suffix, file in sorted(row.files.items()))
    elif isinstance(frames, RoadScenes):
        lines = [f"{frames.seed} {frames.first} {frames.count} {frames.size[0]}x{frames.size[1]}"]
    digest = hashlib.sha256()
    for line in lines:
        digest.update(line.encode(errors="surrogateescape") + b"\n")
    told |= {"frames": len(frames), "size": list(frames[0][0].shape[-2:])}  # pyright: ignore[reportArgumentType]  # a map-style dataset has a length
    return told | {"sha256": digest.hexdigest()}


def _license(pairs: PairedFolder) -> str | None:
    """What was said of the source when the pairs were made."""
    try:
        document = json.loads((pairs.root / "config.json").read_bytes())
    except (OSError, ValueError):
        return None
    told = document.get("license") if isinstance(document, dict) else None
    return told if isinstance(told, str) else None

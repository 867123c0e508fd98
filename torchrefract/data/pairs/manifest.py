"""The manifest of pairs on disk: a line of JSON for each pair, in files manifest*.jsonl that can be put together."""

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from torchrefract.data.pairs.files import DamagedPairError

_FILES = "manifest*.jsonl"
# Nothing but these is ever opened: a manifest may come from anywhere.
_PATH = re.compile(r"pairs/[0-9]+/[0-9]+\.[a-z_]+\.[a-z]+|tars/[0-9]+\.tar")
_SUFFIX = re.compile(r"[a-z_]+\.[a-z]+")
_END = 2**63  # of the whole numbers of 64 bits


class Stored(NamedTuple):
    """A file of a pair, or where in a tar it lies."""

    path: str  # below the folder of the manifest, in posix form
    bytes: int
    sha256: str
    offset: int = 0  # of its first byte in the file at `path`


class PairRow(NamedTuple):
    """What the manifest says of a pair."""

    number: int
    source: str  # below the source folder, in posix form
    frame: int | None  # number in a video
    drive: str
    split: str  # train or val; empty where given splits hold the source in neither
    scene: str
    seed: int  # with `key` all that the draw depends on: degrade(clean, seed=seed, keys=[key])
    key: int
    height: int
    width: int
    effects: list[dict[str, Any]]  # those that acted, in order, each with its parameters
    beyond: dict[str, int]  # valid pixels of each flow that its PNG cannot hold
    files: dict[str, Stored]  # by what follows the name of the pair in theirs
    skipped: str = ""  # why there is no pair

    @property
    def name(self) -> str:
        """What the names of its files begin with."""
        return pair_name(self.number)

    def as_line(self) -> str:
        """The row as JSON, with its end of line."""
        document = self._asdict() | {"files": {suffix: file._asdict() for suffix, file in self.files.items()}}
        return json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n"


class Place(NamedTuple):
    """Where a row lies."""

    manifest: Path
    offset: int
    length: int


def pair_name(number: int) -> str:
    """What the names of the files of a pair begin with."""
    return f"{number:08d}"


def read_row(line: bytes) -> PairRow:
    """The row of a line.

    Raises:
        DamagedPairError: a line that is none, or with the path of a file that does not lie where pairs do.
    """
    try:
        document = json.loads(line)
        files = {suffix: Stored(**file) for suffix, file in document.pop("files").items()}
        row = PairRow(**document, files=files)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise DamagedPairError(f"a row must be one of torchrefract.generate, got {line[:80]!r}") from error
    if not _is_typed(row):
        raise DamagedPairError(f"a row must hold values of the types of torchrefract.generate, got {line[:80]!r}")
    for suffix, file in row.files.items():
        if not isinstance(file.path, str) or not _PATH.fullmatch(file.path) or not _SUFFIX.fullmatch(suffix):
            raise DamagedPairError(
                f"files must lie in pairs/ or tars/ beside the manifest, got {file.path!r} for {suffix!r}"
            )
    return row


def _is_typed(row: PairRow) -> bool:
    """Whether all values are of their types, and whole numbers no larger than files and tensors have them."""
    counts = [row.number, row.height, row.width, *row.beyond.values()] if isinstance(row.beyond, dict) else [None]
    counts += [number for file in row.files.values() for number in (file.bytes, file.offset)]
    counts += [] if row.frame is None else [row.frame]
    texts = (row.source, row.drive, row.split, row.scene, row.skipped, *(file.sha256 for file in row.files.values()))
    return (
        all(type(number) is int and 0 <= number < _END for number in counts)
        and all(type(number) is int and -_END <= number < _END for number in (row.seed, row.key))
        and all(isinstance(text, str) for text in texts)
        and isinstance(row.effects, list)
        and all(isinstance(effect, dict) for effect in row.effects)
    )


def manifests(root: Path) -> list[Path]:
    """The manifests in a folder."""
    return sorted(root.glob(_FILES))


def scan(
    paths: Iterable[Path], keep: Callable[[PairRow], bool], *, torn: bool = False
) -> Iterator[tuple[PairRow, Place]]:
    """The rows to keep, and where each lies; of a pair that is in several manifests the first one.

    Args:
        paths: of the manifests.
        keep: whether to keep a row.
        torn: whether lines that are none are passed over, as a kill or a full disk leaves them.

    Raises:
        DamagedPairError: what `read_row` raises.
    """
    seen = set[int]()
    for path in paths:
        offset = 0
        with path.open("rb") as stream:
            for line in stream:
                try:
                    row = read_row(line)
                except DamagedPairError as error:
                    if not torn:
                        raise DamagedPairError(f"{path}, byte {offset}: {error}") from error
                else:
                    if row.number not in seen and keep(row):
                        seen.add(row.number)
                        yield row, Place(path, offset, len(line))
                offset += len(line)


def lines_of(places: Iterable[Place]) -> Iterator[bytes]:
    """The lines at some places, each with its end."""
    streams = {}
    try:
        for place in places:
            stream = streams.get(place.manifest) or streams.setdefault(place.manifest, place.manifest.open("rb"))
            stream.seek(place.offset)
            yield stream.read(place.length).rstrip(b"\n") + b"\n"
    finally:
        for stream in streams.values():
            stream.close()


def read_stored(root: Path, file: Stored) -> bytes:
    """The bytes of a file of a pair.

    Raises:
        DamagedPairError: a file that is missing or too short.
    """
    try:
        with (root / file.path).open("rb") as stream:
            stream.seek(file.offset)
            # Room for as many bytes as are asked for is made before the first one is read.
            data = stream.read(min(file.bytes, os.fstat(stream.fileno()).st_size))
    except OSError as error:
        raise DamagedPairError(f"{root / file.path} cannot be read ({error.strerror})") from error
    if len(data) != file.bytes:
        raise DamagedPairError(f"{root / file.path} is truncated")
    return data

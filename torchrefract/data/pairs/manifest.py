"""The manifest of a pair set: one line of JSON for each pair, in one or several files manifest*.jsonl."""

import hashlib
import json
import os
import re
import sys
import tarfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

from torchrefract._io import is_remote, matching_files, remove_file, replace_file, write_file
from torchrefract._validation import UsageError
from torchrefract.data.images import UnreadableImageError, opened
from torchrefract.data.pairs.configuration import remove_shard_config, shard_suffix
from torchrefract.data.pairs.files import DamagedPairError

if sys.platform != "win32":
    import fcntl

_MANIFESTS = "manifest*.jsonl"
# A manifest may come from an untrusted source, so only these paths are opened.
_PATH = re.compile(r"pairs/[0-9]+/[0-9]+\.[a-z_]+\.[a-z]+|tars/[0-9]+\.tar")
_SUFFIX = re.compile(r"[a-z_]+\.[a-z]+")
_INT64_END = 2**63
LOST = "lost: "  # begins the reason of a frame that could not be opened or has changed; a manifest has no such row
_PART_SECONDS = 30.0  # between two files of rows in a store
_CHUNK = 256  # rows that are checked in parallel


class StoredFile(NamedTuple):
    """The location of a file of a pair: a file of its own, or part of a tar."""

    path: str  # relative to the folder of the manifest, with forward slashes
    bytes: int
    sha256: str
    offset: int = 0  # of the first byte in the file at `path`


class PairRow(NamedTuple):
    """The description of a pair in the manifest."""

    number: int
    source: str  # path relative to the source folder, with forward slashes
    frame: int | None  # index in a video
    drive: str
    split: str  # train, val, or empty for frames outside of the folders train and val
    scene: str
    seed: int  # degrade(clean, seed=seed, keys=[key]) makes the pair again
    key: int
    height: int
    width: int
    effects: list[dict[str, Any]]  # the effects that were applied, in order, with their parameters
    beyond: dict[str, int]  # number of valid pixels of each flow that its PNG cannot hold
    files: dict[str, StoredFile]  # by the suffix of the file name
    skipped: str = ""  # the reason if the pair does not exist

    @property
    def name(self) -> str:
        """The beginning of the names of the pair's files."""
        return f"{self.number:08d}"

    def as_line(self) -> str:
        """Return the row as a line of JSON."""
        document = self._asdict() | {"files": {suffix: file._asdict() for suffix, file in self.files.items()}}
        return json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n"

    def without_files(self) -> bytes:
        """Return the row as JSON without its files, which a tar holds behind the files of the pair."""
        document = self._asdict()
        del document["files"]
        return json.dumps(document).encode()


class RowLocation(NamedTuple):
    """The location of a row in a manifest file."""

    manifest: Path
    offset: int
    length: int


def tar_path(number: int) -> str:
    """Return the path of a tar of a set."""
    return f"tars/{number:08d}.tar"


def read_row(line: bytes, *, has_files: bool = True) -> PairRow:
    """Parse a line of a manifest, or with `has_files` False the row in a tar, which names no files.

    Raises:
        DamagedPairError: the line is invalid, or the path of a file leads outside of pairs/ and tars/.
    """
    try:
        document = json.loads(line)
        files = {suffix: StoredFile(**file) for suffix, file in (document.pop("files") if has_files else {}).items()}
        row = PairRow(**document, files=files)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise DamagedPairError(f"a row must be one of torchrefract.generate, got {line[:80]!r}") from error
    if not _has_valid_types(row):
        raise DamagedPairError(f"a row must hold values of the types of torchrefract.generate, got {line[:80]!r}")
    for suffix, file in row.files.items():
        if not isinstance(file.path, str) or not _PATH.fullmatch(file.path) or not _SUFFIX.fullmatch(suffix):
            raise DamagedPairError(f"files must lie in pairs/ or tars/ of the set, got {file.path!r} for {suffix!r}")
    return row


def _has_valid_types(row: PairRow) -> bool:
    """Return True if all values have their types and all integers fit 64 bits."""
    counts = [row.number, row.height, row.width, *row.beyond.values()] if isinstance(row.beyond, dict) else [None]
    counts += [number for file in row.files.values() for number in (file.bytes, file.offset)]
    counts += [] if row.frame is None else [row.frame]
    texts = (row.source, row.drive, row.split, row.scene, row.skipped, *(file.sha256 for file in row.files.values()))
    return (
        all(type(number) is int and 0 <= number < _INT64_END for number in counts)
        and all(type(number) is int and -_INT64_END <= number < _INT64_END for number in (row.seed, row.key))
        and all(isinstance(text, str) for text in texts)
        and isinstance(row.effects, list)
        and all(isinstance(effect, dict) for effect in row.effects)
    )


def find_manifests(root: Path) -> list[Path]:
    """Return the manifest files in a folder, sorted."""
    return matching_files(root, _MANIFESTS)


def scan_rows(
    paths: Iterable[Path], keep: Callable[[PairRow], bool], *, skip_invalid: bool = False
) -> Iterator[tuple[PairRow, RowLocation]]:
    """Yield the rows of manifests that `keep` selects and their locations; of several rows of a pair, the first one.

    Invalid lines, which a kill or a full disk leaves behind, are skipped, or raise DamagedPairError.
    """
    seen = set[int]()
    for path in paths:
        offset = 0
        with opened(path) as stream:
            for line in stream:
                try:
                    row = read_row(line)
                except DamagedPairError as error:
                    if not skip_invalid:
                        raise DamagedPairError(f"{path}, byte {offset}: {error}") from error
                else:
                    if row.number not in seen and keep(row):
                        seen.add(row.number)
                        yield row, RowLocation(path, offset, len(line))
                offset += len(line)


def read_lines(locations: Iterable[RowLocation]) -> Iterator[bytes]:
    """Yield the lines at some locations, each with its line break."""
    with ExitStack() as stack:
        streams = dict[Path, BinaryIO]()
        for path, offset, length in locations:
            if path not in streams:
                streams[path] = stack.enter_context(cast(BinaryIO, path.open("rb")))
            streams[path].seek(offset)
            yield streams[path].read(length).rstrip(b"\n") + b"\n"


def read_stored(root: Path, file: StoredFile) -> bytes:
    """Read a file of a pair; raises DamagedPairError if it is missing or too short."""
    try:
        with opened(root / file.path) as stream:
            size = stream.seek(0, os.SEEK_END)
            stream.seek(file.offset)
            # `read` allocates the full count first, which an invalid manifest could make larger than memory.
            data = stream.read(min(file.bytes, size))
    except UnreadableImageError as error:
        raise DamagedPairError(str(error)) from error
    if len(data) != file.bytes:
        raise DamagedPairError(f"{root / file.path} is truncated")
    return data


class Manifest:
    """The manifest that a shard writes: manifest.jsonl if there is a single one, otherwise one file for each shard.

    A store cannot append to a file. There, rows are collected for half a minute and written as a further file, which
    the next `open` or `close` merges into the manifest; a kill costs the rows of half a minute, whose pairs are made
    again.
    """

    def __init__(self, out: Path, shard: int, shards: int):
        self.out = out
        self.path = out / f"manifest{shard_suffix(shard, shards)}.jsonl"
        self._rows, self._parts, self._last = list[PairRow](), 0, time.monotonic()

    def open(
        self, is_in_shard: Callable[[int], bool], *, verify: bool, is_repaired: Callable[[PairRow], bool]
    ) -> tuple[set[int], int]:
        """Write the rows of this shard whose files exist, from all manifests of the folder.

        With `verify`, checksums are compared too. Frames that were skipped are dropped if `is_repaired`, to be tried
        again. Rows move into the manifest of this shard, so that a set that goes on with another number of shards has
        each once.

        Returns:
            the numbers of complete pairs, and the number of damaged pairs that `verify` has detected.
        """
        rows = scan_rows(find_manifests(self.out), lambda row: is_in_shard(row.number), skip_invalid=True)
        size_of = lru_cache(_CHUNK)(lambda path: (self.out / path).stat().st_size)  # a tar holds many pairs
        kept, damaged, check = [], 0, partial(self._is_complete, size_of=size_of, verify=verify)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            while chunk := list(islice(rows, _CHUNK)):
                for (row, location), is_complete in zip(chunk, pool.map(check, [row for row, _ in chunk]), strict=True):
                    if is_complete and not (row.skipped and is_repaired(row)):
                        kept.append((row.number, location))
                    elif verify:
                        damaged += bool(row.files)  # a new file replaces a damaged one, and a tar has intact pairs
        self._write(kept)
        self._remove_parts()
        self._take_rows(is_in_shard)
        return {number for number, _ in kept}, damaged

    def _take_rows(self, is_in_shard: Callable[[int], bool]) -> None:
        """Remove the rows of this shard from the manifests of another number of shards."""
        stem = self.path.stem
        others = f"manifest-[0-9]*{stem[14:]}.*jsonl" if "-of-" in stem else f"{stem}.*jsonl"  # with their parts
        current = set(matching_files(self.out, others))
        with locked("out", self.out, "manifests", wait=True):
            for path in set(find_manifests(self.out)) - current:
                rows = scan_rows([path], lambda row: not is_in_shard(row.number), skip_invalid=True)
                kept = sorted((row.number, location) for row, location in rows)
                if kept:
                    self._write(kept, path)
                else:
                    remove_file(path)
                    remove_shard_config(path)

    def add(self, row: PairRow) -> None:
        """Append the row of a pair whose files are written."""
        self._rows.append(row)
        if not is_remote(self.path) or time.monotonic() - self._last > _PART_SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write the rows that `add` has collected."""
        lines, self._last = "".join(row.as_line() for row in self._rows).encode(), time.monotonic()
        if is_remote(self.path) and lines:
            write_file(self.path.with_name(f"{self.path.stem}.{self._parts:06d}.jsonl"), lines)
            self._parts += 1
        elif lines:
            with self.path.open("ab") as stream:
                stream.write(lines)
        self._rows = []

    def close(self) -> None:
        """Sort the rows by number, those of its parts included."""
        self.flush()
        rows = scan_rows([self.path, *self._part_paths()], lambda _: True, skip_invalid=True)
        self._write([(row.number, location) for row, location in rows])
        self._remove_parts()

    def _part_paths(self) -> list[Path]:
        return matching_files(self.out, f"{self.path.stem}.[0-9]*.jsonl")

    def _remove_parts(self) -> None:
        for path in self._part_paths():
            remove_file(path)

    def _write(self, rows: Sequence[tuple[int, RowLocation]], path: Path | None = None) -> None:
        with replace_file(path or self.path, alone=True) as temporary, temporary.open("wb") as stream:
            stream.writelines(read_lines(location for _, location in sorted(rows)))

    def _is_complete(self, row: PairRow, *, size_of: Callable[[str], int], verify: bool) -> bool:
        """Return True if the files of a pair have their sizes and, with `verify`, their checksums."""
        try:
            sizes = {path: size_of(path) for path in {file.path for file in row.files.values()}}
            for suffix, file in row.files.items():
                end = file.offset + file.bytes
                if sizes[file.path] < end or (file.offset == 0 and sizes[file.path] > end):  # a tar continues
                    return False
                if verify and file.path.endswith(".tar") and not self._has_tar_header(row.name, suffix, file):
                    return False
                if verify and hashlib.sha256(read_stored(self.out, file)).hexdigest() != file.sha256:
                    return False
            in_tar = [file for file in row.files.values() if file.path.endswith(".tar")]
            return not (verify and in_tar) or self._has_row_in_tar(row, max(in_tar, key=lambda file: file.offset))
        except (OSError, DamagedPairError):
            return False

    def _has_row_in_tar(self, row: PairRow, last: StoredFile) -> bool:
        """Return True if the row lies behind the last file of its pair in a tar."""
        content, blocks = row.without_files(), -(-last.bytes // tarfile.BLOCKSIZE)
        file = last._replace(offset=last.offset + (blocks + 1) * tarfile.BLOCKSIZE, bytes=len(content))
        return read_stored(self.out, file) == content and self._has_tar_header(row.name, "json", file)

    def _has_tar_header(self, name: str, suffix: str, file: StoredFile) -> bool:
        """Return True if the header before a file of a tar is intact; other programs stop reading at a damaged one."""
        size = tarfile.BLOCKSIZE
        header = read_stored(self.out, file._replace(offset=file.offset - size, bytes=size))
        try:
            info = tarfile.TarInfo.frombuf(header, "utf-8", "surrogateescape")
        except tarfile.HeaderError:
            return False
        return (info.name, info.size) == (f"{name}.{suffix}", file.bytes)


@contextmanager
def locked(argument: str, folder: Path, name: str = "run", *, wait: bool = False) -> Iterator[None]:
    """Hold a lock on an existing folder until the block or the process ends; on Windows and in a store, do nothing.

    Args:
        argument: that names the folder.
        folder: gets a hidden empty file while the lock is held.
        name: of the lock; locks of different names do not exclude each other.
        wait: True to wait for another process instead of raising.

    Raises:
        UsageError: another process holds the lock.
    """
    if sys.platform == "win32" or is_remote(folder):
        yield
        return
    path = folder / f".{name}.lock"
    while True:
        with path.open("w") as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except BlockingIOError as error:
                raise UsageError(
                    f"{argument} must not be in use, got {folder}, which another run writes to; wait for it, or choose "
                    "another folder"
                ) from error
            # Another process may have removed the file in the meantime.
            if path.exists() and os.path.samestat(os.fstat(stream.fileno()), path.stat()):
                try:
                    yield
                finally:
                    path.unlink(missing_ok=True)
                return


@contextmanager
def locked_shard(out: Path, shard: int, shards: int) -> Iterator[None]:
    """Hold the lock of a shard; raise UsageError if another run makes it, or makes another number of shards."""
    end = f"-of-{shards}"
    with locked("out", out, f"shard-{shard}{end}"):
        for path in out.glob(".shard-*-of-*.lock"):
            if not path.stem.endswith(end):
                with locked("out", out, path.stem.removeprefix(".")):
                    pass
        yield

"""What an output folder holds: whose configuration, which pairs are there, and the manifest that is being written."""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

from torchrefract._io import replace_file
from torchrefract._validation import UsageError
from torchrefract.data.pairs.files import DamagedPairError
from torchrefract.data.pairs.manifest import PairRow, Place, lines_of, manifests, read_stored, scan

_CONFIG = "config.json"
_AT_ONCE = 256  # rows that are looked at together
_LISTED = 6  # differences in a message


class Ledger:
    """The manifest of a shard; of the only one it is the manifest.jsonl of the set."""

    def __init__(self, out: Path, shard: int, shards: int):
        self.out = out
        self.path = out / ("manifest.jsonl" if shards == 1 else f"manifest-{shard:05d}-of-{shards:05d}.jsonl")

    def open(self, mine: Callable[[int], bool], *, verify: bool) -> tuple[set[int], int]:
        """Keep the rows of this shard whose files are there, in whichever manifest they are found.

        Args:
            mine: whether the pair of a number is of this shard.
            verify: whether files are read and compared with their checksums; else their sizes will do. Files that do
                not agree are removed, and frames that could not be read are tried again.

        Returns:
            the numbers of the pairs that are kept, and how many others `verify` has found.
        """
        found, places, damaged = scan(manifests(self.out), lambda row: mine(row.number), torn=True), [], 0
        for rows, whole in _looked_at(found, self._sound if verify else self._there):
            for (row, place), well in zip(rows, whole, strict=True):
                if well and not (verify and row.skipped):
                    places.append((row.number, place))
                elif verify:
                    damaged += bool(row.files)
                    for path in {file.path for file in row.files.values()}:
                        (self.out / path).unlink(missing_ok=True)
        self._write(places)
        return {number for number, _ in places}, damaged

    def add(self, rows: Iterable[PairRow]) -> None:
        """Append the rows of pairs that are written."""
        with self.path.open("ab") as stream:
            stream.write("".join(row.as_line() for row in rows).encode())

    def close(self) -> None:
        """Bring the rows into the order of their numbers."""
        self._write([(row.number, place) for row, place in scan([self.path], lambda _: True, torn=True)])

    def _write(self, places: Sequence[tuple[int, Place]]) -> None:
        with replace_file(self.path, alone=True) as temporary, temporary.open("wb") as stream:
            stream.writelines(lines_of(place for _, place in sorted(places)))

    def _there(self, row: PairRow) -> bool:
        """Whether the files of a pair have their sizes."""
        try:
            sizes = {path: (self.out / path).stat().st_size for path in {file.path for file in row.files.values()}}
        except OSError:
            return False
        # A tar has more behind the file.
        return all(
            sizes[file.path] >= file.offset + file.bytes if file.offset else sizes[file.path] == file.bytes
            for file in row.files.values()
        )

    def _sound(self, row: PairRow) -> bool:
        """Whether the files of a pair have their checksums."""
        try:
            files = [(read_stored(self.out, file), file.sha256) for file in row.files.values()]
        except DamagedPairError:
            return False
        return self._there(row) and all(hashlib.sha256(data).hexdigest() == expected for data, expected in files)


def claim(out: Path, settings: Mapping[str, Any], *, count: int, about: Mapping[str, Any]) -> dict[str, Any]:
    """Make an output folder, or see that it holds pairs of these settings; then write down what is asked of it.

    Args:
        out: the folder.
        settings: all that decides what a pair is, as JSON has it.
        count: pairs of the set; a set may grow, and does not shrink.
        about: what else to write down: it changes no pair.

    Returns:
        what was written down before.

    Raises:
        UsageError: a folder of other settings, or of something else.
        OSError: one that cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    wanted = json.loads(json.dumps(settings))
    path, before = out / _CONFIG, {}
    # Looked for before the configuration is: another shard may be writing both.
    others = sorted(file.name for file in out.iterdir() if not file.name.startswith("."))
    if path.is_file():
        before = _read(path)
        _check_same(before.get("settings", {}), wanted, out)
        if count < before.get("count", 0):
            raise UsageError(f"count must be at least that of the pairs in {out}, {before['count']}, got {count}")
    elif others:
        raise UsageError(f"out must be a new folder or one of this command, got {out}, which holds {others[0]}")
    document = {"settings": wanted, "count": count, **about}
    if document != before:
        with replace_file(path) as temporary:
            temporary.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    return before


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_bytes())
    except ValueError:
        document = None
    if not isinstance(document, dict):
        raise UsageError(f"out must be a folder with a whole {path.name}, got {path}, which is damaged")
    return document


def _check_same(before: Any, wanted: Any, out: Path) -> None:
    there, here = dict(_flat(before)), dict(_flat(wanted))
    different = [name for name in there | here if there.get(name) != here.get(name)]
    if different:
        shown = [f"{name} is {there.get(name)} there and {here.get(name)} here" for name in different[:_LISTED]]
        more = f", and {len(different) - _LISTED} more" if len(different) > _LISTED else ""
        raise UsageError(
            f"out must be a folder of the same configuration, got {out}, where {', '.join(shown)}{more}; choose "
            "another folder"
        )


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The values in nested settings, with dots between their names."""
    if isinstance(value, dict):
        for key, child in value.items():
            yield from _flat(child, f"{name}.{key}" if name else key)
    else:
        yield name, value


_Found = tuple[PairRow, Place]


def _looked_at(
    found: Iterator[_Found], look: Callable[[PairRow], bool]
) -> Iterator[tuple[list[_Found], Iterator[bool]]]:
    """Rows, some at a time, and what a look at each says; files are read and hashed on all cores."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        while rows := list(islice(found, _AT_ONCE)):
            yield rows, pool.map(look, [row for row, _ in rows])

"""Where pairs go: files in folders of a thousand pairs, or tars. A pair or a tar is there whole or not at all.

Files are written under a hidden name and moved. Their data is not forced to the disk one by one, which would take
longer than all the rest: after a kill nothing is lost, as the system still has it; after a power cut files may be
short, which the next run sees by their sizes, or hold zeros, which verify=true finds.
"""

import io
import json
import tarfile
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

from torchrefract._io import replace_file
from torchrefract.data.pairs.generator import Job, Made, Maker
from torchrefract.data.pairs.manifest import PairRow, pair_name

_FOLDER = 1000  # pairs in a folder
_HEAD = 512  # bytes of a tar before each of its files


class Store(ABC):
    """Writes units of pairs; a unit is what is there whole or not at all."""

    def __init__(self, out: Path, unit: int):
        self.out, self.unit = out, unit

    @abstractmethod
    def write(self, jobs: Sequence[Job], maker: Maker) -> list[PairRow]:
        """Make the pairs of a unit and write them; returns their rows."""

    @abstractmethod
    def bytes_of(self, made: Made) -> int:
        """What a pair takes on a disk, about."""


class Folders(Store):
    """A file for each picture and map, pairs/00012/00012345.clean.png; a unit is a pair."""

    def __init__(self, out: Path):
        super().__init__(out, 1)

    def write(self, jobs: Sequence[Job], maker: Maker) -> list[PairRow]:
        """Write the files of the pairs."""
        return [self._write(maker.make(job)) for job in jobs]

    def bytes_of(self, made: Made) -> int:
        """All its files, in blocks of 4 KiB."""
        return sum(-(-len(data) // 4096) * 4096 for data in made.data.values())

    def _write(self, made: Made) -> PairRow:
        folder = f"pairs/{made.row.number // _FOLDER:05d}"
        if made.data:
            (self.out / folder).mkdir(parents=True, exist_ok=True)
        files = {}
        for suffix, data in made.data.items():
            file = made.row.files[suffix]._replace(path=f"{folder}/{made.row.name}.{suffix}")
            with replace_file(self.out / file.path, alone=True) as temporary:
                temporary.write_bytes(data)
            files[suffix] = file
        return made.row._replace(files=files)


class Tars(Store):
    """tars/00000012.tar, of so many pairs that follow one another, as WebDataset has them; a unit is a tar.

    Beside its files each pair has a .json with what the manifest says of it.
    """

    def __init__(self, out: Path, unit: int):
        super().__init__(out, unit)

    def write(self, jobs: Sequence[Job], maker: Maker) -> list[PairRow]:
        """Write a tar."""
        path = f"tars/{pair_name(jobs[0].number // self.unit)}.tar"
        target = self.out / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with (
            replace_file(target, alone=True) as temporary,
            tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar,
        ):
            return [_add_pair(tar, maker.make(job), path) for job in jobs]

    def bytes_of(self, made: Made) -> int:
        """Its files, each with a head and filled up to 512 bytes."""
        sizes = [len(_about(made.row)), *map(len, made.data.values())]
        return sum(_HEAD + -(-size // _HEAD) * _HEAD for size in sizes)


def _about(row: PairRow) -> bytes:
    """What the manifest says of a pair, without its files."""
    document = row._asdict()
    del document["files"]
    return json.dumps(document).encode()


def _add_pair(tar: tarfile.TarFile, made: Made, path: str) -> PairRow:
    files = {}
    for suffix, data in made.data.items():
        files[suffix] = made.row.files[suffix]._replace(path=path, offset=_add(tar, f"{made.row.name}.{suffix}", data))
    if files:
        _add(tar, f"{made.row.name}.json", _about(made.row))
    return made.row._replace(files=files)


def _add(tar: tarfile.TarFile, name: str, data: bytes) -> int:
    """Add a file, of no time and no owner; returns where its bytes begin."""
    start, info = tar.offset, tarfile.TarInfo(name)
    info.size = len(data)
    tar.addfile(info, io.BytesIO(data))
    return start + _HEAD

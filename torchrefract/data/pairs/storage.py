"""Generation of pairs in processes, and their storage: files in folders of a thousand pairs, or tars.

A pair or a tar is always complete. Files are written under a hidden name and then renamed. They are not flushed to
disk one by one, which would take longer than everything else. A kill loses nothing. After a power cut, a file may be
short, which the next run detects by its size, or hold zeros, which verify=true detects.
"""

import io
import json
import multiprocessing
import os
import signal
import tarfile
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.context import BaseContext
from pathlib import Path

import cv2
import torch

from torchrefract._io import replace_file
from torchrefract._validation import UsageError
from torchrefract.data.pairs.generator import GeneratedPair, GenerationConfig, PairGenerator, PairTask
from torchrefract.data.pairs.manifest import PairRow, pair_name

_PAIRS_PER_FOLDER = 1000
_DISK_BLOCK, _TAR_BLOCK = 4096, 512  # bytes
_QUEUED_UNITS = 2  # for each worker, so that none waits


class PairStorage(ABC):
    """Writes units of pairs. A unit is written completely or not at all.

    Args:
        out: the folder of the set.
        unit: number of pairs in a unit.
    """

    def __init__(self, out: Path, unit: int):
        self.out, self.unit = out, unit

    @abstractmethod
    def write(self, tasks: Sequence[PairTask], generator: PairGenerator) -> list[PairRow]:
        """Generate and write the pairs of a unit; return their rows."""

    @abstractmethod
    def disk_bytes(self, pair: GeneratedPair) -> int:
        """Estimate the size of a pair on disk."""


class FileStorage(PairStorage):
    """Writes each image and map to a file of its own, pairs/00012/00012345.clean.png; a unit is a pair."""

    def __init__(self, out: Path):
        super().__init__(out, 1)

    def write(self, tasks: Sequence[PairTask], generator: PairGenerator) -> list[PairRow]:
        """Generate pairs and write their files; return their rows."""
        return [self._write(generator.generate(task)) for task in tasks]

    def disk_bytes(self, pair: GeneratedPair) -> int:
        """Add up the sizes of the files, each rounded up to a block of the file system."""
        return sum(-(-len(data) // _DISK_BLOCK) * _DISK_BLOCK for data in pair.data.values())

    def _write(self, pair: GeneratedPair) -> PairRow:
        folder = f"pairs/{pair.row.number // _PAIRS_PER_FOLDER:05d}"
        if pair.data:
            (self.out / folder).mkdir(parents=True, exist_ok=True)
        files = {}
        for suffix, data in pair.data.items():
            file = pair.row.files[suffix]._replace(path=f"{folder}/{pair.row.name}.{suffix}")
            with replace_file(self.out / file.path, alone=True) as temporary:
                temporary.write_bytes(data)
            files[suffix] = file
        return pair.row._replace(files=files)


class TarStorage(PairStorage):
    """Writes consecutive pairs to a tar in WebDataset's layout, tars/00000012.tar; a unit is a tar.

    A pair has its row of the manifest as a further file, with the suffix json.
    """

    def write(self, tasks: Sequence[PairTask], generator: PairGenerator) -> list[PairRow]:
        """Generate pairs and write them to a tar; return their rows."""
        path = f"tars/{pair_name(tasks[0].number // self.unit)}.tar"
        target = self.out / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with (
            replace_file(target, alone=True) as temporary,
            tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar,
        ):
            return [_add_pair(tar, generator.generate(task), path) for task in tasks]

    def disk_bytes(self, pair: GeneratedPair) -> int:
        """Add up the sizes of the files, each with a header and rounded up to a block of the tar."""
        sizes = [len(_row_without_files(pair.row)), *map(len, pair.data.values())]
        return sum(_TAR_BLOCK + -(-size // _TAR_BLOCK) * _TAR_BLOCK for size in sizes)


def _row_without_files(row: PairRow) -> bytes:
    document = row._asdict()
    del document["files"]
    return json.dumps(document).encode()


def _add_pair(tar: tarfile.TarFile, pair: GeneratedPair, path: str) -> PairRow:
    row, files = pair.row, {}
    for suffix, data in pair.data.items():
        files[suffix] = row.files[suffix]._replace(path=path, offset=_add_file(tar, f"{row.name}.{suffix}", data))
    if files:
        _add_file(tar, f"{row.name}.json", _row_without_files(row))
    return row._replace(files=files)


def _add_file(tar: tarfile.TarFile, name: str, data: bytes) -> int:
    """Add a file without time and owner, so that its bytes are reproducible; return the offset of its content."""
    start, info = tar.offset, tarfile.TarInfo(name)
    info.size = len(data)
    tar.addfile(info, io.BytesIO(data))
    return start + _TAR_BLOCK


def generate_pairs(
    units: Iterable[Sequence[PairTask]], config: GenerationConfig, storage: PairStorage, *, workers: int
) -> Iterator[list[PairRow]]:
    """Generate and write units of pairs; yield the rows of each when it is written, in any order.

    Args:
        units: of `storage`.
        config: of the pairs.
        storage: writes them.
        workers: number of processes; 0 to generate the pairs in this process.

    Raises:
        UsageError: a worker was killed.
        Exception: any error of a worker, after the others have finished their units.
    """
    if workers == 0:
        use_one_thread()
        generator = PairGenerator(config)
        yield from (storage.write(unit, generator) for unit in units)
        return
    pool = ProcessPoolExecutor(workers, mp_context=_context(), initializer=_start, initargs=(config, storage))
    pending = set[Future[list[PairRow]]]()
    try:
        for unit in units:
            pending.add(pool.submit(_write, unit))
            if len(pending) >= _QUEUED_UNITS * workers:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        while pending:
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)
    except BrokenProcessPool as error:
        raise UsageError(
            f"workers must fit the memory, got {workers} of which one was killed; pairs that are written stay, and the "
            "same command continues"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def use_one_thread() -> None:
    """Limit PyTorch and OpenCV to one thread in this process."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def _context() -> BaseContext:
    """Choose the start method of workers: forking this process, which has threads, could hang."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    multiprocessing.set_forkserver_preload([__name__])  # imported once, not in each worker
    return multiprocessing.get_context("forkserver")


class _Worker:
    """The state of a worker process between units."""

    generator: PairGenerator
    storage: PairStorage


def _start(config: GenerationConfig, storage: PairStorage) -> None:
    use_one_thread()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    _Worker.generator, _Worker.storage = PairGenerator(config), storage


def _exit_with_parent() -> None:
    """Exit if the parent is killed; otherwise the worker could write at the same time as the next run."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _write(unit: Sequence[PairTask]) -> list[PairRow]:
    return _Worker.storage.write(unit, _Worker.generator)

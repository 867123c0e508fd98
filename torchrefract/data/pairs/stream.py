"""Pairs read from tars one after another, for object stores and slow disks."""

import tarfile
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from torch.utils.data import Dataset, IterableDataset, default_collate, get_worker_info

from torchrefract._validation import check_count
from torchrefract.data.images import UnreadableImageError, opened
from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.pairs.files import DamagedPairError
from torchrefract.data.pairs.manifest import read_row
from torchrefract.types import Pair

_Sample = Mapping[str, Any]  # the content of each file of a pair by its suffix, and names of webdataset with __


class PairStream(IterableDataset[Pair]):
    """The pairs of tars one after another, each once an epoch; needs the package webdataset.

    Each worker of a DataLoader in each process reads its own part of the tars, whose order depends on the epoch. A
    buffer then shuffles the pairs.

    Args:
        root: the folder with tars/, or its address.
        split: "all", "train" or "val".
        buffer: number of pairs to choose the next one from, which are kept in memory as in the tars; 1 keeps the order
            of the tars and of their pairs.
        seed: of the order, at least 0.
        rank, ranks: index of this process, and number of processes.

    Raises:
        ValueError: see `PairedFolder`; the pairs are files.
        DamagedPairError: on iteration, a tar is damaged or lacks a pair.
    """

    def __init__(
        self, root: str | Path, *, split: str = "all", buffer: int = 1, seed: int = 0, rank: int = 0, ranks: int = 1
    ):
        self.pairs = PairedFolder(root, split=split)
        check_streamed(self.pairs)
        self.buffer = check_count("buffer", buffer)
        self.seed = check_count("seed", seed, low=0)
        self.ranks = check_count("ranks", ranks)
        self.rank = check_count("rank", rank, low=0)
        if rank >= ranks:
            raise ValueError(f"rank must be below ranks = {ranks}, got {rank}")
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Select the order of an epoch, at least 0."""
        self.epoch = check_count("epoch", epoch, low=0)

    def __iter__(self) -> Iterator[Pair]:
        worker = get_worker_info()
        index, count = (worker.id, worker.num_workers) if worker else (0, 1)
        part = _part(len(self.pairs), self.rank * count + index, self.ranks * count)
        samples = _read(self.pairs, part, buffer=self.buffer, seed=(self.seed, self.epoch))
        return (_decode(self.pairs, sample) for sample in samples)


class PairBatches(Dataset[Pair]):
    """Batches of the pairs of tars for one of several processes; each pair is in one batch of one process.

    All processes have the same number of batches, as distributed training needs it, so the sizes of batches may differ
    by a pair.

    Args:
        pairs: the pairs of tars.
        batch_size: largest size; one more if the pairs of a process are not a multiple of a batch_size of 1.
        workers: number of workers of the DataLoader, each of which reads its own part.
        buffer, seed, rank, ranks: see `PairStream`.
    """

    def __init__(
        self, pairs: PairedFolder, *, batch_size: int, workers: int, buffer: int, seed: int, rank: int, ranks: int
    ):
        self.pairs, self.buffer, self.seed = pairs, buffer, seed
        self.readers = max(1, workers)
        self.first, self.all_readers = rank * self.readers, ranks * self.readers
        smallest, largest = len(pairs) // self.all_readers, -(-len(pairs) // self.all_readers)
        self.num_batches = min(-(-largest // batch_size), smallest)  # of each reader
        self._next = (-1, -1)
        self._samples: Iterator[_Sample] = iter(())

    def __len__(self) -> int:
        return self.readers * self.num_batches

    def __getitem__(self, index: tuple[int, int] | int) -> Pair:
        """Read the batch (epoch, number), or a number of epoch 0.

        In a worker that has not just read the one before, read over the earlier.
        """
        epoch, number = index = (0, index) if isinstance(index, int) else index
        turn, reader = divmod(number, self.readers)
        part = _part(len(self.pairs), self.first + reader, self.all_readers)
        batch = _part(len(part), turn, self.num_batches)
        if self._next != index:
            samples = _read(self.pairs, part, buffer=self.buffer, seed=(self.seed, epoch))
            self._samples = islice(samples, batch.start, None)
        self._next = epoch, number + self.readers
        return default_collate([_decode(self.pairs, sample) for sample in islice(self._samples, len(batch))])


def check_streamed(pairs: PairedFolder | None) -> None:
    """Raise ValueError unless the pairs are in tars and webdataset is installed."""
    if pairs is None:
        raise ValueError("buffer must be null unless the data are pairs in tars")
    pairs.tars()
    try:
        import webdataset  # noqa: F401, PLC0415  # only its absence matters here
    except ImportError as error:
        raise ValueError("buffer needs the package webdataset: pip install 'torchrefract[remote]'") from error


def _part(total: int, index: int, count: int) -> range:
    """Return one of `count` parts of equal size, up to one, of the numbers below `total`."""
    return range(index * total // count, (index + 1) * total // count)


def _read(pairs: PairedFolder, part: range, *, buffer: int, seed: tuple[int, int]) -> Iterator[_Sample]:
    """Yield a part of the pairs in the order of a seed and an epoch."""
    from webdataset.filters import shuffle  # noqa: PLC0415  # in an extra

    tars = pairs.tars()
    if buffer == 1:
        return _part_of_tars(pairs.root, tars, part)
    order = np.random.default_rng(seed).permutation(len(tars))
    samples = _part_of_tars(pairs.root, [tars[i] for i in order], part)
    return shuffle(buffer, initial=buffer, rng=Random(repr((*seed, part.start))))(samples)


def _part_of_tars(root: Path, tars: Sequence[tuple[str, np.ndarray]], part: range) -> Iterator[_Sample]:
    start = 0
    for path, numbers in tars:
        selected = numbers[max(0, part.start - start) : max(0, part.stop - start)]
        start += len(numbers)
        if len(selected):
            yield from _read_tar(root / path, {f"{number:08d}" for number in selected})


def _read_tar(path: Path, names: set[str]) -> Iterator[_Sample]:
    """Yield the pairs of a tar that have some names."""
    from webdataset.tariterators import group_by_keys, tar_file_expander  # noqa: PLC0415  # in an extra

    try:
        with opened(path) as stream:
            for sample in group_by_keys(tar_file_expander([{"url": str(path), "stream": stream}])):
                if sample["__key__"] in names:
                    yield sample
                    names.remove(sample["__key__"])
                if not names:
                    return
        reason = f"it lacks pair {min(names)}"
    except UnreadableImageError as error:
        reason = str(error).removeprefix(f"{path} ")
    except (tarfile.TarError, OSError, EOFError, ValueError) as error:
        reason = str(error.args[0]).partition(" @ ")[0]  # webdataset adds the file
    raise DamagedPairError(
        f"{path} must be a whole tar of the pairs in the manifest, got a damaged one ({reason}); torchrefract.generate "
        "with verify=true makes it again"
    )


def _decode(pairs: PairedFolder, sample: _Sample) -> Pair:
    row = read_row(sample.get("json", b""), has_files=False)
    names = (name for name in sample if name != "json" and not name.startswith("__"))
    return pairs.decode(row, {name: partial(bytes, sample[name]) for name in names})

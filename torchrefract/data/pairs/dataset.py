"""Datasets of pairs on disk, as `torchrefract.generate` writes them: in any order, or from tars one after another."""

import tarfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, default_collate, get_worker_info

from torchrefract._io import as_path
from torchrefract._tensor import to_float
from torchrefract._validation import check_choice, check_count, check_flag, check_size
from torchrefract.data.images import UnreadableImageError, crop_center, opened, reduce_by_area
from torchrefract.data.pairs.files import DamagedPairError, decode_pair
from torchrefract.data.pairs.manifest import PairRow, find_manifests, read_row, read_stored, scan_rows, tar_path
from torchrefract.types import Pair
from torchrefract.warping.grid import inside

_SPLITS = ("all", "train", "val")
_ALL_VALID = 0.999  # mean of a mask, up to rounding
_FLOW, _VALID, _TRANSMISSION = "restore_flow", "restore_valid", "transmission"
_Sample = Mapping[str, Any]  # the content of each file of a pair by its suffix, and names of webdataset with __


class PairedFolder(Dataset[Pair]):
    """The pairs in a folder in the order of their numbers.

    A pair equals what `make_pair` computes from its frame, in the precision of its files. Rows of the manifest are
    read on access, so that the dataset takes 40 bytes of memory a pair.

    Args:
        root: the folder with pairs/ or tars/.
        split: "all", "train" or "val".
        transmission: True to load the transmission of each pair.
        flow: True to require a flow in each pair; otherwise, a pair without one has a flow of zeros.
        size: (height, width) to which pairs are cropped and reduced, see `reduce_pair`; None keeps their own size.

    Raises:
        ValueError: the folder has no pairs of the split, or a manifest is damaged. On access: a file is damaged, the
            pair lacks a required map, or it is smaller than `size`.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        split: str = "all",
        transmission: bool = False,
        flow: bool = False,
        size: Sequence[int] | None = None,
    ):
        self.root = as_path(root)
        self.split = check_choice("split", split, _SPLITS)
        self.transmission = check_flag("transmission", transmission)
        self.flow = check_flag("flow", flow)
        self.size = None if size is None else check_size("size", size)
        self._manifests = find_manifests(self.root)
        if not self._manifests:
            raise ValueError(f"root must be a folder with manifest.jsonl, got {self.root}")
        numbers = {path: i for i, path in enumerate(self._manifests)}
        rows = [
            (row.number, _tar_number(row), numbers[location.manifest], location.offset, location.length)
            for row, location in scan_rows(self._manifests, self._is_in_split)
        ]
        if not rows:
            remedy = "; generate it from frames of two or more drives" if split == "val" else ""
            raise ValueError(f"root must hold pairs of the split {split}, got none in {self.root}{remedy}")
        self._locations = np.array(sorted(rows), dtype=np.int64)

    def __len__(self) -> int:
        return len(self._locations)

    def __getitem__(self, index: int) -> Pair:
        """Load a pair.

        Returns:
            degraded and clean image (3, H, W), flow (2, H, W), validity mask (1, H, W), key () and transmission
            (1, H, W), or (0,) if it is not loaded.
        """
        row = self.row(index)
        return self.decode(row, {suffix: partial(read_stored, self.root, file) for suffix, file in row.files.items()})

    def _origin(self, row: PairRow) -> str:
        return f"pair {row.number} of the scene {row.scene} in {self.root}"

    def decode(self, row: PairRow, files: Mapping[str, Callable[[], bytes]]) -> Pair:
        """Make a pair of its row and of functions that read its files, by suffix."""
        try:
            arrays = decode_pair(
                files,
                (_FLOW, _VALID, _TRANSMISSION) if self.transmission else (_FLOW, _VALID),
                size=(row.height, row.width),
            )
        except DamagedPairError as error:
            raise DamagedPairError(
                f"pair {row.number} in {self.root} must be whole, got {error}; torchrefract.generate with "
                "verify=true makes it again"
            ) from error
        if self.transmission and _TRANSMISSION not in arrays.maps:
            raise ValueError(f"root must hold pairs with a transmission, as of fog, got {self._origin(row)} without")
        if self.flow and _FLOW not in arrays.maps:
            raise ValueError(f"root must hold pairs with a flow, as of a lens, got {self._origin(row)} without")
        size = arrays.clean.shape[:2]
        flow = arrays.maps.get(_FLOW, np.zeros((2, *size), np.float32))
        valid = arrays.maps[_VALID] if _FLOW in arrays.maps else np.ones(size, dtype=bool)
        pair = Pair(
            _image(arrays.corrupted),
            _image(arrays.clean),
            torch.from_numpy(flow),
            torch.from_numpy(valid)[None],
            torch.tensor(row.key, device="cpu"),
            torch.from_numpy(arrays.maps[_TRANSMISSION])[None]
            if self.transmission
            else torch.empty(0, dtype=torch.float32, device="cpu"),
        )
        return pair if self.size is None else reduce_pair(pair, self.size)

    def row(self, index: int) -> PairRow:
        """Read the manifest's row of a pair."""
        number, offset, length = self._locations[index, 2:].tolist()
        with opened(self._manifests[number]) as stream:
            stream.seek(offset)
            return read_row(stream.read(length))

    def rows(self) -> Iterator[PairRow]:
        """Read all rows of the split, in the order of the manifest."""
        return (row for row, _ in scan_rows(self._manifests, self._is_in_split))

    def tars(self) -> list[tuple[str, np.ndarray]]:
        """Return the path of each tar, relative to the root, and the numbers of its pairs of the split.

        Raises:
            ValueError: the pairs are files.
        """
        numbers, tars = self._locations[:, 0], self._locations[:, 1]
        if (tars < 0).any():
            raise ValueError(f"root must hold tars to be streamed, got files in {self.root}; give generate tar=200")
        parts = np.split(numbers, np.flatnonzero(np.diff(tars)) + 1)
        return [(tar_path(tar), part) for tar, part in zip(np.unique(tars), parts, strict=True)]

    def _is_in_split(self, row: PairRow) -> bool:
        return not row.skipped and self.split in ("all", row.split)


def reduce_pair(pair: Pair, size: tuple[int, int]) -> Pair:
    """Crop the center of a pair to the aspect ratio of `size` = (height, width) and reduce it by area averaging.

    A pixel is valid if all that it covers is, and if its flow stays in the crop.
    """
    light = pair.transmission.reshape(len(pair.transmission), *pair.clean.shape[1:])  # (0, H, W) if it is not loaded
    crop = crop_center(torch.cat([pair.degraded, pair.clean, pair.flow, pair.valid.float(), light]), size)
    degraded, clean, flow, valid, light = reduce_by_area(crop, size).split([3, 3, 2, 1, len(light)])
    scale = torch.tensor([size[1] / crop.shape[2], size[0] / crop.shape[1]], dtype=torch.float32, device="cpu")
    flow = flow * scale.view(2, 1, 1)
    return pair._replace(
        degraded=degraded.clamp(0, 1),
        clean=clean.clamp(0, 1),
        flow=flow,
        valid=(valid > _ALL_VALID) & inside(flow[None])[0],
        transmission=light if len(light) else pair.transmission,
    )


def _tar_number(row: PairRow) -> int:
    """Return the number of the tar that holds a pair; -1 if its files are not in a tar."""
    path = next((file.path for file in row.files.values()), "")
    return int(path.removeprefix("tars/").removesuffix(".tar")) if path.startswith("tars/") else -1


def _image(pixels: np.ndarray) -> Tensor:
    """Convert (H, W, 3), uint8, into (3, H, W), float32, in [0, 1]."""
    return to_float(torch.from_numpy(pixels).permute(2, 0, 1).contiguous())


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

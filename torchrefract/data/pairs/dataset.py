"""Pairs from disk, as `torchrefract.generate` writes them: any of them by its number, or one after another."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from torchrefract._tensor import to_float
from torchrefract._validation import check_choice, check_count, check_flag
from torchrefract.data.pairs.files import DamagedPairError, decode_pair
from torchrefract.data.pairs.manifest import PairRow, Place, lines_of, manifests, read_row, read_stored, scan
from torchrefract.types import Pair

_SPLITS = ("all", "train", "val")
_FLOW, _PASSED = "restore_flow", "transmission"
_NEEDED = (_FLOW, "restore_valid")


class PairedFolder(Dataset[Pair]):
    """The pairs in a folder, all of them or those of one split, in the order of their numbers.

    A pair is what `make_pair` would have made of its frame on the fly, in the precision of its files. Rows of the
    manifest are read when they are asked for, so that a set of any size takes 24 bytes a pair.

    Args:
        root: the folder, with pairs/ or tars/ in it.
        split: "all", "train" or "val", by drive.
        transmission: whether pairs are read with theirs.
        flow: whether pairs must have one; of those that need none it is zero.

    Raises:
        ValueError: a folder without pairs of the split; a damaged manifest; in `[]`, a damaged file, or a pair without
            the transmission or the flow that is asked for.
    """

    def __init__(self, root: str | Path, *, split: str = "all", transmission: bool = False, flow: bool = False):
        self.root = Path(root).expanduser()
        self.split = check_choice("split", split, _SPLITS)
        self.transmission = check_flag("transmission", transmission)
        self.flow = check_flag("flow", flow)
        self._manifests = manifests(self.root)
        if not self._manifests:
            raise ValueError(f"root must be a folder with manifest.jsonl, got {self.root}")
        numbers = {path: i for i, path in enumerate(self._manifests)}
        found = [
            (row.number, numbers[at.manifest], at.offset, at.length) for row, at in scan(self._manifests, self._has)
        ]
        if not found:
            raise ValueError(f"root must hold pairs of the split {split}, got none in {self.root}")
        self._places = np.array(sorted(found), dtype=np.int64)[:, 1:]

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> Pair:
        """Pair of a degraded and a clean image (3, H, W), a flow (2, H, W), its mask (1, H, W) and a key ().

        And a transmission, (1, H, W), or (0,) where none is asked for.
        """
        row = self.row(index)
        try:
            arrays = decode_pair(
                {suffix: partial(read_stored, self.root, file) for suffix, file in row.files.items()},
                (*_NEEDED, _PASSED) if self.transmission else _NEEDED,
            )
        except DamagedPairError as error:
            raise DamagedPairError(
                f"pair {row.number} in {self.root} must be whole, got {error}; torchrefract.generate with verify=true "
                "makes it again"
            ) from error
        asked = ((self.transmission, _PASSED, "transmission, as of fog"), (self.flow, _FLOW, "flow, as of a lens"))
        for wanted, name, words in asked:
            if wanted and name not in arrays.maps:
                raise ValueError(f"root must hold pairs with a {words}, got {row.number} in {self.root}")
        size = arrays.clean.shape[:2]
        flow = arrays.maps.get(_FLOW, np.zeros((2, *size), np.float32))
        valid = arrays.maps["restore_valid"] if _FLOW in arrays.maps else np.ones(size, dtype=bool)
        degraded, clean = _image(arrays.corrupted), _image(arrays.clean)
        passed = torch.from_numpy(arrays.maps[_PASSED])[None] if self.transmission else torch.empty(0)
        return Pair(
            degraded, clean, torch.from_numpy(flow), torch.from_numpy(valid)[None], torch.tensor(row.key), passed
        )

    def row(self, index: int) -> PairRow:
        """What the manifest says of a pair of the split."""
        number, offset, length = self._places[index].tolist()
        (line,) = lines_of([Place(self._manifests[number], offset, length)])
        return read_row(line)

    def rows(self) -> Iterator[PairRow]:
        """What the manifest says of all pairs of the split, in its order."""
        return (row for row, _ in scan(self._manifests, self._has))

    def _has(self, row: PairRow) -> bool:
        return not row.skipped and self.split in ("all", row.split)


class PairStream(IterableDataset[Pair]):
    """The pairs of a folder one after another, for sets in tars or on slow disks; each once an epoch.

    Every reader, a worker of a DataLoader in one of `ranks` processes, has a stretch of the set of its own, and reads
    it from one end to the other; an order of the epoch comes of a buffer.

    Args:
        root, split: as for `PairedFolder`.
        buffer: pairs to choose the next one from; 1 keeps their order.
        seed: of the order.
        rank, ranks: which of how many processes this is.
    """

    def __init__(
        self, root: str | Path, *, split: str = "all", buffer: int = 1, seed: int = 0, rank: int = 0, ranks: int = 1
    ):
        self.pairs = PairedFolder(root, split=split)
        self.buffer = check_count("buffer", buffer)
        self.seed = check_count("seed", seed, low=0)
        self.ranks = check_count("ranks", ranks)
        self.rank = check_count("rank", rank, low=0)
        if rank >= ranks:
            raise ValueError(f"rank must be below ranks = {ranks}, got {rank}")
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """The order is that of this epoch."""
        self.epoch = check_count("epoch", epoch, low=0)

    def __iter__(self) -> Iterator[Pair]:
        worker = get_worker_info()
        number, readers = (worker.id, worker.num_workers) if worker else (0, 1)
        reader, readers = self.rank * readers + number, self.ranks * readers
        count = len(self.pairs)
        mine = range(reader * count // readers, (reader + 1) * count // readers)
        yield from map(self.pairs.__getitem__, _mixed(mine, self.buffer, (self.seed, self.epoch, reader)))


def _mixed(numbers: range, size: int, seed: tuple[int, int, int]) -> Iterator[int]:
    """The numbers, each time one out of the next `size` that are left."""
    dice, held = np.random.default_rng(seed), list[int]()
    for number in numbers:
        held.append(number)
        if len(held) == size:
            yield held.pop(dice.integers(len(held)))
    while held:
        yield held.pop(dice.integers(len(held)))


def _image(pixels: np.ndarray) -> Tensor:
    """(3, H, W), float32 in [0, 1], of (H, W, 3), uint8."""
    return to_float(torch.from_numpy(pixels).permute(2, 0, 1).contiguous())

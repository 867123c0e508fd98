"""Pairs read from tars one after another: each once, in an order that a resumed training continues."""

from collections.abc import Callable, Iterator
from pathlib import Path

import fsspec
import pytest
import torch
from torch.utils.data import DataLoader

from torchrefract import Pair, UniformFog
from torchrefract._validation import UsageError
from torchrefract.data.module import PairData, pairs
from torchrefract.data.pairs import PairedFolder, PairStream
from torchrefract.data.pairs.files import DamagedPairError
from torchrefract.data.road_scenes import RoadScenes

pytest.importorskip("webdataset")  # in its own extra
COUNT = 23  # of the pairs in the tars
Make = Callable[..., Path]


@pytest.fixture
def copied(tars, tmp_path) -> Path:
    """Return a copy of the tars to damage."""
    fsspec.filesystem("file").copy(str(tars), str(tmp_path / "out"), recursive=True)
    return tmp_path / "out"


def keys_of(batches: list[Pair]) -> list[int]:
    return [key for batch in batches for key in batch.key.tolist()]


def keys_in(root: Path, split: str = "all") -> list[int]:
    return sorted(row.key for row in PairedFolder(root, split=split).rows())


@pytest.mark.parametrize(("workers", "ranks", "buffer"), [(0, 1, 1), (0, 3, 16), (2, 2, 3), (2, 20, 1)])
def test_a_stream_yields_each_pair_once(tars, workers, ranks, buffer):
    keys = []
    for rank in range(ranks):
        stream = PairStream(tars, buffer=buffer, rank=rank, ranks=ranks)
        keys += [int(pair.key) for pair in DataLoader(stream, batch_size=None, num_workers=workers * (ranks < 5))]
    expected = [int(pair.key) for pair in (PairedFolder(tars)[i] for i in range(COUNT))]
    assert sorted(keys) == sorted(expected)
    assert (keys == expected) == (buffer == 1)


def test_streamed_pairs_are_those_of_the_folder(tars):
    folder, stream = PairedFolder(tars, split="val"), list(PairStream(tars, split="val"))
    for i, pair in enumerate(stream):
        for name, a, b in zip(Pair._fields, pair, folder[i], strict=True):
            assert torch.equal(a, b), name
    assert len(folder) == len(stream) > 3


def test_the_order_of_a_stream_depends_on_the_epoch_and_mixes_the_tars(tars):
    stream, orders = PairStream(tars, buffer=4, seed=5), []
    for epoch in (0, 1, 0):
        stream.set_epoch(epoch)
        orders.append([int(pair.key) for pair in stream])
    assert orders[0] == orders[2] != orders[1]
    tar_of = {row.key: row.number // 3 for row in PairedFolder(tars).rows()}
    assert len({tar_of[key] for key in orders[0][:6]}) > 2


def streamed(root: Path | str, *, batch_size: int = 3, workers: int = 0) -> PairData:
    return pairs(root=root, batch_size=batch_size, workers=workers, buffer=4)


@pytest.mark.parametrize(
    ("ranks", "workers", "batch_size"), [(1, 0, 4), (1, 2, 4), (2, 0, 3), (2, 2, 2), (3, 2, 1), (5, 0, 1)]
)
def test_each_pair_is_in_one_batch_of_one_rank_and_all_ranks_have_as_many_batches(
    tars, batches, ranks, workers, batch_size
):
    for training, split in ((True, "train"), (False, "val")):
        data = streamed(tars, workers=workers, batch_size=batch_size)
        parts = [batches(data, training=training, ranks=ranks, rank=rank) for rank in range(ranks)]
        assert sorted(key for part in parts for key in keys_of(part)) == keys_in(tars, split)
        assert len({len(part) for part in parts}) == 1
        sizes = [len(batch.key) for part in parts for batch in part]
        assert max(sizes) - min(sizes) <= 1 or batch_size > len(PairedFolder(tars, split=split)) // ranks
        assert max(sizes) <= max(batch_size, 2)


@pytest.fixture
def in_memory(tars) -> Iterator[str]:
    """Return the address of the tars in memory://."""
    store = fsspec.filesystem("memory")
    store.put(str(tars), "/streamed", recursive=True)
    yield "memory://streamed"
    store.rm("/streamed", recursive=True)


@pytest.mark.parametrize("start", [0, 1, 3])
@pytest.mark.parametrize("workers", [0, 2])
def test_a_stream_in_a_store_continues_within_an_epoch(tars, in_memory, batches, workers, start):
    expected = batches(streamed(tars, workers=workers), epoch=1)
    data = streamed(in_memory, workers=workers)
    data.load_state_dict({"epoch": 1, "batches": start, "of": len(expected)})
    rest = batches(data, epoch=1)
    assert len(expected) > 4
    assert keys_of(rest) == keys_of(expected[start:])
    assert keys_of(batches(data, epoch=2)) != keys_of(expected)  # the loader goes on with a complete epoch


def test_an_epoch_that_is_continued_with_other_batches_raises(tars, batches):
    data = streamed(tars)
    data.load_state_dict({"epoch": 1, "batches": 2, "of": 9})
    with pytest.raises(UsageError, match="ckpt_path within an epoch of 9 batches must be continued with the same"):
        batches(data, epoch=1)
    data.load_state_dict({"epoch": 1, "batches": 0, "of": 9})
    assert sorted(keys_of(batches(data, epoch=1))) == keys_in(tars, "train")


def test_streamed_files_raise(call, words, tmp_path):
    assert call("generate", *words("out", "count=4")).code == 0
    with pytest.raises(ValueError, match="root must hold tars to be streamed, got files in "):
        pairs(root=tmp_path / "out", batch_size=1, buffer=4)
    scenes = RoadScenes(4, size=(8, 12))
    with pytest.raises(ValueError, match="buffer must be null unless the data are pairs in tars"):
        PairData(scenes, scenes, effect=UniformFog(), batch_size=2, buffer=4)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("short", r"out/tars/00000001.tar must be a whole tar of the pairs in the manifest, got a damaged one \("),
        ("lost", r"out/tars/00000001.tar must be a whole tar of the pairs in the manifest, got a damaged one \("),
        ("other", r"got a damaged one \(it lacks pair 00000003\)"),
        ("flipped", r"pair 3 in .*out must be whole, got .* is damaged"),
    ],
)
def test_a_damaged_tar_raises(copied, damage, message):
    path = copied / "tars" / "00000001.tar"
    if damage == "short":
        path.write_bytes(path.read_bytes()[:3000])
    elif damage == "lost":
        path.unlink()
    elif damage == "other":
        path.write_bytes((copied / "tars" / "00000000.tar").read_bytes())
    else:
        file = PairedFolder(copied).row(3).files["clean.png"]
        data = bytearray(path.read_bytes())
        data[file.offset + file.bytes // 2] ^= 1
        path.write_bytes(data)
    with pytest.raises(DamagedPairError, match=message):
        list(PairStream(copied))

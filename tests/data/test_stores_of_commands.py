"""Sources and outputs of `degrade`, and frames of `train`, in object stores: as on disk, also after a kill."""

import json
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fsspec.implementations.memory import MemoryFileSystem
from processes import running, wait_for
from stores import digests, failing_writes
from torch.utils.data import DataLoader

from torchrefract._io import as_path
from torchrefract.data.frames import FrameFolder
from torchrefract.data.module import fingerprint
from torchrefract.data.pairs import PairedFolder
from torchrefract.data.video import write_video

WORDS = ("scene=paper_refractive", "workers=0")
NAMES = ("drive0/a [1].png", "drive0/b.png", "drive1/c.png", "d.mp4")


@pytest.fixture
def raw(frames, tmp_path) -> Path:
    """Write three pictures and a video of even sides into a folder."""
    folder = tmp_path / "raw"
    for name, source in zip(NAMES, sorted(frames.rglob("*.png")), strict=False):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if name.endswith(".png"):
            shutil.copy(source, folder / name)
    write_video([np.full((32, 48, 3), 20 * i, np.uint8) for i in range(3)], folder / "d.mp4", fps=10, size=(48, 32))
    return folder


@pytest.fixture
def stored(memory, raw) -> MemoryFileSystem:
    """Return the store memory:// with the files in memory://raw."""
    memory.put(str(raw), "/raw", recursive=True)
    return memory


def results(folder: str | Path) -> dict[str, str]:
    """Return the checksums of the files in a folder but for the settings, which name the source."""
    return {name: data for name, data in digests(folder).items() if name != "config.json"}


@pytest.mark.parametrize("maps", ["false", "true"])
def test_pictures_and_videos_in_a_store_are_degraded_as_on_disk(call, stored, tmp_path, maps):
    outcome = call("degrade", *WORDS, f"maps={maps}", "source=memory://raw", "out=memory://out")
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out.startswith("memory://out: 4 degraded, 0 already existed, 0 skipped")
    assert call("degrade", *WORDS, f"maps={maps}", "source=raw", "out=out").code == 0
    assert call("degrade", *WORDS, f"maps={maps}", "source=memory://raw", "out=mixed").code == 0
    assert results("memory://out") == results(tmp_path / "out") == results(tmp_path / "mixed")
    for out in ("memory://out", "mixed"):
        outcome = call("degrade", *WORDS, f"maps={maps}", "source=memory://raw", f"out={out}")
        assert outcome.out.startswith(f"{out}: 0 degraded, 4 already existed, 0 skipped")
    message = call("degrade", *WORDS, f"maps={maps}", "seed=3", "source=memory://raw", "out=memory://out").message
    assert message.startswith("out must be a folder of the same configuration, got memory://out, where seed is 0 there")


def test_a_stopped_run_of_degrade_in_a_store_continues(call, stored, tmp_path):
    words = (*WORDS, "source=memory://raw", "out=memory://out")
    with failing_writes(KeyboardInterrupt(), suffix="b.png"):
        assert call("degrade", *words).code == 130
    assert call("degrade", *words).out.startswith("memory://out: 2 degraded, 2 already existed, 0 skipped")
    assert call("degrade", *WORDS, "source=raw", "out=out").code == 0
    assert results("memory://out") == results(tmp_path / "out")


def test_a_file_that_vanishes_from_a_store_is_named_and_degraded_by_the_next_run(call, stored, monkeypatch):
    data, address = stored.cat_file("/raw/drive0/b.png"), "memory://raw/drive0/b.png"
    words = (*WORDS, "source=memory://raw", "out=memory://out")
    with monkeypatch.context() as patch:
        patch.setattr("torchrefract.data.media.describe_losses", lambda *_, **__: stored.rm("/raw/drive0/b.png") or [])
        outcome = call("degrade", *words)
    reason = f"{address} cannot be opened (No such file or directory)"
    assert outcome.err.splitlines() == [
        f"skipped: {reason}",
        f"error: source must stay unchanged during a run, got {reason}; the same command tries them again",
    ]
    stored.pipe_file("/raw/drive0/b.png", b"no picture")
    assert call("degrade", *words).err == f"skipped: {address} is not a JPEG, PNG, WebP or BMP image\n"
    stored.pipe_file("/raw/drive0/b.png", data)
    assert call("degrade", *words).out.startswith("memory://out: 1 degraded, 3 already existed, 0 skipped")


def test_a_store_that_denies_writing_is_one_line_of_degrade(call, stored):
    with failing_writes(PermissionError("Access Denied"), suffix=".png"):
        message = call("degrade", *WORDS, "source=memory://raw", "out=memory://out").message
    assert message == "out must be a folder that can be written to, got memory://out (Permission denied)"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("workers=1",), "workers must be 0 for out=memory://out, because each process has its memory, got 1"),
        (("source=memory://none",), "source must be a folder, a picture or a video, got memory://none, which does not"),
        (("out=memory://raw",), "out must be another folder than that of source, got memory://raw"),
        (("out=memory://raw/out",), "out must be a folder that does not lie in that of source, got memory://raw/out"),
        (("labels=coco.json",), "out must lie on this machine for labels of COCO, which a run continues line by line"),
    ],
)
def test_an_invalid_address_of_degrade_is_one_line(call, stored, tmp_path, words, message):
    document = {"images": [{"id": 0, "file_name": "drive0/b.png", "height": 32, "width": 48}], "annotations": []}
    (tmp_path / "coco.json").write_text(json.dumps(document | {"categories": []}))
    assert call("degrade", *WORDS, "source=memory://raw", "out=memory://out", *words).message.startswith(message)


@pytest.mark.parametrize("protocol", ["s3", "gs"])
def test_a_run_of_degrade_in_a_bucket_that_is_killed_continues_to_the_bytes_on_disk(
    call, frames, tmp_path, request, protocol
):
    request.getfixturevalue(protocol)
    bucket = f"{protocol}://bucket"
    store: Any = as_path(bucket)
    store.fs.put(str(frames), "bucket/raw", recursive=True)
    words = ("scene=paper_refractive", f"source={bucket}/raw", f"out={bucket}/fog", "workers=1")
    with running("-m", "torchrefract.degrade", *words) as run:
        wait_for(lambda: store.fs.glob("bucket/fog/drive0/*"), run)
    assert run.returncode == -signal.SIGKILL
    outcome = call("degrade", *words, "workers=0")
    assert outcome.code == 0
    assert "0 already existed" not in outcome.out
    assert call("degrade", *WORDS, f"source={frames}", "out=fog").code == 0
    assert results(f"{bucket}/fog") == results(tmp_path / "fog")


def test_frames_in_a_store_are_those_on_disk(memory, frames):
    memory.put(str(frames), "/frames", recursive=True)
    for split in ("train", "val"):
        disk, store = (FrameFolder(root, size=(16, 24), split=split) for root in (frames, "memory://frames"))
        assert store.keys == disk.keys
        assert store.drive_names == disk.drive_names
        assert torch.equal(torch.stack([frame.image for frame in store]), torch.stack([frame.image for frame in disk]))
        assert fingerprint(store)["sha256"] == fingerprint(disk)["sha256"]
    memory.pipe_file("/frames/drive0/000.png", b"no picture")
    with pytest.warns(UserWarning, match=r"1 of 12 frames in memory://frames cannot be read and are skipped: drive0/"):
        assert len(FrameFolder("memory://frames", size=(16, 24))) == 11
    with pytest.raises(FileNotFoundError, match="root must be a folder of frames, got memory://none, which does not"):
        FrameFolder("memory://none", size=(16, 24))


@pytest.mark.usefixtures("blank_figures")
def test_a_training_on_frames_in_a_store_is_that_on_disk(call, memory, frames, small):
    memory.put(str(frames), "/frames", recursive=True)
    options = [word for word in small if not word.startswith(("data.train", "data.val"))]
    words = ("+task=undistort", "data=frames", *options)
    losses = []
    for root in (frames, "memory://frames"):
        outcome = call("train", *words, "trainer.max_epochs=1", "data.size=[32,48]", f"data.root={root}")
        losses.append((outcome.folder / "metrics.csv").read_text())
    assert losses[0] == losses[1]


def test_workers_of_a_loader_read_frames_and_pairs_from_s3(frames, tars, s3):
    """Try forked workers, as a client of S3 serves only the process that made it."""
    store: Any = as_path("s3://bucket")
    store.fs.put(str(frames), "bucket/train", recursive=True)
    store.fs.put(str(tars), "bucket/tars", recursive=True)
    folders = (FrameFolder(root, size=(16, 24)) for root in (frames, "s3://bucket/train"))
    pairs = (PairedFolder(root) for root in (tars, "s3://bucket/tars"))
    for disk, stored in (folders, pairs):
        samples = [sample[0] for sample in DataLoader(stored, batch_size=None, num_workers=1)]
        assert len(samples) == len(disk)
        assert all(torch.equal(samples[i], disk[i][0]) for i in range(len(disk)))

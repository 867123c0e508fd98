"""Sources and sets in object stores: the same bytes as on disk, also after a kill, and errors of one line."""

import signal
from typing import Any

import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from processes import running, wait_for
from stores import digests, failing_writes

from torchrefract._io import as_path
from torchrefract.data.pairs import PairedFolder, PairStream
from torchrefract.data.video import write_video


@pytest.fixture
def memory(memory, frames) -> MemoryFileSystem:
    """Return the store memory:// with the frames in memory://frames."""
    memory.put(str(frames), "/frames", recursive=True)
    return memory


@pytest.mark.parametrize("tar", ["null", "5"])
def test_a_set_in_a_store_has_the_bytes_of_one_on_disk(call, words, memory, tmp_path, tar):
    options = ("count=6", f"tar={tar}")
    in_store = words("memory://out", *options, source="memory://frames")
    assert call("generate", *in_store).code == 0
    assert call("generate", *words("file://" + str(tmp_path / "out"), *options)).code == 0
    assert digests("memory://out") == digests(tmp_path / "out")
    assert ": 0 pairs made, 6 in total" in call("generate", *in_store).out
    pairs = PairedFolder("memory://out")
    assert (pairs[3].clean == PairedFolder(tmp_path / "out")[3].clean).all()


def test_a_stopped_run_in_a_store_continues(call, words, memory, monkeypatch, tmp_path):
    monkeypatch.setattr("torchrefract.data.pairs.manifest._PART_SECONDS", -1.0)
    options = words("memory://out", source="memory://frames")
    with failing_writes(KeyboardInterrupt(), suffix="00000007.flow.png"):
        assert call("generate", *options).code == 130
    assert len(memory.glob("/out/manifest.0*.jsonl")) == 7  # a file of rows for each time, as after a kill
    outcome = call("generate", *options)
    assert "7 pairs exist already" in outcome.out
    assert ": 5 pairs made, 12 in total" in outcome.out
    assert call("generate", *words("out")).code == 0
    assert digests("memory://out") == digests(tmp_path / "out")


def test_shards_in_a_store_keep_the_rows_of_one_another(call, words, memory, monkeypatch):
    monkeypatch.setattr("torchrefract.data.pairs.manifest._PART_SECONDS", -1.0)
    for shards in (2, 1):
        for shard in range(shards):
            options = words("memory://out", "count=4", f"shards={shards}", f"shard={shard}", source="memory://frames")
            assert call("generate", *options).code == 0
        names = [path.rpartition("/")[2] for path in memory.glob("/out/manifest*")]
        assert len(names) == shards
    assert len(PairedFolder("memory://out")) == 4


def test_a_store_that_denies_writing_is_one_line(call, words, memory):
    with failing_writes(PermissionError("Access Denied")):
        message = call("generate", *words("memory://out", source="memory://frames")).message
    assert message == "out must be a folder that can be written to, got memory://out (Permission denied)"


def test_a_name_that_vanishes_from_a_store_is_named_and_made_by_the_next_run(call, words, memory):
    data = memory.cat_file("/frames/drive1/005.png")
    options = words("memory://out", source="memory://frames")
    assert call("generate", *options, "count=12", "tar=4").code == 0
    memory.rm("/out/tars", recursive=True)
    memory.rm("/frames/drive1/005.png")
    outcome = call("generate", *options, "count=12", "tar=4")
    assert outcome.message.startswith(
        "source must stay unchanged during a run, got memory://frames/drive1/005.png cannot be opened (No such file"
    )
    memory.pipe_file("/frames/drive1/005.png", data)
    assert ": 4 pairs made, 12 in total; see" in call("generate", *options, "count=12", "tar=4").out


@pytest.mark.parametrize("times", [2, 100])
def test_a_throttled_request_is_tried_again_with_a_limit(call, words, memory, times):
    options = words("memory://out", source="memory://frames")
    error = OSError(16, "Please reduce your request rate")
    with failing_writes(error, suffix="00000003.flow.png", times=times):
        outcome = call("generate", *options)
    lines = [line for line in outcome.err.splitlines() if line.endswith("trying again in 0 s")]
    assert lines[0].startswith("memory://out/pairs/00000/00000003.flow.png: Please reduce your request rate; trying")
    if times == 2:
        assert (outcome.code, len(lines)) == (0, 2)
        return
    assert len(lines) == 3
    reason = "(Please reduce your request rate, after 4 tries)"
    last = f"error: out must be a folder that can be written to, got memory://out {reason}"
    assert outcome.err.splitlines()[-1] == last
    assert "3 pairs exist already" in call("generate", *options).out


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("workers=2", "workers must be 0 for out=memory://out, because each process has its memory, got 2"),
        ("out=nowhere://out", "out: a path must be one on this machine or an address of fsspec, got nowhere://out ("),
        ("out=memory://frames/out", "out must lie outside of source"),
    ],
)
def test_an_invalid_address_raises(call, words, memory, option, message):
    options = [word for word in words("memory://out", source="memory://frames") if word[:4] not in (option[:4])]
    assert call("generate", *options, option).message.startswith(message)


def test_the_name_of_a_folder_in_a_store_is_no_pattern(call, words, memory):
    """Other sets match such a pattern: their manifests must neither be read nor removed."""
    assert call("generate", *words("memory://sets/1", "count=1", source="memory://frames")).code == 0
    memory.copy("/sets/1", "/sets/a-b", recursive=True)
    memory.copy("/sets/1", "/sets/run 1", recursive=True)
    for name in ("run [1]", "a?b", "*", "ü #1 = {x}"):
        before = digests("memory://sets")
        options = words(f"memory://sets/{name}", "count=2", source="memory://frames")
        assert ": 2 pairs made, 2 in total; see" in call("generate", *options).out
        assert ": 0 pairs made, 2 in total; see" in call("generate", *options).out
        assert ": 2 of 2 pairs" in call("merge", f"out=memory://sets/{name}").out
        assert len(PairedFolder(f"memory://sets/{name}")) == 2
        assert {
            path: data for path, data in digests("memory://sets").items() if not path.startswith(f"{name}/")
        } == before
        memory.rm(f"/sets/{name}", recursive=True)


@pytest.mark.parametrize("times", [2, 100])
def test_a_listing_that_is_throttled_is_tried_again_and_loses_no_folder(call, words, memory, monkeypatch, times):
    ls, failures = MemoryFileSystem.ls, list[str]()

    def throttle(self: Any, path: str, *more: Any, **others: Any) -> Any:
        if path.strip("/") == "frames/drive1" and len(failures) < times:
            failures.append(path)
            raise OSError(16, "Please reduce your request rate")
        return ls(self, path, *more, **others)

    with monkeypatch.context() as patch:
        patch.setattr(MemoryFileSystem, "ls", throttle)
        outcome = call("generate", *words("memory://out", source="memory://frames"))
    if times == 2:
        assert outcome.code == 0
        assert ": 12 pairs made, 12 in total" in outcome.out
    else:
        assert outcome.err.splitlines()[-1].startswith("error: ")
        assert "Please reduce your request rate, after 4 tries" in outcome.err.splitlines()[-1]


def test_videos_are_read_from_a_store(call, words, memory, tmp_path):
    pages = [np.full((32, 48, 3), 20 * i, np.uint8) for i in range(2)]
    for name in ("a.mp4", "b.mp4"):
        write_video(pages, tmp_path / name, fps=10, size=(48, 32))
        memory.put_file(str(tmp_path / name), f"/videos/{name}")
    assert call("generate", *words("memory://out", source="memory://videos")).code == 0
    assert len(PairedFolder("memory://out")) == 4


@pytest.mark.parametrize(("protocol", "stop"), [("s3", signal.SIGKILL), ("gs", signal.SIGTERM)])
def test_a_run_in_a_bucket_that_is_killed_continues_to_the_bytes_on_disk(
    call, words, frames, tmp_path, request, protocol, stop
):
    request.getfixturevalue(protocol)
    bucket = f"{protocol}://bucket"
    store: Any = as_path(bucket)
    store.fs.put(str(frames), "bucket/frames", recursive=True)
    options = words(f"{bucket}/out", "tar=2", source=f"{bucket}/frames")
    with running("-m", "torchrefract.generate", *options, "workers=1") as run:
        wait_for(lambda: store.fs.glob("bucket/out/tars/*"), run)
        run.send_signal(stop)
        run.communicate()
    assert run.returncode == -stop
    assert call("generate", *options).code == 0
    assert call("generate", *words("out", "tar=2")).code == 0
    assert digests(f"{bucket}/out") == digests(tmp_path / "out")
    keys = [row.key for row in PairedFolder(f"{bucket}/out").rows()]
    assert [int(pair.key) for pair in PairStream(f"{bucket}/out")] == keys
    assert len(keys) == 12
    message = call("generate", *words(f"{protocol}://missing/out", source=f"{bucket}/frames")).message
    reason = "No such file or directory"
    assert message == f"out must be a folder that can be written to, got {protocol}://missing/out ({reason})"

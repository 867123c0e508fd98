"""The list of the frames of a set: scanned once, shared by shards and later runs, small."""

import shutil
import tracemalloc
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from PIL import Image

from torchrefract import key_of
from torchrefract.data.frames import Source
from torchrefract.data.pairs import sources as listing
from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.pairs.generator import PairGenerator
from torchrefract.data.pairs.sources import Sources, find_sources, read_sources

OPTIONS: dict[str, Any] = {"every": 1, "drive_by": "auto", "val_share": 0.3, "seed": 0}


@pytest.fixture
def scans(monkeypatch) -> list[Path]:
    """Collect the folders that are scanned."""
    folders, scan = list[Path](), listing.list_names

    def count(root: Path) -> Any:
        folders.append(root)
        return scan(root)

    monkeypatch.setattr(listing, "list_names", count)
    return folders


def test_shards_and_later_runs_share_one_scan(call, words, frames, tmp_path, scans):
    for shard in (1, 0):
        assert call("generate", *words("out", "shards=2", f"shard={shard}")).code == 0
    assert "12 frames, as listed in out/sources.parquet" in call("generate", *words("out")).out
    assert call("generate", *words("plain", "files=out/sources.parquet")).code == 0
    assert len(scans) == 1
    table = pq.read_table(tmp_path / "out" / "sources.parquet").to_pydict()
    paths = sorted(path.relative_to(frames).as_posix() for path in frames.rglob("*.png"))
    assert table["path"] == paths
    assert table["bytes"] == [(frames / path).stat().st_size for path in paths]
    assert table["drive"] == [path.split("/")[0] for path in paths]
    assert table["key"] == [key_of(path) for path in paths]
    manifest = tmp_path / "out" / "manifest.jsonl"
    assert manifest.read_text() == (tmp_path / "plain" / "manifest.jsonl").read_text()
    message = call("generate", *words("other", "files=out/sources.parquet", "seed=5")).message
    assert message.startswith(
        "files must be a list of the same options, got out/sources.parquet, where seed is 0 there"
    )
    assert not (tmp_path / "other").exists()
    message = call("generate", *words("other", "files=out/README.md")).message
    assert message == "files must be a list of frames that generate wrote, got out/README.md"


def test_a_frame_that_changes_after_it_was_listed_is_named(call, words, frames, tmp_path, rows):
    shutil.copytree(frames, tmp_path / "frames")
    find_sources(tmp_path / "frames", size=None, **OPTIONS).write(tmp_path / "list.parquet", OPTIONS)
    path = tmp_path / "frames" / "drive2" / "009.png"
    data = path.read_bytes()
    Image.new("RGB", (48, 32)).save(path)
    options = words("out", "files=list.parquet", "val_share=0.3", source="frames")
    message = call("generate", *options).message
    assert message.startswith("source must stay unchanged during a run, got frames/drive2/009.png has changed since")
    assert len(rows(tmp_path / "out")) == 11
    path.write_bytes(data)
    assert ": 1 pairs made, 12 in total" in call("generate", *options).out


def test_an_unreadable_frame_is_tried_again_by_the_same_command(call, words, frames, tmp_path, rows):
    shutil.copytree(frames, tmp_path / "frames")
    path = tmp_path / "frames" / "drive1" / "005.png"
    data = path.read_bytes()
    path.write_bytes(data[:200] + bytes(40) + data[240:])  # between a good header and a good end
    arguments = words("out", source="frames")
    outcome = call("generate", *arguments)
    assert "unreadable, tried again by the same command: drive1/005.png is damaged" in outcome.out
    assert ": 11 pairs made, 11 in total, 1 frames are unreadable" in outcome.out
    (skipped,) = [row for row in rows(tmp_path / "out") if row["skipped"]]
    assert skipped["source"] == "drive1/005.png"
    assert skipped["skipped"].startswith("drive1/005.png is damaged")
    assert "drive1/005.png is damaged" in (tmp_path / "out" / "README.md").read_text()
    assert len(PairedFolder(tmp_path / "out")) == 11
    assert ": 0 pairs made, 11 in total, 1 frames are unreadable" in call("generate", *arguments).out
    path.write_bytes(data)
    assert ": 1 pairs made, 12 in total; see" in call("generate", *arguments).out
    assert not any(row["skipped"] for row in rows(tmp_path / "out"))


def test_a_link_that_leads_to_itself_is_named_after_the_other_frames(call, words, frames, tmp_path, rows):
    shutil.copytree(frames, tmp_path / "frames")
    (tmp_path / "frames" / "drive1" / "ring.png").symlink_to("ring.png")
    message = call("generate", *words("out", source="frames")).message
    assert message.startswith("source must stay unchanged during a run, got frames/drive1/ring.png cannot be opened (")
    assert len(rows(tmp_path / "out")) == 12


def test_a_list_of_many_frames_takes_little_memory_and_keeps_any_name(tmp_path):
    count = 20_000
    names = [f"drive{i // 1000:03d}/{i:06d}.jpg" for i in range(count - 1)] + ["drive0/\udcff.jpg"]
    frames = [Source(name, name.partition("/")[0], "train") for name in names]
    Sources(tmp_path, listing.table_of(frames, lambda _: 7)).write(tmp_path / "list.parquet", {"seed": 0})
    tracemalloc.start()
    sources = read_sources(tmp_path / "list.parquet", tmp_path, {"seed": 0})
    digest = sources.limited(count // 2).digest()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6  # Python objects: those of all frames together would take 12 MB
    assert sources.table.nbytes < 80 * count
    assert len(digest) == 64
    assert [sources.frame(i) for i in (0, 5000, count - 1)] == [frames[i]._replace(bytes=7) for i in (0, 5000, -1)]
    assert next(iter(sources.frames())) == frames[0]._replace(bytes=7)


def test_names_that_are_no_unicode_are_escaped_in_the_table_and_the_card(call, words, frames, tmp_path, rows):
    shutil.copytree(frames, tmp_path / "frames")
    first = sorted((tmp_path / "frames" / "drive1").iterdir())[0]
    shutil.copy(first, first.with_name("\udcff.png"))
    first.with_name("\udcfe.png").write_bytes(first.read_bytes()[:100])
    outcome = call("generate", *words("out", source="frames"))
    assert outcome.code == 0, outcome.err
    assert "unreadable, tried again by the same command: drive1/\\udcfe.png is truncated" in outcome.out
    assert "such as: drive1/\\udcfe.png is truncated" in (tmp_path / "out" / "README.md").read_text()
    table = pq.read_table(tmp_path / "out" / "pairs.parquet")
    names = [row["source"] for row in rows(tmp_path / "out") if not row["skipped"]]
    assert table["source"].to_pylist() == [name.replace("\udcff", "\\udcff") for name in names]
    assert "drive1/\udcff.png" in names


def test_the_main_process_of_a_run_with_workers_makes_no_pair(call, words, monkeypatch):
    """Compiled effects would add half to its memory."""

    def generate(*_: Any) -> None:
        raise AssertionError("a pair of the main process")

    monkeypatch.setattr(PairGenerator, "generate", generate)
    assert ": 2 pairs made, 2 in total" in call("generate", *words("out", "count=2", workers=1)).out

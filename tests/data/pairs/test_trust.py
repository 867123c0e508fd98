"""Sets that changed under a run, that two runs write to, or whose files lie."""

import io
import json
import os
import shutil
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from stores import digests

from torchrefract._validation import UsageError
from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.pairs.files import DamagedPairError
from torchrefract.data.pairs.manifest import locked, locked_shard


def test_a_frame_that_vanishes_is_named_after_the_others_and_made_by_the_next(
    call, words, frames, tmp_path, monkeypatch, rows
):
    shutil.copytree(frames, tmp_path / "frames")
    frame = tmp_path / "frames" / "drive1" / "005.png"
    with monkeypatch.context() as patch:
        patch.setattr("torchrefract.cli.generation._check_disk", lambda *_: frame.rename(tmp_path / "away.png"))
        message = call("generate", *words("out", source="frames")).message
    assert message.startswith("source must stay unchanged during a run, got frames/drive1/005.png cannot be opened")
    assert len(rows(tmp_path / "out")) == 11
    (tmp_path / "away.png").rename(frame)
    assert "12 in total; see" in call("generate", *words("out", source="frames")).out
    assert not any(row["skipped"] for row in rows(tmp_path / "out"))


def test_another_number_of_shards_leaves_one_row_for_each_pair(call, words, tmp_path):
    for shards in (3, 2, 1, 2):
        for shard in range(shards):
            assert call("generate", *words("out", "count=6", f"shards={shards}", f"shard={shard}")).code == 0
        manifests = sorted((tmp_path / "out").glob("manifest*.jsonl"))
        assert len(manifests) == shards
        lines = [json.loads(line)["number"] for path in manifests for line in path.read_text().splitlines()]
        assert sorted(lines) == list(range(6))


def test_a_flipped_byte_of_a_tar_costs_one_pair(call, words, tmp_path):
    arguments = words("out", "count=6", "tar=6")
    assert call("generate", *arguments).code == 0
    before, path = digests(tmp_path / "out"), tmp_path / "out" / "tars" / "00000000.tar"
    with tarfile.open(path) as tar:
        members = [tar.getmember(f"00000003.{suffix}") for suffix in ("clean.png", "json")]
    headers, contents = ([getattr(member, name) for member in members] for name in ("offset", "offset_data"))
    for position in (*(start + 5 for start in headers), *(start + 90 for start in contents)):
        data = bytearray(path.read_bytes())
        data[position] ^= 1
        path.write_bytes(data)
        assert "1 pairs were damaged or missing" in call("generate", *arguments, "verify=true").out
        assert digests(tmp_path / "out") == before


def test_two_runs_into_one_folder_raise(call, words, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with locked_shard(out, 0, 2):
        with locked_shard(out, 1, 2):
            pass
        for shard, shards in ((0, 2), (0, 3), (0, 1)):
            with pytest.raises(UsageError, match="out must not be in use"), locked_shard(out, shard, shards):
                pass
    with locked("out", out), pytest.raises(UsageError, match="out must not be in use"), locked("out", out):
        pass
    assert not list(out.iterdir())
    assert call("generate", *words("out")).code == 0
    with locked_shard(out, 0, 1):
        assert call("generate", *words("out")).message.startswith("out must not be in use, got out, which another run")


def test_an_address_as_output_raises(call, tmp_path):
    for out in ("s3://bucket/pairs", "gs://a", "file:///sets/a", "'hf://datasets/a'"):
        message = call("restore", f"out={out}").message
        assert message.startswith(f"out must be a path on this machine, got {out.strip(chr(39))}")
    assert not list(tmp_path.iterdir())


def test_an_address_as_input_of_a_command_that_takes_none_raises(call):
    for command, option in (("degrade", "labels"), ("restore", "input"), ("rectify", "input"), ("preview", "image")):
        message = call(command, f"{option}=s3://bucket/frames").message
        assert message.startswith(f"{option} must be a path on this machine, got s3://bucket/frames; copy it ")


@pytest.fixture
def pair(call, words, tmp_path) -> Path:
    assert call("generate", *words("out", "count=1", "maps=npz")).code == 0
    return tmp_path / "out" / "pairs" / "00000"


def replace(out: Path, suffix: str, data: bytes) -> None:
    """Replace a file of a pair and its size in the manifest."""
    (out / "pairs" / "00000" / f"00000000.{suffix}").write_bytes(data)
    row = json.loads((out / "manifest.jsonl").read_text())
    row["files"][suffix]["bytes"] = len(data)
    (out / "manifest.jsonl").write_text(json.dumps(row) + "\n")


def test_a_small_png_of_a_large_size_raises_before_it_is_decoded(pair, tmp_path, monkeypatch):
    replace(tmp_path / "out", "clean.png", cv2.imencode(".png", np.zeros((4000, 4000, 3), np.uint8))[1].tobytes())
    monkeypatch.setattr("torchrefract.data.pairs.files._decode_npz", lambda *_: {})
    monkeypatch.setattr(cv2, "imdecode", None)
    with pytest.raises(DamagedPairError, match=r"it must be of \(32, 48\) px \(height, width\), got \(4000, 4000\)"):
        PairedFolder(tmp_path / "out")[0]


@pytest.mark.parametrize("change", ["nan", "infinity", "shape", "type", "mask"])
def test_maps_of_wrong_values_shapes_or_types_raise(pair, tmp_path, change):
    with np.load(pair / "00000000.maps.npz") as archive:
        maps = dict(archive)
    if change in ("nan", "infinity"):
        maps["restore_flow"][0, 3, 4] = np.nan if change == "nan" else np.inf
    elif change == "mask":
        maps["restore_valid"] = maps["restore_valid"].astype(np.float32)
    else:
        maps["restore_flow"] = maps["restore_flow"][:, 1:] if change == "shape" else maps["restore_flow"].astype(float)
    stream = io.BytesIO()
    np.savez(stream, **maps)
    replace(tmp_path / "out", "maps.npz", stream.getvalue())
    with pytest.raises(DamagedPairError, match=f"restore_{'valid' if change == 'mask' else 'flow'} must be"):
        PairedFolder(tmp_path / "out")[0]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_in_place_of_a_file_raises(pair, tmp_path):
    pairs, path = PairedFolder(tmp_path / "out"), pair / "00000000.clean.png"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(DamagedPairError, match="a pipe or a device"):
        pairs[0]
    (tmp_path / "out" / "manifest.jsonl").unlink()
    os.mkfifo(tmp_path / "out" / "manifest.jsonl")
    with pytest.raises(ValueError, match="a pipe or a device"):
        PairedFolder(tmp_path / "out")

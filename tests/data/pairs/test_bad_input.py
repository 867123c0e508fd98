"""Errors that a user can fix are one line, and existing files stay."""

import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from stores import digests

import torchrefract
from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.pairs.files import DamagedPairError, encode_maps


@pytest.fixture
def disk(tmp_path) -> Iterator[Callable[[str], Path]]:
    """Mount a small file system with some options."""
    mounted = list[Path]()

    def mount(options: str) -> Path:
        folder = tmp_path / "disk"
        folder.mkdir()
        tool = shutil.which("mount")
        if tool is None or subprocess.run([tool, "-t", "tmpfs", "-o", options, "none", folder], check=False).returncode:
            pytest.skip("needs the right to mount a tmpfs")
        mounted.append(folder)
        return folder

    yield mount
    for folder in mounted:
        subprocess.run(["umount", folder], check=True)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("license=", "license must be that of the source"),
        ("license=null", "license must be that of the source, in words, got nothing"),
        ("maps=jpg", "maps must be one of png, npz, safetensors, got 'jpg'"),
        ("count=0", "count must be at least 1, got 0"),
        ("size=[0,4]", "size must be at least 1, got 0"),
        ("size=[400,400]", "source: frames must be at least size = 400x400"),
        ("source=nowhere", "source must be a folder of images or videos, or a video, got nowhere, which does not"),
        ("source=empty", "source must hold .jpg, .jpeg, .png, .webp, .bmp, .mp4, .avi"),
        ("shards=2", "shard must be given together with shards, got None of 2"),
        ("shard=2 shards=2", "shard must be below shards = 2, got 2"),
        ("tar=0", "tar must be at least 1, got 0"),
        ("workers=-1", "workers must be at least 0, got -1"),
        ("seed=3000000000", "seed must be a whole number from 0 to 2147483647, got 3000000000"),
        ("seed=-1", "seed must be a whole number from 0 to 2147483647, got -1"),
        ("verify=7", "verify must be True or False, got 7"),
        ("scene.severity=9", "scene: severity must be one of 1, 2, 3, 4, 5, got 9"),
    ],
)
def test_an_invalid_option_raises_before_anything_is_written(call, words, tmp_path, word, message):
    (tmp_path / "empty").mkdir()
    kept = [option for option in words("out") if option.partition("=")[0] != word.partition("=")[0]]
    assert message in call("generate", *kept, *(word.split(" ") if word.startswith("shard") else [word])).message
    assert not (tmp_path / "out").exists()


def test_a_license_and_a_scene_are_required(call, words):
    for name, message in (("license", "license must be given, as in license=…, got nothing"), ("scene", "'scene'")):
        without = [word for word in words("out", scene="paper_weather") if not word.startswith(name)]
        assert message in call("generate", *without).message


def test_light_that_a_png_cannot_hold_names_the_formats_that_hold_it():
    light = {"intensity": np.full((4, 6), 3.0, np.float32)}
    with pytest.raises(ValueError, match="maps must be npz or safetensors for intensity above 2, got up to 3"):
        encode_maps(light, "png")
    assert list(encode_maps(light, "npz")) == ["maps.npz"]


def test_a_folder_of_another_configuration_raises_with_the_differences(call, words, tmp_path):
    assert call("generate", *words("out", "count=2")).code == 0
    before = digests(tmp_path / "out")
    message = call("generate", *words("out", "count=2", "seed=5", "scene.severity=2")).message
    assert "scene.severity is 3 there and 2 here, seed is 0 there and 5 here" in message
    assert digests(tmp_path / "out") == before


def test_an_output_folder_must_be_new_and_lie_outside_of_the_source(call, words, frames, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("words")
    message = call("generate", *words("out")).message
    assert message == "out must be a new folder or one of this command, got out, which holds thesis.tex"
    message = call("generate", *words("out/thesis.tex")).message
    assert message == "out must be a folder that can be written to, got out/thesis.tex (Not a directory)"
    assert "out must lie outside of source" in call("generate", *words(frames / "pairs")).message
    assert not (frames / "pairs").exists()
    with pytest.raises(ValueError, match=r"root must be a folder with manifest\.jsonl, got"):
        PairedFolder(tmp_path / "out")


def test_a_configuration_of_other_types_is_one_line(call, words, tmp_path):
    assert call("generate", *words("out", "count=2")).code == 0
    path = tmp_path / "out" / "config.json"
    content = json.loads(path.read_text())
    for change in ({"count": "x"}, {"settings": []}, {"settings": {}}):
        path.write_text(json.dumps(content | change))
        message = "out must be a folder of generate with a valid config.json, got"
        assert call("merge", "out=out").message.startswith(message)
        assert call("generate", *words("out", "count=2")).message.startswith("out must be a folder ")


def test_a_relative_folder_with_a_colon_is_no_address(call, words, tmp_path):
    assert call("generate", *words("cam:07-30", "count=1")).code == 0
    assert len(PairedFolder(tmp_path / "cam:07-30")) == 1


def test_changed_sources_that_are_listed_again_raise(call, words, frames, tmp_path):
    shutil.copytree(frames, tmp_path / "frames")
    assert call("generate", *words("out", source="frames")).code == 0
    (tmp_path / "frames" / "drive0" / "000.png").unlink()
    (tmp_path / "out" / "sources.parquet").unlink()
    message = call("generate", *words("out", source="frames")).message
    assert re.search(r"frames is 12 there and 11 here, sources is \w+ there", message)


def test_a_disk_that_is_too_small_raises_before_a_pair_is_written(call, words, disk):
    folder = disk("size=64k")
    message = call("generate", *words(folder / "out")).message
    assert message.startswith("out must have enough space, got too little: 12 pairs take about")
    assert not list(folder.rglob("*.png"))


def test_a_disk_that_becomes_full_keeps_complete_pairs_and_the_run_continues(call, words, disk, monkeypatch):
    folder = disk("size=256k")
    monkeypatch.setattr(
        "torchrefract.cli.generation._check_disk", lambda *_: None
    )  # as if another process filled the disk
    message = call("generate", *words(folder / "out")).message
    assert "no space left on device" in message
    assert "the same command continues" in message
    pictures = list(folder.rglob("*.clean.png"))
    assert 0 < len(pictures) < 12
    assert all(np.asarray(Image.open(path)).shape == (32, 48, 3) for path in pictures)
    assert not list(folder.rglob("*.part"))
    subprocess.run(["mount", "-o", "remount,size=8m", folder], check=True)
    assert call("generate", *words(folder / "out")).code == 0
    assert call("generate", *words("out")).code == 0
    assert digests(folder / "out") == digests(Path("out"))


def test_an_interrupted_run_prints_how_to_continue(call, words, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchrefract.cli.generation.generate_pairs", interrupted)
    outcome = call("generate", *words("out"))
    assert (outcome.code, outcome.err) == (130, "stopped; the same command continues\n")


def test_a_set_of_another_version_of_torchrefract_is_continued_with_a_word(call, words, tmp_path):
    assert call("generate", *words("out", "count=1")).code == 0
    path = tmp_path / "out" / "config.json"
    path.write_text(path.read_text().replace(f'"torchrefract": "{torchrefract.__version__}"', '"torchrefract": "0.0"'))
    outcome = call("generate", *words("out", "count=1"))
    assert outcome.code == 0
    assert "warning: the files in out were made with torchrefract 0.0, torch " in outcome.err


def test_a_read_only_folder_raises(call, words, disk):
    folder = disk("ro,size=64k")
    assert "Read-only file system" in call("generate", *words(folder / "out")).message


def test_a_manifest_with_paths_outside_of_the_set_raises(call, words, tmp_path):
    assert call("generate", *words("out", "count=2")).code == 0
    manifest = tmp_path / "out" / "manifest.jsonl"
    text = manifest.read_text()
    paths = ("../secret.png", "/etc/hostname", "pairs/../../x.clean.png", "pairs/00000\\\\x.png", "pairs/0/a/b.png")
    for path in paths:
        manifest.write_text(text.replace("pairs/00000/00000001.clean.png", path))
        with pytest.raises(DamagedPairError, match="files must lie in pairs/ or tars/ of the set, got"):
            PairedFolder(tmp_path / "out")


def test_a_damaged_pair_raises_with_the_remedy(call, words, tmp_path):
    assert call("generate", *words("out", "count=2")).code == 0
    os.truncate(tmp_path / "out" / "pairs/00000/00000001.flow.png", 0)
    os.truncate(tmp_path / "out" / "pairs/00000/00000001.restore_flow.png", 30)
    with pytest.raises(DamagedPairError, match=r"pair 1 in .* must be whole, got .* is truncated; .* verify=true"):
        PairedFolder(tmp_path / "out")[1]

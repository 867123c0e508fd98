"""Pairs on disk are opened without our code, and hold what the effect made."""

import io
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import webdataset
from PIL import Image
from safetensors.numpy import load_file

from torchrefract import presets, warp
from torchrefract.data.frames import FrameFolder
from torchrefract.data.images import read_image

COUNT = 10


@pytest.fixture
def refractive(call, words, tmp_path) -> Path:
    """Ten pairs of warps as files."""
    assert call("generate", *words("out", f"count={COUNT}")).code == 0
    return tmp_path / "out"


def made_again(row, frames, effect):
    """What the row says of a pair, made of its source alone."""
    clean = read_image(frames / row["source"])[None].contiguous()
    return clean, effect.degrade(clean, seed=row["seed"], keys=[row["key"]])


def kitti(path: Path):
    """Flow and mask as the KITTI benchmark's kit defines them, u, v, valid in red, green, blue."""
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    assert stored.dtype == np.uint16
    blue, green, red = np.moveaxis(stored.astype(np.float64), 2, 0)
    return np.stack([(red - 2**15) / 64, (green - 2**15) / 64]), blue > 0


def psnr(image, clean, valid):
    error = ((image - clean) ** 2)[valid.expand_as(clean)].mean()
    return -10 * math.log10(float(error))


def test_flows_as_opencv_reads_them_are_within_a_hundredth_of_a_pixel(refractive, rows, frames):
    effect, seen = presets.paper_refractive(width=192), set()
    for row in rows(refractive):
        _, d = made_again(row, frames, effect)
        seen.add(row["effects"][0]["effect"])
        for name, mask in (("flow", "valid"), ("restore_flow", "restore_valid")):
            path = refractive / row["files"][f"{name}.png"]["path"]
            flow, valid = kitti(path)
            assert np.abs(flow - getattr(d, name)[0].double().numpy()).max() <= 1 / 128
            assert np.array_equal(valid, getattr(d, mask)[0, 0].numpy())
            assert np.array_equal(np.asarray(Image.open(path.with_name(path.name.replace(name, mask)))) > 0, valid)
    assert len(seen) >= 3


def test_pictures_as_pillow_reads_them_are_those_of_the_effect_in_8_bits(refractive, rows, frames):
    for row in rows(refractive):
        clean, d = made_again(row, frames, presets.paper_refractive(width=192))
        for name, image in (("clean", clean), ("corrupted", d.image)):
            pixels = np.asarray(Image.open(refractive / row["files"][f"{name}.png"]["path"]))
            assert np.abs(pixels / 255 - image[0].permute(1, 2, 0).numpy()).max() <= 0.5 / 255 + 1e-6


def test_restoring_from_disk_is_as_good_as_on_the_fly(refractive, rows, frames):
    for row in rows(refractive):
        clean, d = made_again(row, frames, presets.paper_refractive(width=192))
        flow, valid = kitti(refractive / row["files"]["restore_flow.png"]["path"])
        corrupted = np.asarray(Image.open(refractive / row["files"]["corrupted.png"]["path"])) / np.float32(255)
        image = torch.from_numpy(corrupted).permute(2, 0, 1)[None].contiguous()
        mask = torch.from_numpy(valid)[None, None]
        stored = psnr(warp(image, torch.from_numpy(flow)[None].float())[0], clean, mask)
        live = psnr(warp(d.image, d.restore_flow)[0], clean, d.restore_valid)
        assert abs(stored - live) <= 0.3


def test_light_is_stored_in_16_bits(call, words, rows, frames, tmp_path):
    assert call("generate", *words("out", f"count={COUNT}", scene="paper_weather")).code == 0
    for row in rows(tmp_path / "out"):
        _, d = made_again(row, frames, presets.paper_weather())
        for name, steps in (("transmission", 65535), ("intensity", 32768)):
            stored = np.asarray(Image.open(tmp_path / "out" / row["files"][f"{name}.png"]["path"]))
            assert stored.dtype == np.uint16
            assert np.abs(stored / steps - getattr(d, name)[0, 0].numpy()).max() <= 0.5 / steps + 1e-6
        valid = np.asarray(Image.open(tmp_path / "out" / row["files"]["valid.png"]["path"])) > 0
        assert np.array_equal(valid, d.valid[0, 0].numpy())
    acted = {effect["effect"] for row in rows(tmp_path / "out") for effect in row["effects"]}
    assert {"LensFlare", "HeterogeneousFog"} <= acted


def test_a_composition_has_both_flows_and_light(call, words, rows, frames, tmp_path):
    assert call("generate", *words("out", "count=2", scene="unpaved_road")).code == 0
    for row in rows(tmp_path / "out"):
        assert [effect["effect"] for effect in row["effects"]] == ["HeterogeneousFog", "Turbulence"]
        _, d = made_again(row, frames, presets.unpaved_road())
        stored = np.asarray(Image.open(tmp_path / "out" / row["files"]["transmission.png"]["path"])) / 65535
        assert np.abs(stored - d.transmission[0, 0].numpy()).max() <= 0.5 / 65535 + 1e-6
        flow, _ = kitti(tmp_path / "out" / row["files"]["flow.png"]["path"])
        assert np.abs(flow - d.flow[0].double().numpy()).max() <= 1 / 128
        assert np.abs(flow).max() > 1 / 64


@pytest.mark.parametrize("form", ["npz", "safetensors"])
def test_maps_in_full_precision_are_read_by_their_own_libraries(call, words, rows, frames, tmp_path, form):
    assert call("generate", *words("out", "count=3", f"maps={form}")).code == 0
    for row in rows(tmp_path / "out"):
        _, d = made_again(row, frames, presets.paper_refractive(width=192))
        path = tmp_path / "out" / row["files"][f"maps.{form}"]["path"]
        maps = dict(np.load(path)) if form == "npz" else load_file(path)
        assert sorted(maps) == ["flow", "restore_flow", "restore_valid", "valid"]
        for name, value in maps.items():
            assert np.array_equal(value, getattr(d, name)[0].numpy().reshape(value.shape)), name


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # webdataset leaves its tars to the garbage collector to close,
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # where pytest wraps the same warning
def test_tars_are_read_by_webdataset(call, words, rows, sums, tmp_path):
    assert call("generate", *words("tars", "count=7", "tar=3")).code == 0
    assert call("generate", *words("files", "count=7")).code == 0
    urls = sorted(str(path) for path in (tmp_path / "tars" / "tars").glob("*.tar"))
    assert len(urls) == 3
    samples = list(webdataset.compat.WebDataset(urls, shardshuffle=False))
    listed = rows(tmp_path / "files")
    assert [sample["__key__"] for sample in samples] == [f"{row['number']:08d}" for row in listed]
    for sample, row in zip(samples, listed, strict=True):
        for suffix, file in row["files"].items():
            assert sample[suffix] == (tmp_path / "files" / file["path"]).read_bytes()
        assert json.loads(sample["json"]) == {name: value for name, value in row.items() if name != "files"}
        assert np.asarray(Image.open(io.BytesIO(sample["clean.png"]))).shape == (32, 48, 3)


def test_a_row_makes_its_pair_again_and_has_every_parameter(refractive, rows, frames):
    row = next(row for row in rows(refractive) if row["effects"][0]["effect"] == "LensDistortion")
    _, d = made_again(row, frames, presets.paper_refractive(width=192))
    lens = d.params.children[0]
    (found,) = row["effects"]
    assert set(found) == {"effect", *lens._fields} - {"applied"}
    assert found["coefficients"] == lens.coefficients[0].tolist()
    assert (row["height"], row["width"]) == (32, 48)


def test_splits_are_those_of_the_folder_and_no_drive_is_in_both(refractive, rows, frames):
    found = {row["source"]: row["split"] for row in rows(refractive)}
    for split in ("train", "val"):
        folder = FrameFolder(frames, size=(32, 48), split=split)
        expected = {path.relative_to(frames).as_posix() for path in folder.paths}
        assert {source for source, own in found.items() if own == split} <= expected
    drives = {split: {row["drive"] for row in rows(refractive) if row["split"] == split} for split in ("train", "val")}
    assert drives["train"]
    assert drives["val"]
    assert not drives["train"] & drives["val"]


def test_the_card_counts_what_is_there_and_states_the_license(refractive, rows):
    card, listed = (refractive / "README.md").read_text(), rows(refractive)
    assert f"# {COUNT} pairs of the scene paper_refractive" in card
    assert "CC0" in card
    for split in ("train", "val"):
        own = [row for row in listed if row["split"] == split]
        assert f"| {split} | {len(own)} | {len({row['drive'] for row in own})} |" in card
    for name in {row["effects"][0]["effect"] for row in listed}:
        assert f"| {name} | {sum(row['effects'][0]['effect'] == name for row in listed)} |" in card
    assert np.asarray(Image.open(refractive / "parameters.png")).std() > 10


@pytest.mark.parametrize("license_of", ["CC BY 4.0, MIT (two sources)", "the owner's: ask [us]", "'in quotes, too'"])
def test_a_license_is_any_text(call, words, tmp_path, license_of):
    kept = [word for word in words("out", "count=4") if not word.startswith("license=")]
    assert call("generate", *kept, f"license={license_of}").code == 0
    stated = license_of.strip("'") if license_of[0] == "'" else license_of
    assert f"as stated by the creator of this set:** {stated}\n" in (tmp_path / "out" / "README.md").read_text()

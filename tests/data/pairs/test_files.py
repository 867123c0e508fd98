"""Other programs open the files of pairs, which hold the results of the effect."""

import io
import json
import math
import re
from array import array
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
from torchrefract.data.pairs import card

COUNT = 10


@pytest.fixture(scope="module")
def shared(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("refractive") / "out"


@pytest.fixture
def refractive(call, words, shared) -> Path:
    """Return ten pairs of warps as files, which the first test writes and all tests read."""
    if not shared.exists():
        assert call("generate", *words(shared, f"count={COUNT}")).code == 0
    return shared


def made_again(row, frames, effect):
    """Make a pair again from its row and its source."""
    clean = read_image(frames / row["source"])[None].contiguous()
    return clean, effect.degrade(clean, seed=row["seed"], keys=[row["key"]])


def kitti(path: Path):
    """Read flow and mask as the kit of the KITTI benchmark does: u, v, valid in red, green, blue."""
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    assert stored.dtype == np.uint16
    blue, green, red = np.moveaxis(stored.astype(np.float64), 2, 0)
    return np.stack([(red - 2**15) / 64, (green - 2**15) / 64]), blue > 0


def psnr(image, clean, valid):
    error = ((image - clean) ** 2)[valid.expand_as(clean)].mean()
    return -10 * math.log10(float(error))


def test_other_programs_read_the_images_and_flows_of_the_effect(refractive, rows, frames):
    effect, seen = presets.paper_refractive(width=192), set()
    for row in rows(refractive):
        clean, d = made_again(row, frames, effect)
        seen.add(row["effects"][0]["effect"])
        for name, image in (("clean", clean), ("corrupted", d.image)):
            pixels = np.asarray(Image.open(refractive / row["files"][f"{name}.png"]["path"]))
            assert np.abs(pixels / 255 - image[0].permute(1, 2, 0).numpy()).max() <= 0.5 / 255 + 1e-6
        for name, mask in (("flow", "valid"), ("restore_flow", "restore_valid")):
            path = refractive / row["files"][f"{name}.png"]["path"]
            flow, valid = kitti(path)
            assert np.abs(flow - getattr(d, name)[0].double().numpy()).max() <= 1 / 128
            assert np.array_equal(valid, getattr(d, mask)[0, 0].numpy())
            assert np.array_equal(np.asarray(Image.open(path.with_name(path.name.replace(name, mask)))) > 0, valid)
    assert len(seen) >= 3


def test_restoring_from_files_is_as_accurate_as_on_the_fly(refractive, rows, frames):
    for row in rows(refractive):
        clean, d = made_again(row, frames, presets.paper_refractive(width=192))
        flow, valid = kitti(refractive / row["files"]["restore_flow.png"]["path"])
        corrupted = np.asarray(Image.open(refractive / row["files"]["corrupted.png"]["path"])) / np.float32(255)
        image = torch.from_numpy(corrupted).permute(2, 0, 1)[None].contiguous()
        mask = torch.from_numpy(valid)[None, None]
        stored = psnr(warp(image, torch.from_numpy(flow)[None].float())[0], clean, mask)
        live = psnr(warp(d.image, d.restore_flow)[0], clean, d.restore_valid)
        assert abs(stored - live) <= 0.3


def test_transmission_and_intensity_have_16_bits(call, words, rows, frames, tmp_path):
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
        assert [effect["effect"] for effect in row["effects"]] == ["HeterogeneousFog", "Turbulence", "RollingShutter"]
        _, d = made_again(row, frames, presets.unpaved_road())
        stored = np.asarray(Image.open(tmp_path / "out" / row["files"]["transmission.png"]["path"])) / 65535
        assert np.abs(stored - d.transmission[0, 0].numpy()).max() <= 0.5 / 65535 + 1e-6
        flow, _ = kitti(tmp_path / "out" / row["files"]["flow.png"]["path"])
        assert np.abs(flow - d.flow[0].double().numpy()).max() <= 1 / 128
        assert np.abs(flow).max() > 1 / 64


@pytest.mark.parametrize("form", ["npz", "safetensors"])
def test_npz_and_safetensors_hold_maps_in_full_precision(call, words, rows, frames, tmp_path, form):
    assert call("generate", *words("out", "count=2", f"maps={form}")).code == 0
    for row in rows(tmp_path / "out"):
        _, d = made_again(row, frames, presets.paper_refractive(width=192))
        path = tmp_path / "out" / row["files"][f"maps.{form}"]["path"]
        maps = dict(np.load(path)) if form == "npz" else load_file(path)
        assert sorted(maps) == ["flow", "restore_flow", "restore_valid", "valid"]
        for name, value in maps.items():
            assert np.array_equal(value, getattr(d, name)[0].numpy().reshape(value.shape)), name


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # webdataset does not close its tars,
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # and pytest wraps the same warning
def test_webdataset_reads_tars(call, words, rows, tmp_path):
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


def test_a_row_has_every_parameter_of_its_effect(refractive, rows, frames):
    row = next(row for row in rows(refractive) if row["effects"][0]["effect"] == "LensDistortion")
    _, d = made_again(row, frames, presets.paper_refractive(width=192))
    lens = d.params.children[0]
    (effect,) = row["effects"]
    assert set(effect) == {"effect", *lens._fields} - {"applied"}
    assert effect["coefficients"] == lens.coefficients[0].tolist()
    assert (row["height"], row["width"]) == (32, 48)


def test_splits_are_those_of_frame_folder(refractive, rows, frames):
    splits = {row["source"]: row["split"] for row in rows(refractive)}
    for split in ("train", "val"):
        folder = FrameFolder(frames, size=(32, 48), split=split)
        expected = {path.relative_to(frames).as_posix() for path in folder.paths}
        assert {source for source, name in splits.items() if name == split} <= expected
    drives = {split: {row["drive"] for row in rows(refractive) if row["split"] == split} for split in ("train", "val")}
    assert drives["train"]
    assert drives["val"]
    assert not drives["train"] & drives["val"]


def test_the_card_has_counts_and_the_license(refractive, rows):
    card, listed = (refractive / "README.md").read_text(), rows(refractive)
    assert f"# {COUNT} pairs of the scene paper_refractive" in card
    assert "CC0" in card
    assert re.search(r"between them: \d+\.\d (kB|MB), from", card)
    for split in ("train", "val"):
        part = [row for row in listed if row["split"] == split]
        assert f"| {split} | {len(part)} | {len({row['drive'] for row in part})} |" in card
    for name in {row["effects"][0]["effect"] for row in listed}:
        assert f"| {name} | {sum(row['effects'][0]['effect'] == name for row in listed)} |" in card
    assert np.asarray(Image.open(refractive / "parameters.png")).std() > 10


def test_histograms_name_the_components_and_the_unit_of_a_parameter():
    parameters = {
        ("HeterogeneousFog", "airlight"): 3,
        ("HeterogeneousFog", "scale_height"): 1,
        ("LensDistortion", "center"): 2,
        ("RollingShutter", "amplitude"): 3,
        ("RollingShutter", "frequency"): 3,
        ("RollingShutter", "phase"): 9,
        ("Turbulence", "amplitude"): 1,
    }
    columns = {name: [array("d", [0.0, 1.0])] * count for name, count in parameters.items()}
    summary = card.summarize([], settings={"scene": {}})._replace(parameters=columns)
    assert [label for _, label, _ in card.histogram_panels(summary)] == [
        *("airlight red", "airlight green", "airlight blue", "scale_height, m", "center x", "center y"),
        *("amplitude pitch, degrees", "amplitude yaw, degrees", "amplitude roll, degrees"),
        *("frequency 1, Hz", "frequency 2, Hz", "frequency 3, Hz", "phase, rad, all components", "amplitude, px"),
    ]
    few = summary._replace(parameters={("Turbulence", "amplitude"): [array("d", [0.0, 1.0])]})
    figure = card.draw_histograms(few)
    assert figure is not None
    assert Image.open(io.BytesIO(figure)).size == (320, 230)


@pytest.mark.parametrize("license_of", ["CC BY 4.0, MIT (two sources)", "the owner's: ask [us]", "'in quotes, too'"])
def test_a_license_may_be_any_text(call, words, tmp_path, license_of):
    assert call("generate", *words("out", "count=1", license=license_of)).code == 0
    stated = license_of.strip("'") if license_of[0] == "'" else license_of
    assert f"as stated by the creator of this set:** {stated}\n" in (tmp_path / "out" / "README.md").read_text()

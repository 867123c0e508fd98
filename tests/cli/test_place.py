"""`camera=` and `horizon=` of commands."""

import shutil
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf
from pictures import save_picture, save_turned

from torchrefract import presets
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import read_camera, write_opencv
from torchrefract.data.images import fit, read_image
from torchrefract.data.pairs.manifest import find_manifests, scan_rows
from torchrefract.random import key_of

COMMANDS = {
    "degrade": ("source=frames", "workers=0"),
    "generate": ("source=frames", "workers=0", "license=CC0"),
    "preview": ("frames/a.png", "frames=1"),
}
PLACE = ("camera=camera.yaml", "horizon=0.4")
FOG = "scene=cape_town_fog"


@pytest.fixture
def folder(tmp_path) -> Path:
    """Write the frames a.png and b.png, 48 x 64, and camera.yaml of them."""
    for i, name in enumerate("ab"):
        pixels = np.random.default_rng(i).integers(0, 256, (48, 64, 3), dtype=np.uint8)
        save_picture(tmp_path / "frames" / f"{name}.png", pixels)
    write_camera(tmp_path / "camera.yaml", 48, 64)
    return tmp_path


def write_camera(path: Path, height: int, width: int) -> None:
    pinhole: dict[str, Any] = {"fx": 40.0, "fy": 42.0, "cx": width / 2 + 3, "cy": height / 2 - 2}
    write_opencv(path, Camera(width=width, height=height, **pinhole, coefficients=(0.0,) * 4))


def results(folder: Path) -> dict[str, bytes]:
    """Return the pictures of a command by their names."""
    if folder.is_file():
        return {"": folder.read_bytes()}
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in sorted(folder.rglob("*.png"))}


@pytest.mark.parametrize("command", COMMANDS)
def test_camera_and_horizon_reach_the_scene_of_each_command(call, folder, command):
    suffix = ".apng" if command == "preview" else ""
    given = {"both": PLACE, "scene": [f"scene.{option}" for option in PLACE], "none": ()}
    if command == "preview":  # all commands share the code that gives them to the scene
        given |= {"camera": PLACE[:1], "horizon": PLACE[1:]}
    for name, words in given.items():
        outcome = call(command, *COMMANDS[command], FOG, *words, f"out={name}{suffix}")
        assert outcome.code == 0, outcome.err
    made = {name: results(folder / f"{name}{suffix}") for name in given}
    assert made.pop("both") == made["scene"]
    assert all(made[a] != made[b] for a, b in combinations(made, 2))
    errors = {
        ("camera=none.yaml",): "camera must name what exists, got none.yaml: No such file or directory",
        ("horizon=20",): "horizon must be a number in [-10, 10], got 20",
        ("camera=camera.yaml", "scene=cheap_dashcam"): "camera must be given with a scene that takes it, got scene=che",
    }
    for words, message in errors.items():
        assert message in call(command, *COMMANDS[command], FOG, *words, f"out=bad{suffix}").message
        assert not (folder / f"bad{suffix}").exists()


def test_a_picture_is_degraded_with_the_numbers_of_the_camera_file(call, folder):
    assert call("degrade", *COMMANDS["degrade"], FOG, *PLACE, "out=out").code == 0
    image = read_image(folder / "frames" / "a.png")[None]
    fog = presets.cape_town_fog(camera=read_camera(folder / "camera.yaml"), horizon=0.4)
    expected = fog.degrade(image, seed=0, keys=[key_of("a.png")]).image
    written = read_image(folder / "out" / "a.png")
    assert (written - expected[0]).abs().max() < 0.51 / 255 + 1e-5


@pytest.mark.parametrize("command", ["degrade", "generate"])
@pytest.mark.parametrize(
    "camera", ["camera.yaml", "{_target_: torchrefract.cameras.io.read_camera, path: camera.yaml}"]
)
def test_a_folder_is_not_continued_with_another_camera_in_the_file_of_the_scene(call, folder, command, camera):
    scene = f"_target_: torchrefract.presets.cape_town_fog\nseverity: 3\ncamera: {camera}\n"
    (folder / "conf" / "scene").mkdir(parents=True)
    (folder / "conf" / "scene" / "mine.yaml").write_text(scene)
    for width, code in ((64, 0), (64, 0), (128, 1)):
        write_camera(folder / "camera.yaml", 3 * width // 4, width)
        outcome = call(command, "--config-dir", "conf", *COMMANDS[command], "scene=mine", "out=out")
        assert outcome.code == code, outcome.err
    assert "error: out must be a folder of the same configuration, got out, where files.camera.yaml is" in outcome.err


@pytest.mark.parametrize("command", COMMANDS)
def test_frames_that_a_tag_turns_are_warned_of_beside_a_camera(call, folder, command):
    save_turned(folder / "frames" / "c.jpg", np.zeros((48, 64, 3), np.uint8), 3)
    source = ("image=frames", "frames=3") if command == "preview" else COMMANDS[command]
    suffix = ".apng" if command == "preview" else ""
    warning = "c.jpg. They are read as displayed, and so labels and a camera must be of the displayed pictures"
    for name, words in (("with", PLACE[:1]), ("without", ())):
        outcome = call(command, *source, FOG, *words, f"out={name}{suffix}")
        assert outcome.code == 0, outcome.err
        assert (warning in outcome.err) == bool(words)


def test_cropped_frames_have_a_cropped_camera(call, folder):
    options = (*COMMANDS["generate"], FOG, *PLACE, "size=[20,40]", "out=out")
    assert call("generate", *options).code == 0
    cropped = read_camera(folder / "camera.yaml").cropped(left=0, top=8, width=64, height=32)
    row = next(scan_rows(find_manifests(folder / "out"), lambda row: row.source == "a.png"))[0]
    clean = fit(read_image(folder / "frames" / "a.png"), (20, 40))[None]
    fog = presets.cape_town_fog(camera=cropped, horizon=0.4)
    expected = fog.degrade(clean, seed=row.seed, keys=[row.key]).image[0]
    written = read_image(folder / "out" / row.files["corrupted.png"].path)
    assert (written - expected).abs().max() < 0.51 / 255 + 1e-5
    write_camera(folder / "camera.yaml", 32, 64)  # of frames with the shape of the crop, not of the files
    outcome = call("generate", *options, "out=other")
    assert outcome.code == 1
    assert "error: camera must be that of all frames, got a.png: image must have the shape" in outcome.err


@pytest.mark.usefixtures("blank_figures")
def test_a_training_and_its_validation_have_the_camera_of_the_cropped_frames(call, folder):
    for drive in ("u", "v"):
        (folder / "drives" / drive).mkdir(parents=True)
        for name in "ab":
            shutil.copy(folder / "frames" / f"{name}.png", folder / "drives" / drive)
    data = ("data=frames", "data.root=drives", "data.size=[32,64]", "data.batch_size=1", "data.workers=0")
    options = ("+task=deweather", *data, "trainer.max_epochs=1", "model.network.width=4")
    outcome = call("train", *options, *PLACE, "hydra.run.dir=run")
    assert outcome.code == 0, outcome.err
    assert "a tag that turns them" not in outcome.err
    config = OmegaConf.load(folder / "run" / "config.yaml")
    expected = presets.cape_town_fog(
        camera=read_camera(folder / "camera.yaml").cropped(left=0, top=8, width=64, height=32), horizon=0.4
    )
    for scene in (config.scene, config.data.effect):
        assert repr(instantiate(scene)) == repr(expected)
    (folder / "camera.yaml").unlink()
    scored = call("eval", "ckpt_path=run/best.ckpt", "hydra.run.dir=again")
    assert scored.code == 0, scored.err
    assert "as in its own validation" in scored.out
    write_camera(folder / "camera.yaml", 48, 64)
    save_turned(folder / "drives" / "v" / "a.png", np.zeros((48, 64, 3), np.uint8), 3)
    again = call("train", *options, *PLACE, "hydra.run.dir=turned", "trainer.accelerator=none")  # checked later
    assert "rotation of a video): a.png. They are read as displayed, and so labels and a camera must be" in again.err
    shutil.copy(folder / "frames" / "a.png", folder / "drives" / "v")
    wider = ("trainer.max_epochs=2", "model.network.width=8", "ckpt_path=run/last.ckpt")
    other = call("train", *options, *PLACE, *wider)
    assert (other.code, "got run/last.ckpt, where " in other.err) == (1, True)
    assert "HeterogeneousFog assumes the depth of a road between walls" in other.err
    write_camera(folder / "camera.yaml", 32, 64)
    assert "camera must be that of all frames, got drives/v/a.png" in call("train", *options, *PLACE).message
    message = call("train", "+task=deweather", *PLACE).message
    assert "camera and horizon must be those of frames in a folder, data=frames" in message

import errno
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from pictures import load_frames, save_clip
from PIL import Image

import torchrefract as tr
from torchrefract._io import CONFIG_DIR
from torchrefract._validation import UsageError
from torchrefract.cli.command import prepare_arguments
from torchrefract.data.images import fit, pixels_of, read_image
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.data.video import read_video
from torchrefract.effects.base import Effect
from torchrefract.presets import cape_town_fog, limpopo_sun_glare
from torchrefract.visualization.animation import Animation
from torchrefract.visualization.figures import ContactSheetRow, contact_sheet_row

SHOWN = list(OmegaConf.load(Path(__file__).parents[2] / "conf" / "preview.yaml").effects)
LENS = ("scene=cheap_dashcam",)  # a lens with its defaults
FOG = ("scene=cape_town_fog",)
FLARE = ("scene=limpopo_sun_glare", "seed=3")
STILL = ("out=still.apng", "frames=1")  # an animation of one frame, without the figure around it


@pytest.fixture
def picture(tmp_path) -> Path:
    """Write frame.png, 24 x 32 px of random 2 x 2 px squares, to the folder in which commands run."""
    squares = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    Image.fromarray(squares.repeat(2, axis=0).repeat(2, axis=1)).save(tmp_path / "frame.png")
    return tmp_path / "frame.png"


@pytest.fixture
def frames(tmp_path) -> list[torch.Tensor]:
    """Write twelve frames (1, 3, 24, 32) to the folder drive; their names sort by number, not by letter."""
    (tmp_path / "drive").mkdir()
    values = np.random.default_rng(0).integers(0, 256, (12, 24, 32, 3), dtype=np.uint8)
    for t, pixels in enumerate(values):
        Image.fromarray(pixels).save(tmp_path / "drive" / f"frame{t}.png")
    for name in ("notes.txt", "._frame3.png"):
        (tmp_path / "drive" / name).touch()
    return [torch.from_numpy(pixels).movedim(-1, 0)[None] / 255 for pixels in values]


def shows(picture: np.ndarray, cell: np.ndarray) -> bool:
    """Return True if a picture (H, W, 3) contains a cell (h, w, 3), pixel by pixel."""
    height, width = cell.shape[:2]
    rows, columns = picture.shape[0] - height + 1, picture.shape[1] - width + 1
    candidates = np.ones((rows, columns), dtype=bool)
    # A few pixels exclude nearly all positions.
    for y in range(0, height, -(-height // 4)):
        for x in range(0, width, -(-width // 4)):
            candidates &= (picture[y : y + rows, x : x + columns] == cell[y, x]).all(axis=2)
    positions = zip(*candidates.nonzero(), strict=True)
    return any(np.array_equal(picture[y : y + height, x : x + width], cell) for y, x in positions)


def sheet_shows(sheet: Path, cell: torch.Tensor | None) -> bool:
    """Return True if a saved contact sheet contains (3, h, w)."""
    assert cell is not None
    return shows(load_frames(sheet)[0], pixels_of(cell))


def row_of(effect: Effect, frame: torch.Tensor, *, seed: int = 0, depth: np.ndarray | None = None) -> ContactSheetRow:
    meters = None if depth is None else torch.from_numpy(depth.astype(np.float32))[None, None]
    return contact_sheet_row("", effect, frame=frame, seed=seed, depth=meters)


def still(path: Path, effect: Effect, frame: torch.Tensor, **options: Any) -> bool:
    """Return True if a single picture shows a frame (1, 3, 24, 32) that an effect has degraded."""
    (shown,) = load_frames(path)
    return shows(shown, as_displayed(effect.degrade(frame, seed=0, **options).image[0]))


def flare_at(frame: torch.Tensor, t: int) -> np.ndarray:
    """Return a frame (1, 3, 24, 32) with the scene's flare at time t as displayed, (240, 320, 3)."""
    return as_displayed(limpopo_sun_glare().degrade(frame, seed=3, frame=t).image[0])


def as_displayed(image: torch.Tensor, *, factor: int = 10) -> np.ndarray:
    """Return (3, 24, 32) as an animation shows it, (240, 320, 3)."""
    return pixels_of(image).repeat(factor, axis=0).repeat(factor, axis=1)


# --- contact sheets


@pytest.mark.quick
def test_a_picture_becomes_a_contact_sheet(call, picture, tmp_path):
    outcome = call("preview", "frame.png", *LENS, "seed=3")
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out == "preview.png: cheap_dashcam on frame.png\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame.png", "preview.png"]
    row = row_of(tr.LensDistortion(), read_image(picture)[None], seed=3)
    for cell in (row.frame, row.corrupted, row.checkerboard, row.restored):
        assert sheet_shows(tmp_path / "preview.png", cell)
    other_seed = row_of(tr.LensDistortion(), read_image(picture)[None], seed=4)
    assert not sheet_shows(tmp_path / "preview.png", other_seed.corrupted)
    assert call("preview", "frame.png", *LENS, "seed=3", "out=new/again.png").code == 0
    assert (tmp_path / "new" / "again.png").read_bytes() == (tmp_path / "preview.png").read_bytes()


def test_without_a_picture_all_effects_are_drawn_on_a_rendered_scene(call, tmp_path):
    outcome = call("preview", "size=[24,32]", "out=sheet.png")
    assert outcome.out == f"sheet.png: {', '.join(SHOWN)} on a rendered road scene, as no picture was given\n"
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.png"]


def test_a_guess_of_the_depth_is_said(call, picture):
    warning = "warning: HeterogeneousFog assumes the depth of a road between walls"
    assert warning in call("preview", "frame.png", *FOG, *STILL).err
    assert call("preview", *FOG, *STILL, "size=[24,32]").err == ""  # a rendered scene has its own


def test_fog_has_the_depth_of_the_rendered_scene(call, tmp_path):
    assert call("preview", *FOG, "size=[24,32]", "seed=7").code == 0
    frame, depth = render_road_scenes(torch.tensor([7]), 24, 32)
    row = row_of(cape_town_fog(), frame, seed=7, depth=depth[0, 0].numpy())
    for cell in (row.frame, row.corrupted, row.map):
        assert sheet_shows(tmp_path / "preview.png", cell)


def test_the_settings_of_an_effect_can_be_changed(call, picture, tmp_path):
    names = [name for name in SHOWN if name not in ("Turbulence", "UniformFog")]
    words = ["effects.Turbulence.amplitude_range=[1,1]", "effects.UniformFog.visibility_range=[9,9]"]
    outcome = call("preview", "frame.png", *(f"~effects.{name}" for name in names), *words, *STILL)
    assert outcome.out == "still.apng: Turbulence, UniformFog on frame.png, 1 frames\n"
    turbulence = tr.Turbulence(amplitude_range=(1, 1), length_range=(60, 90), aperture_range=(8, 10))
    for effect in (turbulence, tr.UniformFog(visibility_range=(9, 9), depth=tr.GroundPlaneDepth())):
        assert still(tmp_path / "still.apng", effect, read_image(picture)[None])


def test_a_scene_takes_its_severity(call, picture, tmp_path):
    assert call("preview", "frame.png", *FOG, *STILL, "scene.severity=5").code == 0
    assert still(tmp_path / "still.apng", cape_town_fog(5), read_image(picture)[None])
    assert not still(tmp_path / "still.apng", cape_town_fog(), read_image(picture)[None])


# --- arguments

NAMES = (
    "seed=1, my frame.png",
    'it\'s "the road".png',
    "$HOME ${seed} \\${out}.png",
    "[1](2){3: 4}.png",
    "back\\slash and line\nbreak.png",
    "霧.png",
    "~effects.png",
    "+scene=none.png",
    "null",
)


def test_any_name_of_a_picture_reaches_the_configuration_unchanged(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with initialize_config_dir(CONFIG_DIR, version_base="1.3"):
        for name in NAMES:
            Path(name).touch()
            (word,) = prepare_arguments("preview", [name])
            assert compose("preview", overrides=[word]).image == name


def test_a_picture_with_an_odd_name_is_drawn(call, picture, tmp_path):
    name = "it's ${seed},\n霧 seed=1.png"
    picture.rename(tmp_path / name)
    assert call("preview", name, *LENS).out == f"preview.png: cheap_dashcam on {name.replace(chr(10), '?')}\n"


@pytest.mark.quick
def test_only_a_bare_word_is_a_picture_and_there_is_at_most_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    overrides, options = ["seed=1", "~effects.Compose", "+a=b"], ["--config-dir", "mine", "-c", "job", "--resolve"]
    assert prepare_arguments("preview", overrides + options) == overrides + options
    words = prepare_arguments("preview", [*options, "frame.png", *overrides])
    assert words == ["image='frame.png'", *overrides, *options]
    with pytest.raises(UsageError, match=r"one picture, in quotes .*, got my and frame\.png"):
        prepare_arguments("preview", ["my", "frame.png"])


def test_the_configuration_is_shown_without_reading_the_picture(call, tmp_path):
    outcome = call("preview", "none.png", "--cfg", "job")
    assert outcome.code == 0
    assert "image: none.png" in outcome.out.splitlines()
    assert list(tmp_path.iterdir()) == []


def test_an_unreadable_picture_is_one_line_of_error(call, picture, tmp_path):
    picture.write_bytes(picture.read_bytes()[:300])
    (tmp_path / "notes.txt").write_text("no picture")
    assert "none.png cannot be opened" in call("preview", "none.png").message
    assert "frame.png is truncated" in call("preview", "frame.png").message
    assert call("preview", "notes.txt").message.startswith("notes.txt ")
    assert not (tmp_path / "preview.png").exists()


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("scene=london", "scene must be one of cape_town_fog, cheap_dashcam, .*, got london"),
        ("color=red", "color"),
        ("+effects.Turbulence.color=red", "Turbulence: .*'color'"),
        ("effects.Turbulence.amplitude_range=[2,1]", "Turbulence: amplitude_range must be"),
        ("effects.Turbulence._target_=torch.nn.ReLU", "ReLU"),
        ("+effects.Mine=[1]", "Mine must be an effect of torchrefract, got"),
        ("effects=null", "effects must be at least one effect with its name, got None"),
        ("seed=-1", "seed must be a whole number .*, got -1"),
        ("seed=tomorrow", "seed must be a whole number .*, got tomorrow"),
        ("size=[640]", r"size must be \(height, width\), got"),
        ("size=[64,64]", "size: image must be at least size = 64x64"),
        ("out=sheet.doc", r"out must end in one of \.apng, .*\.gif, .*\.mp4, .*\.png, .*\.webp, got sheet.doc"),
        ("out=sheet", "out must end in one of .*, got sheet"),
        ("out=frame.png/sheet.png", "frame.png/sheet.png could not be written: Not a directory"),
        ("out=folder.png", "out must be a file, got the folder folder.png"),
        ("frames=0", "frames must be at least 1, got 0"),
        ("frames=2.5", "frames must be a whole number, got 2.5"),
        ("fps=0", r"fps must be a number in \[0.1, 50\], got 0"),
        ("depth=none.png", "none.png cannot be opened"),
        ("depth=none.npy", "depth must be a file that can be read, got none.npy"),
        ("depth=frame.png", "depth must be a gray PNG of 16 bits, or a .npy in m, got frame.png"),
    ],
)
def test_a_wrong_argument_is_one_line_of_error_and_writes_nothing(call, picture, tmp_path, monkeypatch, word, message):
    # Every error is raised before the first effect is drawn.
    monkeypatch.setattr("torchrefract.cli.preview.contact_sheet_row", None)
    (tmp_path / "folder.png").mkdir()
    assert re.search(message, text := call("preview", "frame.png", word).message), text
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["folder.png", "frame.png"]


def test_a_contact_sheet_that_cannot_be_drawn_keeps_the_old_file(call, picture, tmp_path):
    (tmp_path / "preview.png").write_text("old")
    words = ("+effects.LensDistortion.strict=true", "effects.LensDistortion.k1_range=[-3,-3]")
    assert "LensDistortion: " in call("preview", "frame.png", *words).message
    assert (tmp_path / "preview.png").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 2


# --- depth of a picture


def meters() -> np.ndarray:
    """Return depth (12, 16), m, half the sides of the picture, with sky at the top."""
    depth = np.random.default_rng(1).uniform(5, 120, (12, 16)).round(1)
    depth[:3] = np.inf
    return depth


def tensor_of(depth: np.ndarray, *, factor: int = 2) -> torch.Tensor:
    """Return depth (1, 1, H, W), enlarged."""
    return torch.from_numpy(depth.repeat(factor, axis=0).repeat(factor, axis=1).astype(np.float32))[None, None]


def test_a_depth_array_may_have_any_size_of_the_picture_s_shape(call, picture, tmp_path):
    frame, path = read_image(picture)[None], tmp_path / "still.apng"
    for depth in (meters()[None], tensor_of(meters())[0, 0].double().numpy(), tensor_of(meters(), factor=6)[0, 0]):
        np.save(tmp_path / "depth.npy", depth)
        outcome = call("preview", "frame.png", *FOG, *STILL, "depth=depth.npy")
        assert outcome.out == "still.apng: cape_town_fog on frame.png, 1 frames\n"
        assert still(path, cape_town_fog(), frame, depth=tensor_of(meters()))
    assert not still(path, cape_town_fog(), frame)


@pytest.mark.parametrize(("words", "scale"), [((), 1 / 256), (("depth_scale=0.1",), 0.1)])
def test_a_depth_picture_counts_in_the_scale_and_its_largest_value_is_infinite(call, picture, tmp_path, words, scale):
    steps = np.where(np.isinf(meters()), 65535, meters() / scale).round().astype(np.uint16)
    Image.fromarray(steps).save(tmp_path / "depth.png")
    outcome = call("preview", "frame.png", *FOG, *STILL, "depth=depth.png", *words)
    assert outcome.out == "still.apng: cape_town_fog on frame.png, 1 frames\n"
    depth = tensor_of(np.where(steps == 65535, np.inf, scale * steps))
    assert still(tmp_path / "still.apng", cape_town_fog(), read_image(picture)[None], depth=depth)


def test_depth_that_was_not_measured_counts_as_infinite_and_is_reported(call, picture, tmp_path):
    steps = np.full((24, 32), 256 * 40, np.uint16)
    steps[:6] = 0
    Image.fromarray(steps).save(tmp_path / "depth.png")
    np.save(tmp_path / "depth.npy", steps / 256)
    depth = tensor_of(np.where(steps == 0, np.inf, 40.0), factor=1)
    for name in ("depth.png", "depth.npy"):
        outcome = call("preview", "frame.png", *FOG, *STILL, f"depth={name}")
        assert outcome.out.endswith(", 1 frames; 25.0% of its depth is 0, taken as infinite\n")
        assert still(tmp_path / "still.apng", cape_town_fog(), read_image(picture)[None], depth=depth)


def test_a_contact_sheet_crops_depth_with_its_picture(call, picture, tmp_path):
    np.save(tmp_path / "depth.npy", meters())
    assert call("preview", "frame.png", *FOG, "depth=depth.npy", "size=[12,8]").code == 0
    frame = read_image(picture)[None, :, ::2, 8:24:2].contiguous()
    assert sheet_shows(tmp_path / "preview.png", row_of(cape_town_fog(), frame, depth=meters()[:, 4:12]).corrupted)


@pytest.mark.parametrize(
    ("name", "depth", "message"),
    [
        ("d.npy", meters()[:, :-1], r"of the size of the picture, 24x32 .*, or of its shape, got 12x15"),
        ("d.npy", meters() - 50, "depth must be at least 0, in m, got -"),
        ("d.npy", np.where(meters() > 100, np.nan, meters()), "depth must be at least 0, in m, got nan"),
        ("d.npy", meters() / 1000, "depth must be in m, not normalized"),
        ("d.npy", np.zeros((12, 16)), "depth must be known in half of the pixels .* d.npy with 100.0% at 0"),
        ("d.npy", np.ones((12, 16), np.uint16), r"depth must be \(height, width\) of floating numbers, in m, got d"),
        ("d.npy", np.ones((2, 12, 16)), r"depth must be \(height, width\) of floating numbers, in m, got d.npy"),
        ("d.npy", np.array([{}], dtype=object), "depth must be an array of numbers, got d.npy, which is damaged"),
        ("d.png", np.zeros((12, 16), np.uint16), "depth must be known in half of the pixels .* d.png with 100.0% at 0"),
        ("d.png", np.ones((12, 16), np.uint8), "depth must be a gray PNG of 16 bits, or a .npy in m, got d.png"),
        ("d.png", np.ones((12, 16, 3), np.uint8), "depth must be a gray PNG of 16 bits, or a .npy in m, got d.png"),
    ],
)
def test_a_wrong_depth_is_one_line_of_error(call, picture, tmp_path, name, depth, message):
    path = tmp_path / name
    np.save(path, depth, allow_pickle=True) if path.suffix == ".npy" else Image.fromarray(depth).save(path)
    assert re.search(message, text := call("preview", "frame.png", *FOG, f"depth={name}").message), text
    assert not (tmp_path / "preview.png").exists()


def test_a_truncated_depth_is_one_line_of_error(call, picture, tmp_path):
    np.save(tmp_path / "d.npy", meters())
    Image.fromarray(meters().clip(0, 200).astype(np.uint16)).save(tmp_path / "d.png")
    for name in ("d.npy", "d.png"):
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[: len(data) // 2])
        assert re.search("damaged|truncated", call("preview", "frame.png", *FOG, f"depth={name}").message)


def test_depth_needs_a_picture_and_a_scale(call, picture, tmp_path):
    assert "depth must be that of a picture, image=…" in call("preview", "depth=depth.npy").message
    np.save(tmp_path / "d.npy", meters())
    message = call("preview", "frame.png", *FOG, "depth=d.npy", "depth_scale=0.001").message
    assert message == "depth_scale must be left out for .npy, whose values are in m, got 0.001 with d.npy"
    assert "depth_scale must be above 0, got 0" in call("preview", "frame.png", "depth=d.png", "depth_scale=0").message


# --- animations


@pytest.mark.quick
def test_a_picture_becomes_an_animation(call, picture, tmp_path):
    outcome = call("preview", "frame.png", *FLARE, "out=flare.apng", "frames=4")
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out == "flare.apng: limpopo_sun_glare on frame.png, 4 frames\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flare.apng", "frame.png"]
    pictures = load_frames(tmp_path / "flare.apng")
    assert len(pictures) == 4
    for t, shown in enumerate(pictures):
        assert shows(shown, flare_at(read_image(picture)[None], t))
        assert not shows(shown, flare_at(read_image(picture)[None], t + 1))


def test_an_animation_of_a_rendered_scene_has_its_depth(call, tmp_path):
    assert call("preview", *FOG, "size=[24,32]", "seed=7", "out=fog.apng", "frames=2").code == 0
    frame, depth = render_road_scenes(torch.tensor([7]), 24, 32)
    for t, shown in enumerate(load_frames(tmp_path / "fog.apng")):
        assert shows(shown, as_displayed(cape_town_fog().degrade(frame, seed=7, depth=depth, frame=t).image[0]))


@pytest.mark.parametrize("source", ["drive", "drive.avi"])
def test_each_frame_of_an_animation_has_its_map_of_a_folder(call, frames, tmp_path, source):
    names = [f"frame{t}" for t in range(3)]
    if source == "drive.avi":
        save_clip(tmp_path / source, [pixels_of(frame[0]) for frame in frames])
        frames = [frame for _, frame in read_video(tmp_path / source, range(12))]
        names = [f"{source}/{t:06d}" for t in range(3)]
    depths = [torch.full((1, 1, 24, 32), 5.0 + 40 * t) for t in range(3)]
    for name, depth in zip(names, depths, strict=True):
        (path := tmp_path / "depth" / f"{name}.npy").parent.mkdir(parents=True, exist_ok=True)
        np.save(path, depth[0, 0])
    outcome = call("preview", source, *FOG, "depth=depth", "frames=3", "out=fog.apng")
    assert (outcome.code, outcome.err) == (0, "")
    for t, (picture, depth) in enumerate(zip(load_frames(tmp_path / "fog.apng"), depths, strict=True)):
        image = cape_town_fog().degrade(frames[t], seed=0, depth=depth, frame=t).image[0]
        assert shows(picture, as_displayed(image)), t
    missing = "frame3.png" if source == "drive" else source
    message = call("preview", source, *FOG, "depth=depth", "frames=4", "out=fog.apng").message
    assert f"depth must be a folder with a map for each frame, got none for {missing} in depth" in message
    assert call("preview", source, *FOG, "depth=depth", "frames=4").code == 0  # a contact sheet shows the first alone


def test_one_depth_map_for_all_frames_of_a_drive_is_said(call, frames, picture, tmp_path):
    np.save(tmp_path / "depth.npy", meters())
    words = (*FOG, "depth=depth.npy", "frames=2")
    warning = "warning: depth.npy is one depth map for all 2 frames; depth= takes a folder with one for each"
    assert warning in call("preview", "drive", *words, "out=fog.gif").err
    assert call("preview", "drive", *words, "out=fog.png").err == ""  # shows the first frame alone
    assert call("preview", "frame.png", *words, "out=fog.gif").err == ""


def test_a_folder_is_played_in_the_order_of_its_numbers(call, frames, tmp_path):
    for max_frames, count in ((3, 3), (100, 12)):
        outcome = call("preview", "drive", *FLARE, "out=flare.apng", f"frames={max_frames}")
        assert outcome.out == f"flare.apng: limpopo_sun_glare on drive, {count} frames\n"
    pictures = load_frames(tmp_path / "flare.apng")
    assert len(pictures) == 12
    assert all(shows(shown, flare_at(frames[t], t)) for t, shown in enumerate(pictures))


def test_a_video_is_played_and_its_first_frame_is_that_of_a_contact_sheet(call, frames, tmp_path):
    path = tmp_path / "a: 100%05d.avi"  # neither a protocol nor a pattern of names
    save_clip(path, [pixels_of(frame[0]) for frame in frames])
    decoded = [frame for _, frame in read_video(path, range(12))]
    assert call("preview", path.name, *FLARE, "out=flare.apng").out.endswith("12 frames\n")
    for t, shown in enumerate(load_frames(tmp_path / "flare.apng")):
        assert shows(shown, flare_at(decoded[t], t))
    assert call("preview", path.name, *FLARE, "out=sheet.png").code == 0
    first = torch.from_numpy(flare_at(decoded[0], 0).copy()).movedim(-1, 0) / 255
    assert sheet_shows(tmp_path / "sheet.png", first)


def test_an_animation_is_read_like_a_video(call, picture, tmp_path):
    pages = [Image.new("RGB", (32, 24), (80 * k, 0, 0)) for k in range(3)]
    pages[0].save(tmp_path / "flare.gif", save_all=True, append_images=pages[1:])
    assert call("preview", "flare.gif", *FLARE, "out=again.gif").out.endswith("on flare.gif, 3 frames\n")


def test_frames_are_cropped_and_reduced(call, frames, tmp_path):
    assert call("preview", "drive", *LENS, "size=[12,16]", "out=lens.apng", "frames=2").code == 0
    image = tr.LensDistortion().degrade(fit(frames[1][0], (12, 16)), seed=0).image
    assert shows(load_frames(tmp_path / "lens.apng")[1], as_displayed(image, factor=20))


def test_frames_that_cannot_be_played_are_one_line_of_error(call, frames, picture, tmp_path):
    for name in ("empty", "mixed"):
        (tmp_path / name).mkdir()
    picture.rename(tmp_path / "mixed" / "a.png")
    Image.new("RGB", (8, 8)).save(tmp_path / "mixed" / "b.png")
    (tmp_path / "bad.mp4").write_bytes(b"0" * 5000)
    (tmp_path / "drive" / "frame7.png").write_bytes(b"")
    for name, message in (
        ("empty", "image must be a folder that holds .jpg, .jpeg, .png, .webp, .bmp, got empty"),
        ("mixed", "image must be a folder of frames of one size, 24x32 (height x width), got b.png of 8x8"),
        ("bad.mp4", "image must be a video with a frame that can be decoded, got bad.mp4"),
        ("none.mp4", "none.mp4 cannot be opened (No such file or directory)"),
        ("drive", "drive/frame7.png is empty (0 bytes)"),
    ):
        assert call("preview", name, *FLARE, "out=flare.gif").message == message
    message = call("preview", "drive", *FLARE, "out=flare.gif", "size=[99,99]").message
    assert "image must be at least size" in message
    assert not (tmp_path / "flare.gif").exists()


@pytest.mark.parametrize("name", ["flare.pdf", "flare.png"])
def test_a_contact_sheet_on_a_full_disk_is_one_line_of_error(call, picture, tmp_path, file_limit, name):
    with file_limit(100):
        outcome = call("preview", "frame.png", *FLARE, f"out={name}")
    assert outcome.message == f"{name} could not be written: File too large"
    assert list(tmp_path.iterdir()) == [picture]


def test_a_full_disk_keeps_the_old_animation(call, picture, tmp_path, monkeypatch):
    def render(self, times):
        yield next(original(self, times))
        raise OSError(errno.ENOSPC, "No space left on device")

    original = Animation.render
    monkeypatch.setattr(Animation, "render", render)
    (tmp_path / "flare.webp").write_text("old")
    message = call("preview", "frame.png", *FLARE, "out=flare.webp", "frames=3").message
    assert message == "flare.webp could not be written: No space left on device"
    assert (tmp_path / "flare.webp").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 2

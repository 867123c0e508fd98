import errno
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import matplotlib.image
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from PIL import Image

import torchrefract as tr
from torchrefract._io import CONFIG_DIR
from torchrefract._validation import UsageError
from torchrefract.cli.command import picture_as_option
from torchrefract.data.images import fit, read_image
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.presets import cape_town_fog, limpopo_sun_glare
from torchrefract.visualization.animation import Animation
from torchrefract.visualization.figures import contact_sheet_row

# One quick row.
BRIEFLY = ("scene=cheap_dashcam",)


@pytest.fixture
def picture(tmp_path) -> Path:
    """A picture of 12 x 16 squares of 2 x 2 px, in the folder that commands run in."""
    squares = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    Image.fromarray(squares.repeat(2, axis=0).repeat(2, axis=1)).save(tmp_path / "frame.png")
    return tmp_path / "frame.png"


def shows(page: np.ndarray, cell: np.ndarray) -> bool:
    """Whether a page (H, W, 3) shows a cell (h, w, 3) somewhere, pixel by pixel."""
    height, width = cell.shape[:2]
    rows, columns = page.shape[0] - height + 1, page.shape[1] - width + 1
    found = np.ones((rows, columns), dtype=bool)
    # A few pixels first, since the whole takes long.
    for y in range(0, height, -(-height // 4)):
        for x in range(0, width, -(-width // 4)):
            found &= (page[y : y + rows, x : x + columns] == cell[y, x]).all(axis=2)
    places = zip(*found.nonzero(), strict=True)
    return any(np.array_equal(page[y : y + height, x : x + width], cell) for y, x in places)


def holds(sheet: Path, cell: torch.Tensor) -> bool:
    """Whether the saved sheet shows (3, h, w) somewhere."""
    page = (255 * matplotlib.image.imread(sheet)[..., :3]).round().astype(np.uint8)
    return shows(page, (255 * cell).round().byte().movedim(0, -1).numpy())


def test_a_picture_becomes_a_sheet_of_its_effects(call, picture, tmp_path):
    outcome = call("preview", "frame.png", *BRIEFLY, "seed=3")
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out == "preview.png: cheap_dashcam on frame.png\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame.png", "preview.png"]
    frame = read_image(picture)[None]
    row = contact_sheet_row("", tr.LensDistortion(), frame=frame, seed=3)  # the scene is a lens with its defaults
    assert row.restored is not None
    for cell in (row.frame, row.corrupted, row.checkerboard, row.restored):
        assert holds(tmp_path / "preview.png", cell)
    assert not holds(
        tmp_path / "preview.png", contact_sheet_row("", tr.LensDistortion(), frame=frame, seed=4).corrupted
    )


def test_all_effects_are_drawn_on_a_rendered_scene_where_no_picture_is_given(call, tmp_path):
    outcome = call("preview", "size=[24,32]", "out=sheet.png")
    names = (
        "LensDistortion, Turbulence, ThinPlateSpline, DivergenceFree, UniformFog, HeterogeneousFog, LensFlare, Compose"
    )
    assert outcome.out == f"sheet.png: {names} on a rendered road scene, as no picture was given\n"
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.png"]


def test_fog_knows_the_depth_of_a_rendered_scene(call, tmp_path):
    assert call("preview", "scene=cape_town_fog", "size=[24,32]", "seed=7").code == 0
    frame, depth = render_road_scenes(torch.tensor([7]), 24, 32)
    row = contact_sheet_row("", cape_town_fog(), frame=frame, seed=7, depth=depth)
    assert row.map is not None
    for cell in (row.frame, row.corrupted, row.map):
        assert holds(tmp_path / "preview.png", cell)


def test_the_settings_of_an_effect_can_be_changed(call, picture, tmp_path):
    unwanted = ("LensDistortion", "ThinPlateSpline", "DivergenceFree", "HeterogeneousFog", "LensFlare", "Compose")
    others = [f"~effects.{name}" for name in unwanted]
    words = ["effects.Turbulence.amplitude_range=[1,1]", "effects.UniformFog.visibility_range=[9,9]"]
    assert call("preview", "frame.png", *others, *words).out == "preview.png: Turbulence, UniformFog on frame.png\n"
    air = tr.Turbulence(amplitude_range=(1, 1), length_range=(60, 90), aperture_range=(8, 10))
    fog = tr.UniformFog(visibility_range=(9, 9), depth=tr.GroundPlaneDepth())
    for effect in (air, fog):
        assert holds(
            tmp_path / "preview.png", contact_sheet_row("", effect, frame=read_image(picture)[None], seed=0).corrupted
        )


def test_the_same_seed_gives_the_same_bytes_and_another_one_others(call, picture, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert call("preview", "frame.png", *BRIEFLY, f"seed={seed}", f"out={name}.png").code == 0
    first, again, other = ((tmp_path / f"{name}.png").read_bytes() for name in "abc")
    assert first == again
    assert first != other


def test_a_picture_is_cut_and_reduced_before_it_is_degraded(call, picture, tmp_path):
    assert call("preview", "frame.png", *BRIEFLY, "size=[12,8]").code == 0
    frame = read_image(picture)[None, :, ::2, 8:24:2]
    row = contact_sheet_row("", tr.LensDistortion(), frame=frame.contiguous(), seed=0)
    assert holds(tmp_path / "preview.png", row.frame)
    assert holds(tmp_path / "preview.png", row.corrupted)


def test_the_suffix_of_out_is_its_format(call, picture, tmp_path):
    assert call("preview", "frame.png", *BRIEFLY, "out=sheet.JPG").code == 0
    with Image.open(tmp_path / "sheet.JPG") as image:
        assert image.format == "JPEG"


NAMES = (
    "my frame.png",
    "seed=1.png",
    "a,b.png",
    "it's.png",
    'the "road".png',
    "$HOME ${seed} \\${out}.png",
    "[1](2){3: 4}.png",
    "back\\slash.png",
    "line\nbreak.png",
    "霧.png",
    "~effects.png",
    "+scene=none.png",
    "null",
)


@pytest.mark.parametrize("name", NAMES)
def test_any_name_of_a_file_reaches_the_configuration_letter_by_letter(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    Path(name).touch()
    (word,) = picture_as_option("preview", [name])
    with initialize_config_dir(CONFIG_DIR, version_base="1.3"):
        assert compose("preview", overrides=[word]).image == name


@pytest.mark.parametrize("name", ["it's ${seed}, seed=1.png", "霧\n.png"])
def test_a_picture_with_an_odd_name_is_drawn(call, picture, tmp_path, name):
    picture.rename(tmp_path / name)
    outcome = call("preview", name, *BRIEFLY)
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out == f"preview.png: cheap_dashcam on {name.replace(chr(10), '?')}\n"


def test_words_that_are_no_picture_stay_as_they_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["seed=1", "--config-dir", "mine", "-c", "job", "~effects.Compose", "+a=b", "--resolve"]
    assert picture_as_option("preview", words) == words
    assert picture_as_option("preview", [*words, "frame.png"]) == [*words, "image='frame.png'"]


def test_two_pictures_are_one_too_many():
    with pytest.raises(UsageError, match=r"one picture, in quotes .*, got my and frame\.png"):
        picture_as_option("preview", ["my", "frame.png"])


def test_the_configuration_can_be_looked_at_without_a_picture_being_read(call, tmp_path):
    outcome = call("preview", "none.png", "--cfg", "job")
    assert outcome.code == 0
    assert "image: none.png" in outcome.out.splitlines()
    assert list(tmp_path.iterdir()) == []


def test_a_picture_that_cannot_be_read_is_one_line_of_error(call, picture, tmp_path):
    data = picture.read_bytes()
    picture.write_bytes(data[: len(data) // 2])
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
        ("effects.Turbulence.color=red", "effects.Turbulence.color"),
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
        ("out=none/sheet.png", "none/sheet.png could not be written: No such file or directory"),
        ("out=frame.png/sheet.png", "frame.png/sheet.png could not be written: Not a directory"),
        ("out=folder.png", "out must be a file, got the folder folder.png"),
        ("frames=0", "frames must be at least 1, got 0"),
        ("frames=2.5", "frames must be a whole number, got 2.5"),
        ("fps=0", r"fps must be a number in \[0.1, 50\], got 0"),
        ("fps=fast", "fps must be a real number, got 'fast'"),
        ("depth=none.png", "none.png cannot be opened"),
        ("depth=none.npy", "depth must be a file that can be read, got none.npy"),
        ("depth=frame.png", "depth must be a gray PNG of 16 bits, or a .npy in m, got frame.png"),
    ],
)
def test_a_wrong_word_is_one_line_of_error_and_no_sheet(call, picture, tmp_path, word, message):
    (tmp_path / "folder.png").mkdir()
    found = call("preview", "frame.png", word).message
    assert re.search(message, found), found
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder.png", "frame.png"]
    assert list((tmp_path / "folder.png").iterdir()) == []


def test_a_folder_that_is_not_there_is_found_before_the_work(call, picture, monkeypatch):
    monkeypatch.setattr("torchrefract.cli.preview.contact_sheet_row", None)
    assert "could not be written" in call("preview", "frame.png", "out=none/sheet.png").message


def test_a_sheet_that_cannot_be_drawn_keeps_the_old_one(call, picture, tmp_path):
    (tmp_path / "preview.png").write_text("old")
    assert (
        "LensDistortion: "
        in call(
            "preview",
            "frame.png",
            "+effects.LensDistortion.strict=true",
            "effects.LensDistortion.k1_range=[-3,-3]",
        ).message
    )
    assert (tmp_path / "preview.png").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 2


def test_a_scene_has_the_severity_that_is_asked_for(call, picture, tmp_path):
    assert call("preview", "frame.png", "scene=cape_town_fog", "scene.severity=5").code == 0
    thick, usual = (contact_sheet_row("", cape_town_fog(s), frame=read_image(picture)[None], seed=0) for s in (5, 3))
    assert holds(tmp_path / "preview.png", thick.corrupted)
    assert not holds(tmp_path / "preview.png", usual.corrupted)
    assert (
        "severity must be one of 1, 2, 3, 4, 5, got 9"
        in call("preview", "scene=cape_town_fog", "scene.severity=9").message
    )


# --- depth of a picture


def meters() -> np.ndarray:
    """(12, 16), m: half of the picture's pixels a side, the sky above."""
    depth = np.random.default_rng(1).uniform(5, 120, (12, 16)).round(1)
    depth[:3] = np.inf
    return depth


def foggy(frame: torch.Tensor, depth: np.ndarray) -> torch.Tensor:
    """(3, h, w), as drawn."""
    given = torch.from_numpy(depth.astype(np.float32))[None, None]
    return contact_sheet_row("", cape_town_fog(), frame=frame, seed=0, depth=given).corrupted


def test_a_depth_array_is_that_of_the_picture_at_any_size_of_its_shape(call, picture, tmp_path):
    large = meters().repeat(2, axis=0).repeat(2, axis=1)
    expected = foggy(read_image(picture)[None], large)
    for depth in (
        large,
        meters(),
        meters()[None],
        meters().astype(np.float32),
        large.repeat(3, axis=0).repeat(3, axis=1),
    ):
        np.save(tmp_path / "depth.npy", depth)
        outcome = call("preview", "frame.png", "scene=cape_town_fog", "depth=depth.npy")
        assert outcome.out == "preview.png: cape_town_fog on frame.png\n"
        assert holds(tmp_path / "preview.png", expected)
    assert not holds(
        tmp_path / "preview.png",
        contact_sheet_row("", cape_town_fog(), frame=read_image(picture)[None], seed=0).corrupted,
    )


def test_a_depth_picture_has_steps_of_a_scale_and_no_end(call, picture, tmp_path):
    depth = meters()
    steps = np.where(np.isinf(depth), 65535, depth * 10).round().astype(np.uint16)
    Image.fromarray(steps).save(tmp_path / "depth.png")
    words = ("frame.png", "scene=cape_town_fog", "depth=depth.png", "depth_scale=0.1")
    assert call("preview", *words).out == "preview.png: cape_town_fog on frame.png\n"
    given = np.where(steps == 65535, np.inf, 0.1 * steps).repeat(2, axis=0).repeat(2, axis=1)
    expected = foggy(read_image(picture)[None], given)
    assert holds(tmp_path / "preview.png", expected)


def test_the_usual_scale_of_a_depth_picture_is_1_256_m(call, picture, tmp_path):
    Image.fromarray(np.full((12, 16), 256 * 40, np.uint16)).save(tmp_path / "depth.png")
    assert call("preview", "frame.png", "scene=cape_town_fog", "depth=depth.png").code == 0
    assert holds(tmp_path / "preview.png", foggy(read_image(picture)[None], np.full((24, 32), 40.0)))


def test_depth_that_was_not_measured_counts_as_infinite_and_is_told(call, picture, tmp_path):
    steps = np.full((24, 32), 256 * 40, np.uint16)
    steps[:6] = 0
    Image.fromarray(steps).save(tmp_path / "depth.png")
    outcome = call("preview", "frame.png", "scene=cape_town_fog", "depth=depth.png")
    assert outcome.out == "preview.png: cape_town_fog on frame.png; 25.0% of its depth is 0, taken as infinite\n"
    depth = np.where(steps == 0, np.inf, 40.0)
    assert holds(tmp_path / "preview.png", foggy(read_image(picture)[None], depth))


def test_depth_is_cut_with_its_picture(call, picture, tmp_path):
    np.save(tmp_path / "depth.npy", meters())
    assert call("preview", "frame.png", "scene=cape_town_fog", "depth=depth.npy", "size=[12,8]").code == 0
    frame = read_image(picture)[None, :, ::2, 8:24:2].contiguous()
    assert holds(tmp_path / "preview.png", foggy(frame, meters()[:, 4:12]))


@pytest.mark.parametrize(
    ("name", "depth", "message"),
    [
        (
            "d.npy",
            meters()[:, :-1],
            r"of the size of the picture, 24x32 \(height x width\), or of its shape, got 12x15",
        ),
        ("d.npy", meters() - 50, "depth must be at least 0, in m, got -"),
        ("d.npy", np.where(meters() > 100, np.nan, meters()), "depth must be at least 0, in m, got nan"),
        ("d.npy", meters() / 1000, "depth must be in m, not normalized"),
        (
            "d.npy",
            np.ones((12, 16), np.uint16),
            r"depth must be \(height, width\) of floating numbers, in m, got d.npy",
        ),
        ("d.npy", np.ones((2, 12, 16)), r"depth must be \(height, width\) of floating numbers, in m, got d.npy"),
        (
            "d.npy",
            np.array([{}], dtype=object),
            "depth must be an array of numbers, got d.npy, which is damaged or not an array",
        ),
        ("d.png", np.zeros((12, 16), np.uint16), "depth must be known in half of the pixels .* d.png with 100.0% at 0"),
        ("d.png", np.ones((12, 16), np.uint8), "depth must be a gray PNG of 16 bits, or a .npy in m, got d.png"),
        ("d.png", np.ones((12, 16, 3), np.uint8), "depth must be a gray PNG of 16 bits, or a .npy in m, got d.png"),
    ],
)
def test_a_wrong_depth_is_one_line_of_error(call, picture, tmp_path, name, depth, message):
    path = tmp_path / name
    np.save(path, depth, allow_pickle=True) if path.suffix == ".npy" else Image.fromarray(depth).save(path)
    found = call("preview", "frame.png", "scene=cape_town_fog", f"depth={name}").message
    assert re.search(message, found), found
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found = call("preview", "frame.png", "scene=cape_town_fog", f"depth={name}").message
    assert re.search("damaged|truncated", found), found
    assert not (tmp_path / "preview.png").exists()


def test_a_rendered_scene_has_its_own_depth_already(call):
    assert "depth must be that of a picture, image=…" in call("preview", "depth=depth.npy").message


def test_a_scale_of_depth_that_is_none_is_one_line_of_error(call, picture):
    assert "depth_scale must be above 0, got 0" in call("preview", "frame.png", "depth=d.png", "depth_scale=0").message


# --- what moves

SUN = ("scene=limpopo_sun_glare", "seed=3")


def pages(path: Path) -> list[np.ndarray]:
    with Image.open(path) as image:
        found = []
        for t in range(getattr(image, "n_frames", 1)):
            image.seek(t)
            found.append(np.asarray(image.convert("RGB")))
    return found


def glaring(frame: torch.Tensor, t: int) -> np.ndarray:
    """(240, 320, 3): a frame (1, 3, 24, 32) of the scene at its time, as drawn."""
    image = limpopo_sun_glare().degrade(frame, seed=3, frame=t).image[0]
    return (255 * image).round().byte().repeat_interleave(10, 1).repeat_interleave(10, 2).movedim(0, -1).numpy()


def test_a_picture_becomes_a_film(call, picture, tmp_path):
    outcome = call("preview", "frame.png", *SUN, "out=sun.apng", "frames=4")
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out == "sun.apng: limpopo_sun_glare on frame.png, 4 frames\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame.png", "sun.apng"]
    film = pages(tmp_path / "sun.apng")
    assert len(film) == 4
    for t, page in enumerate(film):
        assert shows(page, glaring(read_image(picture)[None], t))
        assert not shows(page, glaring(read_image(picture)[None], t + 1))


def test_a_film_of_a_rendered_scene_knows_its_depth(call, tmp_path):
    assert call("preview", "scene=cape_town_fog", "size=[24,32]", "seed=7", "out=fog.apng", "frames=2").code == 0
    frame, depth = render_road_scenes(torch.tensor([7]), 24, 32)
    for t, page in enumerate(pages(tmp_path / "fog.apng")):
        image = cape_town_fog().degrade(frame, seed=7, depth=depth, frame=t).image[0]
        large = (255 * image).round().byte().repeat_interleave(10, 1).repeat_interleave(10, 2)
        assert shows(page, large.movedim(0, -1).numpy())


@pytest.fixture
def frames(tmp_path) -> list[torch.Tensor]:
    """Twelve frames (1, 3, 24, 32) in the folder drive, whose names sort by number."""
    (tmp_path / "drive").mkdir()
    squares = np.random.default_rng(0).integers(0, 256, (12, 24, 32, 3), dtype=np.uint8)
    for t, values in enumerate(squares):
        Image.fromarray(values).save(tmp_path / "drive" / f"frame{t}.png")
    for name in ("notes.txt", "._frame3.png"):
        (tmp_path / "drive" / name).touch()
    return [torch.from_numpy(values).movedim(-1, 0)[None] / 255 for values in squares]


@pytest.mark.parametrize(("asked", "got"), [(3, 3), (100, 12)])
def test_a_folder_is_played_in_order(call, frames, tmp_path, asked, got):
    outcome = call("preview", "drive", *SUN, "out=sun.apng", f"frames={asked}")
    assert outcome.out == f"sun.apng: limpopo_sun_glare on drive, {got} frames\n"
    film = pages(tmp_path / "sun.apng")
    assert len(film) == got
    for t, page in enumerate(film):
        assert shows(page, glaring(frames[t], t))


def test_a_video_is_played(call, frames, tmp_path):
    path = tmp_path / "a: 100%05d.avi"  # neither a protocol nor a pattern of names
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (32, 24))
    for frame in frames:
        writer.write((255 * frame[0]).round().byte().movedim(0, -1).numpy()[..., ::-1])
    writer.release()
    video, read = cv2.VideoCapture(str(path)), []
    while (found := video.read())[0]:
        read.append(torch.from_numpy(found[1][..., ::-1].copy()).movedim(-1, 0)[None] / 255)
    assert len(read) == 12
    assert call("preview", path.name, *SUN, "out=sun.apng").out.endswith("12 frames\n")
    for t, page in enumerate(pages(tmp_path / "sun.apng")):
        assert shows(page, glaring(read[t], t))
    assert call("preview", path.name, *SUN, "out=sheet.png").code == 0
    assert holds(tmp_path / "sheet.png", torch.from_numpy(glaring(read[0], 0).copy()).movedim(-1, 0) / 255)


def test_an_animation_is_a_video_too(call, picture, tmp_path):
    assert call("preview", "frame.png", *SUN, "out=sun.gif", "frames=3").code == 0
    assert call("preview", "sun.gif", *SUN, "out=again.gif").out.endswith("on sun.gif, 3 frames\n")


def test_footage_is_cut_and_reduced(call, frames, tmp_path):
    assert call("preview", "drive", *BRIEFLY, "size=[12,16]", "out=lens.apng", "frames=2").code == 0
    image = tr.LensDistortion().degrade(fit(frames[1][0], (12, 16)), seed=0).image
    large = (255 * image).round().byte().repeat_interleave(20, 1).repeat_interleave(20, 2).movedim(0, -1).numpy()
    assert shows(pages(tmp_path / "lens.apng")[1], large)


def test_footage_that_cannot_be_played_is_one_line_of_error(call, frames, picture, tmp_path):
    for name in ("empty", "mixed"):
        (tmp_path / name).mkdir()
    picture.rename(tmp_path / "mixed" / "a.png")
    Image.new("RGB", (8, 8)).save(tmp_path / "mixed" / "b.png")
    (tmp_path / "bad.mp4").write_bytes(b"0" * 5000)
    words = (*SUN, "out=sun.gif")
    assert (
        call("preview", "empty", *words).message
        == "image must be a folder that holds .jpg, .jpeg, .png, .webp, .bmp, got empty"
    )
    message = call("preview", "mixed", *words).message
    assert message == "image must be a folder of frames of one size, 24x32 (height x width), got b.png of 8x8"
    assert call("preview", "bad.mp4", *words).message.endswith("a video with a frame that can be decoded, got bad.mp4")
    assert call("preview", "none.mp4", *words).message == "none.mp4 cannot be opened (No such file or directory)"
    (tmp_path / "drive" / "frame7.png").write_bytes(b"")
    assert call("preview", "drive", *words).message == "drive/frame7.png is empty (0 bytes)"
    assert "image must be at least size" in call("preview", "drive", *words, "size=[99,99]").message
    assert not (tmp_path / "sun.gif").exists()


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".apng"])
def test_a_full_disk_keeps_the_old_film(call, picture, tmp_path, monkeypatch, suffix):
    (tmp_path / f"sun{suffix}").write_text("old")

    def fill(self, times):
        yield next(original(self, times))
        raise OSError(errno.ENOSPC, "No space left on device")

    original = Animation.render
    monkeypatch.setattr(Animation, "render", fill)
    message = call("preview", "frame.png", *SUN, f"out=sun{suffix}", "frames=3").message
    assert message == f"sun{suffix} could not be written: No space left on device"
    assert (tmp_path / f"sun{suffix}").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 2


def test_a_run_that_is_killed_keeps_the_old_film(picture, tmp_path):
    (tmp_path / "sun.mp4").write_text("old")
    words = ("-m", "torchrefract.preview", "frame.png", *SUN, "out=sun.mp4", "frames=100000")
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    with subprocess.Popen([sys.executable, *words], cwd=tmp_path, env=environment) as run:
        begun = time.monotonic()
        while not any(path.stat().st_size > 0 for path in tmp_path.glob(".sun-*.mp4")):
            assert run.poll() is None
            assert time.monotonic() - begun < 120
            time.sleep(0.1)
        run.kill()
    assert (tmp_path / "sun.mp4").read_text() == "old"


def test_an_installed_package_draws_a_sheet_in_a_process_of_its_own(spawn, picture, tmp_path):
    root = Path(__file__).parents[2]
    shutil.copytree(root / "torchrefract", tmp_path / "torchrefract", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(root / "conf", tmp_path / "torchrefract" / "conf")
    outcome = spawn("-m", "torchrefract.preview", "frame.png", *BRIEFLY, cwd=tmp_path)
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out == "preview.png: cheap_dashcam on frame.png\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame.png", "preview.png", "torchrefract"]

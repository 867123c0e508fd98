import re
import shutil
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from PIL import Image

import torchrefract as tr
from torchrefract._command import UsageError, with_picture
from torchrefract._config import CONFIG_DIR
from torchrefract.data.images import read_image
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.sheet import make_row

# One quick row.
BRIEFLY = ("scene=cheap_dashcam",)


@pytest.fixture
def picture(tmp_path) -> Path:
    """A picture of 12 x 16 squares of 2 x 2 px, in the folder that commands run in."""
    squares = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    Image.fromarray(squares.repeat(2, axis=0).repeat(2, axis=1)).save(tmp_path / "frame.png")
    return tmp_path / "frame.png"


def holds(sheet: Path, cell: torch.Tensor) -> bool:
    """Whether the saved sheet shows (3, h, w) somewhere, pixel by pixel."""
    page = (255 * matplotlib.image.imread(sheet)[..., :3]).round().astype(np.uint8)
    wanted = (255 * cell).round().byte().movedim(0, -1).numpy()
    height, width = wanted.shape[:2]
    rows, columns = (page[: 1 - height or None, : 1 - width or None] == wanted[0, 0]).all(axis=2).nonzero()
    return any(
        np.array_equal(page[row : row + height, column : column + width], wanted)
        for row, column in zip(rows, columns, strict=True)
    )


def test_a_picture_becomes_a_sheet_of_its_effects(call, picture, tmp_path):
    outcome = call("preview", "frame.png", *BRIEFLY, "seed=3")
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out == "preview.png: cheap_dashcam on frame.png\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame.png", "preview.png"]
    frame = read_image(picture)[None]
    row = make_row("", tr.LensDistortion(), frame=frame, seed=3)  # the scene is a lens with its defaults
    assert row.restored is not None
    for cell in (row.frame, row.corrupted, row.checkerboard, row.restored):
        assert holds(tmp_path / "preview.png", cell)
    assert not holds(tmp_path / "preview.png", make_row("", tr.LensDistortion(), frame=frame, seed=4).corrupted)


def test_all_effects_are_drawn_on_a_rendered_scene_where_no_picture_is_given(call, tmp_path):
    outcome = call("preview", "size=[24,32]", "out=sheet.png")
    names = "LensDistortion, Turbulence, ThinPlateSpline, DivergenceFree, UniformFog, Compose"
    assert outcome.out == f"sheet.png: {names} on a rendered road scene, as no picture was given\n"
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.png"]


def test_fog_knows_the_depth_of_a_rendered_scene(call, tmp_path):
    assert call("preview", "scene=cape_town_fog", "size=[24,32]", "seed=7").code == 0
    frame, depth = render_road_scenes(torch.tensor([7]), 24, 32)
    row = make_row("", tr.UniformFog(visibility_range=(60, 200)), frame=frame, seed=7, depth=depth)
    assert row.map is not None
    for cell in (row.frame, row.corrupted, row.map):
        assert holds(tmp_path / "preview.png", cell)


def test_the_settings_of_an_effect_can_be_changed(call, picture, tmp_path):
    others = [f"~effects.{name}" for name in ("LensDistortion", "ThinPlateSpline", "DivergenceFree", "Compose")]
    words = ["effects.Turbulence.amplitude_range=[1,1]", "effects.UniformFog.visibility_range=[9,9]"]
    assert call("preview", "frame.png", *others, *words).out == "preview.png: Turbulence, UniformFog on frame.png\n"
    air = tr.Turbulence(amplitude_range=(1, 1), length_range=(60, 90), aperture_range=(8, 10))
    fog = tr.UniformFog(visibility_range=(9, 9))
    for effect in (air, fog):
        assert holds(tmp_path / "preview.png", make_row("", effect, frame=read_image(picture)[None], seed=0).corrupted)


def test_the_same_seed_gives_the_same_bytes_and_another_one_others(call, picture, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert call("preview", "frame.png", *BRIEFLY, f"seed={seed}", f"out={name}.png").code == 0
    first, again, other = ((tmp_path / f"{name}.png").read_bytes() for name in "abc")
    assert first == again
    assert first != other


def test_a_picture_is_cut_and_reduced_before_it_is_degraded(call, picture, tmp_path):
    assert call("preview", "frame.png", *BRIEFLY, "size=[12,8]").code == 0
    frame = read_image(picture)[None, :, ::2, 8:24:2]
    row = make_row("", tr.LensDistortion(), frame=frame.contiguous(), seed=0)
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
    (word,) = with_picture("preview", [name])
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
    assert with_picture("preview", words) == words
    assert with_picture("preview", [*words, "frame.png"]) == [*words, "image='frame.png'"]


def test_two_pictures_are_one_too_many():
    with pytest.raises(UsageError, match=r"one picture, in quotes .*, got my and frame\.png"):
        with_picture("preview", ["my", "frame.png"])


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
        ("scene=london", "scene must be one of cape_town_fog, cheap_dashcam, got london"),
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
        ("out=sheet.doc", r"out must end in one of \..*\.png.*, got sheet.doc"),
        ("out=sheet", "out must end in one of .*, got sheet"),
        ("out=none/sheet.png", "none/sheet.png could not be written: No such file or directory"),
        ("out=frame.png/sheet.png", "frame.png/sheet.png could not be written: Not a directory"),
        ("out=folder.png", "out must be a file, got the folder folder.png"),
    ],
)
def test_a_wrong_word_is_one_line_of_error_and_no_sheet(call, picture, tmp_path, word, message):
    (tmp_path / "folder.png").mkdir()
    found = call("preview", "frame.png", word).message
    assert re.search(message, found), found
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder.png", "frame.png"]
    assert list((tmp_path / "folder.png").iterdir()) == []


def test_a_folder_that_is_not_there_is_found_before_the_work(call, picture, monkeypatch):
    monkeypatch.setattr("torchrefract.preview.make_row", None)
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


def test_an_installed_package_draws_a_sheet_in_a_process_of_its_own(spawn, picture, tmp_path):
    root = Path(__file__).parents[1]
    shutil.copytree(root / "torchrefract", tmp_path / "torchrefract", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(root / "conf", tmp_path / "torchrefract" / "conf")
    outcome = spawn("-m", "torchrefract.preview", "frame.png", *BRIEFLY, cwd=tmp_path)
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out == "preview.png: cheap_dashcam on frame.png\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame.png", "preview.png", "torchrefract"]

import re
from pathlib import Path

import numpy as np
import pytest
from pictures import save_picture

from torchrefract import Compose, LensDistortion, OneOf, UniformFog, Vignetting, key_of, presets
from torchrefract.data.images import read_image
from torchrefract.robustness.quantities import SCENES, quantity_of

RUN = ("robustness.__main__", "data=frames", "out=out", "model=mine:brightness", "score=mine:darkness")
MODULE = """
from torchrefract import Compose, Turbulence, UniformFog, Vignetting, presets

def brightness(images):
    return images.mean(dim=(1, 2, 3))[:, None]

def darkness(prediction, target):
    return 1 - prediction.item()

def fog(severity, width):
    return Compose([Vignetting(), UniformFog(visibility_range=(width, width * 6 / severity))])

def corners(severity=3):
    return Vignetting(strength_range=(0.1 * severity, 0.1 * severity))

def text(severity):
    return "fog"
"""
BY_SEVERITY = """
2:
  _target_: torchrefract.Compose
  effects:
    - {_target_: torchrefract.UniformFog, visibility_range: [200, 400]}
4:
  _target_: torchrefract.Compose
  effects:
    - {_target_: torchrefract.UniformFog, visibility_range: [40, 80]}
"""


@pytest.fixture
def frames(tmp_path, write_module) -> Path:
    picture = np.random.default_rng(0).integers(0, 90, (36, 64, 3), np.uint8)
    for i in range(2):
        save_picture(tmp_path / "frames" / f"{i}.png", picture + 40 * i)
    write_module("mine", MODULE)
    return tmp_path / "frames"


def expected(frames: Path, effect) -> float:
    images = {path.name: read_image(path) for path in sorted(frames.iterdir())}
    degraded = [effect.degrade(image, seed=0, keys=[key_of(name)]).image for name, image in images.items()]
    return 1 - float(np.mean([image.mean().item() for image in degraded]))


def test_scenes_of_a_folder_a_file_and_a_function_are_scored_with_their_quantities(call, results, tmp_path, frames):
    (tmp_path / "conf" / "scene").mkdir(parents=True)
    (tmp_path / "conf" / "scene" / "thick.yaml").write_text(
        "_target_: torchrefract.presets.cape_town_fog\nseverity: 1\ncontrast_range: [0.9, 0.9]\n"
    )
    (tmp_path / "my fog.yaml").write_text(BY_SEVERITY)
    scenes = "scene=[conf/scene/thick.yaml,my fog.yaml,mine:fog,mine:corners,paper_weather]"
    outcome = call(*RUN, scenes, "severity=[2,4]")
    assert outcome.code == 0, outcome.err
    rows = {(row["scene"], row["severity"]): row for row in results()["levels"]}
    fogs = {2: UniformFog(visibility_range=(200, 400)), 4: UniformFog(visibility_range=(40, 80))}
    for severity, fog in fogs.items():
        effects = {
            "conf/scene/thick.yaml": presets.cape_town_fog(severity, contrast_range=(0.9, 0.9)),
            "my fog.yaml": Compose([fog]),
            "mine:fog": Compose([Vignetting(), UniformFog(visibility_range=(64, 384 / severity))]),
            "mine:corners": Vignetting(strength_range=(0.1 * severity, 0.1 * severity)),
            "paper_weather": presets.paper_weather(severity),
        }
        for name, effect in effects.items():
            row = rows[name, severity]
            assert row["score"] == pytest.approx(expected(frames, effect), abs=1e-6), name
            has_fog = name not in ("mine:corners", "paper_weather")
            assert (row["quantity"], row["unit"]) == (("visibility", "m") if has_fog else ("", ""))
    assert 40 <= rows["my fog.yaml", 4]["value"] <= 80
    assert rows["mine:corners", 2]["value"] is None
    assert re.search(r"^my fog.yaml: loses more than 10% .* mildest tested value, visibility \d+ m", outcome.out, re.M)
    assert "mine:corners: mean score 0." in outcome.out
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<td>mine:corners</td><td></td><td></td><td>none, see the scores by severity</td>" in page


def test_a_run_is_not_continued_with_other_parameters_of_a_scene(call, tmp_path, frames):
    path = tmp_path / "fog.yaml"
    path.write_text(BY_SEVERITY)
    words = (*RUN, "scene=fog.yaml", "severity=2")
    assert call(*words).code == 0
    assert call(*words).code == 0
    path.write_text(BY_SEVERITY.replace("400", "401"))
    message = call(*words).message
    assert message.startswith("out must be a folder of the same settings, got one with effects={'fog.yaml': ")
    message = call(*words[:2], "out=other", "base=out", *words[3:]).message
    assert "base must be a run on the same data with the same settings, got one with effects={" in message


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ("scene=cape_town_frog", "scene must be some of cheap_dashcam, cape_town_fog, night_fog, limpopo_sun_glare, "),
        ("scene=lost.yaml", "scene must be some of cheap_dashcam, cape_town_fog, night_fog, limpopo_sun_glare, "),
        ("scene=mine:nothing", "scene: a function must be package.module:name that can be imported, got mine:nothing"),
        ("scene=mine:text", "scene must be an effect of torchrefract, got str of mine:text"),
        ("scene=few.yaml", "scene: few.yaml must hold the _target_ of an effect, or one for severity 1, got neither"),
        ("scene=list.yaml", "scene must be a mapping with the _target_ of an effect, got list in list.yaml"),
        ("scene=one.yaml", "scene must have a severity if several are scored, got one.yaml without one; write an eff"),
        ("scene=mine --config-dir conf", "scene must be given as a file, as in scene=[DIR/scene/mine.yaml], got -"),
        ("scene=wrong.yaml", "scene: visibility_range must "),
    ],
)
def test_an_invalid_scene_is_one_line_before_the_first_prediction(call, tmp_path, frames, scene, message):
    (tmp_path / "few.yaml").write_text(BY_SEVERITY)
    (tmp_path / "list.yaml").write_text("- 1\n")
    (tmp_path / "one.yaml").write_text("_target_: torchrefract.UniformFog\n")
    (tmp_path / "wrong.yaml").write_text("1: {_target_: torchrefract.UniformFog, visibility_range: [9, 2]}\n")
    severities = "severity=1" if "wrong" in scene else "severity=[1,2]"
    assert call(*RUN, *scene.split(" "), severities).message.startswith(message)
    assert not (tmp_path / "out").exists()


@pytest.mark.quick
def test_a_scene_has_the_quantity_of_its_effects():
    expected = {
        **dict.fromkeys(("cape_town_fog", "night_fog", "unpaved_road"), ("visibility", "m", False)),
        "cheap_dashcam": ("k1", "", False),
        "limpopo_sun_glare": ("scattered sunlight", "%", True),
        "highveld_heat_haze": ("road hotter than air", "K", True),
        "highveld_telephoto": ("tilt", "microradians", True),
    }
    assert expected.keys() == set(SCENES)
    for name in SCENES:
        quantity = quantity_of(getattr(presets, name)(severity) for severity in (1, 5))
        assert quantity is not None
        assert quantity[:3] == expected[name]
    fog = UniformFog()
    assert quantity_of([fog, Compose([fog])]) is None
    for effect in (
        *(Vignetting(), UniformFog(p=0.5), OneOf([fog, fog]), Compose([Vignetting()])),
        LensDistortion(k1_range=(-0.1, 0.1)),  # neither end harms more
        LensDistortion.from_lenses(),
    ):
        assert quantity_of([effect]) is None

"""Draw a picture for each scene and effect: `python examples/gallery.py`, into examples/gallery and gallery.md."""

import argparse
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from hydra.utils import instantiate
from PIL import Image
from torch import Tensor

from torchrefract.cli.playground_view import choices, config_of
from torchrefract.data.images import pixels_of
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.base import Effect
from torchrefract.visualization.figures import describe_params, map_image, map_scales

FOLDER = Path(__file__).parent
SIZE, PANEL = (360, 640), (216, 384)  # height and width, px
HEAD = """# Gallery

Each scene at severity 4 (haze at 5, sun at 3), and each effect with strong parameters: a rendered road, degraded, and
the map. Flows have the colors of the wheel: right is red, down yellow, left azure, up violet; stripes are invalid.
Transmission, extinction and intensity run from dark violet, 0, to yellow; of two, one is left and one right. Faint
effects are shown in a part of the frame. `OneOf` draws one of several effects, as in the two scenes of the paper, and
`Rectification` undoes a lens.

`python examples/gallery.py` draws this page.
"""


class Setting(NamedTuple):
    """Road, draw and arguments with which an effect is visible."""

    road: int = 19
    seed: int = 1
    detail: tuple[float, float, int] | None = None  # position of its middle in the frame, and enlargement
    night: bool = False
    arguments: dict[str, Any] = {}  # noqa: RUF012 # a NamedTuple has no mutable default that is shared: it is only read


SETTINGS = {
    "highveld_heat_haze": Setting(detail=(0.6, 0.4, 3), arguments={"severity": 5}),
    "highveld_telephoto": Setting(detail=(0.6, 0.4, 3), arguments={"severity": 5}),
    "limpopo_sun_glare": Setting(road=5, arguments={"severity": 3}),
    "night_fog": Setting(road=10, night=True, arguments={"glow": {"threshold": 0.5}}),
    "paper_refractive": Setting(seed=0),
    "unpaved_road": Setting(road=9),
    "PhysicalTurbulence": Setting(detail=(0.6, 0.4, 3)),
    "RoadMirage": Setting(road=13, detail=(0.5, 0.48, 3), arguments={"horizon": 0.452, "vanishing": 0.56}),
    "TurbulenceBlur": Setting(detail=(0.6, 0.4, 3)),
    "RollingShutter": Setting(arguments={"readout_range": [60.0, 60.0], "yaw_range": [1.0, 1.0]}),
    "SunGlare": Setting(road=5),
    "NightGlow": Setting(road=10, detail=(0.6, 0.6, 2), night=True, arguments={"threshold": 0.5}),
    "Vignetting": Setting(arguments={"strength_range": [1.0, 1.0]}),
    "ChromaticAberration": Setting(
        detail=(0.9, 0.3, 4), arguments={"red_range": [0.005, 0.005], "blue_range": [-0.005, -0.005]}
    ),
}


def drawn_parameters(choice: str) -> str:
    """Describe the parameters that the picture of a scene or an effect shows."""
    effect, image, _, setting = _prepare(choice)
    return describe_params(effect, effect.sample(image, seed=setting.seed))


def draw(choice: str) -> tuple[Image.Image, str]:
    """Return the picture of a scene or an effect, and the values of the last colors of its maps."""
    effect, image, depth, setting = _prepare(choice)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of folds, which the maps show
        degraded = effect.degrade(image, seed=setting.seed, depth=depth)
        scales = map_scales(degraded)
        panels = [image, degraded.image, *([map_image(degraded, scales, largest=SIZE[1])[None]] if scales else [])]
    row = torch.cat([_panel(panel, setting) for panel in panels], dim=3)
    maps = " and ".join(f"{scale.name} shown up to {scale.top:g}" for scale in scales)
    return Image.fromarray(pixels_of(row[0])), maps


def section(choice: str, maps: str) -> str:
    """Return the section of a scene or an effect in gallery.md."""
    title = {choices()[0]: "\n## Scenes\n", "LensDistortion": "\n## Effects\n"}.get(choice, "")
    text = ". Map: ".join(filter(None, (drawn_parameters(choice), maps)))
    return f"{title}\n### {choice}\n\n![{choice}](gallery/{choice}.webp)\n\n{text}\n"


@lru_cache
def _road(key: int) -> tuple[Tensor, Tensor]:
    return render_road_scenes(torch.tensor([key]), *SIZE)


def _prepare(choice: str) -> tuple[Effect, Tensor, Tensor, Setting]:
    setting = SETTINGS.get(choice, Setting())
    image, depth = _road(setting.road)
    effect = instantiate(config_of(choice, severity=4, width=SIZE[1]) | setting.arguments)
    return effect, image**4 if setting.night else image, depth, setting


def _panel(image: Tensor, setting: Setting) -> Tensor:
    height, width = PANEL
    if setting.detail is None:
        return F.interpolate(image, PANEL, mode="area")
    x, y, times = setting.detail
    h, w = height // times, width // times
    top, left = round(min(y * SIZE[0] - h / 2, SIZE[0] - h)), round(min(x * SIZE[1] - w / 2, SIZE[1] - w))
    return F.interpolate(image[..., top : top + h, left : left + w], PANEL, mode="nearest")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    (FOLDER / "gallery").mkdir(exist_ok=True)
    text = HEAD
    for name in choices():
        picture, maps = draw(name)
        picture.save(FOLDER / "gallery" / f"{name}.webp", quality=80, method=6)
        text += section(name, maps)
    (FOLDER / "gallery.md").write_text(text, encoding="utf-8")

"""The content of the playground's page: sliders of a scene or an effect, the degraded picture, its maps and code."""

import copy
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import Tensor

from torchrefract._io import CONFIG_DIR, config_names
from torchrefract.adapters.config import config_to_code, effect_to_config, without_defaults
from torchrefract.data.images import UnreadableImageError, fit, pixels_of, read_image
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.types import Degraded
from torchrefract.visualization.figures import (
    MapScale,
    describe_params,
    draw_invalid_key,
    draw_legend,
    map_image,
    map_scales,
)
from torchrefract.visualization.layout import FigureLayout

RENDERED_SIZE = (540, 960)  # height and width
_MAP_SIDE = 640  # px
_LEGEND_LINES = 20  # width of the longest legend of a map, in heights of a line
_NUM_STEPS = 200  # of a slider, about
_LOGARITHM = "log10 of "  # begins the unit of a slider that moves by powers of ten

Sliders = Mapping[str, Mapping[str, Sequence[Any]]]  # by effect and argument: low, high and unit


class Slider(NamedTuple):
    """A slider that fixes a parameter.

    path: keys that lead to the range in a config.
    effect, name, unit: of the parameter.
    low, high, step: of the slider.
    start: its position while the parameter is drawn from its range.
    info: the range.
    """

    path: tuple[Any, ...]
    effect: str
    name: str
    unit: str
    low: float
    high: float
    step: float
    start: float
    info: str

    def value(self, position: float) -> float:
        """Return the value of the parameter at a position of the slider."""
        return float(f"{10**position if self.unit.startswith(_LOGARITHM) else position:.6g}")


class Source(NamedTuple):
    """A picture: its image (1, 3, H, W), its depth (1, 1, H, W) in m or None, and the code that makes both."""

    image: Tensor
    depth: Tensor | None
    code: str


class View(NamedTuple):
    """All that the page shows of a degraded picture: pixels (H, W, 3) and texts."""

    before: np.ndarray
    after: np.ndarray
    map: np.ndarray | None  # with its legend
    about: str  # parameters, time, warnings and plan
    code: str
    yaml: str


def choices() -> list[str]:
    """Return the names of scenes, and then of effects."""
    return config_names("scene") + list(_effects())


def is_scene(choice: str) -> bool:
    """Return True for a scene, which has a severity, and False for an effect."""
    return choice not in _effects()


def config_of(choice: str, *, severity: int, width: int) -> dict[str, Any]:
    """Return the config of a scene at a severity, for frames of a width in px, or of an effect."""
    if not is_scene(choice):
        return _effects()[choice]
    config: Any = OmegaConf.to_container(OmegaConf.load(Path(CONFIG_DIR, "scene", f"{choice}.yaml")))
    return config | {"severity": severity} | ({"width": width} if "width" in config else {})


def sliders_of(config: dict[str, Any], table: Sliders) -> list[Slider]:
    """Return a slider for each range of a scene or an effect, in the order of the table."""
    return _sliders(effect_to_config(instantiate(config)), table, ())


def with_fixed(config: dict[str, Any], sliders: Sequence[Slider], positions: Sequence[float]) -> dict[str, Any]:
    """Return a config in which the parameters of moved sliders are fixed."""
    at = dict(zip(sliders, positions, strict=True))
    moved = [slider for slider in sliders if abs(at[slider] - slider.start) > slider.step / 4]
    if not moved:
        return config
    # The sun has both coordinates, or is placed by the effect.
    suns = {slider.path[:-1] for slider in moved if slider.name.startswith("center")}
    moved += [slider for slider in sliders if slider.name.startswith("center") and slider.path[:-1] in suns]
    fixed = copy.deepcopy(effect_to_config(instantiate(config)))
    for slider in moved:
        part: Any = fixed
        for key in slider.path[:-1]:
            part = part[key]
        part[slider.path[-1]] = [slider.value(at[slider])] * 2
    return fixed


def rendered_road(key: int) -> Source:
    """Render a road with its depth."""
    image, depth = render_road_scenes(torch.tensor([key], device="cpu"), *RENDERED_SIZE)
    height, width = RENDERED_SIZE
    return Source(image, depth, f"image, depth = render_road_scenes(torch.tensor([{key}]), {height}, {width})")


def picture(path: Path, *, max_side: int) -> Source:
    """Read a picture, and reduce it to a longest side of at most `max_side` px.

    Raises:
        UnreadableImageError: not a complete image; the message names the file without its folder.
    """
    try:
        image, code = read_image(path), f"read_image({path.name!r})"
    except UnreadableImageError as error:
        raise UnreadableImageError(str(error).replace(str(path), path.name)) from error
    height, width = image.shape[1:]
    scale = max_side / max(height, width)
    if scale < 1:
        size = max(1, round(scale * height)), max(1, round(scale * width))
        image, code = fit(image, size), f"fit({code}, {size})"
    return Source(image[None].contiguous(), None, f"image, depth = {code}[None].contiguous(), None")


def view(source: Source, config: dict[str, Any], *, seed: int, key: int) -> View:
    """Degrade a picture by a scene or an effect.

    Raises:
        ValueError, TypeError: the effect cannot degrade this picture.
    """
    effect = instantiate(config)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        start = time.perf_counter()
        degraded = effect.degrade(source.image, seed=seed, keys=[key], depth=source.depth)
        seconds = time.perf_counter() - start
        plan = effect.plan(*source.image.shape[2:])
        drawn_map = _draw_map(degraded)
    height, width = source.image.shape[2:]
    notes = dict.fromkeys(f"Warning: {warning.message}" for warning in caught if warning.category is UserWarning)
    about = [
        describe_params(effect, degraded.params),
        f"{1000 * seconds:.0f} ms for {width}x{height} px; a first run compiles",
        *notes,
    ]
    # A scene has few arguments, of which the severity is to be seen.
    short = config if config["_target_"].startswith("torchrefract.presets.") else without_defaults(config)
    return View(
        before=pixels_of(source.image[0]),
        after=pixels_of(degraded.image[0]),
        map=drawn_map,
        about="\n".join([*about, "", str(plan)]),
        code=_CODE.format(source=source.code, effect=config_to_code(short), seed=seed, key=key),
        yaml=OmegaConf.to_yaml(short),
    )


_CODE = """import torch
import torchrefract
import torchrefract.presets
from PIL import Image
from torchrefract.data.images import fit, pixels_of, read_image
from torchrefract.data.road_scenes import render_road_scenes

{source}
effect = {effect}
degraded = effect.degrade(image, seed={seed}, keys=[{key}], depth=depth)
Image.fromarray(pixels_of(degraded.image[0])).save("degraded.png")
"""


def _effects() -> dict[str, dict[str, Any]]:
    """Return the configs of effects that the contact sheet of `preview` shows."""
    config: Any = OmegaConf.to_container(OmegaConf.load(Path(CONFIG_DIR, "preview.yaml")))
    return config["effects"]


def _sliders(config: Any, table: Sliders, path: tuple[Any, ...]) -> list[Slider]:
    if isinstance(config, list):
        return [slider for i, item in enumerate(config) for slider in _sliders(item, table, (*path, i))]
    if not isinstance(config, dict):
        return []
    effect = config["_target_"].rpartition(".")[2]
    ends = table.get(effect, {})
    sliders = [_slider((*path, name), effect, config[name], *ends[name]) for name in ends]
    return sliders + [s for name, value in config.items() for s in _sliders(value, table, (*path, name))]


def _slider(
    path: tuple[Any, ...], effect: str, drawn: list[float] | None, low: float, high: float, unit: str
) -> Slider:
    step = 10.0 ** round(math.log10((high - low) / _NUM_STEPS))
    ends = drawn or [low, low]
    middle = sum(ends) / 2
    middle = math.log10(max(middle, 10.0**low)) if unit.startswith(_LOGARITHM) else middle
    start = round(low + step * round((min(max(middle, low), high) - low) / step), 12)
    text = "off" if drawn is None else " to ".join(dict.fromkeys(f"{end:g}" for end in drawn))
    name = path[-1].removesuffix("_range").replace("_", " ")
    return Slider(path, effect, name, unit, low, high, step, start, f"{text} until moved")


def _draw_map(degraded: Degraded) -> np.ndarray | None:
    """Draw the flow and the transmission, or other maps, with their legends below one another; None without a map."""
    scales = [map_scales(degraded)]
    if degraded.has("flow") and degraded.has("transmission"):
        scales.append((MapScale("transmission", 1.0),))
    drawn = [_draw_one_map(degraded, scale) for scale in scales if scale]
    return np.concatenate(drawn) if drawn else None


def _draw_one_map(degraded: Degraded, scales: tuple[MapScale, ...]) -> np.ndarray:
    image = map_image(degraded, scales, largest=_MAP_SIDE)
    is_flow = scales[0].name == "flow"
    footer = 3 if is_flow else 0
    layout = FigureLayout(
        1, 1, *image.shape[1:], caption_lines=2, header_lines=1, footer_lines=footer, min_column_lines=_LEGEND_LINES
    )
    layout.show(image, layout.text, layout.top(0))
    draw_legend(layout, scales, x=layout.text, y=layout.top(0))
    if is_flow:
        draw_invalid_key(layout, x=layout.text, y=layout.top(0) + layout.height + layout.text)
    return layout.render().copy()

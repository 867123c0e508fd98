"""Share that each scene takes from a frame at each severity, by one score for all of them.

    python benchmarks/severity.py --root FRAMES                   # a table of real frames
    python benchmarks/severity.py                                 # of rendered roads
    python benchmarks/severity.py --figure examples/severity.jpg  # and a picture of one of them

An edge (Canny) or a corner (ORB) of the clean frame is kept if the degraded one shows it within 2 px of its true place,
which the flow of the scene knows. The score is what a scene takes: 1 less the mean of both shares. A warp moves more
than it takes, so the table also has its displacement.
"""

import argparse
import inspect
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchrefract import presets
from torchrefract.data.frames import evenly_spaced
from torchrefract.data.images import files_in, pixels_of, read_image
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose

NEAR_PX = 2.0
SCENES: dict[str, Callable[..., Any]] = {
    name: function
    for name, function in inspect.getmembers(presets, inspect.isfunction)
    if not name.startswith("_") and function.__module__ == presets.__name__
}
# What a severity sets: the range of an effect, the factor to its unit, and the unit.
QUANTITIES = {
    "visibility_range": (1.0, "m"),
    "k1_range": (1.0, "k1"),
    "scatter_range": (100.0, "% scattered"),
    "strength_range": (1.0, "strength"),
    "difference_range": (1.0, "K"),
    "amplitude_range": (1.0, "px"),
    "cn2_range": (1.0, "m^(-2/3)"),
    "readout_range": (1.0, "ms"),
    "pitch_range": (1.0, "deg"),
}
REFERENCE_WIDTH = 1920  # px, for which displacements are stated


class Score(NamedTuple):
    """Shares that a degraded frame keeps, in [0, 1]; NaN if the clean frame has none."""

    edges: float
    corners: float

    @property
    def taken(self) -> float:
        """Return 1 less the mean of both shares."""
        return 1 - (self.edges + self.corners) / 2


def score(clean: Tensor, degraded: Tensor, flow: Tensor | None = None) -> Score:
    """Return the shares of edges and of corners that a degraded frame shows at their true places.

    Args:
        clean, degraded: (3, H, W), in [0, 1].
        flow: (2, H, W), px, backward: pixel p of the degraded frame shows p + flow(p) of the clean one. None moves
            nothing.
    """
    before, after = (gray_levels(image) for image in (clean, degraded))
    height, width = before.shape
    edges = cv2.Canny(before, 100, 200) > 0
    rows, columns = np.nonzero(cv2.Canny(after, 100, 200))
    x, y = _places(columns, rows, flow)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    shown = np.ones((height, width), np.uint8)
    shown[y[inside].round().astype(int).clip(max=height - 1), x[inside].round().astype(int).clip(max=width - 1)] = 0
    is_near = cv2.distanceTransform(shown, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= NEAR_PX
    return Score(float(is_near[edges].mean()) if edges.any() else np.nan, _kept_corners(before, after, flow))


def _kept_corners(before: np.ndarray, after: np.ndarray, flow: Tensor | None) -> float:
    orb = cv2.ORB.create(1000)
    (points, codes), (others, other_codes) = (orb.detectAndCompute(image, None) for image in (before, after))
    if codes is None or other_codes is None:
        return np.nan if codes is None else 0.0
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(codes, other_codes)
    p = np.array([points[match.queryIdx].pt for match in matches])
    q = np.array([others[match.trainIdx].pt for match in matches])
    x, y = _places(q[:, 0], q[:, 1], flow)
    return float((np.hypot(x - p[:, 0], y - p[:, 1]) <= NEAR_PX).sum() / len(points))


def _places(x: np.ndarray, y: np.ndarray, flow: Tensor | None) -> tuple[np.ndarray, np.ndarray]:
    """Return what the flow says that points of the degraded frame show, px in the clean one."""
    if flow is None:
        return x, y
    at = flow[:, y.round().astype(int), x.round().astype(int)].double().numpy()
    return x + at[0], y + at[1]


def gray_levels(image: Tensor) -> np.ndarray:
    """Return the luma of an image (3, H, W) in [0, 1] as (H, W), uint8."""
    return cv2.cvtColor(pixels_of(image), cv2.COLOR_RGB2GRAY)


def scene_for_width(name: str, severity: int, width: int) -> Any:
    """Return a scene for frames of a width; the paper's weather has none."""
    parameters = inspect.signature(SCENES[name]).parameters.values()
    takes_width = any(p.name == "width" or p.kind is p.VAR_KEYWORD for p in parameters)
    return SCENES[name](severity, **({"width": width} if takes_width else {}))


def quantity(effect: Any) -> str:
    """Describe what a severity sets, "60 … 200 m"; displacements are those of a frame 1920 px wide."""
    parts = effect.effects if isinstance(effect, Compose) else [effect]
    texts = []
    for part in parts:
        for name, (factor, unit) in QUANTITIES.items():
            low, high = (factor * end for end in getattr(part, name, (0.0, 0.0)))
            if high or low:
                texts.append(f"{low:.4g} … {high:.4g} {unit}" if low != high else f"{low:.4g} {unit}")
    return "; ".join(dict.fromkeys(texts))  # two effects of one air have one Cn2


def measure(effect: Effect, frames: list[Tensor], depths: Sequence[Tensor | None]) -> tuple[Score, float]:
    """Return the mean score of frames (1, 3, H, W), and the median displacement in px of frames 1920 px wide."""
    scores, moved = [], []
    for key, (frame, depth) in enumerate(zip(frames, depths, strict=True)):
        d = effect.degrade(frame, seed=0, keys=[key], depth=depth)
        flow = None if d.flow is None else d.flow[0]
        scores.append(score(frame[0], d.image[0], flow))
        moved.append(0.0 if flow is None else flow.norm(dim=0).median().item() * REFERENCE_WIDTH / frame.shape[3])
    return Score(*np.nanmean(np.array(scores), axis=0).tolist()), float(np.mean(moved))


def frames_in(root: Path, count: int, without: list[str]) -> list[Tensor]:
    """Read evenly spaced pictures of a folder, (1, 3, H, W), of those whose name has none of some beginnings."""
    paths = [path for path in files_in(root) if not path.name.startswith(tuple(without))]
    return [read_image(paths[i])[None] for i in evenly_spaced(len(paths), count)]


def rows(names: list[str], frames: list[Tensor], depths: Sequence[Tensor | None]) -> Iterator[str]:
    """Yield the rows of a Markdown table."""
    yield "| scene | severity | quantity | edges | corners | taken | moved, px |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for name in names:
        for severity in presets.SEVERITIES:
            kept, moved = measure(scene_for_width(name, severity, frames[0].shape[3]), frames, depths)
            text = quantity(scene_for_width(name, severity, REFERENCE_WIDTH))
            numbers = f"{kept.edges:.2f} | {kept.corners:.2f} | **{kept.taken:.2f}** | {moved:.1f}"
            yield f"| `{name}` | {severity} | {text} | {numbers} |"


def draw(names: list[str], frame: Tensor, depth: Tensor | None) -> Figure:
    """Draw the scenes at each severity, with what they take from this frame."""
    columns = 1 + len(presets.SEVERITIES)
    figure = Figure(figsize=(2 * columns, 1.4 * len(names)), dpi=110, layout="constrained")
    for axes, name in zip(figure.subplots(len(names), columns, squeeze=False), names, strict=True):
        effects = [scene_for_width(name, severity, frame.shape[3]) for severity in presets.SEVERITIES]
        draws = [effect.degrade(frame, seed=0, keys=[0], depth=depth) for effect in effects]
        titles = [name]
        for severity, d in zip(presets.SEVERITIES, draws, strict=True):
            taken = score(frame[0], d.image[0], None if d.flow is None else d.flow[0]).taken
            titles.append(f"{severity}: takes {taken:.2f}")
        for ax, image, title in zip(axes, [frame, *(d.image for d in draws)], titles, strict=True):
            ax.imshow(image[0].clamp(0, 1).movedim(0, -1).numpy())
            ax.set_title(title, fontsize=8)
            ax.axis("off")
    return figure


def main() -> None:
    """Print a table, or save a picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, help="folder with pictures; without it, rendered roads with their depth")
    parser.add_argument("--without", nargs="*", default=[], help="beginnings of names of frames to leave out")
    parser.add_argument("--count", type=int, default=24, help="number of frames")
    parser.add_argument("--size", type=int, nargs=2, default=(360, 640), help="of rendered roads, px")
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=list(SCENES))
    parser.add_argument("--figure", type=Path, help="save a picture of the first frame instead")
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore", "depth is that of a road")  # frames have no depth map
    depths: Sequence[Tensor | None]
    if arguments.root:
        frames = frames_in(arguments.root, arguments.count, arguments.without)
        if not frames:
            parser.error(f"--root must be a folder with pictures in it, got none in {arguments.root}")
        depths = [None] * len(frames)
    else:
        images, maps = render_road_scenes(torch.arange(arguments.count), *arguments.size)
        frames, depths = list(images.split(1)), list(maps.split(1))
    if arguments.figure:
        draw(arguments.scenes, frames[0], depths[0]).savefig(arguments.figure)
        return
    for row in rows(arguments.scenes, frames, depths):
        print(row, flush=True)


if __name__ == "__main__":
    main()

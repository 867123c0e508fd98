"""Animations of effects: each degraded frame and its map, written as GIF, WebP, APNG or MP4."""

import textwrap
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, features
from torch import Tensor

from torchrefract._validation import UsageError
from torchrefract.data.images import pixels_of
from torchrefract.data.video import can_write_videos, write_video
from torchrefract.effects.base import Effect
from torchrefract.types import Degraded
from torchrefract.visualization.figures import (
    MapScale,
    describe_params,
    draw_invalid_key,
    draw_legend,
    map_image,
    map_scales,
)
from torchrefract.visualization.layout import FigureLayout, resize_for_display

_MAX_STACKED = 3  # effects below one another; more stand in two columns, and are drawn smaller
_LARGEST_SIDE = (480, 320)  # px, largest longer side of an image, of few effects and of many
_MAX_CAPTION_LINES = 4
_NUM_SAMPLED = 5  # frames that decide the scale of a map and the palette of a GIF
_PALETTE_COLORS = 254  # of 256: one is white, one is the transparent color of unchanged pixels
_DITHER = 8.0  # of 255, range of the dither matrix


class FrameSequence(NamedTuple):
    """Frames of one size, read when they are needed."""

    num_frames: int
    read: Callable[[Iterable[int]], Iterator[tuple[int, Tensor]]]  # rising numbers t -> (t, frame (1, 3, H, W))
    depth: Callable[[int], Tensor] | None = None  # number t -> (1, 1, H, W), m, for effects that depend on it


class Panel(NamedTuple):
    """An effect of an animation."""

    name: str
    effect: Effect
    caption: str
    scales: tuple[MapScale, ...]  # of its map, the same in all frames


@dataclass(frozen=True)
class Animation:
    """Effects on a sequence of frames; each degraded frame stands left of its map."""

    panels: Sequence[Panel]
    frames: FrameSequence
    layout: FigureLayout
    background: np.ndarray  # (height, width, 3), uint8, both even: texts and legends, which do not change
    seed: int

    def render(self, times: Iterable[int]) -> Iterator[np.ndarray]:
        """Render the pictures (height, width, 3), uint8, at rising times, one by one."""
        largest = _largest_side(len(self.panels))
        for t, frame in self.frames.read(times):
            picture, depth = self.background.copy(), self.frames.depth and self.frames.depth(t)
            for i, panel in enumerate(self.panels):
                degraded = _degrade(panel.name, panel.effect, frame, self.seed, depth, t)
                images = [resize_for_display(degraded.image, largest=largest)[0]]
                if panel.scales:
                    images.append(map_image(degraded, panel.scales, largest=largest))
                for column, image in enumerate(images):
                    x, y = self.position(i, column)
                    picture[y : y + image.shape[1], x : x + image.shape[2]] = pixels_of(image)
            yield picture

    def position(self, i: int, column: int) -> tuple[int, int]:
        """Return the upper left corner (x, y), px, of an effect's image (column 0) or map (column 1)."""
        row, pair = divmod(i, self.layout.columns // 2)
        return self.layout.left(2 * pair + column), self.layout.top(row)


def make_animation(effects: Mapping[str, Effect], frames: FrameSequence, *, seed: int) -> Animation:
    """Prepare an animation whose frame t is `effect.degrade(frame, seed=seed, depth=frames.depth(t), frame=t)`.

    Args:
        effects: at least one, by name.
        frames: at least one.
        seed: of the draws.

    Raises:
        UsageError: if an effect cannot degrade the frames; the message names the effect.
    """
    panels: dict[str, Panel] = {}
    height = width = 0
    for t, frame in frames.read(_sample_times(frames.num_frames)):
        height, width = resize_for_display(frame, largest=_largest_side(len(effects))).shape[2:]
        depth = frames.depth and frames.depth(t)
        for name, effect in effects.items():
            degraded = _degrade(name, effect, frame, seed, depth, t)
            scales, caption = map_scales(degraded), f"{name}: {describe_params(effect, degraded.params)}"
            panel, tops = panels.setdefault(name, Panel(name, effect, caption, scales)), dict(scales)
            larger = (scale._replace(top=max(scale.top, tops.get(scale.name, scale.top))) for scale in panel.scales)
            panels[name] = panel._replace(scales=tuple(larger))
    layout, background = _draw_background([*panels.values()], height, width)
    return Animation([*panels.values()], frames, layout, background, seed)


def animation_formats() -> list[str]:
    """Return the suffixes of files that the installed Pillow and PyAV can write."""
    available = {".webp": features.check("webp"), ".mp4": can_write_videos()}
    return [suffix for suffix in (".gif", ".webp", ".apng", ".mp4") if available.get(suffix, True)]


def save_animation(animation: Animation, path: Path, *, fps: float, times: Iterable[int] | None = None) -> None:
    """Write an animation that repeats forever. MP4 is written frame by frame, other formats are held in memory.

    Args:
        animation: to write.
        path: its suffix is one of `animation_formats()`.
        fps: frames per second; GIF rounds the times of frames to 1/100 s, WebP and APNG to 1/1000 s.
        times: numbers of the frames, rising; None for all. An iterable can report progress.

    Raises:
        OSError: if the file cannot be written.
    """
    pictures = animation.render(range(animation.frames.num_frames) if times is None else times)
    suffix = path.suffix.lower()
    if suffix == ".mp4":
        height, width = animation.background.shape[:2]
        write_video(pictures, path, fps=fps, size=(width, height))
        return
    if suffix == ".gif":
        samples = animation.render(_sample_times(animation.frames.num_frames))
        palette = _palette(np.concatenate(list(samples)))
        images = [_quantize(picture, palette) for picture in pictures]
    else:
        images = [Image.fromarray(picture) for picture in pictures]
    unit = 10 if suffix == ".gif" else 1  # ms
    # The end of each frame is rounded, so that errors do not add up.
    ends = [unit * round(1000 * (i + 1) / fps / unit) for i in range(len(images))]
    durations = [end - start for start, end in zip([0, *ends], ends, strict=False)]
    # WebP frames that build on one another would all be redrawn now and then, which is seen as a pulse.
    options: dict[str, Any] = {"quality": 90, "kmin": 0, "kmax": 1} if suffix == ".webp" else {}
    format_name = "PNG" if suffix == ".apng" else suffix[1:].upper()
    images[0].save(path, format_name, save_all=True, append_images=images[1:], duration=durations, loop=0, **options)


def _largest_side(num_effects: int) -> int:
    return _LARGEST_SIDE[num_effects > _MAX_STACKED]


def _sample_times(num_frames: int) -> list[int]:
    """Return a few frame numbers, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, num_frames - 1, _NUM_SAMPLED, dtype=int)).tolist()


def _degrade(name: str, effect: Effect, frame: Tensor, seed: int, depth: Tensor | None, t: int) -> Degraded:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Every frame would warn of the same folds.
        try:
            return effect.degrade(frame, seed=seed, depth=depth, frame=t)
        except (ValueError, TypeError) as error:
            raise UsageError(f"{name}: {error}") from error


def _draw_background(panels: Sequence[Panel], height: int, width: int) -> tuple[FigureLayout, np.ndarray]:
    """Lay out images of (height, width), and draw captions and legends."""
    across = 1 if len(panels) <= _MAX_STACKED else 2
    layout = FigureLayout(-(-len(panels) // across), 2 * across, height, width, 2, header_lines=0)
    # The legend of a map takes 17 lines from its left side.
    layout = replace(layout, min_column_lines=33 - width // layout.text)
    letters = round(1.9 * layout.column_px / layout.text)
    captions = [
        textwrap.wrap(panel.caption, letters, max_lines=_MAX_CAPTION_LINES, placeholder=" …") for panel in panels
    ]
    layout = replace(layout, caption_lines=max(2, *map(len, captions)))
    bottom = layout.top(layout.rows - 1) + height + layout.text
    for i, (panel, caption) in enumerate(zip(panels, captions, strict=True)):
        column, y = 2 * (i % across), layout.top(i // across)
        layout.write("\n".join(caption), layout.left(column), y - 0.3 * layout.text, weight="bold")
        draw_legend(layout, panel.scales, x=layout.left(column + 1), y=y)
    if any(scale.name == "flow" for panel in panels for scale in panel.scales):
        draw_invalid_key(layout, x=layout.left(0), y=bottom)
        bottom += 3 * layout.text
    drawn = layout.render()[:bottom]
    # Video codecs need even sides.
    return layout, np.pad(drawn, [(0, drawn.shape[0] % 2), (0, drawn.shape[1] % 2), (0, 0)], constant_values=255)


def _palette(pictures: np.ndarray) -> Image.Image:
    """Return an image whose palette has pure white first, and then the colors of the pictures."""
    # The octree keeps rare colors, such as the ends of a color bar, but no pure white.
    reduced = Image.fromarray(pictures).quantize(_PALETTE_COLORS, method=Image.Quantize.FASTOCTREE)
    palette = Image.new("P", (1, 1))
    palette.putpalette([255, 255, 255, *(reduced.getpalette() or [])])
    return palette


def _quantize(picture: np.ndarray, palette: Image.Image) -> Image.Image:
    """Reduce a picture to a palette by ordered dithering, which stands still where the picture does."""
    height, width = picture.shape[:2]
    matrix = np.zeros((1, 1))  # Bayer's, 8 x 8
    for _ in range(3):
        matrix = np.block([[4 * matrix, 4 * matrix + 2], [4 * matrix + 3, 4 * matrix + 1]])
    offset = np.tile(_DITHER * ((matrix + 0.5) / 64 - 0.5), (-(-height // 8), -(-width // 8)))[:height, :width, None]
    dithered = Image.fromarray((picture + offset).round().clip(0, 255).astype(np.uint8))
    colors = np.array(dithered.quantize(palette=palette, dither=Image.Dither.NONE))
    colors[(picture == 255).all(axis=2)] = 0  # Pillow takes almost white for white.
    image = Image.fromarray(colors)
    image.putpalette(palette.getpalette() or [])
    return image

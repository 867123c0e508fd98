"""Effects in motion: each beside its map, frame by frame, as an animation in a file."""

import struct
import textwrap
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import cv2
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image, features
from PIL.GifImagePlugin import getdata, getheader
from torch import Tensor

from torchrefract.cli.command import naming, progress
from torchrefract.data.images import pixels_of
from torchrefract.data.media import write_video
from torchrefract.effects.base import Effect
from torchrefract.types import Degraded
from torchrefract.visualization.color import hatch_invalid
from torchrefract.visualization.figures import Scale, draw_legend, drawn, map_picture, map_scales
from torchrefract.visualization.page import Page, as_drawn

_STACKED = 3  # effects below one another; more of them stand in pairs, and are drawn smaller
_LARGEST = (480, 320)  # px, the longer side of an image as drawn, of few effects and of many
_LINES = 4  # of a caption
_SURVEYED = 5  # frames that tell the scale of a map and the colors of a palette
_WHITE, _SAME = 0, 255  # of the colors of a GIF; the other one leaves a pixel as it was
_GRAIN = 8.0  # of 255, from the darkest to the brightest place of the pattern that hides the steps of a palette


class Footage(NamedTuple):
    """Frames to degrade, read when they are asked for."""

    total: int
    frames: Callable[[Iterable[int]], Iterator[tuple[int, Tensor]]]  # rising numbers -> each with (1, 3, H, W)


class FilmRow(NamedTuple):
    """An effect, and what is said of it."""

    name: str
    effect: Effect
    caption: str
    scales: tuple[Scale, ...]  # of its map, the same in all frames


@dataclass(frozen=True)
class Film:
    """Effects on footage; `page` says where the images lie, left those that are degraded, right of each its map.

    backdrop: (height, width, 3), uint8, both even: all that stands still.
    """

    rows: Sequence[FilmRow]
    footage: Footage
    page: Page
    backdrop: np.ndarray
    seed: int
    depth: Tensor | None

    def pages(self, times: Iterable[int]) -> Iterator[np.ndarray]:
        """What the film shows at some times, which rise, each as the backdrop; one after the other."""
        for t, frame in self.footage.frames(times):
            page = self.backdrop.copy()
            for i, row in enumerate(self.rows):
                degraded = _degraded(row.name, row.effect, frame, self.seed, self.depth, t)
                self._put(page, as_drawn(degraded.image, largest=_largest(len(self.rows)))[0], i, 0)
                if row.scales:
                    picture = map_picture(degraded, row.scales, largest=_largest(len(self.rows)))
                    self._put(page, picture, i, 1)
            yield page

    def _put(self, page: np.ndarray, image: Tensor, i: int, column: int) -> None:
        x, y = self.place(i, column)
        height, width = image.shape[1:]
        page[y : y + height, x : x + width] = pixels_of(image)

    def place(self, i: int, column: int) -> tuple[int, int]:
        """The upper left corner of an effect's image, column 0, or map, column 1."""
        row, left = divmod(i, self.page.columns // 2)
        return self.page.left(2 * left + column), self.page.top(row)


def make_film(effects: Mapping[str, Effect], footage: Footage, *, seed: int, depth: Tensor | None = None) -> Film:
    """The film of effects on footage: frame t is `effect.degrade(frame, seed=seed, depth=depth, frame=t)`.

    Args:
        effects: at least one, by what they are called.
        footage: at least one frame, all of one size.
        seed: of the draws.
        depth: (1, 1, H, W), m, of all frames, for the effects that ask for it.

    Raises:
        UsageError: what an effect raises for the first frames.
    """
    rows: dict[str, FilmRow] = {}
    shape: tuple[int, ...] = ()
    for t, frame in footage.frames(_survey(footage.total)):
        shape = as_drawn(frame, largest=_largest(len(effects))).shape[2:]
        for name, effect in effects.items():
            degraded = _degraded(name, effect, frame, seed, depth, t)
            found = FilmRow(name, effect, f"{name}: {drawn(effect, degraded.params)}", map_scales(degraded))
            rows[name] = _joined(rows.get(name, found), found)
    page, backdrop = _set_up(list(rows.values()), *shape)
    return Film(list(rows.values()), footage, page, backdrop, seed, depth)


def formats() -> list[str]:
    """The suffixes that a film can be saved with here."""
    able = {".webp": features.check("webp"), ".mp4": cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG)}
    return [suffix for suffix in _WRITERS if able.get(suffix, True)]


def save_film(film: Film, path: Path, *, fps: float, name: str) -> None:
    """Write a film, with a line of progress where somebody watches. No more than a few pages are in memory at a time.

    Args:
        film: what to write.
        path: where; its suffix is one of `formats()`.
        fps: frames a second, rounded to hundredths of a second each in a GIF and to thousandths in a WebP.
        name: what the line of progress says.

    Raises:
        OSError: what cannot be written.
    """
    times = progress(range(film.footage.total), name, count=film.footage.total)
    _WRITERS[path.suffix.lower()](film, film.pages(times), path, fps)


def _largest(effects: int) -> int:
    return _LARGEST[effects > _STACKED]


def _survey(count: int) -> list[int]:
    """A few times of a clip, its ends among them."""
    parts = max(1, min(count, _SURVEYED) - 1)
    return sorted({i * (count - 1) // parts for i in range(parts + 1)})


def _degraded(name: str, effect: Effect, frame: Tensor, seed: int, depth: Tensor | None, t: int) -> Degraded:
    with naming(name), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of folds
        return effect.degrade(frame, seed=seed, depth=depth, frame=t)


def _joined(row: FilmRow, later: FilmRow) -> FilmRow:
    """A row whose scales hold for both."""
    tops = dict(later.scales)
    return row._replace(scales=tuple(Scale(s.name, max(s.top, tops.get(s.name, s.top))) for s in row.scales))


def _set_up(rows: Sequence[FilmRow], height: int, width: int) -> tuple[Page, np.ndarray]:
    """The page of a film, and what stands still on it."""
    across = 1 if len(rows) <= _STACKED else 2
    page = Page(-(-len(rows) // across), 2 * across, height, width, 2, header_lines=0)
    page = page._replace(narrowest=33 - width // page.text)  # leaves 17 lines from a map's left side, for its legend
    letters = round(1.9 * page.pitch / page.text)
    captions = [textwrap.wrap(row.caption, letters, max_lines=_LINES, placeholder=" …") for row in rows]
    page = page._replace(caption_lines=max(2, *map(len, captions)))
    figure, bottom = page.figure(), page.top(page.rows - 1) + height + page.text
    for i, (row, caption) in enumerate(zip(rows, captions, strict=True)):
        column, y = 2 * (i % across), page.top(i // across)
        page.write(figure, "\n".join(caption), page.left(column), y - 0.3 * page.text, weight="bold")
        draw_legend(figure, page, row.scales, x=page.left(column + 1), y=y)
    if any(scale.name == "flow" for row in rows for scale in row.scales):
        stripes = hatch_invalid(torch.zeros(1, 3, height, width), torch.zeros(1, 1, 1, 1, dtype=torch.bool))
        page.explain(figure, stripes[0], "not valid: lost, or outside the frame", x=page.left(0), y=bottom)
        bottom += 3 * page.text
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    still = np.asarray(canvas.buffer_rgba())[:bottom, :, :3]
    # Videos take even sides only.
    return page, np.pad(still, [(0, still.shape[0] % 2), (0, still.shape[1] % 2), (0, 0)], constant_values=255)


def _write_gif(film: Film, pages: Iterator[np.ndarray], path: Path, fps: float) -> None:
    palette = _palette(np.concatenate(list(film.pages(_survey(film.footage.total)))))
    before = np.full(film.backdrop.shape[:2], _SAME, np.uint8)
    with path.open("wb") as stream:
        for i, page in enumerate(pages):
            image = Image.fromarray(_grained(page)).quantize(palette=palette, dither=Image.Dither.NONE)
            colors = np.where((page == 255).all(axis=2), np.uint8(_WHITE), np.asarray(image))
            if i == 0:
                stream.writelines(getheader(image, info={"loop": 0})[0])
            changed = Image.fromarray(np.where(colors == before, np.uint8(_SAME), colors))
            # Hundredths of a second, so that each frame ends at its time.
            shown = round(100 * (i + 1) / fps) - round(100 * i / fps)
            stream.writelines(getdata(changed, duration=10 * shown, transparency=_SAME, disposal=1))
            before = colors
        stream.write(b";")


def _palette(pages: np.ndarray) -> Image.Image:
    """An image whose palette has the colors of pages, white, and one to spare."""
    # The octree keeps rare colors too, such as the ends of a legend, but no pure white.
    found = Image.fromarray(pages).quantize(_SAME - 1, method=Image.Quantize.FASTOCTREE).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([255, 255, 255, *found])
    return palette


def _grained(page: np.ndarray) -> np.ndarray:
    """The page with a pattern of 8 x 8 px that stands still, unlike the noise of other dithering."""
    height, width = page.shape[:2]
    pattern = np.zeros((1, 1))
    for _ in range(3):
        pattern = np.block([[4 * pattern, 4 * pattern + 2], [4 * pattern + 3, 4 * pattern + 1]])
    offset = np.tile(_GRAIN * ((pattern + 0.5) / 64 - 0.5), (-(-height // 8), -(-width // 8)))[:height, :width]
    return (page + offset[..., None]).round().clip(0, 255).astype(np.uint8)


class _Rest:
    """Pages as Pillow asks for images: each when it is looked for, none kept."""

    def __init__(self, pages: Iterator[np.ndarray], count: int):
        self.pages, self.n_frames = pages, count

    def seek(self, frame: int) -> None:
        """The next page is that of this number."""
        self.image = Image.fromarray(next(self.pages))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.image, name)


def _write_webp(film: Film, pages: Iterator[np.ndarray], path: Path, fps: float) -> None:
    first = Image.fromarray(next(pages))
    rest: list[Any] = [_Rest(pages, film.footage.total - 1)] if film.footage.total > 1 else []
    # Every frame for itself: with frames that build on others all would be redrawn now and then, which pulses.
    alone: dict[str, Any] = {"kmin": 0, "kmax": 1}
    first.save(path, save_all=True, append_images=rest, duration=1000 / fps, loop=0, quality=90, **alone)


def _write_apng(film: Film, pages: Iterator[np.ndarray], path: Path, fps: float) -> None:
    height, width = film.backdrop.shape[:2]
    delay = Fraction(1 / fps).limit_denominator(1000)
    with path.open("wb") as stream:
        stream.write(b"\x89PNG\r\n\x1a\n")
        _chunk(stream, b"IHDR", struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0))
        _chunk(stream, b"acTL", struct.pack(">2I", film.footage.total, 0))
        for i, page in enumerate(pages):
            # Chunks of frames are numbered throughout: the first frame has one, the others two.
            frame = (max(0, 2 * i - 1), width, height, 0, 0, *delay.as_integer_ratio(), 0, 0)
            _chunk(stream, b"fcTL", struct.pack(">5I2H2B", *frame))
            pixels = _packed(page)
            _chunk(stream, *((b"fdAT", struct.pack(">I", 2 * i) + pixels) if i else (b"IDAT", pixels)))
        _chunk(stream, b"IEND", b"")


def _packed(page: np.ndarray) -> bytes:
    """The pixels as a PNG has them: each row as its difference to the one above, the filter that is called 2."""
    rows = page.reshape(len(page), -1)
    rows = np.diff(rows, axis=0, prepend=np.zeros_like(rows[:1]))
    return zlib.compress(np.insert(rows, 0, 2, axis=1).tobytes())


def _chunk(stream: BinaryIO, name: bytes, data: bytes) -> None:
    stream.write(struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)))


def _write_mp4(film: Film, pages: Iterator[np.ndarray], path: Path, fps: float) -> None:
    height, width = film.backdrop.shape[:2]
    write_video(pages, path, fps=fps, size=(width, height))


_WRITERS: dict[str, Callable[[Film, Iterator[np.ndarray], Path, float], None]] = {
    ".gif": _write_gif,
    ".webp": _write_webp,
    ".apng": _write_apng,
    ".mp4": _write_mp4,
}

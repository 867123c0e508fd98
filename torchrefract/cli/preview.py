"""Look at effects on a picture, a video or a folder of frames: `python -m torchrefract.preview image.jpg`."""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from matplotlib.figure import Figure
from omegaconf import DictConfig
from torch import Tensor

from torchrefract._io import replace_file
from torchrefract._validation import UsageError, check_count, check_number, check_positive, check_size
from torchrefract.cli.command import check_seed, make, naming
from torchrefract.data.images import EXTENSIONS, files_in, fit, image_size, read_image
from torchrefract.data.media import VIDEOS, read_video
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.base import Effect
from torchrefract.fields.depth import check_depth
from torchrefract.visualization.animation import Footage, formats, make_film, save_film
from torchrefract.visualization.figures import make_row, sheet

_RENDERED = (540, 960)  # height and width
_FASTEST = 50.0  # frames a second: a GIF counts hundredths of a second, and 0 or 1 of them is no delay to many viewers
_FARTHEST = 65535  # steps of a depth picture


class _Subject(NamedTuple):
    """What the effects are drawn on."""

    footage: Footage
    depth: Tensor | None  # (1, 1, H, W), m, where it is known
    name: str
    remark: str  # on its depth


def preview(cfg: DictConfig) -> None:
    """Draw the effects of a configuration on a picture, or on moving ones."""
    seed, effects = check_seed(cfg.seed), _effects(cfg)
    with naming("fps"):
        fps = check_number("fps", cfg.fps, low=0.1, high=_FASTEST)
    subject = _subject(cfg)
    with _writing(str(cfg.out)) as path:
        if moves := path.suffix.lower() in formats():
            film = make_film(effects, subject.footage, seed=seed, depth=subject.depth)
            save_film(film, path, fps=fps, name=str(cfg.out))
        else:
            _save_sheet(effects, subject, seed, path)
    frames = f", {subject.footage.total} frames" if moves else ""
    print(f"{cfg.out}: {', '.join(effects)} on {subject.name}{frames}{subject.remark}")


def _save_sheet(effects: dict[str, Effect], subject: _Subject, seed: int, path: Path) -> None:
    """The effects on the first frame."""
    _, frame = next(subject.footage.frames([0]))
    rows = []
    for name, effect in effects.items():
        with naming(name):
            rows.append(make_row(name, effect, frame=frame, depth=subject.depth, seed=seed))
    height, width = frame.shape[2:]
    sheet(rows, title=f"{subject.name}, {width} x {height} px, seed {seed}").savefig(path)


def _effects(cfg: DictConfig) -> dict[str, Effect]:
    """Those to draw, by name."""
    if cfg.scene is not None:
        effects = {str(HydraConfig.get().runtime.choices["scene"]): make(cfg, "scene")}
    elif isinstance(cfg.effects, DictConfig):
        effects = {name: make(cfg.effects, name) for name in map(str, cfg.effects)}
    else:
        effects = {}
    if not effects:
        raise UsageError(f"effects must be at least one effect with its name, got {cfg.effects}")
    for name, effect in effects.items():
        if not isinstance(effect, Effect):
            raise UsageError(f"{name} must be an effect of torchrefract, got {effect}")
    return effects


def _subject(cfg: DictConfig) -> _Subject:
    """The pictures that are asked for, or a rendered scene."""
    with naming("size"):
        size = None if cfg.size is None else check_size("size", cfg.size)
    with naming("frames"):
        most = check_count("frames", cfg.frames)
    if cfg.image is None:
        if cfg.depth is not None:
            raise UsageError(
                f"depth must be that of a picture, image=…, as a rendered scene has its own, got {cfg.depth}"
            )
        with naming("size"):
            image, depth = render_road_scenes(torch.tensor([cfg.seed]), *(size or _RENDERED))
        return _Subject(_still(image, most), depth, "a rendered road scene, as no picture was given", "")
    path = Path(str(cfg.image))
    footage, name = _read(path, most), _printable(path.name or path.resolve().name)
    _, first = next(footage.frames([0]))
    depth, remark = (None, "") if cfg.depth is None else _depth_of(cfg, first, size)
    return _Subject(footage if size is None else _fitted(footage, size), depth, name, remark)


def _read(path: Path, most: int) -> Footage:
    """The first frames of a video or a folder, or a picture that stands still."""
    if path.is_dir():
        files = sorted(files_in(path), key=_natural)[:most]
        if not files:
            raise UsageError(f"image must be a folder that holds {', '.join(EXTENSIONS)}, got {path}")
        return Footage(len(files), lambda times: _of_one_size((t, files[t].name, read_image(files[t])) for t in times))
    if path.suffix.lower() in VIDEOS:
        count = sum(1 for _ in read_video(path, range(most)))
        if count == 0:
            raise UsageError(f"image must be a video with a frame that can be decoded, got {path}")
        return Footage(count, lambda times: read_video(path, times))
    return _still(read_image(path)[None].contiguous(), most)


def _still(image: Tensor, count: int) -> Footage:
    return Footage(count, lambda times: ((t, image) for t in times))


def _natural(path: Path) -> list[str | int]:
    """Sorts frame 2 before frame 10."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", path.name))]


def _of_one_size(pictures: Iterable[tuple[int, str, Tensor]]) -> Iterator[tuple[int, Tensor]]:
    shape = None
    for t, name, picture in pictures:
        shape = shape or picture.shape
        if picture.shape != shape:
            raise UsageError(
                f"image must be a folder of frames of one size, {shape[1]}x{shape[2]} (height x width), "
                f"got {name} of {picture.shape[1]}x{picture.shape[2]}"
            )
        yield t, picture[None].contiguous()


def _fitted(footage: Footage, size: tuple[int, int]) -> Footage:
    """Footage cut and reduced to a size."""

    def frames(times: Iterable[int]) -> Iterator[tuple[int, Tensor]]:
        for t, frame in footage.frames(times):
            with naming("size"):
                yield t, fit(frame[0], size)[None]

    return Footage(footage.total, frames)


def _depth_of(cfg: DictConfig, picture: Tensor, size: tuple[int, int] | None) -> tuple[Tensor, str]:
    """The depth (1, 1, h, w) of a picture (1, 3, H, W) that is cut and reduced to a size, and a remark."""
    with naming("depth_scale"):
        scale = check_positive("depth_scale", cfg.depth_scale)
    path = Path(str(cfg.depth))
    depth, remark = _read_npy(path) if path.suffix.lower() == ".npy" else _read_depth_png(path, scale)
    (height, width), (rows, columns) = picture.shape[2:], depth.shape
    if 2 * abs(rows * width - columns * height) > max(height, width):
        raise UsageError(
            f"depth must be of the size of the picture, {height}x{width} (height x width), or of its shape, "
            f"got {rows}x{columns}"
        )
    with naming("depth"):
        check_depth(depth[None, None])
    # Where each pixel of the picture comes from, in its heights and widths, goes through what the picture goes through.
    places = torch.zeros(3, height, width)
    places[0] = ((torch.arange(height) + 0.5) / height)[:, None]
    places[1] = (torch.arange(width) + 0.5) / width
    if size is not None:
        with naming("size"):
            places = fit(places, size)
    y, x = ((share * side).long().clamp(max=side - 1) for share, side in zip(places[:2], (rows, columns), strict=True))
    return depth[y, x][None, None], remark


def _read_npy(path: Path) -> tuple[Tensor, str]:
    try:
        value = np.load(path, allow_pickle=False)
    except OSError as error:
        raise UsageError(
            f"depth must be a file that can be read, got {path} ({error.strerror or 'damaged'})"
        ) from error
    except (ValueError, EOFError) as error:
        raise UsageError(f"depth must be an array of numbers, got {path}, which is damaged or none") from error
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f" or value.size == 0 or value.squeeze().ndim != 2:
        raise UsageError(f"depth must be (height, width) of floating numbers, in m, got {path}")
    return torch.from_numpy(value.squeeze().astype(np.float32)), ""


def _read_depth_png(path: Path, scale: float) -> tuple[Tensor, str]:
    """Depth of a 16-bit picture; what was not measured counts as infinitely far, of which the remark tells."""
    image_size(path)
    steps = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if steps is None or steps.dtype != np.uint16 or steps.ndim != 2:
        raise UsageError(f"depth must be a gray PNG of 16 bits, or a .npy in m, got {path}")
    missing = float((steps == 0).mean())
    if missing > 0.5:
        raise UsageError(f"depth must be known in half of the pixels at least, got {path} with {missing:.1%} at 0")
    depth = np.where((steps == 0) | (steps == _FARTHEST), np.inf, steps * scale).astype(np.float32)
    return torch.from_numpy(depth), f"; {missing:.1%} of its depth is 0, taken as infinite" if missing else ""


def _printable(name: str) -> str:
    """A file's name in one line that is not too long."""
    name = "".join(letter if letter.isprintable() else "?" for letter in name)
    return name if len(name) <= 60 else f"{name[:40]}…{name[-19:]}"


@contextmanager
def _writing(out: str) -> Iterator[Path]:
    """A name to write to; that it cannot be written is found at once."""
    able = sorted({*formats(), *(f".{name}" for name in Figure().canvas.get_supported_filetypes())})
    if Path(out).suffix.lower() not in able:
        raise UsageError(f"out must end in one of {', '.join(able)}, got {out}")
    if Path(out).is_dir():
        raise UsageError(f"out must be a file, got the folder {out}")
    try:
        with replace_file(Path(out)) as path:
            path.touch()
            yield path
    except OSError as error:
        raise UsageError(f"{out} could not be written: {error.strerror}") from error

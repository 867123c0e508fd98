"""Contact sheets and animations of effects on a picture, a video, a folder of frames or a rendered scene."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import torch
from hydra.core.hydra_config import HydraConfig
from matplotlib.figure import Figure
from omegaconf import DictConfig
from torch import Tensor

from torchrefract._io import make_folder, replace_file, write_figure
from torchrefract._validation import UsageError, check_count, check_number, check_positive, check_size
from torchrefract.cli.options import check_seed, make_effect, naming, place_scene, read_option, read_optional
from torchrefract.cli.progress import print_warning, progress, warn_of_assumed_depth
from torchrefract.data.depth_maps import DepthFolder, crop_depth, read_depth
from torchrefract.data.images import EXTENSIONS, files_in, fit, natural_order, read_image
from torchrefract.data.media import VIDEOS, describe_turned
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.data.video import read_video
from torchrefract.effects.base import Effect
from torchrefract.visualization.animation import (
    FrameSequence,
    animation_formats,
    make_animation,
    save_animation,
)
from torchrefract.visualization.figures import contact_sheet, contact_sheet_row

_RENDERED_SIZE = (540, 960)  # height and width
_MAX_FPS = 50.0  # many viewers take the shorter delays that a GIF can hold for no delay

_MapName = tuple[str, int | None]  # of a picture, or of a video with the number of its frame, as `DepthFolder` takes


class _Source(NamedTuple):
    """Frames to degrade."""

    frames: FrameSequence
    name: str
    note: str  # on the depth


def preview(cfg: DictConfig) -> None:
    """Write a contact sheet of effects on the first frame or, if the format is one of animations, an animation."""
    with naming("size"):
        place_scene(cfg, size=read_optional(cfg, "size", check_size))
    seed, effects = check_seed(cfg.seed), _effects(cfg)
    fps = read_option(cfg, "fps", check_number, low=0.1, high=_MAX_FPS)
    source = _source(cfg)
    num_frames = source.frames.num_frames
    if source.frames.depth is None:
        for effect in effects.values():
            warn_of_assumed_depth(effect)
    with _writing(str(cfg.out)) as path:
        if is_animation := path.suffix.lower() in animation_formats():
            animation = make_animation(effects, source.frames, seed=seed)
            times = progress(range(num_frames), str(cfg.out), count=num_frames)
            save_animation(animation, path, fps=fps, times=times)
        else:
            _save_contact_sheet(effects, source, seed, path)
    length = f", {num_frames} frames" if is_animation else ""
    print(f"{cfg.out}: {', '.join(effects)} on {source.name}{length}{source.note}")


def _save_contact_sheet(effects: dict[str, Effect], source: _Source, seed: int, path: Path) -> None:
    _, frame = next(source.frames.read([0]))
    depth = source.frames.depth and source.frames.depth(0)
    rows = []
    items = progress(effects.items(), "drawing the effects; a first run compiles for a minute", count=len(effects))
    for name, effect in items:
        with naming(name):
            rows.append(contact_sheet_row(name, effect, frame=frame, depth=depth, seed=seed))
    height, width = frame.shape[2:]
    write_figure(path, contact_sheet(rows, title=f"{source.name}, {width} x {height} px, seed {seed}"))


def _effects(cfg: DictConfig) -> dict[str, Effect]:
    """Instantiate the scene or, without one, the effects of the configuration, by name."""
    if cfg.scene is not None:
        return {str(HydraConfig.get().runtime.choices["scene"]): make_effect(cfg, "scene")}
    if not (isinstance(cfg.effects, DictConfig) and cfg.effects):
        raise UsageError(f"effects must be at least one effect with its name, got {cfg.effects}")
    return {name: make_effect(cfg.effects, name) for name in map(str, cfg.effects)}


def _source(cfg: DictConfig) -> _Source:
    size, max_frames = read_optional(cfg, "size", check_size), read_option(cfg, "frames", check_count)
    if cfg.image is None:
        if cfg.depth is not None:
            raise UsageError(
                f"depth must be that of a picture, image=…, as a rendered scene has its own, got {cfg.depth}"
            )
        with naming("size"):
            image, depth = render_road_scenes(torch.tensor([cfg.seed]), *(size or _RENDERED_SIZE))
        frames = _repeat(image, max_frames)._replace(depth=lambda _: depth)
        return _Source(frames, "a rendered road scene, as no picture was given", "")
    path = Path(str(cfg.image))
    (frames, maps), name = _read_frames(path, max_frames), _printable(path.name or path.resolve().name)
    if cfg.scene is not None and cfg.scene.get("camera") is not None:
        files = [path / name for name, _ in maps] if path.is_dir() else [path]
        if turned := describe_turned(files, upright=True):
            print_warning(turned)
    depth, note = (None, "") if cfg.depth is None else _depth(cfg, frames, maps, size)
    resized = FrameSequence(frames.num_frames, lambda times: ((t, _fit(x, size)) for t, x in frames.read(times)), depth)
    return _Source(resized, name, note)


def _read_frames(path: Path, max_frames: int) -> tuple[FrameSequence, Sequence[_MapName]]:
    """Return the first frames of a folder or a video, or a picture that repeats, and names of their depth maps."""
    if path.is_dir():
        files = sorted(files_in(path), key=lambda file: natural_order(file.name))[:max_frames]
        if not files:
            raise UsageError(f"image must be a folder that holds {', '.join(EXTENSIONS)}, got {path}")
        maps = [(file.name, None) for file in files]
        return FrameSequence(len(files), lambda times: _read_folder(files, times)), maps
    if path.suffix.lower() in VIDEOS:
        num_frames = sum(1 for _ in read_video(path, range(max_frames)))
        if num_frames == 0:
            raise UsageError(f"image must be a video with a frame that can be decoded, got {path}")
        names = [(path.name, t) for t in range(num_frames)]
        return FrameSequence(num_frames, lambda times: read_video(path, times)), names
    return _repeat(read_image(path)[None].contiguous(), max_frames), [(path.name, None)]


def _repeat(image: Tensor, num_frames: int) -> FrameSequence:
    return FrameSequence(num_frames, lambda times: ((t, image) for t in times))


def _read_folder(files: list[Path], times: Iterable[int]) -> Iterator[tuple[int, Tensor]]:
    shape = None
    for t in times:
        image = read_image(files[t])
        shape = shape or image.shape
        if image.shape != shape:
            raise UsageError(
                f"image must be a folder of frames of one size, {shape[1]}x{shape[2]} (height x width), "
                f"got {files[t].name} of {image.shape[1]}x{image.shape[2]}"
            )
        yield t, image[None].contiguous()


def _fit(frame: Tensor, size: tuple[int, int] | None) -> Tensor:
    with naming("size"):
        return frame if size is None else fit(frame[0], size)[None]


def _depth(
    cfg: DictConfig, frames: FrameSequence, maps: Sequence[_MapName], size: tuple[int, int] | None
) -> tuple[Callable[[int], Tensor], str]:
    """Return the depth of frames that are cropped and reduced to a size, from a map or a folder of maps, and a note."""
    scale = read_option(cfg, "depth_scale", check_positive)
    path, is_animation = Path(str(cfg.depth)), Path(str(cfg.out)).suffix.lower() in animation_formats()
    _, first = next(frames.read([0]))
    height, width = first.shape[2:]
    if path.is_dir():
        folder = DepthFolder(path, scale)
        folder.check(maps if is_animation else maps[:1])
        last = len(maps) - 1  # a picture that repeats has one map
        return lambda t: folder.read(*maps[min(t, last)], frame_size=(height, width), size=size)[None], ""
    if is_animation and maps[1:]:
        print_warning(
            f"{path} is one depth map for all {len(maps)} frames; depth= takes a folder with one for each, as "
            "estimate_depth writes"
        )
    depth, missing = read_depth(path, scale=scale)
    with naming("depth"):
        depth = crop_depth(depth, (height, width), size, name=str(path))
    note = f"; {missing:.1%} of its depth is 0, taken as infinite" if missing else ""
    return lambda _: depth[None], note


def _printable(name: str) -> str:
    """Shorten the name of a file to one line."""
    name = "".join(letter if letter.isprintable() else "?" for letter in name)
    return name if len(name) <= 60 else f"{name[:40]}…{name[-19:]}"


@contextmanager
def _writing(out: str) -> Iterator[Path]:
    """Yield a temporary path that replaces `out` at the end; raise UsageError at once if it cannot be written."""
    formats = sorted({*animation_formats(), *(f".{name}" for name in Figure().canvas.get_supported_filetypes())})
    if Path(out).suffix.lower() not in formats:
        raise UsageError(f"out must end in one of {', '.join(formats)}, got {out}")
    if Path(out).is_dir():
        raise UsageError(f"out must be a file, got the folder {out}")
    try:
        make_folder(Path(out).parent)
        with replace_file(Path(out)) as path:
            path.touch()
            yield path
    except OSError as error:
        raise UsageError(f"{out} could not be written: {error.strerror}") from error

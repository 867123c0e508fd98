"""The command that estimates depth maps of pictures and videos with a network."""

import statistics
import sys
from collections.abc import Iterable, Iterator
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchrefract._io import make_folder, matching_files, relative_name
from torchrefract._validation import UsageError, check_count
from torchrefract.cli.command import progress
from torchrefract.cli.options import find_device, make, naming, read_option, source_and_out
from torchrefract.data import media
from torchrefract.data.depth_maps import DepthFolder, write_depth
from torchrefract.data.images import UnreadableImageError, read_image
from torchrefract.data.pairs.configuration import claim
from torchrefract.data.pairs.manifest import locked
from torchrefract.depth import RoadSpreadError, TransformersDepth


class _Frame(NamedTuple):
    image: Tensor  # (3, H, W)
    target: Path
    name: str


def estimate_depth(cfg: DictConfig) -> None:
    """Write the depth maps of a picture, a video or a folder that are not in the output folder yet."""
    with source_and_out(cfg) as (source, out):
        _estimate_depth(cfg, source, out)


def _estimate_depth(cfg: DictConfig, source: Path, out: Path) -> None:
    size = read_option(cfg, "batch", check_count)
    files = media.find_media(source, deep=True, name="source")
    media.check_output_folder(out, source, deep=True, name="source")
    folder, root = DepthFolder(out), source if source.is_dir() else source.parent
    pictures = [relative_name(file, root) for file in files if not media.is_video(file)]
    folder.check([(name, None) for name in pictures], exist=False)
    cfg.device = str(find_device(str(cfg.device)))
    try:
        network = make(cfg, "model")
    except ImportError as error:
        raise UsageError(f"model: {error}") from error
    if not isinstance(network, TransformersDepth):
        raise UsageError(f"model must be torchrefract.depth.from_transformers, got {type(network).__name__}")
    with naming("out"):
        if (out / "config.json").is_file():
            _claim(cfg, out, root)
        make_folder(out)
    skipped, spreads = dict[str, str](), list[float]()
    num_written = 0
    with locked("out", out):
        frames = _missing_frames(progress(files, "estimating depth", count=len(files)), root, folder, skipped)
        for batch in _batches(frames, size):
            for frame, result in zip(batch, network.each(torch.stack([frame.image for frame in batch])), strict=True):
                if isinstance(result, RoadSpreadError):
                    _skip(skipped, frame.name, f"{frame.name}: {result}")
                    continue
                if num_written == 0:
                    _claim(cfg, out, root)
                make_folder(frame.target.parent)
                write_depth(frame.target, result.depth[0].cpu())
                num_written += 1
                spreads += [] if result.spread is None else [result.spread]
    if num_written == 0 and skipped:
        raise UsageError(f"source must hold a frame whose depth can be estimated, got {next(iter(skipped.values()))}")
    spread = f", median spread of the scale {statistics.median(spreads):.2f}" if spreads else ""
    print(f"{out}: {num_written} depth maps written, {len(skipped)} frames skipped{spread}")
    if skipped:
        raise SystemExit(1)


def _claim(cfg: DictConfig, out: Path, root: Path) -> None:
    """Note the settings in the output folder; raise UsageError if its maps are of another network, road or source."""
    names = [path.name for path in matching_files(out, "*") if not path.name.startswith(".")]
    if names and "config.json" not in names:
        return  # a folder of maps of another program, of which the frames without one are estimated
    model = cast(dict[str, Any], OmegaConf.to_container(cfg.model, resolve=True))
    content = {name: value for name, value in model.items() if name not in ("device", "max_spread")}
    claim(out, {"source": str(root.resolve()), "model": content}, count=0, about={})


def _missing_frames(
    files: Iterable[Path], root: Path, folder: DepthFolder, skipped: dict[str, str]
) -> Iterator[_Frame]:
    """Yield the frames that have no map yet; name those that cannot be read."""
    for file in files:
        name = relative_name(file, root)
        try:
            if media.is_video(file):
                for index, image in media.read_video(file, count()):
                    if not folder.has(name, index):
                        yield _Frame(image[0], folder.path(name, index), f"{name}#{index}")
            elif not folder.has(name):
                yield _Frame(read_image(file), folder.path(name), name)
        except UnreadableImageError as error:
            _skip(skipped, name, str(error))


def _skip(skipped: dict[str, str], name: str, reason: str) -> None:
    skipped[name] = reason
    print(f"skipped: {reason}", file=sys.stderr)


def _batches(frames: Iterator[_Frame], size: int) -> Iterator[list[_Frame]]:
    """Yield up to `size` frames in a row of one shape."""
    batch = list[_Frame]()
    for frame in frames:
        if batch and (len(batch) == size or frame.image.shape != batch[0].image.shape):
            yield batch
            batch = []
        batch.append(frame)
    if batch:
        yield batch

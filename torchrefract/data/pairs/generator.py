"""Generation of one pair: read a frame, degrade it by its own draw, encode the files."""

import hashlib
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from torchrefract._validation import UsageError
from torchrefract.data.images import UnreadableImageError, pixels_of
from torchrefract.data.pairs.files import FLOWS, LIGHTS, PairArrays, count_out_of_range, encode_pair
from torchrefract.data.pairs.manifest import PairRow, StoredFile
from torchrefract.data.pairs.sources import Source, SourceReader, draw_of
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose
from torchrefract.types import Degraded


@dataclass(frozen=True)
class GenerationConfig:
    """Everything that a pair depends on, apart from its number and its frame.

    Args:
        effect: degrades the frames.
        scene: name of the effect.
        root: folder of the frames.
        size: (height, width), px, to crop and reduce frames to; None keeps their size.
        seed: of the draws.
        maps: format of the maps: "png", "npz" or "safetensors".
    """

    effect: Effect
    scene: str
    root: Path
    size: tuple[int, int] | None
    seed: int
    maps: str


class PairTask(NamedTuple):
    """A pair to generate."""

    number: int
    source: Source
    repeat: int  # how many times the source was used before


class GeneratedPair(NamedTuple):
    """An encoded pair."""

    row: PairRow  # its files have no path yet
    data: dict[str, bytes]  # content of each file by the suffix of its name; empty if the frame was skipped


class PairGenerator:
    """Generates pairs on the CPU, one at a time, so that a pair has the same bytes in any order and process."""

    def __init__(self, config: GenerationConfig):
        self.config = config
        self._reader = SourceReader(config.root, config.size)

    def generate(self, task: PairTask) -> GeneratedPair:
        """Generate a pair. An unreadable frame gives a row with the reason and no files.

        Raises:
            UsageError: the scene, the size or the format of the maps does not suit the frame.
        """
        config = self.config
        try:
            image, pixels = self._reader.read(task.source)
        except UnreadableImageError as error:
            return GeneratedPair(self._row(task, (0, 0), skipped=str(error).replace(f"{config.root}/", "")), {})
        except ValueError as error:
            raise UsageError(f"size: {error}") from error
        seed, key = draw_of(task.source, seed=config.seed, repeat=task.repeat)
        try:
            with warnings.catch_warnings(), torch.no_grad():
                warnings.simplefilter("ignore", UserWarning)  # of folded pixels, which the masks exclude
                degraded = config.effect.degrade(image[None], seed=seed, keys=[key])
        except (ValueError, TypeError, OSError) as error:
            raise UsageError(f"scene: {error}") from error
        pair = PairArrays(pixels, pixels_of(degraded.image[0]), _maps(degraded))
        try:
            data = encode_pair(pair, config.maps)
        except ValueError as error:
            raise UsageError(f"maps: {error}") from error
        row = self._row(
            task,
            (image.shape[1], image.shape[2]),
            effects=applied_effects(config.effect, degraded.params),
            beyond=_count_out_of_range(pair) if config.maps == "png" else {},
            files={name: StoredFile("", len(x), hashlib.sha256(x).hexdigest()) for name, x in data.items()},
        )
        return GeneratedPair(row, data)

    def _row(self, task: PairTask, size: tuple[int, int], **rest: Any) -> PairRow:
        seed, key = draw_of(task.source, seed=self.config.seed, repeat=task.repeat)
        source, (height, width) = task.source, size
        origin = (source.path, source.frame, source.drive, source.split)
        empty: dict[str, Any] = {"effects": [], "beyond": {}, "files": {}}
        return PairRow(task.number, *origin, self.config.scene, seed, key, height, width, **(empty | rest))


def applied_effects(effect: Effect, params: Any) -> list[dict[str, Any]]:
    """Return the name and the parameters of each effect that was applied to the first sample, in order."""
    leaves = effect.leaves(params) if isinstance(effect, Compose) else [(effect, params)]
    return [
        {"effect": type(leaf).__name__}
        | {name: _plain(value[0].tolist()) for name, value in values._asdict().items() if name != "applied"}
        for leaf, values in leaves
        if values.applied[0]
    ]


def _plain(value: Any) -> Any:
    """Replace infinite numbers by words, because JSON has no infinity."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _maps(degraded: Degraded) -> dict[str, np.ndarray]:
    maps = {"valid": degraded.valid[0, 0].numpy()}
    if degraded.has("flow"):
        maps["restore_valid"] = degraded.restore_valid[0, 0].numpy()
        maps |= {name: getattr(degraded, name)[0].float().numpy() for name in FLOWS}
    return maps | {name: getattr(degraded, name)[0, 0].float().numpy() for name in LIGHTS if degraded.has(name)}


def _count_out_of_range(pair: PairArrays) -> dict[str, int]:
    maps = pair.maps
    counts = {name: count_out_of_range(maps[name], maps[mask]) for name, mask in FLOWS.items() if name in maps}
    return {name: count for name, count in counts.items() if count}

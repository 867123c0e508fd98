"""One pair: a frame read, degraded by its own draw, and put into files."""

import hashlib
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from torchrefract._validation import UsageError
from torchrefract.cli.command import naming
from torchrefract.data.images import UnreadableImageError, pixels_of
from torchrefract.data.pairs.files import FLOWS, LIGHTS, PairArrays, beyond, encode_pair
from torchrefract.data.pairs.manifest import PairRow, Stored
from torchrefract.data.pairs.sources import Reader, Source, draw_of
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose
from torchrefract.types import Degraded


@dataclass(frozen=True)
class Recipe:
    """All that a pair depends on beside its number and its frame.

    effect: what degrades the frames; scene: what it is called.
    root: of the frames; size: (height, width), px, that they are cut and reduced to, or None.
    seed: of the draws.
    maps: the form of the maps, "png", "npz" or "safetensors".
    """

    effect: Effect
    scene: str
    root: Path
    size: tuple[int, int] | None
    seed: int
    maps: str


class Job(NamedTuple):
    """A pair to make."""

    number: int
    source: Source
    lap: int  # how often the source was used before


class Made(NamedTuple):
    """A pair in files that are not written yet."""

    row: PairRow  # its files without a place
    data: dict[str, bytes]


class Maker:
    """Makes the pairs of a recipe, on the CPU, each by itself, so that it has the same bits whoever makes it."""

    def __init__(self, recipe: Recipe):
        self.recipe = recipe
        self._reader = Reader(recipe.root, recipe.size)

    def make(self, job: Job) -> Made:
        """The pair of a job; a frame that cannot be read gives none, and a row that says so."""
        try:
            image, pixels = self._reader.read(job.source)
        except UnreadableImageError as error:
            return Made(self._row(job, (0, 0), skipped=str(error).replace(f"{self.recipe.root}/", "")), {})
        except ValueError as error:
            raise UsageError(f"size: {error}") from error
        seed, key = draw_of(job.source, seed=self.recipe.seed, lap=job.lap)
        with naming("scene"), warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore", UserWarning)  # of folds, which the masks leave out
            degraded = self.recipe.effect.degrade(image[None], seed=seed, keys=[key])
            pair = PairArrays(pixels, pixels_of(degraded.image[0]), _maps(degraded))
        with naming("maps"):
            data = encode_pair(pair, self.recipe.maps)
        rest = {
            "effects": acting(self.recipe.effect, degraded.params),
            "beyond": _beyond(pair) if self.recipe.maps == "png" else {},
            "files": {name: Stored("", len(value), hashlib.sha256(value).hexdigest()) for name, value in data.items()},
        }
        return Made(self._row(job, tuple(image.shape[1:]), **rest), data)

    def _row(self, job: Job, size: tuple[int, ...], **rest: Any) -> PairRow:
        seed, key = draw_of(job.source, seed=self.recipe.seed, lap=job.lap)
        empty: dict[str, Any] = {"effects": [], "beyond": {}, "files": {}}
        source, (height, width) = job.source, size
        where = (source.path, source.frame, source.drive, source.split)
        return PairRow(job.number, *where, self.recipe.scene, seed, key, height, width, **(empty | rest))


def acting(effect: Effect, params: Any) -> list[dict[str, Any]]:
    """The effects that acted on the first sample, in order, each with its name and all its parameters but the gate."""
    leaves = effect.leaves(params) if isinstance(effect, Compose) else [(effect, params)]
    found = []
    for leaf, own in leaves:
        if own.applied[0]:
            values = {name: _plain(value[0].tolist()) for name, value in own._asdict().items() if name != "gate"}
            found.append({"effect": type(leaf).__name__} | values)
    return found


def _plain(value: Any) -> Any:
    """A number, or nested lists of them; JSON has no infinity, so that it becomes a word."""
    if isinstance(value, list):
        return [_plain(row) for row in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _maps(degraded: Degraded) -> dict[str, np.ndarray]:
    """The maps that there are, of one sample."""
    maps = {"valid": degraded.valid[0, 0].numpy()}
    if degraded.has("flow"):
        maps["restore_valid"] = degraded.restore_valid[0, 0].numpy()
        maps |= {name: getattr(degraded, name)[0].float().numpy() for name in FLOWS}
    return maps | {name: getattr(degraded, name)[0, 0].float().numpy() for name in LIGHTS if degraded.has(name)}


def _beyond(pair: PairArrays) -> dict[str, int]:
    """How many valid pixels a PNG cannot hold, of the flows that have some."""
    counts = {name: beyond(pair.maps[name], pair.maps[mask]) for name, mask in FLOWS.items() if name in pair.maps}
    return {name: count for name, count in counts.items() if count}

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from torchrefract import Pair, presets
from torchrefract.data.module import PairData
from torchrefract.data.pairs import card
from torchrefract.data.pairs.generator import PairGenerator, PairStorage, PairTask, SourceReader
from torchrefract.data.pairs.manifest import Manifest
from torchrefract.data.pairs.sources import find_sources

SIZE = (32, 48)


@pytest.fixture(scope="session", autouse=True)
def _equal_figures_are_drawn_once() -> Iterator[None]:
    """Keep the histograms of a set, which take longer than its pairs, for other sets of the same parameters."""
    draw, figures = card.draw_histograms, dict[Any, bytes | None]()

    def draw_once(summary: card.Summary) -> bytes | None:
        columns = ((key, *map(bytes, columns)) for key, columns in sorted(summary.parameters.items()))
        if (key := tuple(columns)) not in figures:
            figures[key] = draw(summary)
        return figures[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(card, "draw_histograms", draw_once)
        yield


@pytest.fixture(scope="session")
def frames(tmp_path_factory) -> Path:
    """Write twelve different images of three drives, with waves and noise."""
    root = tmp_path_factory.mktemp("frames")
    generator = np.random.default_rng(0)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    for number in range(12):
        waves = [np.sin(x / (5 + number % 3) + c + number) * np.cos(y / 6 - c) for c in range(3)]
        path = root / f"drive{number // 4}" / f"{number:03d}.png"
        path.parent.mkdir(exist_ok=True)
        pixels = 127 + 90 * np.stack(waves, axis=2) + generator.uniform(-30, 30, (*SIZE, 3))
        Image.fromarray(pixels.round().astype(np.uint8)).save(path)
    return root


@pytest.fixture(scope="session")
def words(frames) -> Callable[..., tuple[str, ...]]:
    """Return the options of the command for the frames; without workers, unless they are given."""

    def of(out: Path | str, *more: str, scene: str = "paper_refractive", **others: Any) -> tuple[str, ...]:
        width = ("scene.width=192",) if scene == "paper_refractive" else ()
        options = {"source": frames, "out": out, "license": "CC0", "workers": 0} | others
        return (f"scene={scene}", *width, *(f"{name}={value}" for name, value in options.items()), *more)

    return of


@pytest.fixture(scope="session")
def tars(tmp_path_factory, frames) -> Path:
    """Write 23 pairs of the frames in tars of three, as the command does; some tars hold pairs of both splits."""
    out = tmp_path_factory.mktemp("tars") / "out"
    sources = find_sources(frames, size=None, every=1, drive_by="auto", val_share=0.2, seed=0)
    reader = SourceReader(frames, None)
    generator = PairGenerator(presets.paper_refractive(width=192), "paper_refractive", reader, 0, "png")
    tasks = [PairTask(i - 4, sources.frame(i % 12), i // 12) for i in range(4, 27)]
    out.mkdir()
    manifest, storage = Manifest(out, 0, 1), PairStorage(out, 3)
    for i in range(0, len(tasks), 3):
        for row in storage.write(tasks[i : i + 3], generator):
            manifest.add(row)
    return out


@pytest.fixture(scope="session")
def rows() -> Callable[[Path], list[Any]]:
    """Return the rows of a manifest as JSON documents."""
    return lambda out: [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]


@pytest.fixture(scope="session")
def during() -> Callable[..., PairData]:
    """Return a function that attaches what `PairData` reads of Lightning's trainer at a point of a run."""

    def attach(data: PairData, *, epoch: int = 0, training: bool = True, ranks: int = 1, rank: int = 0) -> PairData:
        run = SimpleNamespace(training=training, current_epoch=epoch, world_size=ranks, global_rank=rank)
        data.trainer = run  # pyright: ignore[reportAttributeAccessIssue]  # only these attributes are read
        return data

    return attach


@pytest.fixture(scope="session")
def batches(during) -> Callable[..., list[Pair]]:
    """Return a function that gives the batches of an epoch of training, or of validation."""

    def of(data: PairData, *, epoch: int = 0, training: bool = True, **ranks: int) -> list[Pair]:
        during(data, epoch=epoch, training=training, **ranks)
        loader: Any = data.train_dataloader() if training else data.val_dataloader()
        if training:
            loader.sampler.set_epoch(epoch)
        return [data.on_after_batch_transfer(batch, 0) for batch in loader]

    return of

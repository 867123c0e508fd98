"""Train several networks for the same processor time on a lens or in fog, and plot their learning curves in one figure.

    python benchmarks/learning.py [--task undistort] [--models ddpm resunet lens_net] [--seconds 240] [--size 192x336]
                                  [--scenes 512] [--val 64] [--threads 1] [--out benchmarks/results/learning]
    python benchmarks/learning.py --task deweather --size 96x168 [--models fog_net bridge ddpm_image]

All networks see the same rendered roads, rendered before, through the same lenses or the same fog. `ddpm_image` has the
network of `bridge` here. Four steps of each give the number
of steps that its seconds allow, at least six; the learning rate ends at zero there. Seconds are of the process, without
validations. Models with results of the same settings in `--out` are not trained again.
"""

import argparse
import json
import time
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from pytorch_lightning import Callback, LightningModule, Trainer, seed_everything
from timing import RESULTS, count, markdown, size, write_json

from torchrefract._io import write_figure
from torchrefract.data.module import PairData

CONF = Path(__file__).resolve().parents[1] / "conf"
_SMALL = ("model.network.widths=[32,64,128,128]", "model.lr=0.001", "model.warmup_steps=50", "model.crop=null")
_OPTIONS = {"ddpm_image": _SMALL}  # of models that are too large for minutes
_TRIAL, _POINTS = 4, 6  # steps, validations
_BATCH = 16  # frames
Point = dict[str, float]  # the seconds and the scores of a validation, by name


class Kind(NamedTuple):
    """The score of a task, and its models and rivals."""

    models: tuple[str, ...]  # the first three are the default
    score: str  # of a validation
    unit: str
    rivals: dict[str, str]  # names of methods without a network, by the suffix of their score


KINDS = {
    "undistort": Kind(
        ("ddpm", "resunet", "lens_net", "segformer"),
        "epe",
        "endpoint error (px at 1920x1080)",
        {"identity": "do nothing", "constant": "best constant flow"},
    ),
    "deweather": Kind(
        ("fog_net", "bridge", "ddpm_image", "resunet"),
        "psnr",
        "PSNR (dB)",
        {"identity": "do nothing", "fog": "true fog, 8 bits"},
    ),
}


class Clock(Callback):
    """Measure the processor time of training steps, and keep and print the scores of each validation."""

    def __init__(self, name: str, kind: Kind) -> None:
        self.name, self.kind = name, kind
        self.steps: list[float] = []
        self.points: list[Point] = []

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        self._last = time.process_time()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Add a step, from loading its frames to the update of the weights."""
        now = time.process_time()
        self.steps.append(now - self._last)
        self._last = now

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Add a point, and do not count the time of the validation."""
        scores = {name: float(value) for name, value in trainer.callback_metrics.items() if name.startswith("val/")}
        self.points.append({"seconds": sum(self.steps), "steps": len(self.steps)} | scores)
        score = f"{self.kind.unit} {scores[f'val/{self.kind.score}']:.2f}"
        print(f"{self.name}: {sum(self.steps):.0f} s, {len(self.steps)} steps, {score}", flush=True)
        self._last = time.process_time()


def main() -> None:
    """Train the models that have no results yet, print a table, and plot the curves."""
    args = _parser().parse_args()
    kind = KINDS[args.task]
    args.models = args.models or kind.models[:3]
    torch.set_num_threads(args.threads)
    height, width = args.size
    settings = f"{args.task}_{height}x{width}_{args.scenes}_{args.val}_{args.seconds:g}s"
    files = {name: args.out / f"{name}_{settings}.json" for name in args.models}
    if missing := [name for name, file in files.items() if not file.is_file()]:
        data = instantiate(_config(missing[0], args).data)
        for frames in (data.train, data.val):  # keeps what it renders
            for i in range(len(frames)):
                frames[i]
        for name in missing:
            write_json(files[name], learn(name, data, args))
    curves = {name: json.loads(file.read_text()) for name, file in files.items()}
    print(table(curves, kind))
    write_figure(args.out / f"{args.task}.png", plot(curves, kind))


def learn(name: str, data: PairData, args: argparse.Namespace) -> list[Point]:
    """Train a model for the seconds of the arguments; return its validations."""
    kind = KINDS[args.task]
    _fit(name, data, args, trial := Clock(name, kind), steps=_TRIAL, interval=None)
    interval = max(1, round(args.seconds / median(trial.steps) / _POINTS))
    _fit(name, data, args, clock := Clock(name, kind), steps=_POINTS * interval, interval=interval)
    return clock.points


def _fit(
    name: str, data: PairData, args: argparse.Namespace, clock: Clock, *, steps: int, interval: int | None
) -> None:
    seed_everything(0, verbose=False)
    model = instantiate(_config(name, args).model)
    options: dict[str, Any] = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    options |= {"accelerator": "cpu", "enable_model_summary": False, "num_sanity_val_steps": 0}
    options |= {"limit_val_batches": None if interval else 0, "check_val_every_n_epoch": None}
    trainer = Trainer(max_steps=steps, val_check_interval=interval, callbacks=[clock], **options)
    trainer.fit(model, data)


def _config(name: str, args: argparse.Namespace) -> Any:
    """Return the configuration of `torchrefract.train` for a model, with the frames of this process."""
    words = [
        f"+task={args.task}",
        f"model={name}",
        *_OPTIONS.get(name, ()),
        f"frame_size=[{args.size[0]},{args.size[1]}]",
    ]
    words += ["data.workers=0", f"data.batch_size={_BATCH}"]
    words += [f"data.train_count={args.scenes}", f"data.val_count={args.val}"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("train", words)
    OmegaConf.resolve(parts := OmegaConf.create({"task": config.task, "seed": config.seed}))
    return OmegaConf.merge(config, parts)


def table(curves: dict[str, list[Point]], kind: Kind) -> str:
    """Format a Markdown table of the last validation of each model."""
    head = ["model", "seconds", "steps", kind.unit, *kind.rivals.values(), "within two standard deviations"]
    rows = []
    for name, points in curves.items():
        last = points[-1]
        cells = [name, f"{last['seconds']:.0f}", f"{last['steps']:.0f}", f"{last[f'val/{kind.score}']:.2f}"]
        cells += [f"{last[f'val/{kind.score}_{rival}']:.2f}" for rival in kind.rivals]
        rows.append([*cells, f"{last['val/coverage']:.1%}" if "val/coverage" in last else ""])
    return markdown(head, rows)


def plot(curves: dict[str, list[Point]], kind: Kind) -> Figure:
    """Plot the score over the seconds of training, and two methods without a network."""
    figure = Figure(figsize=(6.4, 4.4), dpi=120, layout="constrained")
    axes = figure.subplots()
    for name, points in curves.items():
        axes.plot(
            [p["seconds"] for p in points], [p[f"val/{kind.score}"] for p in points], "-o", markersize=3, label=name
        )
    last = next(iter(curves.values()))[-1]
    for (key, label), color in zip(kind.rivals.items(), ("#6b6b6b", "#d95f02"), strict=True):
        axes.axhline(last[f"val/{kind.score}_{key}"], linestyle="--", color=color, label=label)
    axes.set_xlabel("seconds of the processor")
    axes.set_ylabel(kind.unit)
    axes.set_ylim(bottom=0)
    axes.grid(color="#e4e4e4", linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    return figure


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=list(KINDS), default="undistort")
    models = sorted({name for kind in KINDS.values() for name in kind.models})
    parser.add_argument("--models", nargs="+", choices=models, help="by default the first three of the task")
    parser.add_argument("--seconds", type=float, default=240.0, help="of the processor, for each model, 240")
    parser.add_argument("--size", type=size, default=(192, 336), help="height and width of frames, 192x336")
    parser.add_argument("--scenes", type=count(16), default=512, help="rendered roads to train on, 512")
    parser.add_argument("--val", type=count(1), default=64, help="rendered roads to validate on, 64")
    parser.add_argument("--threads", type=count(1), default=1, help="CPU threads, 1")
    parser.add_argument("--out", type=Path, default=RESULTS / "learning", help="folder of the results")
    return parser


if __name__ == "__main__":
    main()

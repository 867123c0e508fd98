"""The report of a training: its curves, a panel of examples, and a table that compares the model with the baselines."""

import csv
import math
import signal
from collections.abc import Iterable, Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from statistics import fmean
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator
from pytorch_lightning import Callback, LightningModule, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.loggers import CSVLogger
from pytorch_lightning.trainer.states import TrainerFn
from pytorch_lightning.utilities import rank_zero_only
from torch import Tensor

from torchrefract._io import (
    as_path,
    is_remote,
    make_folder,
    matching_files,
    read_bytes,
    write_csv,
    write_figure,
    write_file,
)
from torchrefract.data.drive_lenses import bent_drives
from torchrefract.data.frames import FrameFolder, evenly_spaced
from torchrefract.data.module import PairData, fingerprint
from torchrefract.data.workers import held_signal
from torchrefract.effects.base import Effect
from torchrefract.effects.lens import LensDistortion
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.restoration.metrics import psnr
from torchrefract.restoration.models.lens_net import LensNet
from torchrefract.restoration.module import RestorationModule
from torchrefract.restoration.tasks import Deweather, Restored
from torchrefract.types import Pair
from torchrefract.visualization.color import flow_to_rgb, full_color_px, hatch_invalid
from torchrefract.visualization.figures import MapScale, draw_invalid_key, draw_legend
from torchrefract.visualization.layout import FigureLayout, resize_for_display

METRICS, METRICS_BEFORE = "metrics.csv", "metrics_before.csv"
_PANEL_ROWS = 4
_NAME_WIDTH = 36  # of the first column of the table
_METHODS = {"do nothing": "_identity", "best constant flow": "_constant", "true fog, 8 bits": "_fog", "model": ""}


class RunSummary(Callback):
    """Print on what a run trains, a table that compares the model with the baselines, and a verdict.

    Saves curves.png and panel.png into the run folder.

    Args:
        run_dir: the run folder.
        ckpt_path: the checkpoint that the run resumes from; the metrics next to it are copied into the run folder.
    """

    def __init__(self, run_dir: str, ckpt_path: str | None = None):
        self.run_dir = as_path(run_dir)
        self.resumed_run = None if ckpt_path is None else as_path(ckpt_path).parent
        if self.resumed_run is not None and self.resumed_run.resolve() == self.run_dir.resolve():
            carry_over(self.resumed_run, self.run_dir)  # the logger deletes the table when the run starts
        self._examples: tuple[Restored, Pair] | None = None

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Copy best.ckpt of the run that this one resumes, which ModelCheckpoint would forget in another folder."""
        best = trainer.checkpoint_callback  # of best.ckpt, as the first of its kind
        if self.resumed_run is None or not isinstance(best, ModelCheckpoint) or trainer.state.fn != TrainerFn.FITTING:
            return
        source, target = self.resumed_run / "best.ckpt", self.run_dir / "best.ckpt"
        state = checkpoint["callbacks"].get(best.state_key)
        if not state or state["best_model_score"] is None or not source.is_file():
            return
        if trainer.is_global_zero and source.resolve() != target.resolve():
            make_folder(self.run_dir)
            write_file(target, read_bytes(source))
        path = f"{best.dirpath}/{target.name}"
        state |= {"dirpath": best.dirpath, "best_model_path": path, "kth_best_model_path": path}
        state["best_k_models"] = {path: state["best_model_score"]}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Copy the metrics of the run that this one resumes; print on what it trains."""
        if not trainer.is_global_zero:
            return
        if self.resumed_run is not None:
            carry_over(self.resumed_run, self.run_dir, before_epoch=trainer.current_epoch)
        if isinstance(pl_module, RestorationModule):
            print("\n".join(describe_training(trainer, pl_module)), flush=True)
            data = trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]  # set by `fit`
            has_lenses = data.effect is not None and _has_part(data.effect, LensDistortion)
            if has_lenses and isinstance(data.train, FrameFolder) and (shifts := bent_drives(data.train)):
                print(
                    f"warning: the camera of {', '.join(shifts)} has a lens, which shifts the left and right edge by "
                    f"up to {max(shifts.values()):.1%} of the width. The network will not learn it, and so learns a "
                    "wrong lens: take it out first, by `python -m torchrefract.estimate_lens` and `rectify`",
                    flush=True,
                )

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep examples of the first batch for the panel."""
        if batch_idx == 0:
            self._examples = choose_examples(Restored(**outputs), batch)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Save the pictures; print the table and the files of the run. SIGTERM stops the program afterwards."""
        if trainer.is_global_zero and isinstance(pl_module, RestorationModule):
            with held_signal(signal.SIGTERM):
                self._report(trainer, pl_module, stage)

    def _report(self, trainer: Trainer, pl_module: RestorationModule, stage: str) -> None:
        if self._examples is None:
            if stage == "fit" and trainer.global_step:
                print(self._files())
                print("no best.ckpt and no scores: the training ended before its first validation")
            return
        height, width = pl_module.metric_size
        # With fast_dev_run, the logger writes no metrics.
        if stage == "fit" and any(metrics_rows(self.run_dir)):
            write_figure(self.run_dir / "curves.png", plot_curves(self.run_dir, epe_unit=f"px at {width}x{height}"))
        write_figure(self.run_dir / "panel.png", draw_panel(*self._examples))
        data = getattr(trainer, "datamodule", None)
        border = border_name(data) if isinstance(data, PairData) else ""
        print("\n".join(summary(trainer.callback_metrics, pl_module.metric_size, border=border)))
        print(self._files())
        best = getattr(trainer, "checkpoint_callback", None) if stage == "fit" else None
        print(verdict(trainer.callback_metrics, best=getattr(best, "best_model_score", None)))

    def _files(self) -> str:
        names = sorted(path.name for path in matching_files(self.run_dir, "[!.]*") if path.is_file())
        return f"{self.run_dir}: {', '.join(names)}"


def describe_training(trainer: Trainer, model: RestorationModule) -> list[str]:
    """State on what a run trains and for how long, one line each."""
    data, origin = trainer.datamodule, model.origin  # pyright: ignore[reportAttributeAccessIssue]  # set by `fit`
    train, val = origin["data"], fingerprint(data.val)
    share = val["frames"] / (train["frames"] + val["frames"])
    steps = model.num_steps
    epochs = f"{num} epochs" if (num := trainer.max_epochs or -1) > 0 else "epochs"
    batch = data.batch_size * trainer.world_size * trainer.accumulate_grad_batches
    lines = {
        "frames": f"{train['frames']} of {train['source']}" + (f" {root}" if (root := train["root"]) else ""),
        "drives": "unknown" if train["drives"] is None else str(train["drives"]),
        "size": f"{train['size'][0]}x{train['size'][1]} px, height and width",
        "validation": f"{val['frames']} frames, {share:.0%} of all"
        + ("" if val["drives"] is None else f", of {val['drives']} other drives")
        + ("" if (limit := trainer.limit_val_batches) == 1.0 else f", limit_val_batches {limit}"),
        "steps": f"{steps} in {epochs} of {model.steps_per_epoch}, of {batch} frames each",
        "scene": describe_scene(data, origin["config"]["data"].get("effect")),
    }
    if isinstance(model.network, LensNet) and not isinstance(data.effect, LensDistortion | None):
        lines["scene"] += "; lens_net predicts the flow of a lens alone: add model=resunet for other warps"
    if isinstance(model.task, Deweather) and data.effect is not None and _has_part(data.effect, WarpEffect):
        lines["scene"] += "; it moves pixels too, which deweather does not undo: that takes +task=undistort"
    if model.schedule == "cosine" and (num := model.num_warmup_steps(int(steps))) < model.warmup_steps:
        lines["steps"] += f"; warm-up {num}, a tenth, instead of warmup_steps={model.warmup_steps}"
    return [f"{name:<12}{text}" for name, text in lines.items()]


def _has_part(effect: Effect, kind: type[Effect]) -> bool:
    return any(isinstance(part, kind) for part in effect.modules())


def describe_scene(data: PairData, config: Mapping[str, Any] | None) -> str:
    """Name the scene of data, its severity, and the border of its frames.

    Args:
        data: frames and the scene, or pairs from disk.
        config: of the scene.
    """
    if data.effect is None or config is None:
        return "degraded on disk"
    severity = f" of severity {config['severity']}" if "severity" in config else ""
    border = f", {name}" if (name := border_name(data)) else ""
    return f"{str(config.get('_target_')).rpartition('.')[2]}{severity}{border}"


def border_name(data: PairData) -> str:
    """Name the border of frames behind a lens; empty if they are filled."""
    if data.border is not None:
        return f"{data.border} border"
    parts = () if data.effect is None else data.effect.modules()
    is_padded = any(isinstance(part, LensDistortion) and part.frame == "pad" for part in parts)
    return "padded frames" if is_padded else ""


def summary(metrics: Mapping[str, Tensor], metric_size: tuple[int, int], *, border: str = "") -> list[str]:
    """Format a table of validation scores with a line for each baseline and for the model.

    Args:
        metrics: the scores by name.
        metric_size: (height, width) of the frame whose pixels are the unit of the endpoint error.
        border: of padded frames, which names the rows.
    """
    values = _validation_scores(metrics)
    losses = [name for name in ("L", "L_rec", "L_k") if name in values]
    lines = [f"{'validation':<{_NAME_WIDTH}}{''.join(f'{name:>8}' for name in losses)}{'PSNR (dB)':>18}{'SSIM':>8}"]
    if "psnr_seen" in values:
        lines[0] += f"{'PSNR where t >= 1/255 (dB)':>28}"
    if "epe" in values:
        lines[0] += f"{f'endpoint error (px at {metric_size[1]}x{metric_size[0]})':>40}"
    for name, suffix in _METHODS.items():
        if f"psnr{suffix}" not in values:
            continue
        score = values[f"psnr{suffix}"]
        line = f"{f'{name}, {border}' if border else name:<{_NAME_WIDTH}}"
        line += "".join(f"{values[f'{loss}{suffix}']:8.4f}" for loss in losses)
        line += f"{score:.2f} ({score - values['psnr_identity']:+.2f})".rjust(18)
        line += f"{values.get(f'ssim{suffix}', math.nan):8.3f}"  # a stopped run has none
        if "psnr_seen" in values:
            seen = values[f"psnr_seen{suffix}"]
            line += f"{seen:.2f} ({seen - values['psnr_seen_identity']:+.2f})".rjust(28)
        if "epe" in values:
            epe = values[f"epe{suffix}"]
            line += f"{epe:.2f} ({epe / max(values['epe_identity'], 1e-9):.2f} x do nothing)".rjust(40)
        lines.append(line)
    if "coverage" in values:
        share = f"{values['coverage']:.0%} of the values of the flow within two predicted standard deviations"
        lines.append(f"{'model':<{_NAME_WIDTH}}{share}; 95% if they are right")
    return lines


def verdict(metrics: Mapping[str, Tensor], *, best: Tensor | None = None) -> str:
    """Say by how much a model is better than the baselines, in px for a flow and in dB otherwise.

    Args:
        metrics: the scores by name.
        best: the score of best.ckpt in px or dB; None for the scores of the model in `metrics`.
    """
    values = _validation_scores(metrics)
    name, unit, sign = ("epe", "px", -1) if "epe" in values else ("psnr", "dB", 1)
    score = values[name] if best is None else float(best)
    gains = {
        rival: sign * (score - values[f"{name}{suffix}"])
        for rival, suffix in (("doing nothing", "_identity"), ("the constant flow", "_constant"))
        if f"{name}{suffix}" in values
    }
    model = "the model" if best is None else "best.ckpt"
    better = " and than ".join(f"{rival} by {gain:.2f} {unit}" for rival, gain in gains.items() if gain > 0)
    worse = " or ".join(f"{rival} ({gain:+.2f} {unit})" for rival, gain in gains.items() if not gain > 0)  # or NaN
    if "psnr_fog" in values and unit == "dB":
        limit = values["psnr_fog"] - values["psnr_identity"]
        better += f" (the true fog, in 8 bits, by {limit:.2f} dB)" if better else ""
    if not worse:
        return f"{model}: better than {better}"
    verdict = f"better than {better}, but NOT" if better else "NOT better"
    return f"{model}: {verdict} than {worse}: train longer, on more frames, or at a larger data.size"


def _validation_scores(metrics: Mapping[str, Tensor]) -> dict[str, float]:
    return {name.removeprefix("val/"): float(value) for name, value in metrics.items() if name.startswith("val/")}


def metrics_rows(run: Path) -> Iterator[dict[str, str]]:
    """Yield the rows of metrics of a run folder; rows of runs that it resumes come first."""
    for name in (METRICS_BEFORE, METRICS):
        if (path := run / name).is_file():
            with path.open(newline="") as file:
                yield from csv.DictReader(file)


class MetricsLogger(CSVLogger):
    """Write metrics.csv as Lightning's logger does; in a store, write all rows each time, as some cannot append."""

    @rank_zero_only
    def save(self) -> None:
        """Write the rows of this run, in a store with the further tries of `retried`."""
        if not is_remote(run := as_path(self.log_dir)):
            super().save()
        elif rows := self.experiment.metrics:
            write_csv(run / METRICS, rows)


def carry_over(resumed: Path, run: Path, *, before_epoch: float = math.inf) -> None:
    """Copy the metrics of the epochs below `before_epoch` from the folder `resumed` into the folder `run`."""
    complete = (row for row in metrics_rows(resumed) if _epoch_of(row) < before_epoch)
    # A row that is in both tables counts once.
    rows = [dict(row) for row in dict.fromkeys(tuple(pair for pair in row.items() if pair[1]) for row in complete)]
    if rows:
        write_csv(run / METRICS_BEFORE, rows)


def _epoch_of(row: dict[str, str]) -> float:
    # A killed run can leave an incomplete last row, which lacks its last cells.
    is_complete = None not in row.values() and row.get("epoch", "").isdigit()
    return int(row["epoch"]) if is_complete else math.inf


_STYLES = {  # column -> label, color and line of its curve; without markers, a point between gaps would be invisible
    "train/{}": ("training", "#7fb2dd", "-o"),
    "val/{}": ("validation", "#08306b", "-o"),
    "val/{}_identity": ("do nothing", "#6b6b6b", "--"),
    "val/{}_constant": ("best constant flow", "#d95f02", "--"),
}


def plot_curves(run: Path, *, epe_unit: str) -> Figure:
    """Plot loss, PSNR and endpoint error of a run over its epochs, together with the baselines.

    A quantity without columns gets no plot. Training values are means over the rows of an epoch, validation values the
    last of an epoch; a value that is not finite leaves a gap. Labels hold the last value in brackets.

    Args:
        run: the run folder with the metrics.csv of Lightning's CSVLogger and, after a resume, metrics_before.csv.
        epe_unit: the unit of the endpoint error with the image size that it refers to, such as "px at 1920x1080".

    Raises:
        ValueError: the metrics hold no value to plot.
    """
    units = {"loss": "loss", "psnr": "PSNR (dB)", "epe": f"endpoint error ({epe_unit})"}
    rows = [row for row in metrics_rows(run) if row.get("epoch")]
    shown = {quantity: curves for quantity in units if (curves := _read_curves(rows, quantity))}
    if not shown:
        raise ValueError(f"metrics must hold a loss, psnr or epe of an epoch, got none in {run}")
    figure = Figure(figsize=(4.8 * len(shown), 4.4), dpi=120, layout=ConstrainedLayoutEngine(w_pad=0.12))
    for axes, (quantity, curves) in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown.items(), strict=True):
        for column, curve in curves.items():
            _plot_curve(axes, curve, *_STYLES[column])
        unit = units[quantity]
        axes.set_xlabel("epoch")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.grid(color="#e4e4e4", linewidth=0.8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False, fontsize=9)
        axes.set_ylabel(unit, parse_math=False)
        axes.set_title(f"{unit.split(' (')[0]}, {'higher' if quantity == 'psnr' else 'lower'} is better", fontsize=11)
    return figure


def _read_curves(rows: list[dict[str, str]], quantity: str) -> dict[str, dict[int, float]]:
    """Return the curves of a quantity that have values, by epoch; a logger leaves most cells of a row empty."""
    curves = {}
    for column in _STYLES:
        name, cells = column.format(quantity), dict[int, list[float]]()
        for row in rows:
            if row.get(name):
                cells.setdefault(int(row["epoch"]), []).append(float(row[name]))
        if cells:
            mean_or_last = fmean if name.startswith("train/") else itemgetter(-1)
            curves[column] = {epoch: mean_or_last(cells[epoch]) for epoch in sorted(cells)}
    return curves


def _plot_curve(axes: Axes, curve: dict[int, float], label: str, color: str, line: str) -> None:
    epochs, values = list(curve), list(curve.values())
    label = f"{label} ({values[-1]:.4g})"
    if line == "--" and len(values) == 1:  # a dashed line with one point would be invisible
        axes.axhline(values[0], color=color, linestyle=line, label=label)
    else:
        axes.plot(epochs, values, line, color=color, markersize=3, linewidth=1.6, label=label)


def draw_panel(restored: Restored, pair: Pair) -> Figure:
    """Draw examples, one a row: clean, corrupted, restored, true flow and predicted flow with a common color scale.

    Without a flow, the last column is |restored - clean| times 4. Invalid pixels are hatched from the third column on;
    values that are not finite are gray.
    """
    before, after = (psnr(image, pair.clean, pair.valid) for image in (pair.degraded, restored.image))
    derived = {"restored": restored.image}
    # The scale of the true flow, so that a bad prediction cannot make it pale.
    scale = full_color_px(pair.flow, pair.valid) if restored.flow is not None else 1.0
    if restored.flow is None:
        derived["|restored - clean| x 4"] = 4 * (restored.image.clamp(0, 1) - pair.clean).abs()
    else:
        derived["true flow"] = flow_to_rgb(pair.flow, max_px=scale)
        derived["predicted flow"] = flow_to_rgb(restored.flow, max_px=scale)
    columns = {"clean": resize_for_display(pair.clean), "corrupted": resize_for_display(pair.degraded)}
    columns |= {title: hatch_invalid(resize_for_display(image), pair.valid) for title, image in derived.items()}
    height, width = columns["clean"].shape[2:]
    page = FigureLayout(len(pair.clean), len(columns), height, width, caption_lines=1)
    for j, (title, images) in enumerate(columns.items()):
        page.write(title, page.left(j) + page.width / 2, 2 * page.text, ha="center", weight="bold")
        for i, image in enumerate(images):
            page.show(image, page.left(j), page.top(i))
    for i, (degraded, result) in enumerate(zip(before.tolist(), after.tolist(), strict=True)):
        page.write(f"{degraded:.1f} -> {result:.1f} dB", page.left(0), page.top(i) - 0.3 * page.text)
    bottom = page.top(page.rows)
    if not pair.valid.all():
        draw_invalid_key(page, x=page.left(0), y=bottom)
    if restored.flow is not None:
        x, y = page.left(page.columns - 2), bottom + 2 * page.text
        draw_legend(page, [MapScale("flow", scale)], x=x, y=y)
    return page.figure


def choose_examples(restored: Restored, pair: Pair) -> tuple[Restored, Pair]:
    """Choose up to 4 examples evenly by degradation, so that a mix of effects shows several kinds; on the CPU."""
    order = psnr(pair.degraded, pair.clean, pair.valid).argsort(stable=True)
    rows = order[evenly_spaced(len(order), _PANEL_ROWS)]

    def choose(values: Iterable[Tensor | None]) -> list[Any]:
        return [value if value is None else value[rows].detach().cpu() for value in values]

    return Restored(*choose(restored)), Pair(*choose(pair[:5]))

"""What a run leaves behind: its pictures, and how the model compares with doing nothing."""

from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer
from torch import Tensor

from torchrefract.restoration.metrics import psnr
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.report import PanelRows, save_curves, save_panel
from torchrefract.restoration.tasks import Restored
from torchrefract.types import Pair

_ROWS = 4
_RIVALS = {"do nothing": "_identity", "best constant flow": "_constant", "model": ""}


class RunSummary(Callback):
    """Draws curves.png and panel.png into the run folder, and prints how the model compares with doing nothing.

    Args:
        run_dir: the run folder.
    """

    def __init__(self, run_dir: str):
        self.run_dir = Path(run_dir)
        self._rows: PanelRows | None = None

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """The first rows of the first batch are kept for the panel."""
        if batch_idx == 0:
            self._rows = _panel_rows(outputs, batch)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Pictures and figures of a training."""
        if trainer.is_global_zero and isinstance(pl_module, Restoration):
            height, width = pl_module.metric_size
            save_curves(self.run_dir / "metrics.csv", self.run_dir / "curves.png", epe_unit=f"px at {width}x{height}")
            self._finish(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Panel and figures of an evaluation."""
        if trainer.is_global_zero and trainer.state.fn == "validate" and isinstance(pl_module, Restoration):
            self._finish(trainer, pl_module)

    def _finish(self, trainer: Trainer, model: Restoration) -> None:
        if self._rows is not None:
            save_panel(self._rows, self.run_dir / "panel.png")
        print("\n".join(summary(trainer.callback_metrics, model.metric_size)))
        print(f"{self.run_dir}: {', '.join(sorted(path.name for path in self.run_dir.iterdir() if path.is_file()))}")


def summary(metrics: dict[str, Tensor], metric_size: tuple[int, int]) -> list[str]:
    """The lines of a table: a row for each rival and the model, with what the model gains on doing nothing."""
    values = {name.removeprefix("val/"): float(value) for name, value in metrics.items() if name.startswith("val/")}
    head = f"{'validation':<20}{'PSNR (dB)':>18}{'SSIM':>8}"
    lines = [head + f"{f'endpoint error (px at {metric_size[1]}x{metric_size[0]})':>40}" * ("epe" in values)]
    for name, suffix in _RIVALS.items():
        if f"psnr{suffix}" not in values:
            continue
        gain = values[f"psnr{suffix}"] - values["psnr_identity"]
        line = f"{name:<20}{values[f'psnr{suffix}']:>8.2f} ({gain:+.2f})" + " " * 2
        line += f"{values[f'ssim{suffix}']:>7.3f}" if f"ssim{suffix}" in values else " " * 7
        if "epe" in values:
            share = values[f"epe{suffix}"] / max(values["epe_identity"], 1e-9)
            line += f"{values[f'epe{suffix}']:>18.2f} ({share:.2f} x do nothing)"
        lines.append(line)
    return lines


def _panel_rows(restored: Restored, pair: Pair) -> PanelRows:
    count = min(_ROWS, len(pair.clean))

    def first(value: Tensor) -> Tensor:
        return value[:count].detach().float().cpu()

    return PanelRows(
        degraded=first(pair.degraded),
        clean=first(pair.clean),
        restored=first(restored.image).clamp(0, 1),
        valid=first(pair.valid) > 0,
        captions=_captions(restored, pair, count),
        flow=None if restored.flow is None else first(pair.flow),
        predicted_flow=None if restored.flow is None else first(restored.flow),
    )


def _captions(restored: Restored, pair: Pair, count: int) -> list[str]:
    before, after = (
        psnr(image[:count], pair.clean[:count], pair.valid[:count]) for image in (pair.degraded, restored.image)
    )
    return [f"{a:.1f} -> {b:.1f} dB" for a, b in torch.stack([before, after], dim=1).tolist()]

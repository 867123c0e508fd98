"""What a run leaves behind: its pictures, and how the model compares with doing nothing."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytorch_lightning import Callback, LightningModule, Trainer
from torch import Tensor

from torchrefract.restoration.history import carry_over, metrics_rows
from torchrefract.restoration.metrics import psnr
from torchrefract.restoration.module import Learner
from torchrefract.restoration.report import PanelRows, save_curves, save_panel
from torchrefract.restoration.tasks import Restored
from torchrefract.types import Pair

_ROWS = 4
_RIVALS = {"do nothing": "_identity", "best constant flow": "_constant", "model": ""}


class RunSummary(Callback):
    """Draws curves.png and panel.png into the run folder, and prints how the model compares with doing nothing.

    Args:
        run_dir: the run folder.
        ckpt_path: the checkpoint that the run goes on with; the figures beside it are carried over.
    """

    def __init__(self, run_dir: str, ckpt_path: str | None = None):
        self.run_dir = Path(run_dir)
        self.stopped = None if ckpt_path is None else Path(ckpt_path).parent
        self._rows: PanelRows | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """The figures of the run that was stopped are carried over."""
        if self.stopped is not None and trainer.is_global_zero:
            carry_over(self.stopped, self.run_dir, before_epoch=trainer.current_epoch)

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Some rows of the first batch are kept for the panel."""
        if batch_idx == 0:
            self._rows = _panel_rows(Restored(**outputs), batch)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """The pictures, and the last lines."""
        if self._rows is None or not trainer.is_global_zero or not isinstance(pl_module, Learner):
            return
        height, width = pl_module.metric_size
        # A trial of single batches has no log.
        if stage == "fit" and any(metrics_rows(self.run_dir)):
            save_curves(self.run_dir, self.run_dir / "curves.png", epe_unit=f"px at {width}x{height}")
        save_panel(self._rows, self.run_dir / "panel.png")
        print("\n".join(summary(trainer.callback_metrics, pl_module.metric_size)))
        print(f"{self.run_dir}: {', '.join(sorted(path.name for path in self.run_dir.iterdir() if path.is_file()))}")


def summary(metrics: Mapping[str, Tensor], metric_size: tuple[int, int]) -> list[str]:
    """The lines of a table: a row for each rival and the model, with what it gains on doing nothing."""
    values = {name.removeprefix("val/"): float(value) for name, value in metrics.items() if name.startswith("val/")}
    lines = [f"{'validation':<20}{'PSNR (dB)':>18}{'SSIM':>8}"]
    if "epe" in values:
        lines[0] += f"{f'endpoint error (px at {metric_size[1]}x{metric_size[0]})':>40}"
    for name, suffix in _RIVALS.items():
        if f"psnr{suffix}" in values:
            lines.append(f"{name:<20}" + _scores(values, suffix))
    return lines


def _scores(values: dict[str, float], suffix: str) -> str:
    psnr, ssim = values[f"psnr{suffix}"], values[f"ssim{suffix}"]
    line = f"{psnr:.2f} ({psnr - values['psnr_identity']:+.2f})".rjust(18) + f"{ssim:8.3f}"
    if "epe" in values:
        epe = values[f"epe{suffix}"]
        line += f"{epe:.2f} ({epe / max(values['epe_identity'], 1e-9):.2f} x do nothing)".rjust(40)
    return line


def _panel_rows(restored: Restored, pair: Pair) -> PanelRows:
    """Rows of a batch, evenly from the most degraded sample on: of a mix, hardly two of one kind."""
    before, after = (psnr(image, pair.clean, pair.valid) for image in (pair.degraded, restored.image))
    count = len(pair.clean)
    rows = before.argsort(stable=True)[[i * count // min(_ROWS, count) for i in range(min(_ROWS, count))]]

    def chosen(value: Tensor) -> Tensor:
        return value[rows].detach().float().cpu()

    return PanelRows(
        degraded=chosen(pair.degraded),
        clean=chosen(pair.clean),
        restored=chosen(restored.image).clamp(0, 1),
        valid=chosen(pair.valid) > 0,
        captions=[f"{before[row]:.1f} -> {after[row]:.1f} dB" for row in rows.tolist()],
        flow=None if restored.flow is None else chosen(pair.flow),
        predicted_flow=None if restored.flow is None else chosen(restored.flow),
    )

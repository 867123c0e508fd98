from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from PIL import Image
from torch import nn

from torchrefract import Pair
from torchrefract.restoration import summary as summary_module
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.report import PanelRows
from torchrefract.restoration.summary import RunSummary, summary
from torchrefract.restoration.tasks import Deweather, Restored, Undistort

SCORES = {
    "val/loss": 0.04,
    "val/psnr": 26.0,
    "val/psnr_constant": 25.25,
    "val/psnr_identity": 20.5,
    "val/ssim": 0.8,
    "val/ssim_constant": 0.75,
    "val/ssim_identity": 0.7,
    "val/epe": 5.0,
    "val/epe_constant": 6.0,
    "val/epe_identity": 20.0,
    "train/psnr": 99.0,
    "train/epe": 0.0,
}


def scores(**others: float) -> dict[str, torch.Tensor]:
    named = {f"val/{name}": value for name, value in others.items()}
    return {name: torch.tensor(value) for name, value in (SCORES | named).items()}


def words(lines: list[str]) -> list[str]:
    return [" ".join(line.split()) for line in lines]


def test_the_table_compares_the_model_with_its_rivals():
    head, *rows = summary(scores(), (1080, 1920))
    assert "px at 1920x1080" in head
    assert "PSNR (dB)" in head
    assert words(rows) == [
        "do nothing 20.50 (+0.00) 0.700 20.00 (1.00 x do nothing)",
        "best constant flow 25.25 (+4.75) 0.750 6.00 (0.30 x do nothing)",
        "model 26.00 (+5.50) 0.800 5.00 (0.25 x do nothing)",
    ]
    assert len({len(line) for line in rows}) == 1


def test_a_model_that_makes_it_worse_is_told_so():
    _, _, _, model = summary(scores(psnr=18.0, epe=30.0), (1080, 1920))
    assert model.split()[:3] == ["model", "18.00", "(-2.50)"]
    assert "1.50 x do nothing" in model


def test_the_table_of_a_task_without_a_flow_has_no_endpoint_error():
    metrics = {name: value for name, value in scores().items() if "epe" not in name and "constant" not in name}
    head, *rows = summary(metrics, (1080, 1920))
    assert "endpoint" not in head
    assert words(rows) == ["do nothing 20.50 (+0.00) 0.700", "model 26.00 (+5.50) 0.800"]


def test_a_scene_that_moves_nothing_divides_by_nothing():
    assert len(summary(scores(epe=0.0, epe_constant=0.0, epe_identity=0.0), (1080, 1920))) == 4


def pair(seed: int = 0, batch: int = 6) -> Pair:
    generator = torch.Generator().manual_seed(seed)
    clean = 0.25 + 0.5 * torch.rand(batch, 3, 20, 30, generator=generator)
    flow = torch.randn(batch, 2, 20, 30, generator=generator)
    return Pair(clean + 0.1, clean, flow, torch.ones(batch, 1, 20, 30, dtype=torch.bool), torch.arange(batch))


def finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, task: Any, *batches: Pair, rank: int = 0
) -> list[PanelRows]:
    """What a summary draws after a validation of these batches, whose restoration is off by 0.01."""
    drawn: list[PanelRows] = []
    monkeypatch.setattr(summary_module, "save_panel", lambda rows, out: drawn.append(rows))
    trainer: Any = SimpleNamespace(is_global_zero=rank == 0, callback_metrics=scores())
    model, callback = Restoration(lambda channels, smooth: nn.Conv2d(3, channels, 1), task), RunSummary(str(tmp_path))
    for number, batch in enumerate(batches):
        flow = 2 * batch.flow if isinstance(task, Undistort) else None
        outputs = Restored(batch.clean + 0.01, flow)._asdict()
        callback.on_validation_batch_end(trainer, model, outputs, batch, number)
    callback.teardown(trainer, model, "validate")
    return drawn


def test_the_panel_shows_four_of_the_first_batch_from_the_most_degraded_on(tmp_path, monkeypatch):
    first = pair()
    off = torch.tensor([0.01, 0.1, 0.02, 0.2, 0.05, 0.04])
    first = first._replace(degraded=first.clean + off.view(6, 1, 1, 1))
    shown = [3, 1, 5, 2]  # of 3 1 4 5 2 0
    (rows,) = finished(tmp_path, monkeypatch, Undistort(), first, pair(seed=1))
    assert torch.equal(rows.clean, first.clean[shown])
    assert torch.equal(rows.degraded, first.degraded[shown])
    assert torch.equal(rows.restored, first.clean[shown] + 0.01)
    assert rows.flow is not None
    assert rows.predicted_flow is not None
    assert torch.equal(rows.flow, first.flow[shown])
    assert torch.equal(rows.predicted_flow, 2 * first.flow[shown])
    # Off by 0.1 is 20 dB, off by 0.01 is 40 dB.
    assert rows.captions == [f"{before} -> 40.0 dB" for before in ("14.0", "20.0", "28.0", "34.0")]


def test_the_panel_of_a_task_without_a_flow_has_none(tmp_path, monkeypatch):
    (rows,) = finished(tmp_path, monkeypatch, Deweather(), pair(batch=2))
    assert rows.flow is None
    assert rows.predicted_flow is None
    assert len(rows.clean) == 2


def test_the_last_line_says_where_everything_is(tmp_path, monkeypatch, capsys):
    for name in ("last.ckpt", "best.ckpt", "config.yaml"):
        (tmp_path / name).touch()
    (tmp_path / "folder").mkdir()
    finished(tmp_path, monkeypatch, Undistort(), pair())
    lines = capsys.readouterr().out.splitlines()
    assert lines[:-1] == summary(scores(), (1080, 1920))
    assert lines[-1] == f"{tmp_path}: best.ckpt, config.yaml, last.ckpt"


def test_a_second_rank_says_and_draws_nothing(tmp_path, monkeypatch, capsys):
    assert finished(tmp_path, monkeypatch, Undistort(), pair(), rank=1) == []
    assert capsys.readouterr().out == ""


def test_a_run_that_validated_nothing_says_and_draws_nothing(tmp_path, monkeypatch, capsys):
    assert finished(tmp_path, monkeypatch, Undistort()) == []
    assert capsys.readouterr().out == ""


def test_a_training_leaves_both_pictures(tmp_path):
    (tmp_path / "metrics.csv").write_text("epoch,step,train/loss,val/loss\n0,3,,0.3\n0,3,0.5,\n1,7,,0.2\n1,7,0.4,\n")
    trainer: Any = SimpleNamespace(is_global_zero=True, callback_metrics=scores())
    model, callback, batch = (
        Restoration(lambda c, smooth: nn.Conv2d(3, c, 1), Undistort()),
        RunSummary(str(tmp_path)),
        pair(),
    )
    callback.on_validation_batch_end(trainer, model, Restored(batch.degraded, batch.flow)._asdict(), batch, 0)
    callback.teardown(trainer, model, "fit")
    for name in ("curves.png", "panel.png"):
        with Image.open(tmp_path / name) as picture:
            assert min(picture.size) > 300

import csv
from pathlib import Path

import pytest

from torchrefract.restoration.history import carry_over, metrics_rows


@pytest.fixture
def stopped(tmp_path: Path) -> Path:
    """A run folder whose run goes on with another one and was itself stopped in epoch 2, in the middle of a row."""
    folder = tmp_path / "stopped"
    folder.mkdir()
    (folder / "metrics_before.csv").write_text("epoch,val/loss\n0,9\n")
    (folder / "metrics.csv").write_text("epoch,val/loss,val/epe\n1,8,70\n2,7,60\n2")
    return folder


def test_what_a_stopped_run_had_measured_before_the_checkpoint_comes_first(stopped: Path, tmp_path: Path):
    run = tmp_path / "run"
    run.mkdir()
    carry_over(stopped, run, before_epoch=2)
    (run / "metrics.csv").write_text("epoch,val/loss\n2,6\n3,5\n")
    losses = [(int(row["epoch"]), float(row["val/loss"])) for row in metrics_rows(run)]
    assert losses == [(0, 9), (1, 8), (2, 6), (3, 5)]
    with (run / "metrics_before.csv").open(newline="") as file:
        assert [row["val/epe"] for row in csv.DictReader(file)] == ["", "70"]


def test_a_row_cut_short_is_not_carried_over(stopped: Path, tmp_path: Path):
    carry_over(stopped, tmp_path, before_epoch=3)
    assert [row["epoch"] for row in metrics_rows(tmp_path)] == ["0", "1", "2"]
    assert all(row["val/loss"] for row in metrics_rows(tmp_path))


def test_a_folder_without_metrics_leaves_no_file(tmp_path: Path):
    run = tmp_path / "run"
    run.mkdir()
    carry_over(tmp_path, run, before_epoch=5)
    assert list(run.iterdir()) == []

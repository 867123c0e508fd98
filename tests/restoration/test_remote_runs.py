"""Run folders and checkpoints in object stores."""

import os
import signal

import numpy as np
import pytest
from PIL import Image
from stores import failing_writes

from torchrefract._io import as_path
from torchrefract.restoration.checkpoints import read_checkpoint
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.report import metrics_rows

pytestmark = pytest.mark.usefixtures("blank_figures")


@pytest.fixture(params=["memory", "s3", "gs"])
def store(request, monkeypatch) -> str:
    """Return the address of an empty folder in a store, without pauses before further tries."""
    monkeypatch.setattr("torchrefract._io._PAUSES", (0.0, 0.0, 0.0))
    if request.param != "memory":
        request.getfixturevalue(request.param)
    return f"{request.param}://bucket/runs"


def test_a_run_in_a_store_is_stopped_continued_scored_and_applied(call, small, store, tmp_path, monkeypatch):
    step = Restoration.training_step

    def stopped_step(self, batch, index):
        if (self.current_epoch, index) == (1, 1):
            os.kill(os.getpid(), signal.SIGTERM)
        return step(self, batch, index)

    with monkeypatch.context() as patch:
        patch.setattr(Restoration, "training_step", stopped_step)
        outcome = call("train", "+task=undistort", *small, f"run_dir={store}/a")
    last = f"{store}/a/last.ckpt"
    assert (outcome.code, outcome.err) == (143, f"stopped by SIGTERM in step 6; ckpt_path={last} continues\n")
    assert call("train", "+task=undistort", *small, f"run_dir={store}/a", f"ckpt_path={last}").code == 0
    files = ["best.ckpt", "config.yaml", "curves.png", "last.ckpt", "metrics.csv", "metrics_before.csv", "panel.png"]
    assert sorted(path.name for path in as_path(f"{store}/a").iterdir()) == files
    epochs = [row["epoch"] for row in metrics_rows(as_path(f"{store}/a")) if row.get("val/loss")]
    assert epochs == ["0", "1"]  # Google's storage cannot append to a file
    assert read_checkpoint(as_path(last), task="undistort")["global_step"] == 8
    outcome = call("eval", f"ckpt_path={store}/a/best.ckpt")
    assert f"scoring {store}/a/best.ckpt on 4 validation frames of RoadScenes" in outcome.out
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "raw.png")
    assert call("restore", f"ckpt_path={store}/a/best.ckpt", "input=raw.png", "out=out").code == 0
    assert np.abs(np.asarray(Image.open(tmp_path / "out" / "raw.png")).astype(float) - pixels).mean() > 1
    assert not [name for name in os.listdir(tmp_path) if name.startswith(("memory:", "s3:", "gs:"))]


def test_a_checkpoint_that_is_missing_in_a_store_is_one_line_of_error(call, small, store):
    message = call("train", "+task=undistort", *small, f"ckpt_path={store}/none.ckpt").message
    expected = "ckpt_path must be a checkpoint file, such as <run>/last.ckpt, or the name lens_small, got "
    assert message == f"{expected}{store}/none.ckpt"


def test_a_run_folder_in_a_store_that_denies_writing_is_one_line_of_error(call, small):
    with failing_writes(PermissionError("Access Denied")):
        message = call("train", "+task=undistort", *small, "run_dir=memory://denied").message
    condition = "run_dir must name what can be read or written"
    assert message == f"{condition}, got memory://denied/config.yaml: Permission denied"

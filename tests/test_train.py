import csv
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from torchrefract.data.pairs import PairedFolder
from torchrefract.restoration.checkpoints import read_checkpoint

# A run that goes on leaves best.ckpt of the one before where it is; Lightning says so.

FILES = ["best.ckpt", "config.yaml", "curves.png", "last.ckpt", "metrics.csv", "panel.png"]
# A training that ends itself as `kill -9` would, in the middle of its second epoch.
KILLED = """
import os, signal
from torchrefract.restoration.module import Restoration
from torchrefract.train import main

step = Restoration.training_step

def dying_step(self, batch, index):
    if (self.current_epoch, index) == (1, 2):
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self, batch, index)

Restoration.training_step = dying_step
main()
"""


def metrics(run: Path, name: str, *, file: str = "metrics.csv") -> dict[int, float]:
    """The last value of each epoch in a table of a run."""
    with (run / file).open(newline="") as table:
        return {int(row["epoch"]): float(row[name]) for row in csv.DictReader(table) if row[name]}


@pytest.fixture(scope="module")
def stopped(tmp_path_factory, spawn, small) -> Path:
    """The folder of a run that was killed."""
    folder = tmp_path_factory.mktemp("stopped")
    outcome = spawn("-c", KILLED, "+task=undistort", *small, "hydra.run.dir=run", cwd=folder)
    assert outcome.code == -signal.SIGKILL, outcome.err
    return folder / "run"


def test_a_run_folder_holds_everything(trained):
    assert sorted(path.name for path in trained.folder.iterdir()) == FILES
    assert trained.folder.parts[-3:-1] == ("runs", "undistort")
    for name in ("curves.png", "panel.png"):
        with Image.open(trained.folder / name) as picture:
            picture.load()
            assert min(picture.size) > 300


def test_the_configuration_of_a_run_is_resolved_and_repeats_it(trained):
    text = (trained.folder / "config.yaml").read_text()
    assert "${" not in text
    assert "???" not in text
    configuration: Any = OmegaConf.create(text)
    assert configuration.data.train_count == 32
    assert configuration.model.network.encoder == "tu-mobilenetv3_small_050"
    assert configuration.data.effect._target_ == "torchrefract.presets.cheap_dashcam"
    assert configuration.run_dir == str(trained.folder)


def test_a_run_says_last_how_the_model_compares_and_where_everything_is(trained):
    head, nothing, constant, model, where = trained.outcome.out.splitlines()[-5:]
    assert "px at 1920x1080" in head
    assert nothing.startswith("do nothing ")
    assert "(1.00 x do nothing)" in nothing
    assert constant.startswith("best constant flow ")
    assert where == f"{trained.folder}: {', '.join(FILES)}"
    last = {
        name: metrics(trained.folder, f"val/{name}")[2] for name in ("psnr", "psnr_identity", "epe", "epe_identity")
    }
    assert model.split()[:3] == ["model", f"{last['psnr']:.2f}", f"({last['psnr'] - last['psnr_identity']:+.2f})"]
    assert f"{last['epe']:.2f} ({last['epe'] / last['epe_identity']:.2f} x do nothing)" in model


def test_a_run_has_no_traceback_and_no_advice_of_libraries(trained):
    assert trained.outcome.err == ""
    for word in ("Traceback", "Warning", "Tip:"):
        assert word not in trained.outcome.out


def test_each_epoch_has_its_scores_of_training_and_validation(trained):
    for name in ("train/loss", "train/psnr", "train/epe", "val/loss", "val/psnr", "val/epe", "val/epe_constant"):
        assert sorted(metrics(trained.folder, name)) == [0, 1, 2]
    loss = metrics(trained.folder, "train/loss")
    assert loss[2] < loss[0]


def test_doing_nothing_scores_the_same_in_every_epoch(trained):
    for name in ("val/psnr_identity", "val/epe_identity", "val/ssim_identity"):
        assert len(set(metrics(trained.folder, name).values())) == 1


def test_the_checkpoints_are_those_of_the_last_and_of_the_best_epoch(trained):
    loss = metrics(trained.folder, "val/loss")
    assert read_checkpoint(trained.folder / "last.ckpt", task="undistort")["epoch"] == 2
    assert read_checkpoint(trained.folder / "best.ckpt", task="undistort")["epoch"] == min(loss, key=loss.__getitem__)


def test_a_kill_in_mid_epoch_leaves_the_checkpoint_of_the_epoch_before(stopped):
    assert read_checkpoint(stopped / "last.ckpt", task="undistort")["epoch"] == 0
    assert read_checkpoint(stopped / "best.ckpt", task="undistort")["epoch"] == 0


def test_a_stopped_run_goes_on_at_its_epoch_and_ends_as_if_never_stopped(call, stopped, trained):
    outcome = call("train", *trained.words, f"ckpt_path={stopped / 'last.ckpt'}", "hydra.run.dir=run")
    assert "Traceback" not in outcome.err
    folder = outcome.folder
    assert {*FILES} <= {path.name for path in folder.iterdir()}
    for name in ("train/loss", "train/epe", "val/loss", "val/psnr", "val/epe", "val/epe_constant"):
        found, expected = metrics(folder, name), metrics(trained.folder, name)
        assert sorted(found) == [1, 2]
        assert metrics(folder, name, file="metrics_before.csv") == pytest.approx({0: expected[0]}, rel=1e-3)
        assert found == pytest.approx({epoch: expected[epoch] for epoch in (1, 2)}, rel=1e-3)
    weights, others = (
        read_checkpoint(run / "last.ckpt", task="undistort")["state_dict"] for run in (folder, trained.folder)
    )
    name = "network.network.segmentation_head.0.weight"
    assert torch.allclose(weights[name], others[name], rtol=0, atol=1e-4)


def test_a_finished_run_says_that_nothing_is_left_to_do(call, trained):
    outcome = call("train", *trained.words, f"ckpt_path={trained.folder / 'last.ckpt'}", "hydra.run.dir=run")
    assert "trainer.max_epochs" in outcome.message


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("+task=undistort", "scene=cape_town_fog"),
            "data: effect must have a flow, as a lens has, got HeterogeneousFog",
        ),
        (
            ("+task=deweather", "task.transmission_head=true", "scene=cheap_dashcam"),
            "data: effect must have a transmission, as fog has, got LensDistortion",
        ),
        (("+task=undistort", "run_dir=/dev/null/run"), "run_dir: "),
        (("+task=undistort", "model.lr=nan"), "model: lr must not be NaN, got nan"),
        (("+task=undistort", "model.weight_decay=-1"), "model: weight_decay must be a number of at least 0, got -1"),
        (("+task=undistort", "model.warmup_steps=-1"), "model: warmup_steps must be at least 0, got -1"),
        (("+task=undistort", "model.metric_size=[1080]"), "model: metric_size must be (height, width), got [1080]"),
    ],
)
def test_what_cannot_be_trained_is_one_line_of_error(call, small, words, message):
    assert call("train", *small, *words).message.startswith(message)


def test_a_run_folder_that_is_not_there_yet_is_made(call, small, tmp_path):
    assert call("train", "+task=undistort", *small, "trainer.max_epochs=1", "run_dir=new/run").code == 0
    assert sorted(path.name for path in (tmp_path / "new" / "run").iterdir()) == FILES


def test_a_damaged_pair_is_one_line_of_error(call, small, tmp_path):
    (tmp_path / "frames").mkdir()
    for drive in "ab":
        for i in range(4):
            pixels = np.random.default_rng(i).integers(0, 256, (36, 48, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(tmp_path / "frames" / f"{drive}_{i}.png")
    words = ("scene=cheap_dashcam", "source=frames", "out=out", "license=CC0", "workers=0")
    assert call("generate", *words).code == 0
    stored = PairedFolder(tmp_path / "out", split="train")
    last = stored.row(len(stored) - 1)
    (tmp_path / "out" / last.files["clean.png"].path).write_bytes(b"")
    model = [word for word in small if not word.startswith("data.")]
    options = ("data=pairs", "data.root=out", "data.batch_size=2", "data.workers=1")
    outcome = call("train", "+task=undistort", *model, *options)
    assert outcome.code == 1
    message = f"error: pair {last.number} in out must be whole, got out/{last.files['clean.png'].path} is "
    assert outcome.err.splitlines()[-1].startswith(message), outcome.err


def test_deweathering_is_trained_by_the_same_command(call, small, tmp_path):
    outcome = call("train", "+task=deweather", *small, "trainer.max_epochs=1", "hydra.run.dir=run")
    folder = outcome.folder
    assert folder == tmp_path / "run"
    assert sorted(path.name for path in folder.iterdir()) == FILES
    head, nothing, model = outcome.out.splitlines()[-4:-1]
    assert "endpoint" not in head
    assert (nothing[:10], model[:5]) == ("do nothing", "model")
    assert read_checkpoint(folder / "last.ckpt", task="deweather")["epoch"] == 0

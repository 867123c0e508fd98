import csv

import pytest
from omegaconf import OmegaConf

from torchrefract.restoration.checkpoints import read_checkpoint

# The folder that best.ckpt lies in is another than that of the evaluation; Lightning says so.


def test_an_evaluation_without_a_checkpoint_asks_for_one(call, small):
    message = call("eval", "+task=undistort", *small, "hydra.run.dir=scored").message
    assert message == "ckpt_path must be the path of a checkpoint: add ckpt_path=<run>/best.ckpt, got none"


def test_an_evaluation_finds_the_scores_of_the_training(call, trained, tmp_path):
    outcome = call("eval", *trained.words, f"ckpt_path={trained.folder / 'best.ckpt'}", "hydra.run.dir=scored")
    assert outcome.folder == tmp_path / "scored"
    best = read_checkpoint(trained.folder / "best.ckpt", task="undistort")["epoch"]
    with (trained.folder / "metrics.csv").open(newline="") as file:
        expected = next(row for row in csv.DictReader(file) if row["epoch"] == str(best) and row["val/loss"])
    with (tmp_path / "scored" / "metrics.csv").open(newline="") as file:
        (found,) = csv.DictReader(file)
    names = [name for name in expected if name.startswith("val/")]
    assert {"val/psnr", "val/epe", "val/epe_constant", "val/ssim_identity"} <= set(names)
    assert {name: float(found[name]) for name in names} == pytest.approx(
        {name: float(expected[name]) for name in names}, rel=1e-4
    )
    assert {"config.yaml", "metrics.csv", "panel.png"} == {path.name for path in (tmp_path / "scored").iterdir()}


def test_an_evaluation_leaves_the_training_alone(call, trained, tmp_path):
    before = {path: path.stat().st_mtime_ns for path in trained.folder.iterdir()}
    outcome = call("eval", *trained.words, f"ckpt_path={trained.folder / 'last.ckpt'}")
    assert outcome.folder.is_relative_to(tmp_path / "runs" / "eval_undistort")
    assert {path: path.stat().st_mtime_ns for path in trained.folder.iterdir()} == before
    assert OmegaConf.select(OmegaConf.load(outcome.folder / "config.yaml"), "ckpt_path") == str(
        trained.folder / "last.ckpt"
    )


def test_a_checkpoint_of_another_task_is_refused(call, trained, small):
    message = call("eval", "+task=deweather", *small, f"ckpt_path={trained.folder / 'best.ckpt'}").message
    assert message.endswith(f"a checkpoint of the task deweather, got {trained.folder / 'best.ckpt'} of undistort")

import csv
import os
import re
import shutil
import signal
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from pictures import save_picture
from PIL import Image
from processes import running, wait_for
from torch.utils.data import DataLoader

from torchrefract import presets
from torchrefract.data.module import make_pair
from torchrefract.data.pairs import PairedFolder
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.restoration.checkpoints import AtomicCheckpointIO, read_checkpoint
from torchrefract.restoration.metrics import endpoint_error, psnr
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.report import metrics_rows

pytestmark = pytest.mark.usefixtures("blank_figures")  # `trained`, a process of its own, draws them
FILES = ["best.ckpt", "config.yaml", "curves.png", "last.ckpt", "metrics.csv", "panel.png"]
DDPM = ("model=ddpm_image", "model.network.widths=[8,16]", "model.network.attention=[false,true]")
DDPM += ("model.network.layers=1",)
DDPM += ("model.network.groups=4", "model.val_steps=3", "model.lr=0.002", "data.train_count=8", "data.val_count=4")
DDPM += ("data.batch_size=4", "data.size=[16,32]", "data.workers=0")


def metrics(run: Path, name: str, *, file: str = "metrics.csv") -> dict[int, float]:
    """Return the last value of each epoch in a table of a run."""
    with (run / file).open(newline="") as table:
        return {int(row["epoch"]): float(row[name]) for row in csv.DictReader(table) if row[name]}


def test_a_run_folder_holds_checkpoints_pictures_and_the_resolved_configuration(trained):
    assert sorted(path.name for path in trained.folder.iterdir()) == FILES
    assert trained.folder.parts[-3:-1] == ("runs", "undistort")
    for name in ("curves.png", "panel.png"):
        with Image.open(trained.folder / name) as picture:
            picture.load()
            assert min(picture.size) > 300
    text = (trained.folder / "config.yaml").read_text()
    assert "${" not in text
    assert "???" not in text
    config: Any = OmegaConf.create(text)
    assert config.data.train_count == 8
    assert config.model.network.encoder == "tu-test_resnet"
    assert config.data.effect._target_ == "torchrefract.presets.cheap_dashcam"
    assert config.run_dir == str(trained.folder)


def test_a_run_prints_a_comparison_with_the_baselines_and_nothing_of_the_libraries(trained):
    head, nothing, constant, model, files, verdict = trained.outcome.out.splitlines()[-6:]
    assert "px at 1920x1080" in head
    assert nothing.startswith("do nothing ")
    assert "(1.00 x do nothing)" in nothing
    assert constant.startswith("best constant flow ")
    assert files == f"{trained.folder}: {', '.join(FILES)}"
    psnr, nothing_psnr, epe, nothing_epe = (
        metrics(trained.folder, f"val/{name}")[1] for name in ("psnr", "psnr_identity", "epe", "epe_identity")
    )
    losses = [f"{metrics(trained.folder, f'val/{name}')[1]:.4f}" for name in ("L", "L_rec", "L_k")]
    assert model.split()[:6] == ["model", *losses, f"{psnr:.2f}", f"({psnr - nothing_psnr:+.2f})"]
    assert f"{epe:.2f} ({epe / nothing_epe:.2f} x do nothing)" in model
    gains = [metrics(trained.folder, f"val/epe_{rival}")[1] for rival in ("identity", "constant")]
    best = min(metrics(trained.folder, "val/epe").values())
    assert verdict.startswith("best.ckpt: ")
    assert "NOT better" in verdict or "but NOT" in verdict or min(gains) > best
    assert f"doing nothing by {gains[0] - best:.2f} px" in verdict
    assert f"the constant flow ({gains[1] - best:+.2f} px)" in verdict
    assert trained.outcome.err == "torchrefract: loading …\n"
    for word in ("Traceback", "Warning", "Tip:"):
        assert word not in trained.outcome.out


def test_a_run_says_on_what_it_trains_before_it_starts(trained):
    words = [" ".join(line.split()) for line in trained.outcome.out.splitlines()[:6]]
    assert words == [
        "frames 8 of RoadScenes",
        "drives unknown",
        "size 32x64 px, height and width",
        "validation 4 frames, 33% of all",
        "steps 8 in 2 epochs of 4, of 2 frames each; warm-up 0, a tenth, instead of warmup_steps=50",
        "scene cheap_dashcam of severity 3",
    ]


def test_a_network_of_lenses_says_so_for_other_warps(call, small):
    words = (*(word for word in small if word.startswith("data.")), "+trainer.max_steps=1")
    haze = call("train", "+task=undistort", "scene=highveld_heat_haze", *words).out
    assert "severity 3; lens_net predicts the flow of a lens alone: add model=resunet for other warps" in haze


def test_a_deweathering_of_a_scene_that_moves_pixels_says_what_it_cannot_undo(call, small):
    words = ("+task=deweather", *small, "+trainer.max_steps=1")
    dust = call("train", *words, "scene=unpaved_road", "run_dir=dust").out
    assert "severity 3; it moves pixels too, which deweather does not undo: that takes +task=undistort" in dust
    assert "severity 3\n" in call("train", *words, "scene=cape_town_fog", "run_dir=fog").out


def test_a_training_on_frames_without_depth_maps_names_its_option(call, small, tmp_path):
    for name in ("train/0.png", "train/1.png", "val/0.png"):
        save_picture(tmp_path / "frames" / name, np.full((32, 64, 3), 90, np.uint8))
    words = (*(word for word in small if "count" not in word), "data=frames", "data.root=frames")
    outcome = call("train", "+task=deweather", "scene=cape_town_fog", *words, "trainer.max_epochs=0", "run_dir=run")
    assert outcome.code == 0
    assert outcome.err == (
        "warning: HeterogeneousFog assumes the depth of a road between walls; depth maps, as estimate_depth writes "
        "them, are better: data.depth=...; a camera that looks down needs horizon=..., taken as 0.55\n"
    )


def test_each_epoch_logs_its_scores_and_constant_baselines(trained):
    for name in ("train/loss", "train/psnr", "train/epe", "val/loss", "val/psnr", "val/epe", "val/epe_constant"):
        assert sorted(metrics(trained.folder, name)) == [0, 1]
    loss = metrics(trained.folder, "train/loss")
    assert loss[1] < loss[0]
    for name in ("val/psnr_identity", "val/epe_identity", "val/ssim_identity"):
        assert len(set(metrics(trained.folder, name).values())) == 1


def test_the_checkpoints_are_those_of_the_last_and_of_the_best_epoch(trained):
    epe = metrics(trained.folder, "val/epe")
    assert read_checkpoint(trained.folder / "last.ckpt", task="undistort")["epoch"] == 1
    assert read_checkpoint(trained.folder / "best.ckpt", task="undistort")["epoch"] == min(epe, key=epe.__getitem__)


def test_the_checkpoint_of_a_training_is_sufficient_to_restore(call, tmp_path, trained):
    raw, best = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8), trained.folder / "best.ckpt"
    Image.fromarray(raw).save(tmp_path / "raw.png")
    assert call("restore", f"ckpt_path={best}", "input=raw.png", "out=out").code == 0
    restored = np.asarray(Image.open(tmp_path / "out" / "raw.png"))
    assert np.abs(restored.astype(float) - raw).mean() > 1
    checkpoint = read_checkpoint(best)
    assert checkpoint["config"]["data"]["train_count"] == 8
    data = checkpoint["data"]
    assert (data["source"], data["frames"], data["size"], data["license"]) == ("RoadScenes", 8, [32, 64], None)
    assert checkpoint["licenses"] == {"data": None, "pretrained weights": None}


def test_a_stopped_or_killed_run_continues_to_the_end_of_an_uninterrupted_one(call, trained, monkeypatch):
    words, run, killed = (*trained.words, "hydra.run.dir=run"), Path("run").resolve(), Path("killed").resolve()
    step = Restoration.training_step

    def stop_in_second_epoch(self, batch, index):
        if (self.current_epoch, index) == (1, 1):
            shutil.copytree(run, killed)  # the files that SIGKILL would leave now
            os.kill(os.getpid(), signal.SIGTERM)
        return step(self, batch, index)

    with monkeypatch.context() as patch:
        patch.setattr(Restoration, "training_step", stop_in_second_epoch)
        outcome = call("train", *words)
    last = run / "last.ckpt"
    assert (outcome.code, outcome.err) == (143, f"stopped by SIGTERM in step 6; ckpt_path={last} continues\n")
    for name in ("last.ckpt", "best.ckpt"):
        assert read_checkpoint(killed / name, task="undistort")["epoch"] == 0
    before = metrics(run, "val/loss")
    for name in (".last.part.ckpt", ".best-0123abcd.ckpt"):
        (run / name).touch()
    outcome = call("train", *words, f"ckpt_path={last}")
    assert (outcome.code, outcome.err) == (0, "")
    assert metrics(run, "val/loss", file="metrics_before.csv") == before
    assert sorted(metrics(run, "val/loss")) == [1]
    assert not list(run.glob(".*"))
    folder = call("train", *trained.words, f"ckpt_path={killed / 'last.ckpt'}", "hydra.run.dir=again").folder
    assert {*FILES} <= {path.name for path in folder.iterdir()}
    for name in ("train/loss", "train/epe", "val/loss", "val/psnr", "val/epe", "val/epe_constant"):
        resumed, expected = metrics(folder, name), metrics(trained.folder, name)
        assert metrics(folder, name, file="metrics_before.csv") == pytest.approx({0: expected[0]}, rel=1e-3)
        assert resumed == pytest.approx({1: expected[1]}, rel=1e-3)
    expected = read_checkpoint(trained.folder / "last.ckpt")["state_dict"]
    for path in (run, folder):
        weights = read_checkpoint(path / "last.ckpt")["state_dict"]
        assert all(torch.allclose(weights[name], expected[name], rtol=0, atol=1e-4) for name in expected)


def test_sigterm_during_the_report_of_a_training_stops_it_behind_the_verdict(call, trained, monkeypatch):
    def stop(number: int, frame: Any) -> None:
        raise SystemExit(128 + number)

    def save(figure: Any, path: Any, **options: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        path.write(b"a picture")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", save)
    before = signal.signal(signal.SIGTERM, stop)
    try:
        outcome = call("eval", f"ckpt_path={trained.folder / 'best.ckpt'}", "run_dir=run", "data.workers=0")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert outcome.code == 143
    assert Path("run/panel.png").read_bytes() == b"a picture"
    assert outcome.out.rstrip().splitlines()[-1].startswith("the model: ")


def test_several_processes_with_a_trainer_of_one_raise(call, trained, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    message = call("train", *trained.words, "hydra.run.dir=run").message
    assert message.startswith("trainer must be ddp with trainer.devices=2 under torchrun, got one that uses 1 of 2")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "1")
    message = call("train", *trained.words, "hydra.run.dir=run").message
    assert message.startswith("trainer must be ddp with trainer.devices=1 and trainer.num_nodes=2 under torchrun, got")


STOPPED = """
import os, signal, time
from pathlib import Path
from torchrefract.restoration.module import Restoration
from torchrefract.train import main

step = Restoration.training_step

def recorded_step(self, batch, index):
    with Path(f"keys{self.global_rank}.txt").open("a") as file:
        print(self.current_epoch, *batch.key.tolist(), file=file)
    if self.global_step == 2 and self.trainer.is_global_zero and not Path("run/stopped").exists():
        Path("run/stopped").touch()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1)  # the other process waits for the gradients of this one
    return step(self, batch, index)

Restoration.training_step = recorded_step
main()
"""


def test_a_training_in_two_processes_stops_on_sigterm_in_one_step_and_continues_at_the_next(small, tmp_path):
    (tmp_path / "stopped.py").write_text(STOPPED)
    words = ("+task=undistort", *small, "trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "run_dir=run")
    with running("stopped.py", *words, cwd=tmp_path) as process:
        _, message = process.communicate(timeout=120)
    assert process.returncode == 143, message
    (line,) = (line for line in message.splitlines() if line.startswith("stopped by SIGTERM"))
    assert line == "stopped by SIGTERM in step 3; ckpt_path=run/last.ckpt continues"
    assert read_checkpoint(tmp_path / "run" / "last.ckpt", task="undistort")["global_step"] == 3
    with running("stopped.py", *words, "ckpt_path=run/last.ckpt", cwd=tmp_path) as process:
        _, message = process.communicate(timeout=120)
    assert process.returncode == 0, message
    lines = [line.split() for rank in range(2) for line in (tmp_path / f"keys{rank}.txt").read_text().splitlines()]
    batches = [(epoch, key) for epoch, *keys in lines for key in keys]
    assert len({key for _, key in batches}) == 8
    assert sorted(batches) == sorted({(epoch, key) for epoch in "01" for _, key in batches})


def test_a_process_of_a_training_ends_when_the_first_one_is_killed_while_it_loads(small, tmp_path):
    words = ("+task=undistort", *small, "trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "run_dir=run")
    with running("-m", "torchrefract.train", *words, cwd=tmp_path) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        wait_for(lambda: "train_ddp_process_1" in commands(children.read_text().split()), process)
        process.kill()
        process.communicate(timeout=120)  # ends with the last process


def commands(processes: list[str]) -> str:
    """Return the command lines of processes."""
    return " ".join(path.read_text() for number in processes if (path := Path(f"/proc/{number}/cmdline")).exists())


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (signal.SIGTERM, "stopped by SIGTERM; the same command starts again\n"),
        (signal.SIGINT, "stopped; the same command starts again\n"),
    ],
)
def test_an_evaluation_that_is_stopped_has_the_status_of_the_signal(call, trained, monkeypatch, number, message):
    step = Restoration.validation_step

    def stop(self, batch, index):
        os.kill(os.getpid(), number)
        return step(self, batch, index)

    monkeypatch.setattr(Restoration, "validation_step", stop)
    # A shell lets programs in the background ignore an interrupt, and Lightning ignores further ones.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        outcome = call("eval", f"ckpt_path={trained.folder / 'best.ckpt'}", "data.workers=0", "data.batch_size=1")
    finally:
        signal.signal(signal.SIGINT, before)
    assert (outcome.code, outcome.err) == (128 + number, message)


def test_sigterm_in_the_last_validation_has_its_status_behind_the_report(call, small, monkeypatch):
    step = Restoration.validation_step

    def stop(self, batch, index):
        if self.current_epoch == 1:
            os.kill(os.getpid(), signal.SIGTERM)
        return step(self, batch, index)

    monkeypatch.setattr(Restoration, "validation_step", stop)
    outcome = call("train", "+task=undistort", *small, "run_dir=run")
    assert outcome.code == 143
    assert outcome.out.splitlines()[-1].startswith("best.ckpt: ")


def test_a_training_whose_workers_receive_sigterm_too_stops_with_a_checkpoint(small, tmp_path):
    # Not forked from the tests: a forked process could wait forever for threads of its parent.
    words = ("+task=undistort", *small, "run_dir=run", "trainer.max_epochs=1000", "data.workers=1")
    with running("-m", "torchrefract.train", *words, cwd=tmp_path) as process:
        wait_for((tmp_path / "run" / "last.ckpt").exists, process)
        os.killpg(process.pid, signal.SIGTERM)  # as SLURM and systemd send it
        _, message = process.communicate(timeout=60)
    assert process.returncode == 143, message
    (line,) = (line for line in message.splitlines() if "stopped" in line or "Error" in line)
    assert re.fullmatch(r"stopped by SIGTERM in step \d+; ckpt_path=run/last.ckpt continues", line)


def test_a_finished_run_cannot_be_resumed(call, trained):
    message = call("train", *trained.words, f"ckpt_path={trained.folder / 'last.ckpt'}", "hydra.run.dir=run").message
    assert message == (
        "trainer.max_epochs must be above the 2 epochs of ckpt_path, got 2; eval scores a training that is complete"
    )


def test_a_run_that_is_resumed_in_another_folder_keeps_the_best_checkpoint(call, trained, tmp_path):
    (tmp_path / "old").mkdir()
    shutil.copy(trained.folder / "best.ckpt", tmp_path / "old")
    content = torch.load(trained.folder / "last.ckpt", weights_only=True)
    (state,) = (state for name, state in content["callbacks"].items() if "'monitor': 'val/epe'" in name)
    score = torch.zeros(())  # no later epoch is better
    state |= {"best_model_score": score, "best_k_models": {state["best_model_path"]: score}}
    torch.save(content, tmp_path / "old" / "last.ckpt")
    words = ("ckpt_path=old/last.ckpt", "trainer.max_epochs=3", "hydra.run.dir=new")
    outcome = call("train", *trained.words, *words)
    assert (outcome.code, outcome.err) == (0, "")
    assert (tmp_path / "new" / "best.ckpt").read_bytes() == (trained.folder / "best.ckpt").read_bytes()
    gain = metrics(tmp_path / "new", "val/epe_identity")[2]
    assert outcome.out.splitlines()[-1].startswith(f"best.ckpt: better than doing nothing by {gain:.2f} px")


@pytest.mark.parametrize(
    ("word", "stored"), [("lr=0.02", "0.001"), ("weight_decay=0.5", "0.01"), ("schedule=plateau", "cosine")]
)
def test_a_resumed_run_keeps_its_optimizer(call, trained, word, stored):
    path, (name, _, value) = trained.folder / "last.ckpt", word.partition("=")
    words = (*trained.words, "trainer.max_epochs=3", f"ckpt_path={path}", "run_dir=run", f"model.{word}")
    assert call("train", *words).message == (
        f"model.{name} must be {stored}, as of the training that ckpt_path resumes, got {value}: init_from={path} "
        "starts a new training with its weights"
    )
    assert not Path("run").exists()


@pytest.mark.parametrize(("word", "steps"), [("data.val_count=2", 12), ("data.batch_size=4", 10)])
def test_a_resumed_run_warns_of_other_values_and_ends_at_a_learning_rate_of_zero(call, trained, word, steps):
    words = (f"ckpt_path={trained.folder / 'last.ckpt'}", "trainer.max_epochs=3", word, "run_dir=run")
    outcome = call("train", *trained.words, *words)
    assert outcome.code == 0
    warning, *rest = outcome.err.splitlines()
    assert warning == f"warning: the training continues with other values than before of {word.partition('=')[0]}"
    assert not rest
    assert re.search(rf"^steps +{steps} in 3 epochs of {steps - 8}, ", outcome.out, re.MULTILINE), outcome.out
    (schedule,) = read_checkpoint(Path("run/last.ckpt"))["lr_schedulers"]
    assert (schedule["last_epoch"], schedule["_last_lr"]) == (steps, [0.0])


def test_a_run_resumed_by_another_number_of_processes_warns(call, trained, monkeypatch):
    monkeypatch.setattr("pytorch_lightning.Trainer.fit", lambda *_, **__: None)
    words = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "trainer.max_epochs=3", "run_dir=run")
    outcome = call("train", *trained.words, *words, f"ckpt_path={trained.folder / 'last.ckpt'}")
    warning, *_ = outcome.err.splitlines()
    assert warning == "warning: the training continues with other values than before of the number of processes"


@pytest.mark.parametrize(
    ("words", "steps"),
    [
        (("trainer.max_epochs=-1", "+trainer.max_steps=4"), "4 in epochs of 4, of 2 frames each"),
        (("trainer.max_epochs=3", "+trainer.check_val_every_n_epoch=2"), "12 in 3 epochs of 4, of 2 frames each"),
        (("trainer.max_epochs=1", "+trainer.accumulate_grad_batches=3"), "2 in 1 epochs of 2, of 6 frames each"),
    ],
)
def test_the_steps_of_a_run_are_those_of_the_optimizer_and_its_last_validation_has_ssim(call, small, words, steps):
    outcome = call("train", "+task=undistort", *small, "run_dir=run", *words)
    assert re.search(rf"^steps +{steps};", outcome.out, re.MULTILINE), outcome.out
    *_, last = (row["val/ssim"] for row in metrics_rows(Path("run")) if row["val/loss"])
    assert float(last) > 0


def test_a_new_training_does_not_replace_the_checkpoints_of_another_one(call, trained, tmp_path):
    shutil.copytree(trained.folder, tmp_path / "run")
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    message = call("train", *trained.words, "seed=3", "run_dir=run").message
    assert message == (
        "run_dir must be a folder without the checkpoints of another training, got run: ckpt_path=run/last.ckpt "
        "continues that one, and another run_dir keeps it"
    )
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before


def test_a_training_starts_with_the_weights_and_the_licenses_of_a_checkpoint(call, trained):
    best = trained.folder / "best.ckpt"
    words = ("trainer.max_epochs=1", "model.lr=0", f"init_from={best}", "run_dir=run")  # no step changes a weight
    assert call("train", *trained.words, *words).code == 0
    before, after = read_checkpoint(best), read_checkpoint(Path("run/last.ckpt"))
    names = [name for name in before["state_dict"] if name.endswith((".weight", ".bias"))]
    assert len(names) > 20
    assert [name for name in names if not before["state_dict"][name].equal(after["state_dict"][name])] == []
    assert after["licenses"][f"initial weights, {best}"] == before["licenses"]
    assert OmegaConf.load("run/config.yaml").init_from == str(best)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("init_from=none.ckpt",),
            "init_from must be a checkpoint file, such as <run>/last.ckpt, or the name lens_small, got none.ckpt",
        ),
        (("init_from=lens_small",), "init_from must be a checkpoint of ResUNet (tu-test_resnet), which model= names"),
        (("+task=deweather", "scene=cape_town_fog", "init_from=lens_small"), "init_from must be a checkpoint of the "),
    ],
)
def test_initial_weights_of_another_model_are_one_line_of_error(call, small, words, message):
    task = () if any(word.startswith("+task") for word in words) else ("+task=undistort",)
    assert call("train", *task, *small, *words).message.startswith(message)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("scene=cape_town_fog",), "data: effect must have a flow, as a lens has, got HeterogeneousFog"),
        (
            ("scene=paper_refractive", "data.border=black"),
            "data: border must be null unless the scene is a lens that fills its frames, got black",
        ),
        (("run_dir=/dev/null/run",), "run_dir must name what can be read or written, got /dev/null/run: "),
        (("model.lr=nan",), "model: lr must not be NaN, got nan"),
        (("model.weight_decay=-1",), "model: weight_decay must be a number of at least 0, got -1"),
        (("model.warmup_steps=-1",), "model: warmup_steps must be at least 0, got -1"),
        (("model.metric_size=[1080]",), "model: metric_size must be (height, width), got [1080]"),
        (("trainer.max_epochs=2.5",), "trainer: max_epochs must be a whole number, got 2.5"),
        (("trainer.accelerator=tpu",), "trainer: "),
        (("+trainer.precision=bf16-true",), "trainer.precision must be one of 32-true, bf16-mixed, 16-mixed, since"),
        (("trainer.max_epochs=-1", "+trainer.max_time=00:00:00:05"), "schedule must be plateau "),
        (("hydra.run.dir=/dev/null/run",), "/dev/null/run could not be written: "),
        (("frame_size=[16,32]",), "frame_size must be that of data.size, which decides, got [16, 32] and [32, 64]"),
        (("epochs=2", "trainer.max_epochs=3"), "epochs must be that of trainer.max_epochs, which decides, got 2 and 3"),
        (("train_scenes=9",), "train_scenes must be that of data.train_count, which decides, got 9 and 8"),
        (
            ("~data.train_count", "train_scenes=9"),  # as for frames in a folder
            "train_scenes must be that of data.train_count, which decides, got 9 and none; leave train_scenes out",
        ),
        (("best.monitor=val/psnr",), "best.mode must be max for val/psnr, of which the best is the highest, got min"),
    ],
)
def test_an_invalid_option_is_one_line_of_error(call, small, words, message):
    assert call("train", "+task=undistort", *small, *words).message.startswith(message)


def test_a_metric_that_no_validation_has_is_one_line_of_error(call, small):
    outcome = call("train", "+task=undistort", *small, "best.monitor=val/nothing")
    assert outcome.code == 1
    assert "error: trainer: " in outcome.err.splitlines()[-1]
    assert "val/nothing" in outcome.err.splitlines()[-1]


@pytest.mark.parametrize("words", [("trainer.limit_train_batches=0",), ("+trainer.max_steps=0",)])
def test_a_training_without_a_step_is_an_error(call, small, words):
    message = call("train", "+task=undistort", *small, *words).message
    assert message.startswith("trainer must make a step, got none; ")


def test_a_training_that_ends_before_its_first_validation_says_what_it_saved(call, small):
    outcome = call("train", "+task=undistort", *small, "+trainer.max_steps=3", "run_dir=run")
    assert outcome.code == 0, outcome.err
    assert outcome.out.splitlines()[-2:] == [
        "run: config.yaml, last.ckpt, metrics.csv",
        "no best.ckpt and no scores: the training ended before its first validation",
    ]


def test_a_logger_without_its_package_names_the_extra(call, small, monkeypatch):
    monkeypatch.setattr("pytorch_lightning.loggers.wandb._WANDB_AVAILABLE", False)
    message = call("train", "+task=undistort", *small, "logger=wandb").message
    assert message == "logger=wandb needs its package: pip install 'torchrefract[loggers]'"


def test_a_damaged_pair_is_one_line_of_error(call, small, tmp_path):
    for drive, i in product("ab", range(4)):
        pixels = np.random.default_rng(i).integers(0, 256, (36, 48, 3), dtype=np.uint8)
        save_picture(tmp_path / "frames" / f"{drive}_{i}.png", pixels)
    words = ("scene=cheap_dashcam", "source=frames", "out=out", "license=CC0", "workers=0")
    assert call("generate", *words).code == 0
    stored = PairedFolder(tmp_path / "out", split="train")
    last = stored.row(len(stored) - 1)
    (tmp_path / "out" / last.files["clean.png"].path).write_bytes(b"")
    model = [word for word in small if not word.startswith("data.")]
    options = ("data=pairs", "data.root=out", "data.batch_size=2", "data.workers=1")
    outcome = call("train", "+task=undistort", *model, *options)
    assert outcome.code == 1
    assert outcome.err.splitlines()[-1].startswith(f"error: pair {last.number} in out must be "), outcome.err
    assert f"got out/{last.files['clean.png'].path} is " in outcome.err


def test_deweathering_trains_by_the_same_command_into_a_new_folder(call, small, tmp_path):
    outcome = call("train", "+task=deweather", *small, "trainer.max_epochs=1", "run_dir=new/run")
    assert sorted(path.name for path in (tmp_path / "new" / "run").iterdir()) == FILES
    head, nothing, fog, model, _, verdict = outcome.out.splitlines()[-6:]
    assert "endpoint" not in head
    assert (nothing[:10], fog[:8], model[:5]) == ("do nothing", "true fog", "model")
    run = tmp_path / "new" / "run"
    gain = max(metrics(run, "val/psnr").values()) - metrics(run, "val/psnr_identity")[0]
    better, worse = f"than doing nothing by {gain:.2f} dB", f"NOT better than doing nothing ({gain:+.2f} dB)"
    assert better in verdict or worse in verdict
    assert read_checkpoint(run / "last.ckpt", task="deweather")["epoch"] == 0


def model_line(text: str) -> list[str]:
    return next(line for line in reversed(text.splitlines()) if line.startswith("model ")).split()


def test_a_diffusion_model_trains_and_its_evaluation_by_the_moving_average_repeats_the_validation(call):
    trained = call("train", "+task=undistort", *DDPM, "trainer.max_epochs=1", "hydra.run.dir=run")
    path = trained.folder / "last.ckpt"
    checkpoint, name = read_checkpoint(path, task="undistort"), "network.network.conv_out.weight"
    assert not checkpoint["state_dict"][name].equal(checkpoint["current_model_state"][name])
    (monitored,) = (state for name, state in checkpoint["callbacks"].items() if "'monitor': 'val/epe'" in name)
    assert float(monitored["best_model_score"]) == pytest.approx(metrics(trained.folder, "val/epe")[0], rel=1e-5)
    evaluated = call("eval", "+task=undistort", *DDPM, f"ckpt_path={path}", "hydra.run.dir=again", "model.steps=3")
    assert evaluated.code == 0, evaluated.err
    assert model_line(evaluated.out) == model_line(trained.out)


def test_an_evaluation_scores_by_default_what_the_checkpoint_was_validated_on_and_says_so(call, trained, tmp_path):
    checkpoint = trained.folder / "best.ckpt"
    score = model_line(trained.outcome.out)
    for words in (("+task=undistort", "seed=0"), ("-m", "data.batch_size=3", "hydra.sweep.dir=sweep")):
        outcome = call("eval", *words, f"ckpt_path={checkpoint}")
        assert outcome.code == 0, outcome.err
        (line,) = (line for line in outcome.out.splitlines() if line.startswith("scoring "))
        assert line == (
            f"scoring {checkpoint} on 4 validation frames of RoadScenes, 32x64 px, cheap_dashcam of severity 3; "
            "as in its own validation"
        )
        assert model_line(outcome.out) == score
        assert not list(outcome.folder.rglob("*.ckpt"))
    outcome = call("eval", f"ckpt_path={checkpoint}", "data.val_count=2", "scene=paper_refractive", "scene.severity=5")
    (line,) = (line for line in outcome.out.splitlines() if line.startswith("scoring "))
    assert line.endswith(
        "on 2 validation frames of RoadScenes, 32x64 px, paper_refractive of severity 5, padded frames; "
        "unlike its own validation in data.effect._target_, data.effect.frame, data.effect.severity, "
        "data.effect.width, data.val_count"
    )


def test_the_same_checkpoint_is_scored_with_filled_frames_and_with_named_borders(call, trained):
    """A network whose heads are zero scores like doing nothing, on frames that this test degrades itself."""
    content, path = read_checkpoint(trained.folder / "best.ckpt"), Path("zero.ckpt").resolve()
    for name, weight in content["state_dict"].items():
        if "head" in name:
            weight.zero_()
    AtomicCheckpointIO().save_checkpoint(content, path)
    loader = DataLoader(RoadScenes(4, size=(32, 64), first=8), batch_size=4)
    errors = []
    for border, name in ((None, ""), ("black", ", black border"), ("mirrored", ", mirrored border")):
        words = [] if border is None else [f"data.border={border}"]
        outcome = call("eval", f"ckpt_path={path}", *words, "data.batch_size=4")
        assert outcome.code == 0, outcome.err
        head, *rows, _, verdict = outcome.out.splitlines()
        assert f"cheap_dashcam of severity 3{name}; " in head
        pair = make_pair(next(iter(loader)), presets.cheap_dashcam(), seed=0, border=border)
        expected_psnr = float(psnr(pair.degraded, pair.clean, pair.valid).mean())
        errors.append(float(endpoint_error(0 * pair.flow, pair.flow, pair.valid, size=(1080, 1920)).mean()))
        for method in ("do nothing", "model"):
            (row,) = (line for line in rows if line.startswith(f"{method}{name}  "))
            assert f"{expected_psnr:.2f} (+0.00)" in row
            assert f"{errors[-1]:.2f} (1.00 x do nothing)" in row
        assert re.search(r"NOT (better )?than doing nothing \([+-]0\.00 px\)", verdict)
    assert errors == [errors[0]] * 3


def test_an_evaluation_runs_no_code_that_a_checkpoint_names(call, known_model, tmp_path):
    path = known_model("undistort", (0.0, 0.0))
    content = read_checkpoint(path)
    for target in ("os.mkdir", "torchrefract.data.media.os.mkdir", "torchrefract._io.replace_file"):
        data = {"_target_": "torchrefract.data.module.road_scenes", "effect": {"_target_": target, "path": "made"}}
        AtomicCheckpointIO().save_checkpoint(content | {"config": content["config"] | {"data": data}}, path)
        message = call("eval", f"ckpt_path={path}", "hydra.run.dir=run").message
        assert message.startswith("ckpt_path must name models and tasks of torchrefract only, got ")
        assert message.endswith(repr(target))
        assert list(tmp_path.iterdir()) == []


def test_an_evaluation_repeats_the_scores_of_the_training_and_leaves_its_folder_alone(call, trained, tmp_path):
    before = {path: path.stat().st_mtime_ns for path in trained.folder.iterdir()}
    checkpoint = trained.folder / "best.ckpt"
    outcome = call("eval", *trained.words, f"ckpt_path={checkpoint}")
    folder = outcome.folder
    assert folder.is_relative_to(tmp_path / "runs" / "eval_undistort")
    assert {"config.yaml", "metrics.csv", "panel.png"} == {path.name for path in folder.iterdir()}
    assert OmegaConf.select(OmegaConf.load(folder / "config.yaml"), "ckpt_path") == str(checkpoint)
    assert {path: path.stat().st_mtime_ns for path in trained.folder.iterdir()} == before
    best = read_checkpoint(checkpoint, task="undistort")["epoch"]
    (scores,) = metrics_rows(folder)
    names = {name for row in metrics_rows(trained.folder) for name in row if name.startswith("val/")}
    assert {"val/psnr", "val/epe", "val/epe_constant", "val/ssim_identity"} <= names
    for name in names:
        assert float(scores[name]) == pytest.approx(metrics(trained.folder, name)[best], rel=1e-4), name


def test_an_evaluation_needs_a_checkpoint_of_its_task(call, trained, small):
    checkpoint = trained.folder / "best.ckpt"
    message = call("eval", "+task=deweather", *small, f"ckpt_path={checkpoint}").message
    assert message.endswith(f"a checkpoint of the task deweather, got {checkpoint} of undistort")

import errno
import random
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from torchrefract.cli import command as _command
from torchrefract.data.frames import FrameFolder
from torchrefract.restoration.checkpoints import AtomicCheckpointIO, read_checkpoint

# Loads the data and the model, and trains for no epoch.
BRIEFLY = ("trainer.max_epochs=0", "hydra.run.dir=run")


def pictures(root: Path, count: int, *, size: tuple[int, int] = (64, 32)) -> list[Path]:
    """Frames of two drives."""
    dice = random.Random(0)
    paths = []
    for number in range(count):
        path = root / f"drive{number % 2}" / f"{number:03d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.frombytes("RGB", size, dice.randbytes(3 * size[0] * size[1])).save(path)
        paths.append(path)
    return paths


@pytest.mark.parametrize("name", ["train", "eval"])
def test_a_command_without_a_task_lists_the_tasks(call, name):
    message = call(name).message
    assert message.startswith("+task must be one of deweather, undistort: ")
    assert f"python -m torchrefract.{name} +task=" in message


def test_an_experiment_chooses_its_task_itself(call):
    outcome = call("train", "+experiment=table1_segformer_deweather", "data.root=frames", "--cfg", "job")
    assert OmegaConf.create(outcome.out).task._target_ == "torchrefract.restoration.tasks.Deweather"
    assert "data.root" in call("train", "+experiment=table1_segformer_deweather_small", *BRIEFLY).message


@pytest.mark.parametrize("name", ["train", "eval"])
def test_a_task_without_its_plus_is_told_of_the_plus(call, name):
    message = call(name, "task=deweather", "seed=1").message
    assert message.startswith("task=deweather needs a plus")
    assert message.endswith(f"python -m torchrefract.{name} +task=deweather")


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("+task=sharpen", "task must be one of deweather, undistort, got sharpen"),
        ("model=unet", "model must be one of ddpm, ddpm_cat256, resunet, segformer, got unet"),
        ("scene=london", "scene must be one of cape_town_fog, cheap_dashcam, highveld_heat_haze, .* got london"),
        ("data=video", "data must be one of frames, pairs, road_scenes, got video"),
        ("trainer=tpu", "trainer must be one of base, cpu, ddp, gpu, got tpu"),
        ("data.color=red", "data.color"),
        ("model.depth=3", "model.depth"),
        ("+model.depth=3", "model: .*'depth'"),
        ("model.network.encoder=nonsense", "model: encoder must be known to .*, got nonsense"),
        ("model.network.encoder=tu-nonsense", "model: encoder must be known to .*, got tu-nonsense"),
        ("data.size=[64", r"\[64"),
        ("data.size=[4,4]", "data: size must be at least 8, got 4"),
        ("data.batch_size=33", "data: batch_size must be at most the 32 training frames, got 33"),
        ("data.workers=-1", "data: workers must be at least 0, got -1"),
        ("trainer.max_epochs=-5", "trainer: .*max_epochs.*-5"),
        ("seed=-1", "seed.*-1"),
        ("seed=tomorrow", "seed.*tomorrow"),
    ],
)
def test_a_wrong_word_is_one_line_of_error(call, small, word, message):
    task = [] if word.startswith("+task") else ["+task=undistort"]
    assert re.search(message, call("train", *task, *small, *BRIEFLY, word).message)


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about a machine without a GPU")
def test_a_gpu_that_is_not_there_is_one_line_of_error(call, small):
    assert "gpu" in call("train", "+task=undistort", *small, *BRIEFLY, "trainer=gpu").message.lower()


def test_frames_without_a_folder_ask_for_it(call):
    assert "data.root" in call("train", "+task=undistort", "data=frames", *BRIEFLY).message


def test_a_folder_that_is_none_is_named(call, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "film.mp4").touch()
    for name, reason in (("none", "does not exist"), ("empty", "must hold .jpg"), ("film.mp4", "got the file")):
        root = tmp_path / name
        message = call("train", "+task=undistort", "data=frames", f"data.root={root}", *BRIEFLY).message
        assert message.startswith("data: root must ")
        assert str(root) in message
        assert reason in message


def test_frames_smaller_than_the_crop_are_named(call, tmp_path):
    pictures(tmp_path / "frames", 6, size=(32, 16))
    message = call("train", "+task=undistort", "data=frames", "data.root=frames", "data.size=[32,64]", *BRIEFLY).message
    assert "frames must be at least size = 32x64" in message
    assert re.search(r"drive./00.\.png of 16x32", message)


FOLDER = ("data=frames", "data.root=frames", "data.size=[32,64]", "data.batch_size=4", "data.workers=0")
LITTLE = ("+task=deweather", "model.network.encoder=tu-mobilenetv3_small_050", *FOLDER, "hydra.run.dir=run")


def test_a_few_bad_frames_are_named_skipped_and_counted(call, tmp_path):
    paths = pictures(tmp_path / "frames", 44)
    paths[4].write_bytes(b"")
    paths[7].write_bytes(paths[7].read_bytes()[:900])
    with pytest.warns(UserWarning, match="cannot be read and are skipped") as caught:
        assert call("train", *LITTLE, "trainer.max_epochs=0").code == 0
    told = " ".join(str(warning.message) for warning in caught)
    for text in ("1 of 22 frames", "drive0/004.png is empty (0 bytes)", "drive1/007.png is truncated (900 bytes"):
        assert text in told


def test_many_bad_frames_stop_the_command(call, tmp_path):
    for path in pictures(tmp_path / "frames", 20)[:6]:
        path.write_bytes(b"")
    message = call("train", *LITTLE, "trainer.max_epochs=0").message
    assert message.startswith("data: root must hold readable frames, got 3 of 10")
    assert re.search(r"drive./00.\.png is empty \(0 bytes\)", message)


@pytest.mark.parametrize("whole", [0, 1])
@pytest.mark.parametrize("workers", [0, 2])
def test_a_frame_that_turns_out_to_be_damaged_is_named(call, tmp_path, workers, whole):
    paths = pictures(tmp_path / "frames", 8)
    # One is read before the training, the others by workers.
    spared = FrameFolder(tmp_path / "frames", size=(8, 8), split="train").paths[:whole]
    for path in set(paths) - set(spared):
        data = path.read_bytes()
        path.write_bytes(data[:200] + b"\0" * 600 + data[800:])
    outcome = call("train", *LITTLE, "trainer.max_epochs=1", f"data.workers={workers}")
    assert outcome.code == 1
    assert "Traceback" not in outcome.err
    line = outcome.err.splitlines()[-1]
    assert line.startswith("error: frames/drive")
    assert ".png" in line


def other_model(path: Path) -> None:
    AtomicCheckpointIO().save_checkpoint({"state_dict": {"network.0.weight": torch.ones(3)}, "task": "undistort"}, path)


def other_task(path: Path) -> None:
    AtomicCheckpointIO().save_checkpoint({"state_dict": {}, "task": "deweather"}, path)


@pytest.mark.parametrize("name", ["train", "eval"])
@pytest.mark.parametrize(
    ("make", "remedy"),
    [
        (lambda path: None, "<run>/last.ckpt"),
        (lambda path: path.write_bytes(random.Random(0).randbytes(5000)), "damaged"),
        (lambda path: path.write_bytes(b""), "damaged"),
        (other_task, "a checkpoint of the task undistort, got"),
        (other_model, "a checkpoint of the model that model= names, got"),
    ],
    ids=["missing", "noise", "empty", "task", "model"],
)
def test_a_checkpoint_that_is_of_no_use_is_one_line_of_error(call, small, tmp_path, name, make, remedy):
    make(tmp_path / "old.ckpt")
    message = call(name, "+task=undistort", *small, *BRIEFLY, "ckpt_path=old.ckpt").message
    assert message.startswith("ckpt_path must be ")
    assert remedy in message
    assert "old.ckpt" in message


def test_a_full_disk_stops_the_command_and_keeps_the_last_good_checkpoint(call, small, tmp_path, monkeypatch):
    whole = torch.save

    def save(value, file) -> None:
        whole(value, file)
        if value["epoch"] >= 1:
            Path(file).write_bytes(Path(file).read_bytes()[:1000])
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(torch, "save", save)
    outcome = call("train", "+task=undistort", *small, "hydra.run.dir=run")
    assert outcome.code == 1
    assert "Traceback" not in outcome.err
    line = outcome.err.splitlines()[-1]
    assert line.startswith("error: ")
    assert "could not be written (No space left on device)" in line
    assert "ckpt_path=" in line
    for name in ("best.ckpt", "last.ckpt"):
        assert read_checkpoint(tmp_path / "run" / name, task="undistort")["epoch"] == 0
    assert not [path for path in (tmp_path / "run").iterdir() if path.name.startswith(".")]


def test_an_error_of_ours_keeps_its_traceback(call, small, monkeypatch):
    monkeypatch.setattr(_command, "Path", SimpleNamespace())
    with pytest.raises(TypeError, match="not callable"):
        call("train", "+task=undistort", *small, *BRIEFLY)


def test_the_configuration_can_be_looked_at_without_a_run(call, tmp_path):
    outcome = call("train", "+task=deweather", "seed=7", "--cfg", "job")
    assert outcome.code == 0, outcome.err
    shown = OmegaConf.create(outcome.out)
    assert (shown.seed, shown.data.seed) == (7, 7)
    assert shown.scene._target_ == "torchrefract.presets.cape_town_fog"
    assert list(tmp_path.iterdir()) == []


def test_help_needs_no_task(call):
    outcome = call("train", "--help")
    assert outcome.code == 0
    assert "undistort" in outcome.out


def test_a_multirun_has_a_folder_for_each_job(call, small, tmp_path):
    outcome = call(
        "train", "-m", "+task=undistort", *small, "trainer.max_epochs=0", "seed=3,4", "hydra.sweep.dir=sweep"
    )
    assert outcome.code == 0, outcome.err
    seeds = {
        path.parent.name: OmegaConf.select(OmegaConf.load(path), "data.seed")
        for path in tmp_path.glob("sweep/*/config.yaml")
    }
    assert seeds == {"0": 3, "1": 4}

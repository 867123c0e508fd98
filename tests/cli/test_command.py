import errno
import random
import re
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from torchrefract._validation import UsageError
from torchrefract.cli.command import command, naming, progress, quote_option
from torchrefract.data.frames import FrameFolder
from torchrefract.data.images import UnreadableImageError
from torchrefract.restoration.checkpoints import AtomicCheckpointIO, read_checkpoint

# Load data and model, and train for no epoch.
NO_EPOCH = ("trainer.max_epochs=0", "hydra.run.dir=run")
FOLDER = ("data=frames", "data.root=frames", "data.size=[32,64]", "data.batch_size=4", "data.workers=0")
DEWEATHER = ("+task=deweather", "model.network.encoder=tu-mobilenetv3_small_050", *FOLDER, "hydra.run.dir=run")


def write_frames(root: Path, count: int, *, size: tuple[int, int] = (64, 32)) -> list[Path]:
    """Write random frames of two drives."""
    generator = random.Random(0)
    paths = []
    for number in range(count):
        path = root / f"drive{number % 2}" / f"{number:03d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.frombytes("RGB", size, generator.randbytes(3 * size[0] * size[1])).save(path)
        paths.append(path)
    return paths


# --- errors


@pytest.fixture
def run_main(monkeypatch, capsys):
    """Run a main function as a command; return what it wrote to stderr."""
    monkeypatch.setattr(sys, "argv", ["torchrefract.train", "license=[CC0], by us"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "")

    def run(function, **options) -> str:
        monkeypatch.setattr("hydra.main", lambda **_: lambda job: lambda: job(None))
        command("train", lambda _: function(), **options)()
        return capsys.readouterr().err

    return run


@pytest.mark.quick
def test_an_error_of_the_user_is_one_line_and_another_keeps_its_traceback(run_main, capsys):
    def fail(error: Exception) -> None:
        raise error

    for error, message in (
        (UsageError("count must be\n above 0"), "count must be above 0"),
        (UnreadableImageError("Traceback …\nValueError: a.png is empty"), "a.png is empty"),
        (
            OSError(errno.ENOSPC, "No space left on device", "run/a.csv"),
            "run/a.csv could not be written: No space left",
        ),
    ):
        with pytest.raises(SystemExit) as stop:
            run_main(lambda error=error: fail(error))
        assert stop.value.code == 1
        assert capsys.readouterr().err.startswith(f"error: {message}")
    with pytest.raises(TypeError, match="not callable"):
        run_main(lambda: fail(TypeError("'int' object is not callable")))


@pytest.mark.quick
def test_naming_adds_the_part_to_errors_of_values_only():
    with pytest.raises(UsageError, match=r"^size: too small$"), naming("size"):
        raise ValueError("too small")
    with pytest.raises(UnreadableImageError, match=r"^a\.png is empty$"), naming("size"):
        raise UnreadableImageError("a.png is empty")
    with pytest.raises(KeyError), naming("size"):
        raise KeyError("size")


@pytest.mark.quick
def test_the_value_of_a_quoted_option_reaches_hydra_as_text(run_main):
    run_main(lambda: None, prepare=quote_option("license"))
    assert sys.argv[1:] == ["license='[CC0], by us'"]
    assert quote_option("license")("generate", ["license=null", "license='a'"]) == ["license=null", "license='a'"]


@pytest.mark.quick
def test_progress_hands_on_its_items_and_is_silent_outside_a_terminal(capsys):
    assert list(progress(range(3), "working", count=3)) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")


# --- arguments


@pytest.mark.parametrize("name", ["train", "eval"])
def test_a_command_without_a_task_lists_the_tasks(call, name):
    message = call(name).message
    assert message.startswith("+task must be one of deweather, undistort: ")
    assert f"python -m torchrefract.{name} +task=" in message
    assert "undistort" in call(name, "--help").out


def test_a_task_without_its_plus_is_one_line_of_error(call):
    message = call("train", "task=deweather", "seed=1").message
    assert message.startswith("task=deweather needs a plus")
    assert message.endswith("python -m torchrefract.train +task=deweather")


def test_an_experiment_chooses_its_task_and_is_shown_without_a_run(call, tmp_path):
    outcome = call("train", "+experiment=table1_segformer_deweather", "data.root=frames", "--cfg", "job")
    assert OmegaConf.create(outcome.out).task._target_ == "torchrefract.restoration.tasks.Deweather"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("+task=sharpen", "task must be one of deweather, undistort, got sharpen"),
        ("model=unet", "model must be one of ddpm, ddpm_cat256, resunet, segformer, got unet"),
        ("scene=london", "scene must be one of cape_town_fog, cheap_dashcam, highveld_heat_haze, .* got london"),
        ("sede=1", "an option must be one of .*, got sede; did you mean seed"),
        ("data.color=red", "data.color"),
        ("+model.depth=3", "model: .*'depth'"),
        ("model.network.encoder=tu-nonsense", "model: encoder must be a name of .*, got tu-nonsense"),
        ("data.size=[64", r"\[64"),
        ("data.size=[4,4]", "data: size must be at least 8, got 4"),
        ("data.batch_size=33", "data: batch_size must be at most the 32 training frames, got 33"),
        ("data.workers=-1", "data: workers must be at least 0, got -1"),
        ("trainer.max_epochs=-5", "trainer: .*max_epochs.*-5"),
        ("seed=-1", "seed.*-1"),
        ("seed=tomorrow", "seed.*tomorrow"),
    ],
)
def test_a_wrong_argument_is_one_line_of_error(call, small, word, message):
    task = [] if word.startswith("+task") else ["+task=undistort"]
    assert re.search(message, text := call("train", *task, *small, *NO_EPOCH, word).message), text


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about a machine without a GPU")
def test_a_missing_gpu_is_one_line_of_error(call, small):
    assert "gpu" in call("train", "+task=undistort", *small, *NO_EPOCH, "trainer=gpu").message.lower()


def test_a_multirun_has_a_folder_for_each_job(call, small, tmp_path):
    words = ("-m", "+task=undistort", *small, "trainer.max_epochs=0", "seed=3,4", "hydra.sweep.dir=sweep")
    assert (outcome := call("train", *words)).code == 0, outcome.err
    configs = tmp_path.glob("sweep/*/config.yaml")
    assert {path.parent.name: OmegaConf.select(OmegaConf.load(path), "data.seed") for path in configs} == {
        "0": 3,
        "1": 4,
    }


# --- frames


def test_a_missing_folder_of_frames_is_one_line_of_error(call, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "film.mp4").touch()
    assert "data.root" in call("train", "+task=undistort", "data=frames", *NO_EPOCH).message
    for name, reason in (("none", "does not exist"), ("empty", "must hold .jpg"), ("film.mp4", "got the file")):
        root = tmp_path / name
        message = call("train", "+task=undistort", "data=frames", f"data.root={root}", *NO_EPOCH).message
        assert message.startswith("data: root must ")
        assert str(root) in message
        assert reason in message


@pytest.mark.parametrize(("workers", "num_readable"), [(0, 0), (2, 1)])
def test_a_frame_that_is_damaged_in_the_middle_is_named_by_the_process_that_reads_it(
    call, tmp_path, workers, num_readable
):
    paths = write_frames(tmp_path / "frames", 8)
    # One frame is read before the training, the others by workers.
    readable = FrameFolder(tmp_path / "frames", size=(8, 8), split="train").paths[:num_readable]
    for path in set(paths) - set(readable):
        data = path.read_bytes()
        path.write_bytes(data[:200] + b"\0" * 600 + data[800:])
    outcome = call("train", *DEWEATHER, "trainer.max_epochs=1", f"data.workers={workers}")
    assert outcome.code == 1
    assert "Traceback" not in outcome.err
    assert re.match(r"error: frames/drive.*\.png", outcome.err.splitlines()[-1])


# --- checkpoints


def test_a_checkpoint_of_another_model_is_one_line_of_error(call, small, tmp_path):
    content = {"state_dict": {"network.0.weight": torch.ones(3)}, "task": "undistort"}
    AtomicCheckpointIO().save_checkpoint(content, tmp_path / "old.ckpt")
    text = call("train", "+task=undistort", *small, *NO_EPOCH, "ckpt_path=old.ckpt").message
    assert text.startswith("ckpt_path must be a checkpoint of the model that model= names, got old.ckpt")


def test_a_full_disk_stops_the_command_and_keeps_the_last_good_checkpoint(call, small, tmp_path, monkeypatch):
    original = torch.save

    def save(value, file) -> None:
        original(value, file)
        if value["epoch"] >= 1:
            Path(file).write_bytes(Path(file).read_bytes()[:1000])
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(torch, "save", save)
    outcome = call("train", "+task=undistort", *small, "trainer.max_epochs=2", "hydra.run.dir=run")
    assert outcome.code == 1
    assert "Traceback" not in outcome.err
    line = outcome.err.splitlines()[-1]
    assert line.startswith("error: ")
    assert "could not be written (No space left on device)" in line
    assert "ckpt_path=" in line
    for name in ("best.ckpt", "last.ckpt"):
        assert read_checkpoint(tmp_path / "run" / name, task="undistort")["epoch"] == 0
    assert not [path for path in (tmp_path / "run").iterdir() if path.name.startswith(".")]

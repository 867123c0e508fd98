import errno
import io
import os
import random
import re
import shlex
import signal
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from PIL import Image
from processes import running

from torchrefract._io import CONFIG_DIR
from torchrefract._validation import UsageError
from torchrefract.cli.command import prepare_arguments, quote_text, run
from torchrefract.cli.entry import command
from torchrefract.cli.options import disk_errors, naming
from torchrefract.cli.progress import progress
from torchrefract.data.frames import FrameFolder
from torchrefract.data.images import UnreadableImageError
from torchrefract.restoration.checkpoints import AtomicCheckpointIO, read_checkpoint

# Load data and model, and train for no epoch.
NO_EPOCH = ("trainer.max_epochs=0", "hydra.run.dir=run")
FOLDER = ("data=frames", "data.root=frames", "data.size=[32,64]", "data.batch_size=4", "data.workers=0")
DEWEATHER = ("+task=deweather", *FOLDER, "hydra.run.dir=run", "model.network.width=4")


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
    """Run a function as a command; return what it wrote to stderr."""
    monkeypatch.setattr(sys, "argv", ["torchrefract.train", "+task=undistort"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "")

    def run_function(function) -> str:
        monkeypatch.setattr("hydra.main", lambda **_: lambda job: function)
        run("train", lambda _: None)
        return capsys.readouterr().err

    return run_function


CLOSED = "[gloo/transport/tcp/pair.cc:561] Connection closed by peer [127.0.0.1]:7."


@pytest.mark.quick
def test_an_error_of_the_user_is_one_line_and_another_keeps_its_traceback(run_main, capsys):
    def fail(error: Exception) -> None:
        raise error

    for error, message in (
        (UsageError("count must be\n above 0"), "count must be above 0"),
        (UnreadableImageError("Traceback …\nValueError: a.png is empty"), "a.png is empty"),
        (OSError(errno.ENOSPC, "No space left", "run/a.csv"), "run/a.csv could not be written: No space left"),
        (FileExistsError(errno.EEXIST, "File exists", "a.yaml"), "a.yaml could not be written: File exists"),
        (NotADirectoryError(errno.ENOTDIR, "Not a directory", "a/b"), "a/b could not be written: Not a directory"),
        (PermissionError(errno.EACCES, "Permission denied", "frames"), "frames could not be opened: Permission denied"),
        (
            RuntimeError("DataLoader worker (pid 7) is killed by signal: Killed. "),
            "data.workers must fit the memory, got one that ended (DataLoader worker (pid 7) is killed by signal: Kill",
        ),
        (RuntimeError(CLOSED), "another process of the training has ended: it printed why, or was killed, as for"),
    ):
        with pytest.raises(SystemExit) as stop:
            run_main(lambda error=error: fail(error))
        assert stop.value.code == 1
        assert capsys.readouterr().err.startswith(f"error: {message}")
    with pytest.raises(TypeError, match="not callable"):
        run_main(lambda: fail(TypeError("'int' object is not callable")))


@pytest.mark.quick
def test_only_the_first_process_of_a_training_says_that_another_has_ended_or_that_it_was_interrupted(
    run_main, capsys, monkeypatch
):
    for error, code in ((RuntimeError(CLOSED), 1), (KeyboardInterrupt(), 130)):
        for rank in range(2):

            def fail(error: BaseException = error) -> None:
                raise error

            monkeypatch.setenv("LOCAL_RANK", str(rank))
            with pytest.raises(SystemExit) as stop:
                run_main(fail)
            assert (stop.value.code, len(capsys.readouterr().err.splitlines())) == (code, 1 - rank)


@pytest.mark.quick
def test_an_interrupt_while_a_command_loads_is_one_line(capsys, monkeypatch):
    def interrupt(name):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", ["torchrefract.degrade"])
    monkeypatch.setattr("importlib.import_module", interrupt)
    with pytest.raises(SystemExit) as stop:
        command("degrade", "", "degradation:degrade")()
    assert (stop.value.code, capsys.readouterr().err) == (130, "stopped\n")


def test_ctrl_c_while_the_package_is_imported_is_one_line():
    with running("-m", "torchrefract.degrade") as process:
        assert process.stderr is not None
        assert process.stderr.readline() == "torchrefract: loading …\n"
        process.send_signal(signal.SIGINT)
        assert process.communicate() == (None, "stopped\n")
    assert process.returncode not in (None, 0)


@pytest.mark.quick
def test_an_output_whose_reader_has_ended_stops_a_command_in_one_line(run_main, capsys, monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)

    def write() -> None:
        with disk_errors(Path("out")):
            print("3 pairs exist already", flush=True)

    with open(writer, "w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        with pytest.raises(SystemExit) as stop:
            run_main(write)
    message = "stopped, as the reader of the output has ended; the same command continues\n"
    assert (stop.value.code, capsys.readouterr().err) == (1, message)


@pytest.mark.quick
def test_letters_that_a_redirected_output_lacks_are_escaped(monkeypatch):
    output = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(output, encoding="cp1252", write_through=True))
    monkeypatch.setattr(sys, "argv", ["degrade", "--help"])
    command("degrade", "folder 路 …", "none:none")()
    assert output.getvalue().startswith(b"folder \\u8def \x85\n")


def test_a_warning_to_the_user_is_one_line(run_main):
    def warn() -> None:
        with warnings.catch_warnings():  # pytest would keep them
            warnings.simplefilter("always")
            warnings.showwarning = lambda *given, **_: sys.stderr.write(warnings.formatwarning(*given[:4]))
            warnings.warn("the lens is a guess", stacklevel=2)
            warnings.warn("old", FutureWarning, stacklevel=2)

    first, second = run_main(warn).splitlines()[:2]
    assert first == "warning: the lens is a guess"
    assert second.endswith("FutureWarning: old")


@pytest.mark.quick
def test_naming_adds_the_part_to_errors_of_values_only():
    with pytest.raises(UsageError, match=r"^size: too small$"), naming("size"):
        raise ValueError("too small")
    with pytest.raises(UnreadableImageError, match=r"^a\.png is empty$"), naming("size"):
        raise UnreadableImageError("a.png is empty")
    with pytest.raises(KeyError), naming("size"):
        raise KeyError("size")


@pytest.mark.quick
def test_progress_hands_on_its_items_and_prints_a_line_outside_a_terminal_only_if_they_take_long(capsys, monkeypatch):
    assert list(progress(range(3), "working", count=3)) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr("torchrefract.cli.progress._MESSAGE_INTERVAL", 0.02)
    for item in progress(range(2), "working", count=2):
        if item == 1:
            time.sleep(0.2)
    assert capsys.readouterr().err.startswith("working: 1 of 2, 0 s, about 0 s left\n")


# --- arguments


ODD_NAMES = ("Größe", "clip (1)", "epoch=1-step=20", "it#5%", "a@b, [c] {d}: e", "a${seed}b", "line\nbreak", "null")
ODD_NAMES += ("霧~ $HOME `x` 1e3",)
ODD_ENDS = ("'quoted'", '"', "back\\slash\\")  # which could end the quotes around a name, or escape them
# The options of each command that take the name of a file, and the arguments that it needs.
FILE_OPTIONS = {
    "preview": (("image", "depth"), ()),
    "generate": (("source",), ("scene=paper_weather", "out=o", "license=l")),
    "degrade": (("source", "out", "labels", "depth"), ("scene=paper_weather", "source=s", "out=o")),
    "calibrate": (("images", "out"), ()),
    "rectify": (("input", "camera"), ("camera=c", "input=i")),
    "restore": (("ckpt_path", "input", "out"), ("ckpt_path=a", "input=b")),
    "export": (("ckpt_path",), ()),
    "make_board": (("out",), ()),
    "robustness": (
        ("model", "weights", "data", "labels", "depth", "camera", "base", "out"),
        ("model=a", "data=d", "out=o"),
    ),
    "train": (("data.root", "ckpt_path", "run_dir", "hydra.run.dir"), ("+task=undistort", "data=frames")),
}


@pytest.mark.parametrize("name", FILE_OPTIONS)
def test_any_name_of_a_file_reaches_the_configuration_of_each_command(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options, required = FILE_OPTIONS[name]
    folder = Path(CONFIG_DIR, name)
    with initialize_config_dir(str(folder if folder.is_dir() else CONFIG_DIR), version_base="1.3"):
        for end in ODD_ENDS:
            path = Path(tmp_path, *ODD_NAMES, end)
            path.mkdir(parents=True)
            words = [word for word in required if word.partition("=")[0] not in options]
            words = prepare_arguments(name, [*(f"{option}={path}" for option in options), *words])
            cfg = compose(name, words, return_hydra_config=True)
            assert [OmegaConf.select(cfg, option) for option in options] == [str(path)] * len(options)


@pytest.mark.quick
@pytest.mark.parametrize("name", FILE_OPTIONS)
def test_a_path_that_begins_with_a_tilde_lies_in_the_home_folder(name, monkeypatch):
    monkeypatch.setenv("HOME", "/users/me")
    for option in FILE_OPTIONS[name][0]:
        for flags, values, expected in (
            ([], "~/drive.x", "'/users/me/drive.x'"),
            (["-m"], "~/a.x,~/b.x", "'/users/me/a.x','/users/me/b.x'"),
        ):
            words = prepare_arguments(name, [f"{option}={values}", *FILE_OPTIONS[name][1], *flags])
            assert words[0] == f"{option}={expected}"


@pytest.mark.quick
def test_a_value_that_is_text_is_quoted_unless_it_is_quoted_or_an_interpolation(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for word, expected in (
        ("license=[CC0], by us", "license='[CC0], by us'"),
        ("license=null", "license=null"),
        ("license='a'", "license='a'"),
        ("license=a ${b}", "license='a \\${b}'"),
        ("+ckpt_path=a=1.ckpt", "+ckpt_path='a=1.ckpt'"),
        ("out=runs/${seed}", "out='runs/${seed}'"),
        ("seed=1,2", "seed=1,2"),
        ("data.size=[3,4]", "data.size=[3,4]"),
    ):
        assert prepare_arguments("restore", [word]) == [expected]


@pytest.mark.quick
def test_a_multirun_splits_names_of_files_at_commas_and_its_option_may_stand_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a, b").touch()
    words = ["input=ä,b=c", "-m", "out=choice(x,y)", "ckpt_path=a, b", "license=l, m", "--package", "p", "size=null"]
    assert prepare_arguments("restore", words) == [
        *("input='ä','b=c'", "out=choice(x,y)", "ckpt_path='a, b'", "license='l, m'", "size=null"),
        *("-m", "--package", "p"),
    ]


def test_names_of_files_are_the_values_of_a_multirun(call, tmp_path):
    words = ("out=ä=1.pdf,b#2.pdf", "-m", "square_mm=20")
    outcome = call("make_board", *words)
    assert outcome.code == 0, outcome.err
    assert {path.name for path in tmp_path.iterdir()} >= {"ä=1.pdf", "b#2.pdf"}


COMMANDS = ("train", "eval", "preview", "degrade", "generate", "restore", "export")
COMMANDS += ("calibrate", "rectify", "make_board", "playground")


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.quick
def test_a_help_page_says_what_a_command_does_with_options_that_exist_and_two_examples(call, name, tmp_path):
    outcome = call(name, "seed=1", "--help")
    assert (outcome.code, outcome.err, list(tmp_path.iterdir())) == (0, "", [])
    assert len(outcome.out.splitlines()) < 32
    _, options, examples = re.split(r"\n(?:Options|Examples):\n", outcome.out)
    words = [
        [word for word in shlex.split(line.strip()) if word not in ("python", "-m", f"torchrefract.{name}")]
        for line in examples.splitlines()
        if line.startswith("    python -m ")
    ]
    assert len(words) == 2
    named = re.findall(r"^    ([+\w.]+)=", options, re.MULTILINE)
    assert 3 <= len(named) <= 10
    choices = {"train": ["data=frames", "scene=cape_town_fog"], "preview": ["scene=cape_town_fog"]}
    choices["eval"] = ["+task=undistort", "data=frames", "scene=cape_town_fog", "model=ddpm"]
    with initialize_config_dir(CONFIG_DIR, version_base="1.3"):
        for example in words:
            compose(name, [*example, *choices["eval"]] if name == "eval" else prepare_arguments(name, example))
        required = [word for word in words[0] if "=" in word and word.partition("=")[0] not in ("data", "scene")]
        if name in ("degrade", "generate"):
            required += ["scene=cape_town_fog"]
        cfg: Any = compose(
            name, [quote_text(word) for word in required] + choices.get(name, []), return_hydra_config=True
        )
    for option in named:
        parent, _, key = option.lstrip("+").rpartition(".")
        assert key in [*(OmegaConf.select(cfg, parent) if parent else cfg)] or option == "+model.steps", option


def test_a_command_without_a_task_lists_the_tasks(call):
    message = call("train").message
    assert message.startswith("+task must be one of deweather, undistort: ")
    assert "python -m torchrefract.train +task=" in message


def test_an_evaluation_without_a_checkpoint_names_the_option(call):
    message = "ckpt_path must be the path of a checkpoint: add ckpt_path=<run>/best.ckpt, got none"
    assert call("eval").message == message
    assert call("eval", "ckpt_path=a=1.ckpt").message.endswith(
        "must be a checkpoint file, such as <run>/last.ckpt, or the name lens_small, got a=1.ckpt"
    )


def test_a_run_that_fails_leaves_no_empty_folder_but_those_that_existed(call, tmp_path):
    frames = ("data=frames", "data.root=none")
    (tmp_path / "kept").mkdir()
    for words in ((), ("hydra.run.dir=new/run",), ("run_dir=other",), ("hydra.run.dir=kept",)):
        assert call("train", "+task=undistort", *frames, *words).code == 1
    several = call("train", "-m", "+task=undistort", *frames, "seed=1,2")
    assert several.code == 1
    assert several.err.count("root must be a folder of frames") == len(several.err.splitlines()) == 2
    assert call("calibrate", "images=none", "out=a/camera").code == 1
    assert call("rectify", "input=none", "camera=none", "out=a/rectified").code == 1
    assert call("generate", "scene=paper_weather", "source=none", "out=a/pairs", "license=CC0").code == 1
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == ["kept"]


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
        ("model=unet", "model must be one of bridge, ddpm, ddpm_cat256, .* resunet, segformer, got unet$"),
        ("scene=london", "scene must be one of cape_town_fog, cheap_dashcam, highveld_heat_haze, .* got london"),
        (
            "scene=my/scenes/fog.yaml",
            "scene must be one of .*, got my/scenes/fog.yaml; a file DIR/scene/NAME.yaml is given by --config-dir DIR "
            "scene=NAME$",
        ),
        ("logger=false", "logger must be one of csv, tensorboard, wandb, got false$"),
        ("data=null", "data must be one of frames, pairs, road_scenes, got null$"),
        ("sede=1", "an option must be one of .*, got sede; did you mean seed"),
        ("data.color=red", "data.color"),
        ("data.worker=1", r"data.worker.*; did you mean data.workers\?$"),
        ("frames", "an option must be NAME=VALUE, got frames$"),
        ("+model.depth=3", "model: .*'depth'"),
        ("model.network.encoder=tu-nonsense", "model: encoder must be a name of .*, got tu-nonsense"),
        ("data.size=[64", r"\[64"),
        ("data.batch_size=9", "data: batch_size must be at most the 8 training frames, got 9"),
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
    for job, seed in enumerate((3, 4)):
        assert OmegaConf.select(OmegaConf.load(tmp_path / f"sweep/{job}/config.yaml"), "data.seed") == seed


def test_a_job_of_a_multirun_that_fails_does_not_stop_the_others(call, small, tmp_path):
    words = ("-m", "+task=undistort", *small, "trainer.max_epochs=0", "model.lr=-1,0.1", "hydra.sweep.dir=sweep")
    assert call("train", *words).message == "model: lr must be a number of at least 0, got -1"
    assert [path.name for path in tmp_path.glob("sweep/*/config.yaml")] == ["config.yaml"]


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

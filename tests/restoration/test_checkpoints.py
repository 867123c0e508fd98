import errno
import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from pytorch_lightning import Trainer
from torch import nn

from torchrefract.restoration import checkpoints
from torchrefract.restoration.checkpoints import (
    AtomicCheckpointIO,
    CheckpointError,
    Origin,
    check_fits,
    model_name,
    read_checkpoint,
)
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.tasks import Undistort


def content(value: float = 1.0, task: str = "undistort"):
    weights = {"first.weight": torch.full((8, 8), value), "first.bias": torch.full((8,), value)}
    return {
        "state_dict": weights,
        "task": task,
        "epoch": 3,
        "flows": (torch.ones(2, 3, 4), torch.ones(1, 3, 4)),
    }


@pytest.fixture
def path(tmp_path) -> Path:
    path = tmp_path / "run" / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(content(), path)
    return path


def refused(path: Path, task: str = "undistort") -> str:
    """The one line that is said about a file."""
    with pytest.raises(CheckpointError) as caught:
        read_checkpoint(path, task=task)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("ckpt_path must be ")
    assert str(path) in message
    return message


def test_what_is_saved_comes_back(path):
    found = read_checkpoint(path, task="undistort")
    expected = content()
    assert found["epoch"] == 3
    for name, value in expected["state_dict"].items():
        assert torch.equal(found["state_dict"][name], value)
    assert torch.equal(found["flows"][0], expected["flows"][0])
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def test_a_new_checkpoint_takes_the_place_of_the_old(path):
    AtomicCheckpointIO().save_checkpoint(content(2.0), path)
    assert read_checkpoint(path, task="undistort")["state_dict"]["first.bias"][0] == 2
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def half_a_save(error: Exception):
    """torch.save on a disk that fills up in the middle of a file."""
    whole = torch.save

    def save(value, file) -> None:
        whole(value, file)
        data = Path(file).read_bytes()
        Path(file).write_bytes(data[: len(data) // 2])
        raise error

    return save


FULL = [
    OSError(errno.ENOSPC, "No space left on device"),
    RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos 64 vs 0"),
]


@pytest.mark.parametrize("error", FULL, ids=["OSError", "RuntimeError"])
def test_a_full_disk_leaves_the_checkpoint_before_whole(path, monkeypatch, error):
    before = path.read_bytes()
    monkeypatch.setattr(checkpoints.torch, "save", half_a_save(error))
    with pytest.raises(CheckpointError) as caught:
        AtomicCheckpointIO().save_checkpoint(content(2.0), path)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]
    message = str(caught.value)
    assert re.fullmatch(
        rf"{re.escape(str(path))} could not be written \(.*\); .* is whole: make room .* ckpt_path=.*", message
    )
    assert "\n" not in message


@pytest.mark.parametrize("error", FULL, ids=["OSError", "RuntimeError"])
def test_a_full_disk_at_the_first_save_leaves_no_part_of_a_file(tmp_path, monkeypatch, error):
    monkeypatch.setattr(checkpoints.torch, "save", half_a_save(error))
    with pytest.raises(CheckpointError, match=r"last\.ckpt could not be written") as caught:
        AtomicCheckpointIO().save_checkpoint(content(), tmp_path / "last.ckpt")
    assert "whole" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "run").write_text("a file in the way")
    with pytest.raises(CheckpointError, match=r"run/last\.ckpt could not be written \((File exists|Not a directory)\)"):
        AtomicCheckpointIO().save_checkpoint(content(), tmp_path / "run" / "last.ckpt")


def test_a_checkpoint_of_another_task_is_refused_by_name(path):
    assert "the task deweather, got" in (message := refused(path, task="deweather"))
    assert message.endswith("of undistort")


def test_a_missing_checkpoint_and_a_folder_are_refused(tmp_path):
    for path in (tmp_path / "none.ckpt", tmp_path):
        assert "<run>/last.ckpt" in refused(path)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.1, 0.5, 0.9, 0.99, 0.9999])
def test_a_truncated_checkpoint_is_refused(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    assert "damaged" in refused(path)


@pytest.mark.parametrize("seed", range(8))
def test_random_bytes_are_refused(tmp_path, seed):
    path = tmp_path / "noise.ckpt"
    path.write_bytes(random.Random(seed).randbytes(20_000))
    refused(path)


@pytest.mark.parametrize("text", ["epoch,step\n0,3\n", "\x80\x02.", "("], ids=["csv", "pickle", "bracket"])
def test_a_text_file_is_refused(tmp_path, text):
    path = tmp_path / "metrics.csv"
    path.write_text(text, encoding="latin-1")
    refused(path)


def with_holes(data: bytes, *, seed: int) -> Iterator[bytes]:
    """A file with a few bytes lost, at places all over it: lost sectors read as noise."""
    dice = random.Random(seed)
    for start in range(0, len(data) - 16, len(data) // 150):
        yield data[:start] + dice.randbytes(dice.choice((1, 4, 16))) + data[start + 16 :]
        yield data[:start] + dice.randbytes(16) + data[start + 16 :]


def readable(path: Path, versions: Iterator[bytes]) -> Iterator[dict[str, Any]]:
    for version in versions:
        path.write_bytes(version)
        try:
            yield read_checkpoint(path, task="undistort")
        except CheckpointError:
            continue


@pytest.mark.parametrize("seed", range(4))
def test_a_checkpoint_with_a_hole_is_read_or_refused_and_nothing_else(path, seed):
    found = list(readable(path, with_holes(path.read_bytes(), seed=seed)))
    assert all(checkpoint["task"] == "undistort" for checkpoint in found)


def test_no_checkpoint_with_a_hole_gives_other_weights(path):
    expected = content()["state_dict"]
    for found in readable(path, with_holes(path.read_bytes(), seed=0)):
        assert found["state_dict"].keys() == expected.keys()
        for name, value in found["state_dict"].items():
            assert torch.equal(value, expected[name])


class Trap:
    """What a hostile file would hold: a call of its own."""

    def __reduce__(self):
        return Path.touch, (Path("trapped"),)


def test_no_code_from_a_file_is_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save(content() | {"hyper_parameters": Trap()}, tmp_path / "hostile.ckpt")
    refused(tmp_path / "hostile.ckpt")
    assert not (tmp_path / "trapped").exists()


@pytest.mark.parametrize("value", [[1, 2], {"state_dict": {}}, {"weights": torch.ones(2)}, torch.ones(3)])
def test_a_file_of_something_else_is_refused(tmp_path, value):
    torch.save(value, tmp_path / "other.ckpt")
    assert "torchrefract" in refused(tmp_path / "other.ckpt")


def test_the_weights_of_such_a_model_fit():
    model = nn.Sequential(nn.Linear(8, 8))
    check_fits({"state_dict": model.state_dict()}, model, Path("last.ckpt"))


@pytest.mark.parametrize(
    "other",
    [nn.Sequential(nn.Linear(8, 9)), nn.Sequential(nn.Linear(8, 8), nn.Linear(8, 8)), nn.Sequential()],
    ids=["size", "more", "less"],
)
def test_the_weights_of_another_model_do_not_fit(other):
    model = nn.Sequential(nn.Linear(8, 8))
    with pytest.raises(
        CheckpointError,
        match=r"^ckpt_path must be a checkpoint of the model that model= names, got last.ckpt, where \d\..* differs$",
    ):
        check_fits({"state_dict": other.state_dict()}, model, Path("last.ckpt"))


RESUNET = {"network": {"_target_": "torchrefract.restoration.models.resunet.ResUNet", "encoder": "tu-resnet34"}}
SEGFORMER = {"network": {"_target_": "torchrefract.restoration.models.segformer.SegFormer", "encoder": "mit_b1"}}


def test_the_weights_of_another_model_are_refused_by_both_names():
    model, other = nn.Sequential(nn.Linear(8, 8)), nn.Sequential(nn.Linear(8, 9))
    checkpoint = {"state_dict": other.state_dict(), "config": {"model": RESUNET}}
    with pytest.raises(CheckpointError) as caught:
        check_fits(checkpoint, model, Path("last.ckpt"), config=SEGFORMER)
    wanted = "ckpt_path must be a checkpoint of SegFormer (mit_b1), which model= names"
    assert str(caught.value) == f"{wanted}, got last.ckpt of ResUNet (tu-resnet34)"


def test_a_model_is_called_by_its_network_and_encoder():
    assert model_name(RESUNET) == "ResUNet (tu-resnet34)"
    assert model_name({"network": {"_target_": "a.b.Unet"}}) == "Unet"
    assert model_name({"_target_": "a.b.Diffusion", "steps": 3}) == "Diffusion"


def test_a_checkpoint_says_where_it_comes_from(tmp_path):
    config, data = {"model": {"lr": 1e-3, "size": [3, 4]}, "task": None}, {"frames": 3, "sha256": "00"}
    trainer = Trainer(
        callbacks=[Origin(config, data=data, licenses={"data": "CC0"})],
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        plugins=[AtomicCheckpointIO()],
    )
    trainer.strategy.connect(Restoration(lambda channels, smooth: nn.Linear(1, channels), Undistort()))
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    found = read_checkpoint(tmp_path / "last.ckpt")
    assert (found["config"], found["data"], found["licenses"]) == (config, data, {"data": "CC0"})

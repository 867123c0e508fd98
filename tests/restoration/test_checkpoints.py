import errno
import random
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from torch import nn

from torchrefract.restoration import checkpoints
from torchrefract.restoration.checkpoints import (
    AtomicCheckpointIO,
    CheckpointError,
    check_fits,
    load_model,
    model_name,
    read_checkpoint,
    rename_weights,
)

TASKS = "torchrefract.restoration.tasks"


def content(value: float = 1.0) -> dict[str, Any]:
    weights = {"first.weight": torch.full((8, 8), value), "first.bias": torch.full((8,), value)}
    flows = (torch.ones(2, 3, 4), torch.ones(1, 3, 4))
    return {"state_dict": weights, "task": "undistort", "epoch": 3, "flows": flows}


@pytest.fixture
def path(tmp_path) -> Path:
    path = tmp_path / "run" / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(content(), path)
    return path


def error_of(read: Callable[[], object], path: Path) -> str:
    """Return the one-line message of a CheckpointError, which names the file."""
    with pytest.raises(CheckpointError) as caught:
        read()
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("ckpt_path must ")
    assert str(path) in message
    return message


def read_error(path: Path, task: str = "undistort") -> str:
    return error_of(lambda: read_checkpoint(path, task=task), path)


@pytest.mark.quick
def test_a_saved_checkpoint_is_read_back_and_a_new_one_replaces_it(path):
    checkpoint, expected = read_checkpoint(path, task="undistort"), content()
    assert checkpoint["epoch"] == 3
    for name, value in expected["state_dict"].items():
        assert torch.equal(checkpoint["state_dict"][name], value)
    assert torch.equal(checkpoint["flows"][0], expected["flows"][0])
    AtomicCheckpointIO().save_checkpoint(content(2.0), path)
    assert read_checkpoint(path, task="undistort")["state_dict"]["first.bias"][0] == 2
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def interrupted_save(error: Exception):
    """Return torch.save on a disk that fills up halfway."""
    save = torch.save

    def interrupted(value, file) -> None:
        save(value, file)
        data = Path(file).read_bytes()
        Path(file).write_bytes(data[: len(data) // 2])
        raise error

    return interrupted


def test_a_worker_that_is_killed_while_a_checkpoint_is_written_is_not_taken_for_a_full_disk(path, monkeypatch):
    error = RuntimeError("DataLoader worker (pid 7) is killed by signal: Killed. ")
    monkeypatch.setattr(checkpoints.torch, "save", interrupted_save(error))
    with pytest.raises(RuntimeError, match=r"^DataLoader worker \(pid 7\)"):
        AtomicCheckpointIO().save_checkpoint(content(2.0), path)


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), RuntimeError("[enforce fail at inline_container.cc]")]
)
def test_a_full_disk_keeps_the_previous_checkpoint(path, monkeypatch, error):
    before, first = path.read_bytes(), path.with_name("first.ckpt")
    monkeypatch.setattr(checkpoints.torch, "save", interrupted_save(error))
    with pytest.raises(CheckpointError) as caught:
        AtomicCheckpointIO().save_checkpoint(content(2.0), path)
    pattern = rf"{re.escape(str(path))} could not be written \(.*\); .* is intact: free disk space .* ckpt_path="
    assert re.fullmatch(pattern, str(caught.value))
    with pytest.raises(CheckpointError, match=r"first\.ckpt could not be written \([^;]*\): free disk space"):
        AtomicCheckpointIO().save_checkpoint(content(2.0), first)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def test_a_folder_that_cannot_be_created_is_named(tmp_path):
    (tmp_path / "run").write_text("a file in the way")
    with pytest.raises(CheckpointError, match=r"run/last\.ckpt could not be written \((File exists|Not a directory)\)"):
        AtomicCheckpointIO().save_checkpoint(content(), tmp_path / "run" / "last.ckpt")


def test_a_missing_truncated_or_other_checkpoint_is_rejected(path):
    assert read_error(path, task="deweather").endswith(f"of the task deweather, got {path} of undistort")
    data = path.read_bytes()
    for share in (0.0, 0.01, 0.5, 0.9999):
        path.write_bytes(data[: int(share * len(data))])
        assert "damaged" in read_error(path)
    for missing in (path.with_name("none.ckpt"), path.parent):
        assert "<run>/last.ckpt" in read_error(missing)


def with_holes(data: bytes) -> Iterator[bytes]:
    """Yield copies of a file with a few lost bytes at places all over it."""
    dice = random.Random(0)
    for start in range(0, len(data) - 16, len(data) // 150):
        yield data[:start] + dice.randbytes(dice.choice((1, 4, 16))) + data[start + 16 :]
        yield data[:start] + dice.randbytes(16) + data[start + 16 :]


def test_a_checkpoint_with_a_hole_is_rejected_or_gives_the_saved_weights(path):
    expected = content()["state_dict"]
    for data in with_holes(path.read_bytes()):
        path.write_bytes(data)
        try:
            checkpoint = read_checkpoint(path, task="undistort")
        except CheckpointError:
            continue
        assert checkpoint["state_dict"].keys() == expected.keys()
        for name, value in checkpoint["state_dict"].items():
            assert torch.equal(value, expected[name])


@pytest.mark.parametrize("value", [[1, 2], {"state_dict": {}}, {"weights": torch.ones(2)}, torch.ones(3)])
def test_a_file_with_other_content_is_rejected(tmp_path, value):
    torch.save(value, tmp_path / "other.ckpt")
    assert "torchrefract" in read_error(tmp_path / "other.ckpt")


@pytest.mark.parametrize(
    "other",
    [nn.Sequential(nn.Linear(8, 9)), nn.Sequential(nn.Linear(8, 8), nn.Linear(8, 8)), nn.Sequential()],
    ids=["size", "more", "less"],
)
def test_weights_fit_their_model_and_no_other(other):
    model = nn.Sequential(nn.Linear(8, 8))
    check_fits({"state_dict": model.state_dict()}, model, Path("last.ckpt"))
    message = error_of(
        lambda: check_fits({"state_dict": other.state_dict()}, model, Path("last.ckpt")), Path("last.ckpt")
    )
    assert re.fullmatch(r".* of the model that model= names, got last.ckpt, where \d\..* differs", message)


def network(name: str, encoder: str) -> dict[str, Any]:
    return {"network": {"_target_": f"torchrefract.restoration.models.coordconv.{name}", "encoder": encoder}}


def test_weights_of_another_network_are_rejected_by_both_names():
    checkpoint = {
        "state_dict": nn.Linear(8, 9).state_dict(),
        "config": {"model": network("ResUNet", "tu-resnet34")},
    }
    with pytest.raises(CheckpointError) as caught:
        check_fits(checkpoint, nn.Linear(8, 8), Path("last.ckpt"), config=network("SegFormer", "mit_b1"))
    expected = "ckpt_path must be a checkpoint of SegFormer (mit_b1), which model= names"
    assert str(caught.value) == f"{expected}, got last.ckpt of ResUNet (tu-resnet34)"


def test_a_model_is_named_by_its_network_and_encoder():
    assert model_name(network("ResUNet", "tu-resnet34")) == "ResUNet (tu-resnet34)"
    assert model_name({"network": {"_target_": "a.b.Unet"}}) == "Unet"
    assert model_name({"_target_": "a.b.Diffusion", "steps": 3}) == "Diffusion"


def test_weights_of_older_checkpoints_get_their_new_names():
    old = {"network.whole.layers.0.bias": 1, "network.network.conv1.parametrizations.weight.0.place": 2, "mean": 3}
    new = {
        "network.polynomial_head.layers.0.bias": 1,
        "network.network.conv1.parametrizations.weight.0.coordinate_weight": 2,
        "mean": 3,
    }
    assert rename_weights(old) == new  # pyright: ignore[reportArgumentType]  # numbers stand for tensors


def test_networks_of_older_checkpoints_are_built_by_their_new_names(write):
    for name, encoder in (("ResUNet", "tu-test_resnet"), ("SegFormer", "mit_b0")):
        target = f"torchrefract.restoration.models.{name.lower()}.{name}"
        old = config(network=config()["network"] | {"_target_": target, "encoder": encoder})
        weights = instantiate(config(network=old["network"] | {"_target_": target.replace(name.lower(), "coordconv")}))
        loaded = load_model(write(config={"model": old}, state_dict=weights.state_dict()))
        assert loaded.name == f"{name} ({encoder})"


def config(**changes: Any) -> dict[str, Any]:
    """Return the configuration of a model."""
    network = {
        "_target_": "torchrefract.restoration.models.coordconv.ResUNet",
        "_partial_": True,
        "encoder": "tu-test_resnet",
    }
    task = {"_target_": f"{TASKS}.Undistort", "limit": 0.5}
    return {"_target_": "torchrefract.restoration.module.Restoration", "task": task, "network": network, **changes}


@pytest.fixture(scope="module")
def saved() -> dict[str, Any]:
    """Return the content of a checkpoint of an untrained model with a random last layer."""
    torch.manual_seed(0)
    model = instantiate(config())
    nn.init.normal_(model.network.network.segmentation_head[0].weight)
    return {
        "state_dict": model.state_dict(),
        "task": "undistort",
        "flows": (torch.ones(2, 3, 4), torch.ones(1, 3, 4)),
        "config": {"model": config(), "seed": 0},
        "data": {"size": [32, 64]},
        "licenses": {"data": None},
    }


@pytest.fixture
def write(tmp_path, saved) -> Callable[..., Path]:
    """Return a function that writes the checkpoint with changes."""

    def write(**changes: Any) -> Path:
        AtomicCheckpointIO().save_checkpoint(saved | changes, tmp_path / "best.ckpt")
        return tmp_path / "best.ckpt"

    return write


def load_error(path: Path) -> str:
    return error_of(lambda: load_model(path), path)


@torch.no_grad()
def test_a_checkpoint_alone_rebuilds_its_model(write, saved):
    loaded = load_model(write())
    assert (loaded.name, loaded.task, loaded.size) == ("ResUNet (tu-test_resnet)", "undistort", (32, 64))
    assert loaded.licenses == {"data": None}
    assert not loaded.model.training
    model = instantiate(config())
    model.load_state_dict(saved["state_dict"])
    image = torch.rand(1, 3, 32, 64)
    flow = loaded.model(image).flow
    assert torch.equal(flow, model.eval()(image).flow)
    assert flow.abs().max() > 0.1
    changed = load_model(write(), changes={"task": {"limit": 0.25}})
    torch.testing.assert_close(2 * changed.model(image).flow, flow)


class Other:
    """A class outside the package."""

    def __init__(self) -> None:
        raise AssertionError("instantiated")


@pytest.mark.parametrize(
    "target",
    [
        f"{__name__}.Other",
        "os.system",
        "torchrefract_other.models.Network",
        "torchrefract._io.os.replace",
        "torchrefract.restoration.module.torch.nn.Linear",
        "torchrefract.restoration.module.LightningModule",
        "torchrefract._io.replace_file",
        "torchrefract.restoration.no_module.Network",
        "torchrefract.Camera",
        "torchrefract.",
        7,
        None,
        ["torchrefract.restoration.module.Restoration"],
    ],
)
def test_only_models_and_tasks_of_the_package_are_instantiated(write, target, monkeypatch):
    monkeypatch.setattr("os.system", lambda _: pytest.fail("run"))
    hostile = {"_target_": target}
    for model in (config() | hostile, config(network=hostile), config(metric_size=[{"nested": [hostile]}])):
        message = load_error(write(config={"model": model}, state_dict={}))
        assert f"must name models and tasks of torchrefract only, got {write()} with {target!r}" in message


def test_loading_reads_no_environment_variable(write):
    message = load_error(write(config={"model": config(lr="${oc.env:HOME}")}))
    assert "must hold a resolved configuration" in message
    assert str(Path.home()) not in message.replace(str(write()), "")


def test_loading_ignores_pretrained_weights(write):
    # Undistort has no such argument, so the key is still passed on, with None for its value.
    task = {"_target_": f"{TASKS}.Undistort", "pretrained": "imagenet"}
    assert "pretrained" in load_error(write(config={"model": config(task=task)}))
    nested = config(task={"_target_": f"{TASKS}.Undistort", "limit": {"pretrained": "imagenet"}})
    loaded = load_model(write(config={"model": nested}))
    assert vars(loaded.model.task)["limit"] == {"pretrained": None}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"config": None}, "must be a checkpoint with its configuration, as torchrefract.train writes them"),
        ({"config": {"model": "ResUNet"}}, "must be a checkpoint with its configuration"),
        ({"data": [1]}, "must be a checkpoint with its configuration"),
        ({"data": {"size": None}}, "must hold the size of its frames"),
        ({"data": {"size": [64, 0]}}, "must hold the size of its frames"),
        ({"data": {"size": "64x112"}}, "must hold the size of its frames"),
        ({"config": {"model": config(depth=3)}}, "must be of a model that can be built"),
        ({"config": {"model": {"_target_": f"{TASKS}.Deweather"}}}, "must be of a model, got"),
        ({"config": {"model": config(network=config()["network"] | {"encoder": "tu-resnet18"})}}, "differs"),
    ],
)
def test_a_checkpoint_that_rebuilds_no_model_says_why(write, changes, message):
    assert message in load_error(write(**changes))


@pytest.mark.parametrize("encoder", ["tu-hf-hub:timm/resnet18.a1_in1k", "tu-hf_hub:a/b", "tu-local-dir:/x", "a/b"])
def test_an_encoder_of_the_hub_is_rejected_without_network(write, encoder, monkeypatch):
    monkeypatch.setattr("socket.getaddrinfo", lambda *_, **__: pytest.fail("reached the network"))
    message = load_error(write(config={"model": config(network=config()["network"] | {"encoder": encoder})}))
    assert "encoder must be a name of segmentation-models-pytorch or tu- and a name of timm, without" in message
    assert f"got {encoder}; add model.network.encoder=tu-NAME" in message


def test_a_missing_library_is_not_a_fault_of_the_checkpoint(write, monkeypatch):
    path = write()
    monkeypatch.setitem(sys.modules, "diffusers", None)
    monkeypatch.setitem(sys.modules, "diffusers.optimization", None)
    monkeypatch.delitem(sys.modules, "torchrefract.restoration.module")
    with pytest.raises(ModuleNotFoundError, match="diffusers"):
        load_model(path)

from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate

from torchrefract.restoration.checkpoints import AtomicCheckpointIO, CheckpointError
from torchrefract.restoration.loading import load_model

TASKS = "torchrefract.restoration.tasks"


def config(**changes: Any) -> dict[str, Any]:
    """The part of a configuration that makes a model."""
    network = {
        "_target_": "torchrefract.restoration.models.resunet.ResUNet",
        "_partial_": True,
        "encoder": "tu-mobilenetv3_small_050",
    }
    task = {"_target_": f"{TASKS}.Undistort", "limit": 0.5}
    return {"_target_": "torchrefract.restoration.module.Restoration", "task": task, "network": network, **changes}


@pytest.fixture(scope="module")
def saved() -> dict[str, Any]:
    """What a checkpoint holds of a model that was never trained, but for its last layer."""
    torch.manual_seed(0)
    model = instantiate(config())
    torch.nn.init.normal_(model.network.network.segmentation_head[0].weight)
    return {
        "state_dict": model.state_dict(),
        "task": "undistort",
        "flows": (torch.ones(2, 3, 4), torch.ones(1, 3, 4)),
        "config": {"model": config(), "seed": 0},
        "data": {"size": [32, 64]},
        "licenses": {"data": None},
    }


@pytest.fixture
def written(tmp_path, saved):
    """Writes such a checkpoint, some of it changed."""

    def write(**changes: Any) -> Path:
        AtomicCheckpointIO().save_checkpoint(saved | changes, tmp_path / "best.ckpt")
        return tmp_path / "best.ckpt"

    return write


def refused(path: Path) -> str:
    with pytest.raises(CheckpointError) as caught:
        load_model(path)
    message = str(caught.value)
    assert message.startswith("ckpt_path must ")
    assert str(path) in message
    return message


def test_a_checkpoint_alone_makes_its_model(written, saved):
    loaded = load_model(written())
    assert (loaded.name, loaded.task, loaded.size) == ("ResUNet (tu-mobilenetv3_small_050)", "undistort", (32, 64))
    assert loaded.licenses == {"data": None}
    assert not loaded.model.training
    model = instantiate(config())
    model.load_state_dict(saved["state_dict"])
    image = torch.rand(1, 3, 32, 64)
    with torch.no_grad():
        found, expected = loaded.model(image), model.eval()(image)
    assert torch.equal(found.flow, expected.flow)
    assert found.flow.abs().max() > 0.1


def test_the_user_may_change_what_the_checkpoint_says_of_its_model(written, saved):
    image = torch.rand(1, 3, 32, 64)
    with torch.no_grad():
        narrow = load_model(written(), changes={"task": {"limit": 0.25}}).model(image).flow
        wide = load_model(written()).model(image).flow
    torch.testing.assert_close(2 * narrow, wide)


class Trap:
    """Would be made if targets outside the package were."""

    def __init__(self) -> None:
        raise AssertionError("made")


@pytest.mark.parametrize(
    "target",
    [
        f"{__name__}.Trap",
        "os.system",
        "builtins.exec",
        "torchrefract_other.models.Network",
        "torchrefract._io.os.system",
        "torchrefract._io.os.replace",
        "torchrefract.restoration.module.torch.nn.Linear",
        "torchrefract.restoration.module.LightningModule",
        "torchrefract.data.media.write_video",
        "torchrefract.restoration.no_module.Network",
        "torchrefract.Camera",
        "torchrefract.",
        7,
        None,
        ["torchrefract.restoration.module.Restoration"],
    ],
)
@pytest.mark.parametrize("place", ["model", "network", "deep"])
def test_nothing_but_models_and_tasks_of_the_package_is_made(written, target, place, monkeypatch):
    monkeypatch.setattr("os.system", lambda _: pytest.fail("run"))
    hostile = {"_target_": target}
    model = {
        "model": config() | hostile,
        "network": config(network=hostile),
        "deep": config(metric_size=[{"nested": [hostile]}]),
    }[place]
    message = refused(written(config={"model": model}))
    assert f"must name models and tasks of torchrefract alone, got {written()} with {target!r}" in message


def test_no_variable_of_the_machine_is_read(written):
    message = refused(written(config={"model": config(lr="${oc.env:HOME}")}))
    assert "must hold a resolved configuration" in message
    assert str(Path.home()) not in message.replace(str(written()), "")


def test_no_pretrained_weights_are_looked_for(written, saved):
    # ResUNet would not take the word, so a None that is handed on is told apart from one that is not.
    network = {"_target_": f"{TASKS}.Undistort", "pretrained": "imagenet"}
    assert "pretrained" in refused(written(config={"model": config(task=network)}))
    nested = config(task={"_target_": f"{TASKS}.Undistort", "limit": {"pretrained": "imagenet"}})
    loaded = load_model(written(config={"model": nested}))
    assert vars(loaded.model.task)["limit"] == {"pretrained": None}


@pytest.mark.parametrize(
    "changes",
    [{"config": None}, {"config": {}}, {"config": {"model": "ResUNet"}}, {"data": None}, {"data": [1]}],
)
def test_a_checkpoint_without_its_configuration_is_refused(written, changes):
    assert "must be a checkpoint with its configuration, as torchrefract.train writes them" in refused(
        written(**changes)
    )


@pytest.mark.parametrize("size", [None, [64], [64, 0], ["64", "112"], [64, 112, 3], "64x112"])
def test_a_checkpoint_tells_the_size_of_its_frames(written, size):
    assert "must tell the size of its frames" in refused(written(data={"size": size}))


def test_a_configuration_that_makes_nothing_says_why(written):
    message = refused(written(config={"model": config(depth=3)}))
    assert "must be of a model that can be made" in message
    assert "depth" in message
    task = {"_target_": f"{TASKS}.Deweather"}
    assert "must be of a model, got" in refused(written(config={"model": task}))


def test_weights_of_another_encoder_are_refused(written):
    network = config()["network"] | {"encoder": "tu-resnet18"}
    assert "differs" in refused(written(config={"model": config(network=network)}))

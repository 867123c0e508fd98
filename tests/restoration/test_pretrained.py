from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close
from torch.utils.data import DataLoader

import torchrefract
from torchrefract import presets
from torchrefract.data.module import make_pair
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.restoration import pretrained
from torchrefract.restoration.checkpoints import AtomicCheckpointIO, CheckpointError, load_model, read_checkpoint
from torchrefract.restoration.metrics import endpoint_error
from torchrefract.restoration.models.lens_net import LensNet
from torchrefract.restoration.pretrained import find_checkpoint, model_names, read_weights, write_weights
from torchrefract.types import Frame

SIZE = (96, 160)
FULL_HD = (1080, 1920)
_MODELS = "torchrefract.restoration"


def content() -> dict[str, Any]:
    """Return the checkpoint of an untrained network with a random head."""
    torch.manual_seed(0)
    network = LensNet(2, smooth=True, weightings=2)
    torch.nn.init.normal_(network.head.layers[-1].weight, std=1.0)  # pyright: ignore[reportArgumentType]  # a linear layer
    config = {
        "_target_": f"{_MODELS}.module.Restoration",
        "task": {"_target_": f"{_MODELS}.tasks.Undistort"},
        "network": {"_target_": f"{_MODELS}.models.lens_net.LensNet", "_partial_": True, "weightings": 2},
    }
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIZE[0]), torch.linspace(-1, 1, SIZE[1]), indexing="ij")
    flows = 5 * torch.stack([x * (x * x + y * y), y * (x * x + y * y)]).double(), torch.full((1, *SIZE), 5.0).double()
    return {
        "state_dict": {f"network.{name}": value for name, value in network.state_dict().items()},
        "task": "undistort",
        "config": {"model": config},
        "data": {"size": [*SIZE]},
        "licenses": {"data": None},
        "flows": flows,
    }


@pytest.fixture
def files(tmp_path) -> tuple[Path, Path]:
    """Return a checkpoint and a file of its weights."""
    checkpoint, weights = tmp_path / "run" / "best.ckpt", tmp_path / "lens.safetensors"
    AtomicCheckpointIO().save_checkpoint(content(), checkpoint)
    write_weights(read_checkpoint(checkpoint), weights)
    return checkpoint, weights


@pytest.mark.quick
def test_a_file_of_weights_restores_as_its_checkpoint(files):
    (expected, actual), image = (load_model(file) for file in files), torch.rand(2, 3, *SIZE)
    assert actual[1:] == expected[1:]
    with torch.no_grad():
        flows: list[Tensor] = [loaded.model(image).flow for loaded in (expected, actual)]
    assert flows[0].abs().max() > 0.5
    assert_close(flows[1], flows[0], rtol=1e-2, atol=1e-2)  # half precision
    like = torch.zeros(1, 2, *SIZE)
    models: list[Any] = [expected.model, actual.model]
    constants = [model.constant_flow(like) for model in models]
    assert constants[0].max() > 1
    assert_close(constants[1], constants[0], rtol=0, atol=0.05)
    assert files[1].stat().st_size < 0.6 * files[0].stat().st_size


def test_a_damaged_file_of_weights_is_refused(files):
    _, path = files
    data = bytearray(path.read_bytes())
    data[-40] ^= 1
    path.write_bytes(data)
    with pytest.raises(CheckpointError, match=r"ckpt_path must be an intact checkpoint, got .*lens\.safetensors"):
        load_model(path)
    path.write_bytes(data[:100])
    with pytest.raises(CheckpointError, match="ckpt_path must be an intact checkpoint"):
        load_model(path)


def test_a_name_stands_for_a_shipped_file_unless_it_is_unknown(files, monkeypatch):
    assert find_checkpoint("best.ckpt") == Path("best.ckpt")
    with pytest.raises(ValueError, match=r"must be lens_small, got 'lens_huge'; .*load_model reads files"):
        torchrefract.pretrained("lens_huge")
    monkeypatch.setattr(pretrained, "_FOLDER", files[1].parent)
    assert model_names() == ["lens"]
    assert find_checkpoint("lens") == files[1]
    assert torchrefract.pretrained("lens").size == SIZE


@pytest.fixture(scope="module")
def lens_small() -> Any:
    return torchrefract.pretrained("lens_small")


def test_the_shipped_model_is_small(lens_small):
    path = find_checkpoint("lens_small")
    assert path.stat().st_size < 8e6
    assert sum(parameter.numel() for parameter in lens_small.model.parameters()) < 2e6
    assert read_weights(path)["data"]["source"] == "RoadScenes"  # rendered, so that no license binds its users
    assert path.with_suffix(".md").is_file()
    assert b"run_dir" not in path.read_bytes()  # nor other paths of the machine that trained it


def test_the_shipped_model_reads_the_lens_and_not_a_border(lens_small, make_frames):
    frames: Frame = make_frames(10, first=10_000, size=lens_small.size)
    effect = presets.cheap_dashcam(k1_range=(-0.33, 0.06), k2_range=(0.05, 0.16))  # of its training
    scores = {}
    for border in (None, "black", "mirrored"):
        pair = make_pair(frames, effect, seed=1, border=border)
        with torch.no_grad():
            flow = lens_small.model(pair.degraded).flow
        scores[border] = endpoint_error(flow, pair.flow, pair.valid, size=FULL_HD).mean().item()
    constant = (pair.flow * pair.valid).sum(dim=0) / pair.valid.sum(dim=0).clamp(min=1)
    of_constant = endpoint_error(constant.expand_as(pair.flow), pair.flow, pair.valid, size=FULL_HD).mean().item()
    assert scores[None] < 0.75 * of_constant
    for border in ("black", "mirrored"):  # the same lenses and frames
        assert abs(scores[border] / scores[None] - 1) < 0.2, scores


@pytest.mark.usefixtures("blank_figures")
def test_the_shipped_model_is_scored_by_its_name(call, lens_small):
    size = (96, 168)
    outcome = call("eval", "ckpt_path=lens_small", f"data.size=[{size[0]},{size[1]}]", "data.val_count=4")
    assert outcome.code == 0, outcome.err
    frames = next(iter(DataLoader(RoadScenes(4, size=size, first=512), batch_size=4)))  # as of its training
    pair = make_pair(frames, presets.cheap_dashcam(k1_range=(-0.33, 0.06), k2_range=(0.05, 0.16)), seed=0)
    with torch.no_grad():
        flow = lens_small.model(pair.degraded).flow
    error = endpoint_error(flow, pair.flow, pair.valid, size=FULL_HD).mean().item()
    (row,) = (line for line in outcome.out.splitlines() if line.startswith("model  "))
    assert f"{error:.2f} (" in row

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
import segmentation_models_pytorch as smp
import timm
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.testing import assert_close

from torchrefract.restoration.models.coordconv import CoordConvSegmenter, ResUNet, SegFormer, weights_license

COLORS = {"mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}
KINDS: dict[str, Callable[..., CoordConvSegmenter]] = {
    "mit_b0": SegFormer,
    "resnet18": ResUNet,
    "tu-resnet10t": ResUNet,
}

of_every_kind = pytest.mark.parametrize("encoder", KINDS)
# The warning of the license has its own test.
pytestmark = pytest.mark.filterwarnings("ignore:the pretrained weights of mit_b")


def classifier(encoder: str) -> Any:
    """Return a classifier with the architecture of the encoder and with random weights and statistics."""
    torch.manual_seed(0)
    name = encoder.removeprefix("tu-")
    model = smp.encoders.get_encoder(name, weights=None) if name == encoder else timm.create_model(name)
    for name, value in model.named_buffers():
        if "running" in name:
            nn.init.uniform_(value, -0.1, 0.1).add_(name.endswith("var"))
    return model.eval()


def scales(model: Any, image: Tensor) -> list[Tensor]:
    if hasattr(model, "forward_intermediates"):
        return model.forward_intermediates(image, intermediates_only=True)
    return model(image)[1:]


def write_weights(folder: Path, encoder: str) -> Path:
    """Write the files of an encoder's repository on the hub."""
    folder.mkdir(parents=True)
    save_file(classifier(encoder).state_dict(), folder / "model.safetensors")
    name = encoder.removeprefix("tu-")
    config = COLORS if name == encoder else {"architecture": name, "pretrained_cfg": COLORS}
    (folder / "config.json").write_text(json.dumps(config))
    return folder


@pytest.fixture
def offline(monkeypatch, tmp_path) -> Path:
    """Return the empty cache of the hub on a machine without a network."""
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "hub"


@torch.no_grad()
@of_every_kind
def test_a_pretrained_encoder_has_the_features_of_its_classifier(tmp_path, encoder):
    network = KINDS[encoder](2, encoder=encoder, pretrained=str(write_weights(tmp_path / "weights", encoder)))
    image, features = torch.rand(1, 3, 64, 96), []
    network.network.encoder.register_forward_hook(lambda _, inputs, outputs: features.extend(outputs[1:]))
    network(image)
    mean, std = (torch.tensor(value).view(1, 3, 1, 1) for value in COLORS.values())
    expected = scales(classifier(encoder), (image - mean) / std)
    for value, other in zip(features, expected, strict=True):
        assert_close(value, other, rtol=1e-4, atol=1e-4)


@of_every_kind
def test_training_changes_only_the_coordinate_weights_of_a_frozen_encoder(tmp_path, encoder):
    network = KINDS[encoder](2, encoder=encoder, pretrained=str(write_weights(tmp_path / "weights", encoder)))
    nn.init.normal_(network.network.segmentation_head[0].weight)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-2)
    for _ in range(2):
        network.eval()
        network.train()
        optimizer.zero_grad()
        network(torch.rand(2, 3, 64, 64)).square().mean().backward()
        optimizer.step()
    changed = {name for name, value in network.state_dict().items() if not torch.equal(value, before[name])}
    (coordinates,) = (name for name in changed if ".encoder." in name)
    assert coordinates.endswith(".coordinate_weight")
    assert not before[coordinates].any()
    assert any("decoder" in name for name in changed)


def test_a_random_encoder_is_trained_with_its_statistics():
    network = ResUNet(2, encoder="tu-resnet10t")
    assert all(parameter.requires_grad for parameter in network.parameters())
    network.eval()
    assert all(module.training for module in network.train().modules())


def test_a_trained_network_loads_without_its_pretrained_weights(tmp_path):
    trained = SegFormer(2, encoder="mit_b0", pretrained=str(write_weights(tmp_path / "weights", "mit_b0"))).eval()
    nn.init.normal_(trained.network.segmentation_head[0].weight)
    fresh = SegFormer(2, encoder="mit_b0").eval()
    fresh.load_state_dict(trained.state_dict())
    image = torch.rand(1, 3, 64, 64)
    assert torch.equal(fresh(image), trained(image))


def test_imagenet_reads_the_cache_of_the_hub_like_a_folder(tmp_path, offline):
    encoder = "mit_b0"
    settings = smp.encoders.encoders[encoder]["pretrained_settings"]["imagenet"]
    cached = offline / f"models--{settings['repo_id'].replace('/', '--')}" / "snapshots" / settings["revision"]
    write_weights(cached, encoder)
    by_name, by_folder = (SegFormer(2, encoder=encoder, pretrained=source) for source in ("imagenet", str(cached)))
    weights, expected = (network.network.encoder.state_dict() for network in (by_name, by_folder))
    assert_close(weights, expected, rtol=0, atol=0)
    assert by_name.is_frozen


@of_every_kind
def test_an_unreachable_hub_names_the_options_that_avoid_it(offline, encoder):
    with pytest.raises(ValueError, match=r"model\.network\.pretrained=null or .*=FOLDER") as caught:
        KINDS[encoder](2, encoder=encoder, pretrained="imagenet")
    assert "where the hub cannot be reached, got imagenet" in str(caught.value)


def test_only_a_non_commercial_license_gives_a_warning(tmp_path):
    with pytest.warns(UserWarning, match="weights of mit_b0 come under .* SegFormer, non-commercial"):
        SegFormer(2, encoder="mit_b0", pretrained=str(write_weights(tmp_path / "mit", "mit_b0")))
    assert weights_license("tu-resnet10t") == "apache-2.0"
    # A warning would be an error.
    ResUNet(2, encoder="tu-resnet10t", pretrained=str(write_weights(tmp_path / "timm", "tu-resnet10t")))


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"pretrained must be null, imagenet, or a folder .*none without config\.json"):
        ResUNet(2, pretrained=str(tmp_path / "none"))


@pytest.mark.parametrize(("encoder", "other"), [("mit_b1", "mit_b0"), ("tu-resnet34", "tu-resnet10t")])
def test_weights_of_another_encoder_are_rejected(tmp_path, encoder, other):
    folder = write_weights(tmp_path / "weights", other)
    with pytest.raises(ValueError, match=f"pretrained must .*weights of {encoder}, got .*weights"):
        KINDS[other](2, encoder=encoder, pretrained=str(folder))


@of_every_kind
def test_damaged_weights_are_rejected(tmp_path, encoder):
    folder = write_weights(tmp_path / "weights", encoder)
    tensors = folder / "model.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:5000])
    with pytest.raises(ValueError, match=f"pretrained must hold intact weights of {encoder}, got "):
        KINDS[encoder](2, encoder=encoder, pretrained=str(folder))


def test_a_configuration_without_colors_is_rejected(tmp_path):
    folder = write_weights(tmp_path / "weights", "resnet18")
    for text in ("{}", "[]", "{", '{"mean": 3, "std": 1}'):
        (folder / "config.json").write_text(text)
        with pytest.raises(ValueError, match=r"pretrained must have mean and std in its config\.json, got "):
            ResUNet(2, encoder="resnet18", pretrained=str(folder))

"""ImageNet weights of encoders, from the hub or from a folder that lies as the hub's do."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import segmentation_models_pytorch as smp
import timm
from huggingface_hub import hf_hub_download
from huggingface_hub.errors import HfHubHTTPError
from safetensors import SafetensorError
from safetensors.torch import load_file

HUB = "imagenet"
_CONFIG, _TENSORS = "config.json", "model.safetensors"
_TIMM = "tu-"  # how segmentation-models-pytorch calls the encoders of timm
_MIT_LICENSE = "NVIDIA Source Code License for SegFormer, non-commercial: for research and evaluation only"
# What the libraries raise of an encoder that they do not know, and of a file that is damaged or of another one.
_UNFIT = (SafetensorError, KeyError, RuntimeError, ValueError)


class Weights(NamedTuple):
    """Where an encoder's weights lie, and what they were trained on."""

    file: Path  # safetensors
    mean: tuple[float, ...]  # of the colors in [0, 1]
    std: tuple[float, ...]


def find_weights(encoder: str, pretrained: str) -> Weights:
    """The ImageNet weights of an encoder; a warning names their license where it is a non-commercial one.

    Args:
        encoder: a name known to segmentation-models-pytorch; "tu-…" is timm's.
        pretrained: "imagenet", which is fetched from the hub once, or a folder with the config.json and the
            model.safetensors of the encoder's place on the hub.

    Raises:
        ValueError: a hub that cannot be reached, an encoder that it does not have, no such folder, other files in it.
    """
    folder = _fetch(encoder) if pretrained == HUB else Path(pretrained).expanduser()
    if missing := [name for name in (_CONFIG, _TENSORS) if not (folder / name).is_file()]:
        raise ValueError(
            f"pretrained must be null, {HUB}, or a folder with {_CONFIG} and {_TENSORS}, got {pretrained} "
            f"without {' and '.join(missing)}"
        )
    try:
        config = json.loads((folder / _CONFIG).read_text(encoding="utf-8"))
        colors = config.get("pretrained_cfg", config)  # timm has them one level down
        found = Weights(folder / _TENSORS, tuple(map(float, colors["mean"])), tuple(map(float, colors["std"])))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"pretrained must have mean and std in its {_CONFIG}, got {folder}") from error
    # timm takes what fits of another architecture, and leaves the rest as it was drawn.
    if encoder.startswith(_TIMM) and config.get("architecture") != encoder.removeprefix(_TIMM).partition(".")[0]:
        raise ValueError(f"pretrained must be weights of {encoder}, got {folder} of {config.get('architecture')}")
    if (name := weights_license(encoder)) and ("non-commercial" in name or "-nc" in name):
        warnings.warn(f"the pretrained weights of {encoder} come under this license: {name}", stacklevel=2)
    return found


def load_network(architecture: Callable[..., Any], encoder: str, weights: Weights | None, *, channels: int) -> Any:
    """A network of segmentation-models-pytorch for three colors, its encoder drawn, or with given weights.

    Raises:
        ValueError: an encoder that is not known, or not of this kind; weights of another one, or damaged ones.
    """
    # timm loads weights while it makes the encoder, for it renames them.
    by_timm = weights is not None and encoder.startswith(_TIMM)
    options = {"pretrained_cfg_overlay": {"file": str(weights.file)}} if weights and by_timm else {}
    try:
        network = architecture(encoder, encoder_weights=by_timm or None, in_channels=3, classes=channels, **options)
        if weights is not None and not by_timm:
            network.encoder.load_state_dict(load_file(weights.file))
    except _UNFIT as error:
        if weights is not None:
            raise ValueError(f"pretrained must hold whole weights of {encoder}, got {weights.file}") from error
        raise ValueError(
            "encoder must be known to segmentation-models-pytorch, or to timm with tu- in front, and have features "
            f"at five scales, got {encoder}"
        ) from error
    return network


def weights_license(encoder: str) -> str | None:
    """The license that the ImageNet weights of an encoder come under, None where the library does not tell."""
    if encoder.startswith(_TIMM):
        config = timm.models.get_pretrained_cfg(encoder.removeprefix(_TIMM))
        return config and config.license
    return _MIT_LICENSE if encoder.startswith("mit_b") else None


def _fetch(encoder: str) -> Path:
    """The folder in the hub's cache."""
    repository, revision = _place(encoder)
    try:
        files = [hf_hub_download(repository, name, revision=revision) for name in (_CONFIG, _TENSORS)]
    except (OSError, HfHubHTTPError) as error:
        raise ValueError(
            f"pretrained must be null, or a folder with {_CONFIG} and {_TENSORS} of {repository}, where the hub cannot "
            f"be reached, got {HUB}: add model.network.pretrained=null or model.network.pretrained=FOLDER"
        ) from error
    return Path(files[0]).parent


def _place(encoder: str) -> tuple[str, str | None]:
    """The repository of an encoder's ImageNet weights on the hub, and their version."""
    if encoder.startswith(_TIMM):
        config = timm.models.get_pretrained_cfg(encoder.removeprefix(_TIMM))
        if config is not None and config.hf_hub_id:
            return config.hf_hub_id, None
    elif settings := smp.encoders.encoders.get(encoder, {}).get("pretrained_settings", {}).get(HUB):
        return settings["repo_id"], settings["revision"]
    raise ValueError(
        f"pretrained must be null or a folder for an encoder without {HUB} weights, got {HUB} of {encoder}"
    )

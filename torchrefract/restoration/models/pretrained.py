"""ImageNet weights of encoders, from the Hugging Face hub or from a folder with the same files."""

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
_TIMM = "tu-"  # the prefix of timm's encoders in segmentation-models-pytorch
_MIT_LICENSE = "NVIDIA Source Code License for SegFormer, non-commercial: for research and evaluation only"
# The libraries raise these for an unknown encoder and for a damaged or unfitting file.
_LOAD_ERRORS = (SafetensorError, KeyError, RuntimeError, ValueError)


class Weights(NamedTuple):
    """The weights file of an encoder and the colors that it was trained on."""

    file: Path  # safetensors
    mean: tuple[float, ...]  # of the colors in [0, 1]
    std: tuple[float, ...]


def find_weights(encoder: str, pretrained: str) -> Weights:
    """Locate the ImageNet weights of an encoder; warn of a non-commercial license.

    Args:
        encoder: a name of segmentation-models-pytorch; "tu-…" selects an encoder of timm.
        pretrained: "imagenet", which downloads them from the hub once, or a folder with the config.json and the
            model.safetensors of the encoder's repository on the hub.

    Raises:
        ValueError: the hub cannot be reached or lacks the encoder; the folder is missing, incomplete, or of another
            encoder.
    """
    folder = _fetch(encoder) if pretrained == HUB else Path(pretrained).expanduser()
    if missing := [name for name in (_CONFIG, _TENSORS) if not (folder / name).is_file()]:
        raise ValueError(
            f"pretrained must be null, {HUB}, or a folder with {_CONFIG} and {_TENSORS}, got {pretrained} "
            f"without {' and '.join(missing)}"
        )
    try:
        config = json.loads((folder / _CONFIG).read_text(encoding="utf-8"))
        colors = config.get("pretrained_cfg", config)  # timm nests them one level deeper
        weights = Weights(folder / _TENSORS, tuple(map(float, colors["mean"])), tuple(map(float, colors["std"])))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"pretrained must have mean and std in its {_CONFIG}, got {folder}") from error
    # timm loads the weights that fit of another architecture and silently keeps random ones for the rest.
    if encoder.startswith(_TIMM) and config.get("architecture") != encoder.removeprefix(_TIMM).partition(".")[0]:
        raise ValueError(f"pretrained must be weights of {encoder}, got {folder} of {config.get('architecture')}")
    if (name := weights_license(encoder)) and ("non-commercial" in name or "-nc" in name):
        warnings.warn(f"the pretrained weights of {encoder} come under this license: {name}", stacklevel=2)
    return weights


def load_network(architecture: Callable[..., Any], encoder: str, weights: Weights | None, *, channels: int) -> Any:
    """Build a network of segmentation-models-pytorch for three colors; without weights its encoder is random.

    Raises:
        ValueError: the encoder is unknown or has no features at five scales; the weights are damaged or of another
            encoder.
    """
    # timm renames weights while it builds the encoder, so it must load them itself.
    by_timm = weights is not None and encoder.startswith(_TIMM)
    options = {"pretrained_cfg_overlay": {"file": str(weights.file)}} if weights and by_timm else {}
    try:
        network = architecture(encoder, encoder_weights=by_timm or None, in_channels=3, classes=channels, **options)
        if weights is not None and not by_timm:
            network.encoder.load_state_dict(load_file(weights.file))
    except _LOAD_ERRORS as error:
        if weights is not None:
            raise ValueError(f"pretrained must hold intact weights of {encoder}, got {weights.file}") from error
        raise ValueError(
            "encoder must be a name of segmentation-models-pytorch, or tu- and a name of timm, with features at five "
            f"scales, got {encoder}"
        ) from error
    return network


def weights_license(encoder: str) -> str | None:
    """Return the license of an encoder's ImageNet weights, or None if the library does not state it."""
    if encoder.startswith(_TIMM):
        config = timm.models.get_pretrained_cfg(encoder.removeprefix(_TIMM))
        return config and config.license
    return _MIT_LICENSE if encoder.startswith("mit_b") else None


def _fetch(encoder: str) -> Path:
    """Download the weights unless they are cached; return their folder."""
    repository, revision = _repository(encoder)
    try:
        files = [hf_hub_download(repository, name, revision=revision) for name in (_CONFIG, _TENSORS)]
    except (OSError, HfHubHTTPError) as error:
        raise ValueError(
            f"pretrained must be null, or a folder with {_CONFIG} and {_TENSORS} of {repository}, where the hub cannot "
            f"be reached, got {HUB}: add model.network.pretrained=null or model.network.pretrained=FOLDER"
        ) from error
    return Path(files[0]).parent


def _repository(encoder: str) -> tuple[str, str | None]:
    """Return the repository of an encoder's ImageNet weights on the hub and its revision."""
    if encoder.startswith(_TIMM):
        config = timm.models.get_pretrained_cfg(encoder.removeprefix(_TIMM))
        if config is not None and config.hf_hub_id:
            return config.hf_hub_id, None
    elif settings := smp.encoders.encoders.get(encoder, {}).get("pretrained_settings", {}).get(HUB):
        return settings["repo_id"], settings["revision"]
    raise ValueError(
        f"pretrained must be null or a folder for an encoder without {HUB} weights, got {HUB} of {encoder}"
    )

"""The feed-forward baselines: segmentation networks with pixel coordinates as inputs and a polynomial head."""

import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import segmentation_models_pytorch as smp
import timm
import torch
from huggingface_hub import hf_hub_download
from huggingface_hub.errors import HfHubHTTPError
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchrefract._tensor import pad_to_multiple, without_autocast
from torchrefract._validation import check_rgb, warn
from torchrefract.warping.grid import pixel_axes

_STRIDE = 32
_MEAN, _STD = [0.5] * 3, [0.25] * 3  # of colors, for an encoder without pretrained weights
_DEGREE = 5  # a lens with k1 and k2 has terms of degree 3 and 5
_TERMS = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
NUM_TERMS = len(_TERMS)
_HIDDEN = 256
_HUB = "imagenet"
_CONFIG, _TENSORS = "config.json", "model.safetensors"
_ENCODER = re.compile(r"[\w.\-]+")  # with a colon, timm reads an encoder from the hub or from a folder
_TIMM = "tu-"  # the prefix of timm's encoders in segmentation-models-pytorch
_MIT_LICENSE = "NVIDIA Source Code License for SegFormer, non-commercial: for research and evaluation only"
# The libraries raise these for an unknown encoder and for a damaged or unfitting file.
_LOAD_ERRORS = (SafetensorError, KeyError, RuntimeError, ValueError)


class CoordConvSegmenter(nn.Module):
    """Predict maps by a segmentation network that also sees the coordinates of its pixels.

    The last layer starts at zero, so an untrained network predicts zeros. With `smooth`, a `PolynomialFlowHead` adds
    maps of the whole frame, which start at zero too.

    An encoder with pretrained weights is frozen, together with its running statistics and its dropout. Only the weights
    that its first layer applies to the coordinates are trained; they start at zero.

    Args:
        architecture: a model class of segmentation-models-pytorch.
        channels: number of maps to predict.
        encoder: a name of segmentation-models-pytorch; "tu-…" selects an encoder of timm.
        pretrained: None; "imagenet", which downloads ImageNet weights from the hub once; or a folder with the
            config.json and the model.safetensors of the encoder's repository on the hub.
        cell: side of the square of pixels for which the architecture predicts one value, px.
        smooth: True adds a `PolynomialFlowHead`, for maps that are smooth over the frame, such as the flow of a lens.

    Raises:
        ValueError: the encoder is unknown or has no features at five scales; the pretrained weights are unavailable.

    Source: Liu, Lehman, Molino, Petroski Such, Frank, Sergeev, Yosinski, "An intriguing failing of convolutional neural
    networks and the CoordConv solution", NeurIPS 2018, for the coordinates.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        architecture: Callable[..., Any],
        channels: int,
        *,
        encoder: str,
        pretrained: str | None,
        cell: int,
        smooth: bool,
    ):
        super().__init__()
        if not _ENCODER.fullmatch(encoder):
            raise ValueError(
                "encoder must be a name of segmentation-models-pytorch or tu- and a name of timm, without a source "
                f"such as hf-hub: or a path, got {encoder}; add model.network.encoder=tu-NAME, and for its weights "
                "model.network.pretrained=FOLDER"
            )
        file, mean, std = (None, _MEAN, _STD) if pretrained is None else _find_weights(encoder, pretrained)
        self.network = _load_network(architecture, encoder, file, channels=channels)
        self.is_frozen, self.cell = file is not None, cell
        self.network.encoder.requires_grad_(not self.is_frozen)
        _add_coordinate_inputs(self.network.encoder, start_at_zero=self.is_frozen)
        # The checkpoint holds both, so it can be used without the pretrained weights.
        self.register_buffer("mean", torch.tensor(mean).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(std).view(1, 3, 1, 1))
        for parameter in self.network.segmentation_head.parameters():
            nn.init.zeros_(parameter)
        self.polynomial_head = PolynomialFlowHead(self.network.encoder.out_channels[-1], channels) if smooth else None
        self.to(memory_format=torch.channels_last)
        self.train()

    def train(self, mode: bool = True) -> "CoordConvSegmenter":
        """Set the training mode; a frozen encoder stays in evaluation mode."""
        super().train(mode)
        if self.is_frozen:
            self.network.encoder.eval()
        return self

    def forward(self, image: Tensor) -> Tensor:
        """Predict the maps for images of any size.

        Args:
            image: (B, 3, H, W), in [0, 1].

        Returns:
            (B, channels, ceil(H / cell), ceil(W / cell)); with `smooth` float32, even under autocast.

        Raises:
            ValueError: the image has another shape.
        """
        check_rgb("image", image)
        height, width = image.shape[2:]
        inputs = torch.cat([(image - self.mean) / self.std, pixel_coordinates(image)], dim=1)
        inputs = pad_to_multiple(inputs, _STRIDE).contiguous(memory_format=torch.channels_last)
        features = self.network.encoder(inputs)
        maps = self.network.segmentation_head(self.network.decoder(features))
        maps = maps[:, :, : -(-height // self.cell), : -(-width // self.cell)]
        if self.polynomial_head is None:
            return maps
        return maps + self.polynomial_head(features[-1], *cell_axes(image, self.cell))


class ResUNet(CoordConvSegmenter):
    """Predict maps by a U-Net with a residual encoder. See `CoordConvSegmenter` for the arguments.

    Source: Ronneberger, Fischer, Brox, "U-Net", MICCAI 2015; He, Zhang, Ren, Sun, "Deep residual learning", CVPR 2016.
    """

    def __init__(
        self, channels: int, *, encoder: str = "tu-resnet34", pretrained: str | None = None, smooth: bool = False
    ):
        super().__init__(smp.Unet, channels, encoder=encoder, pretrained=pretrained, cell=1, smooth=smooth)


class SegFormer(CoordConvSegmenter):
    """Predict maps by a transformer, a value for each cell of 4 x 4 px. See `CoordConvSegmenter` for the arguments.

    Source: Xie, Wang, Yu, Anandkumar, Alvarez, Luo, "SegFormer", NeurIPS 2021.
    """

    def __init__(self, channels: int, *, encoder: str = "mit_b1", pretrained: str | None = None, smooth: bool = False):
        architecture = partial(smp.Segformer, upsampling=1)
        super().__init__(architecture, channels, encoder=encoder, pretrained=pretrained, cell=4, smooth=smooth)


class PolynomialFlowHead(nn.Module):
    """Predict smooth maps of the whole frame from its coarsest features.

    Two layers compute the coefficients of each map in the basis of `polynomial_basis` from the mean and the maximum of
    each feature. The coefficients start at zero. The flow of a lens is such a map, and every pixel carries a little
    evidence for it.

    Args:
        features: number of feature channels.
        channels: number of maps.
    """

    def __init__(self, features: int, channels: int):
        super().__init__()
        self.channels = channels
        last = nn.Linear(_HIDDEN, channels * NUM_TERMS)
        for parameter in last.parameters():
            nn.init.zeros_(parameter)
        self.layers = nn.Sequential(nn.Linear(2 * features, _HIDDEN), nn.SiLU(), last)

    def forward(self, features: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Evaluate the maps (B, channels, H, W), float32, from features (B, F, h, w) at x (W,) and y (H,)."""
        flat = features.float().flatten(2)
        pooled = torch.cat([flat.mean(dim=2), flat.amax(dim=2)], dim=1)
        # bfloat16 has 8 bits of mantissa: a flow of 100 px would be off by a quarter of a pixel.
        with without_autocast(features.device):
            coefficients = self.layers(pooled).unflatten(1, (self.channels, NUM_TERMS))
            return torch.einsum("bct,thw->bchw", coefficients, polynomial_basis(x, y))


def polynomial_basis(x: Tensor, y: Tensor) -> Tensor:
    """Return the polynomials of degree 5 at x (W,) and y (H,), as of `pixel_coordinates`: (21, H, W), float32.

    T_i(x) T_j(y) for i + j <= 5,  T_n(x) = cos(n arccos(x))
    """
    return torch.stack([_chebyshev(y, j)[:, None] * _chebyshev(x, i) for i, j in _TERMS])


def pixel_coordinates(image: Tensor) -> Tensor:
    """Return x and y of the pixels of an image (B, C, H, W) as (B, 2, H, W), in [-1, 1].

        x = (2 column + 1) / W - 1,  y = (2 row + 1) / H - 1

    A convolution alone cannot tell where on the frame it is, and the effect of a lens depends on that.
    """
    x, y = cell_axes(image, 1)
    axes = torch.meshgrid(x, y, indexing="xy")
    return torch.stack(axes).expand(image.shape[0], -1, -1, -1)


def cell_axes(image: Tensor, cell: int) -> tuple[Tensor, Tensor]:
    """Return x, (ceil(W / cell),), and y, (ceil(H / cell),), of the centers of cells; the last may exceed 1."""
    height, width = image.shape[2:]
    x, y = pixel_axes(-(-height // cell), -(-width // cell), dtype=image.dtype, device=image.device)
    return cell * (2 * x.flatten() + 1) / width - 1, cell * (2 * y.flatten() + 1) / height - 1


def _chebyshev(x: Tensor, degree: int) -> Tensor:
    return torch.cos(degree * torch.acos(x.float().clamp(-1, 1)))


class _CoordinateInputs(nn.Module):
    """Append the weights of two more input channels to the weight of a convolution."""

    def __init__(self, weight: Tensor, *, start_at_zero: bool):
        super().__init__()
        added = torch.zeros_like(weight[:, :2])
        self.coordinate_weight = nn.Parameter(
            added if start_at_zero else nn.init.normal_(added, std=float(weight.std()))
        )

    def forward(self, weight: Tensor) -> Tensor:
        return torch.cat([weight, self.coordinate_weight], dim=1)


def _add_coordinate_inputs(encoder: nn.Module, *, start_at_zero: bool) -> None:
    """Let the first convolution of an encoder take the two coordinates after the three colors."""
    stem = next(module for module in encoder.modules() if isinstance(module, nn.Conv2d))
    inputs = _CoordinateInputs(stem.weight.detach(), start_at_zero=start_at_zero)
    parametrize.register_parametrization(stem, "weight", inputs, unsafe=True)  # unsafe: the shape changes
    stem.in_channels = stem.weight.shape[1]


def _find_weights(encoder: str, pretrained: str) -> tuple[Path, list[float], list[float]]:
    """Return the ImageNet weights of an encoder, and mean and std of their colors; warn of a non-commercial license."""
    folder = _fetch(encoder) if pretrained == _HUB else Path(pretrained).expanduser()
    if missing := [name for name in (_CONFIG, _TENSORS) if not (folder / name).is_file()]:
        raise ValueError(
            f"pretrained must be null, {_HUB}, or a folder with {_CONFIG} and {_TENSORS}, got {pretrained} "
            f"without {' and '.join(missing)}"
        )
    try:
        config = json.loads((folder / _CONFIG).read_text(encoding="utf-8"))
        colors = config.get("pretrained_cfg", config)  # timm nests them one level deeper
        mean, std = ([float(value) for value in colors[name]] for name in ("mean", "std"))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"pretrained must have mean and std in its {_CONFIG}, got {folder}") from error
    # timm loads the weights that fit of another architecture and silently keeps random ones for the rest.
    if encoder.startswith(_TIMM) and config.get("architecture") != encoder.removeprefix(_TIMM).partition(".")[0]:
        raise ValueError(f"pretrained must be weights of {encoder}, got {folder} of {config.get('architecture')}")
    if (name := weights_license(encoder)) and ("non-commercial" in name or "-nc" in name):
        warn(f"the pretrained weights of {encoder} come under this license: {name}")
    return folder / _TENSORS, mean, std


def _load_network(architecture: Callable[..., Any], encoder: str, weights: Path | None, *, channels: int) -> Any:
    """Build a network for three colors; without weights its encoder is random."""
    # timm renames weights while it builds the encoder, so it must load them itself.
    by_timm = weights is not None and encoder.startswith(_TIMM)
    options = {"pretrained_cfg_overlay": {"file": str(weights)}} if by_timm else {}
    try:
        network = architecture(encoder, encoder_weights=by_timm or None, in_channels=3, classes=channels, **options)
        if weights is not None and not by_timm:
            network.encoder.load_state_dict(load_file(weights))
    except _LOAD_ERRORS as error:
        if weights is not None:
            raise ValueError(f"pretrained must hold intact weights of {encoder}, got {weights}") from error
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
    """Return the folder of the weights in the cache of the hub; download them first if they are missing."""
    if encoder.startswith(_TIMM):
        config = timm.models.get_pretrained_cfg(encoder.removeprefix(_TIMM))
        repository, revision = config and config.hf_hub_id, None
    else:
        settings = smp.encoders.encoders.get(encoder, {}).get("pretrained_settings", {}).get(_HUB, {})
        repository, revision = settings.get("repo_id"), settings.get("revision")
    if not repository:
        raise ValueError(
            f"pretrained must be null or a folder for an encoder without {_HUB} weights, got {_HUB} of {encoder}"
        )
    try:
        files = [hf_hub_download(repository, name, revision=revision) for name in (_CONFIG, _TENSORS)]
    except (OSError, HfHubHTTPError) as error:
        raise ValueError(
            f"pretrained must be null, or a folder with {_CONFIG} and {_TENSORS} of {repository}, where the hub cannot "
            f"be reached, got {_HUB}: add model.network.pretrained=null or model.network.pretrained=FOLDER"
        ) from error
    return Path(files[0]).parent

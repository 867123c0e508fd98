"""The U-Nets of the diffusion models: of images, and of flows on a lattice."""

import json
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from diffusers import UNet2DModel
from torch import Tensor, nn

from torchrefract._validation import check_count
from torchrefract.restoration.models.coordconv import PolynomialFlowHead, pixel_coordinates
from torchrefract.restoration.models.lens_net import EDGE_FEATURES, LENS_FEATURES, LensEncoder

_LOCAL_CHANNELS = 64
_NODE_DISTANCE = 16  # px
_CONDITION_CHANNELS = 5  # the image and the coordinates of its pixels
# These options follow from the task. A published network may differ in them.
_FREE_OPTIONS = ("in_channels", "out_channels", "sample_size")


class Denoiser(nn.Module):
    """Predict noise or velocity of a noisy target, given its noise level and the degraded image.

    The network of denoising diffusion models. The default has 35.7 M parameters and attention at the coarsest scale
    only, which large frames can afford. Pretrained weights keep their function at the start: the first channels of the
    target take the place of the colors, and the weights of all new channels start at zero. A pretrained encoder is
    frozen.

    Args:
        channels: number of channels of the target.
        widths: channels of each scale, from the finest; multiples of `groups`.
        attention: True for each scale with attention.
        layers: blocks of each scale.
        groups: groups of the group norms.
        pretrained: weights to start from, of the same widths, attention, layers and groups: the name of a repository on
            the Hugging Face hub, such as google/ddpm-cat-256, or a folder written by `UNet2DModel.save_pretrained`.

    Raises:
        ValueError: widths and attention differ in length or are empty; widths are no multiples of groups; the
            pretrained weights are unavailable or belong to another network.

    Source: Ho, Jain, Abbeel, "Denoising diffusion probabilistic models", NeurIPS 2020.
    """

    def __init__(
        self,
        channels: int,
        *,
        widths: Sequence[int] = (128, 256, 256, 256),
        attention: Sequence[bool] = (False, False, False, True),
        layers: int = 2,
        groups: int = 32,
        pretrained: str | None = None,
    ):
        super().__init__()
        if not len(widths) == len(attention) > 0:
            raise ValueError(f"attention must have an entry for each of widths = {list(widths)}, got {list(attention)}")
        if any(width % check_count("groups", groups) for width in widths):
            raise ValueError(f"widths must be multiples of groups = {groups}, got {list(widths)}")
        self.network = UNet2DModel(
            in_channels=channels + _CONDITION_CHANNELS,
            out_channels=channels,
            block_out_channels=tuple(widths),
            down_block_types=tuple("AttnDownBlock2D" if at else "DownBlock2D" for at in attention),
            up_block_types=tuple("AttnUpBlock2D" if at else "UpBlock2D" for at in reversed(attention)),
            layers_per_block=check_count("layers", layers),
            norm_num_groups=groups,
            # The defaults of diffusers differ from the published network here.
            attention_head_dim=None,
            downsample_padding=0,
            flip_sin_to_cos=False,
            freq_shift=1,
            norm_eps=1e-6,
        )
        self.stride = 2 ** (len(widths) - 1)
        if pretrained is not None:
            _copy_weights(self.network, _load_published(pretrained), pretrained)
            self.network.down_blocks.requires_grad_(False)

    def forward(self, noisy: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        """Predict the noise, or the velocity, of a noisy target of any size; float32.

        Args:
            noisy: (B, channels, H, W); the result has the same shape.
            time: (B,), int64, the noise level.
            condition: (B, 5, H, W), as of `conditions`.
        """
        height, width = noisy.shape[2:]
        inputs = torch.cat([noisy, condition], dim=1)
        inputs = F.pad(inputs, (0, -width % self.stride, 0, -height % self.stride), mode="replicate")
        return self.network(inputs, time).sample[:, :, :height, :width].float()


class LatticeCondition(NamedTuple):
    """The description of images for a `LatticeDenoiser`."""

    guess: Tensor  # (B, channels, h, w): the target without a look at the noisy one
    local: Tensor  # (B, 64, h, w)
    token: Tensor  # (B, 4 widths[0]), of the whole frame


class LatticeDenoiser(nn.Module):
    """Predict a smooth target on a lattice of nodes about 16 px apart from a noisy one, given the whole frame.

        predicted = guess(image) + unet(noisy, time, image)

    A `LensEncoder` describes the frame: a `PolynomialFlowHead` on it is the guess, and the U-Net takes it in each of
    its blocks, next to the edges of the frame by two strided convolutions. Both parts start at zero.

    Args:
        channels: number of channels of the target.
        widths: channels of the two scales of the U-Net, multiples of 32.
        weightings, lenses, edges: see `LensEncoder`.
    """

    def __init__(
        self,
        channels: int,
        *,
        widths: Sequence[int] = (64, 96),
        weightings: int = 8,
        lenses: int = 11,
        edges: int = 1024,
    ):
        super().__init__()
        self.encoder = LensEncoder(weightings=weightings, lenses=lenses, edges=edges)
        self.head = PolynomialFlowHead(LENS_FEATURES, channels)
        self.token = nn.Linear(LENS_FEATURES, 4 * widths[0])
        self.local = nn.Sequential(
            nn.Conv2d(EDGE_FEATURES, 32, 3, stride=2, padding=1),
            nn.SiLU(),
            nn.Conv2d(32, _LOCAL_CHANNELS, 3, stride=2, padding=1),
        )
        self.network = UNet2DModel(
            in_channels=channels + _LOCAL_CHANNELS,
            out_channels=channels,
            block_out_channels=tuple(widths),
            down_block_types=("DownBlock2D", "AttnDownBlock2D"),
            up_block_types=("AttnUpBlock2D", "UpBlock2D"),
            layers_per_block=1,
            class_embed_type="identity",
        )
        for parameter in self.network.conv_out.parameters():
            nn.init.zeros_(parameter)

    def encode(self, image: Tensor) -> LatticeCondition:
        """Describe images (B, 3, H, W) in [0, 1]; the nodes are those of `lattice_size`."""
        frame, cells = self.encoder(image)
        size = lattice_size(image)
        axes = (torch.linspace(-1, 1, count, device=image.device) for count in reversed(size))
        local = F.interpolate(self.local(cells), size, mode="bilinear", align_corners=True)
        return LatticeCondition(self.head(frame, *axes), local, self.token(frame.flatten(1)))

    def forward(self, noisy: Tensor, time: Tensor, condition: LatticeCondition) -> Tensor:
        """Predict the target (B, channels, h, w), float32, from a noisy one at its noise level (B,), int64."""
        height, width = noisy.shape[2:]
        inputs = F.pad(torch.cat([noisy, condition.local], dim=1), (0, width % 2, 0, height % 2), mode="replicate")
        change = self.network(inputs, time, class_labels=condition.token).sample[:, :, :height, :width]
        return condition.guess + change.float()


def lattice_size(image: Tensor) -> tuple[int, int]:
    """Return the number of nodes down and across for images (B, C, H, W): the first and the last are at the border."""
    height, width = image.shape[2:]
    return 1 + -(-height // _NODE_DISTANCE), 1 + -(-width // _NODE_DISTANCE)


def conditions(image: Tensor) -> Tensor:
    """Stack an image (B, 3, H, W) in [0, 1], mapped to [-1, 1], and its pixel coordinates to (B, 5, H, W)."""
    return torch.cat([2 * image - 1, pixel_coordinates(image)], dim=1)


def _load_published(name: str) -> UNet2DModel:
    try:
        return UNet2DModel.from_pretrained(name, low_cpu_mem_usage=False)
    except (OSError, ValueError, RuntimeError) as error:
        raise ValueError(
            "pretrained must be null, a folder with the config.json and the weights that UNet2DModel.save_pretrained "
            f"writes, or the name of such a repository on a hub that can be reached, got {name}: add "
            "model.network.pretrained=null or model.network.pretrained=FOLDER"
        ) from error


def _copy_weights(network: UNet2DModel, published: UNet2DModel, name: str) -> None:
    """Copy the published weights into the channels that both networks have; set all other weights to zero."""
    ours, theirs = (json.loads(model.to_json_string()) for model in (network, published))
    for key in sorted(ours.keys() - {*_FREE_OPTIONS}):
        if ours[key] != theirs.get(key) and not key.startswith("_"):
            raise ValueError(
                f"pretrained must be a network with {key} = {ours[key]}, got {name}, where it is {theirs.get(key)}"
            )
    weights = published.state_dict()
    # Only the channels of the target correspond to the published input; the condition follows them.
    weights["conv_in.weight"] = weights["conv_in.weight"][:, : network.config["out_channels"]]
    for key, weight in network.state_dict().items():
        common = tuple(slice(min(sizes)) for sizes in zip(weight.shape, weights[key].shape, strict=True))
        weight.zero_()[common] = weights[key][common]

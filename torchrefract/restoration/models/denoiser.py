"""The networks of the diffusion models: of images, and of the numbers of a lens."""

import json
from collections.abc import Sequence

import torch
from diffusers import UNet2DModel
from torch import Tensor, nn

from torchrefract._tensor import pad_to_multiple
from torchrefract._validation import check_count, check_rgb
from torchrefract.restoration.models.coordconv import pixel_coordinates
from torchrefract.restoration.models.lens_net import LENS_FEATURES, LensEncoder

_HIDDEN = 256
_LOG_DEVIATION = (-5.0, 1.0)  # range of the logarithm of s
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
        inputs = pad_to_multiple(torch.cat([noisy, condition], dim=1), self.stride)
        return self.network(inputs, time).sample[:, :, :height, :width].float()


class LensDenoiser(nn.Module):
    """Estimate a few numbers of a lens from noisy ones, given the frame, with the deviation of each.

        1 / deviation^2 = 1 / s^2 + a / (1 - a)
        mean = deviation^2 (g / s^2 + sqrt(a) noisy / (1 - a)),  noisy = sqrt(a) numbers + sqrt(1 - a) noise

    A `LensEncoder` describes the frame. Two layers compute from its features, the noisy numbers and their level the
    evidence of the frame, numbers g with deviations s, which start at 0 and 1. The rest is Bayes' rule for normal
    distributions: it holds exactly at any level if g and s do not depend on the noisy numbers.

    Args:
        count: number of the numbers, of about unit deviation.
        weightings, lenses, edges: see `LensEncoder`.
    """

    def __init__(self, count: int, *, weightings: int = 8, lenses: int = 11, edges: int = 1024):
        super().__init__()
        self.encoder = LensEncoder(weightings=weightings, lenses=lenses, edges=edges)
        last = nn.Linear(_HIDDEN, 2 * count)
        for parameter in last.parameters():
            nn.init.zeros_(parameter)
        self.layers = nn.Sequential(nn.Linear(LENS_FEATURES + count + 2, _HIDDEN), nn.SiLU(), last)

    def encode(self, image: Tensor) -> Tensor:
        """Describe images (B, 3, H, W) in [0, 1] by features (B, 128)."""
        return self.encoder(image)[0].flatten(1)

    def forward(self, noisy: Tensor, share: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean and the deviation of the numbers, each (B, K, count), float32.

        Args:
            noisy: (B, K, count), K noisy versions of each sample.
            share: (B, K, 1), a of the equations, in (0, 1).
            features: (B, 128), as of `encode`.
        """
        repeated = features[:, None].expand(-1, noisy.shape[1], -1)
        inputs = torch.cat([noisy, share.sqrt(), (1 - share).sqrt(), repeated], dim=2)
        guess, log_deviation = self.layers(inputs).float().chunk(2, dim=2)
        precision = torch.exp(-2 * log_deviation.clamp(*_LOG_DEVIATION))
        total = precision + share / (1 - share)
        return (precision * guess + share.sqrt() / (1 - share) * noisy) / total, total.rsqrt()


def conditions(image: Tensor) -> Tensor:
    """Stack an image (B, 3, H, W) in [0, 1], mapped to [-1, 1], and its pixel coordinates to (B, 5, H, W)."""
    return torch.cat([2 * check_rgb("image", image) - 1, pixel_coordinates(image)], dim=1)


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

"""The U-Net of the diffusion baseline."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from diffusers import UNet2DModel
from torch import Tensor, nn

from torchrefract._validation import check_count
from torchrefract.restoration.models.places import places

_CONDITIONS = 5  # the image, and the pixel coordinates
# Of the published network these follow from what is restored, and do not make it another one.
_FREE = ("in_channels", "out_channels", "sample_size")


class Denoiser(nn.Module):
    """What `Diffusion` wants predicted of a noisy target, from it, its level of noise, and what it belongs to.

    The network of denoising diffusion models, by default that of 35.7 M parameters with its attention at the coarsest
    scale, where large frames can afford it. Weights that were trained before on pictures keep what they know: the
    first channels of the target stand for colors, and what the network has not seen counts for nothing at first. Their
    encoder is frozen.

    Args:
        channels: of the target.
        widths: channels at each scale, from the finest; multiples of `groups`.
        attention: at which scales there is some.
        layers: blocks at each scale.
        groups: of the group norms.
        pretrained: weights to start from, of the same widths, attention, layers and groups: the name of a repository
            on the hub, such as google/ddpm-cat-256, or a folder that `UNet2DModel.save_pretrained` wrote.

    Raises:
        ValueError: widths and attention of different lengths or empty, widths that the groups do not divide, pretrained
            weights that cannot be had, or are those of another network.

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
            in_channels=channels + _CONDITIONS,
            out_channels=channels,
            block_out_channels=tuple(widths),
            down_block_types=tuple("AttnDownBlock2D" if at else "DownBlock2D" for at in attention),
            up_block_types=tuple("AttnUpBlock2D" if at else "UpBlock2D" for at in reversed(attention)),
            layers_per_block=check_count("layers", layers),
            norm_num_groups=groups,
            # As in the published network, where diffusers has other defaults.
            attention_head_dim=None,
            downsample_padding=0,
            flip_sin_to_cos=False,
            freq_shift=1,
            norm_eps=1e-6,
        )
        self.stride = 2 ** (len(widths) - 1)
        if pretrained is not None:
            _take_over(self.network, _published(pretrained), pretrained)
            self.network.down_blocks.requires_grad_(False)

    def forward(self, noisy: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        """(B, channels, H, W), float32: the noise, or whatever else it was trained to predict.

        Args:
            noisy: (B, channels, H, W), the target with noise, of any size.
            time: (B,), int64, the step of the noise.
            condition: (B, 5, H, W), of `conditions`.
        """
        height, width = noisy.shape[2:]
        inputs = torch.cat([noisy, condition], dim=1)
        inputs = F.pad(inputs, (0, -width % self.stride, 0, -height % self.stride), mode="replicate")
        return self.network(inputs, time).sample[:, :, :height, :width].float()


def conditions(image: Tensor) -> Tensor:
    """(B, 5, H, W), in [-1, 1]: an image (B, 3, H, W) in [0, 1], and the `places` of its pixels."""
    return torch.cat([2 * image - 1, places(image)], dim=1)


def _published(name: str) -> UNet2DModel:
    """The network of a folder or of the hub."""
    try:
        return UNet2DModel.from_pretrained(name, low_cpu_mem_usage=False)
    except (OSError, ValueError, RuntimeError) as error:
        raise ValueError(
            "pretrained must be null, a folder with the config.json and the weights that UNet2DModel.save_pretrained "
            f"writes, or the name of such a repository on a hub that can be reached, got {name}: add "
            "model.network.pretrained=null or model.network.pretrained=FOLDER"
        ) from error


def _take_over(network: UNet2DModel, published: UNet2DModel, name: str) -> None:
    """The published weights, in the channels that both networks have; those that are new begin at zero."""
    for key in sorted(network.config.keys() - {*_FREE}):
        ours, theirs = (_plain(made.config.get(key)) for made in (network, published))
        if ours != theirs and not key.startswith("_"):
            raise ValueError(f"pretrained must be a network with {key} = {ours}, got {name}, where it is {theirs}")
    weights = published.state_dict()
    # Of the inputs the target alone is like theirs; the image that comes after it is not.
    weights["conv_in.weight"] = weights["conv_in.weight"][:, : network.config["out_channels"]]
    for key, ours in network.state_dict().items():
        theirs = weights[key]
        common = tuple(slice(min(sizes)) for sizes in zip(ours.shape, theirs.shape, strict=True))
        ours.zero_()[common] = theirs[common]


def _plain(value: object) -> object:
    return list(value) if isinstance(value, list | tuple) else value

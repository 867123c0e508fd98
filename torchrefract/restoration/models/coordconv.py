"""What the feed-forward baselines share: pixel coordinates, a part for the whole frame, a start at doing nothing."""

from collections.abc import Callable
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchrefract.restoration.models.global_part import GlobalPart
from torchrefract.restoration.models.places import place_axes, places
from torchrefract.restoration.models.pretrained import find_weights, load_network

_STRIDE = 32
_MEAN, _STD = (0.5,) * 3, (0.25,) * 3  # of colors, where no weights ask for others


class Located(nn.Module):
    """A network of segmentation-models-pytorch that is given the `places` of the pixels as two more channels.

    The last layer starts at zero: before training the network does nothing. So does what is added to its answer where
    maps of the whole frame are wanted, a `GlobalPart`.

    An encoder with pretrained weights is frozen, its running statistics and its dropout, too. Only what its first layer
    makes of the coordinates, nothing at the start, is learned.

    Args:
        architecture: of segmentation-models-pytorch.
        channels: to predict.
        encoder: a name known to segmentation-models-pytorch; "tu-…" is timm's.
        pretrained: None, "imagenet" or a folder, as for `find_weights`.
        cell: side of the square of pixels that the architecture predicts one value for.
        smooth: whether a `GlobalPart` is added, for what is smooth over the frame, as the flow of a lens.

    Raises:
        ValueError: an encoder that is not known, or not of this kind; weights that cannot be had.
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
        weights = None if pretrained is None else find_weights(encoder, pretrained)
        self.network = load_network(architecture, encoder, weights, channels=channels)
        self.frozen, self.cell = weights is not None, cell
        self.network.encoder.requires_grad_(not self.frozen)
        _widen(self.network.encoder, known=self.frozen)
        # They go into the checkpoint, so that it can be used without the weights that it came from.
        mean, std = (_MEAN, _STD) if weights is None else (weights.mean, weights.std)
        self.register_buffer("mean", torch.tensor(mean).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(std).view(1, 3, 1, 1))
        for parameter in self.network.segmentation_head.parameters():
            nn.init.zeros_(parameter)
        self.whole = GlobalPart(self.network.encoder.out_channels[-1], channels) if smooth else None
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # missing in torch's annotations
        self.train()

    def train(self, mode: bool = True) -> "Located":
        """As of every module, but a frozen encoder stays in evaluation."""
        super().train(mode)
        if self.frozen:
            self.network.encoder.eval()
        return self

    def forward(self, image: Tensor) -> Tensor:
        """The prediction for an image of any size.

        Args:
            image: (B, 3, H, W), in [0, 1].

        Returns:
            (B, channels, ceil(H / cell), ceil(W / cell)); under autocast float32 if `smooth`, else half.
        """
        if image.ndim != 4 or image.shape[1] != 3:
            raise ValueError(f"image must have shape (B, 3, H, W), got {tuple(image.shape)}")
        height, width = image.shape[2:]
        inputs = torch.cat([(image - self.mean) / self.std, places(image)], dim=1)
        inputs = F.pad(inputs, (0, -width % _STRIDE, 0, -height % _STRIDE), mode="replicate")
        features = self.network.encoder(inputs.contiguous(memory_format=torch.channels_last))
        found = self.network.segmentation_head(self.network.decoder(features))
        found = found[:, :, : -(-height // self.cell), : -(-width // self.cell)]
        if self.whole is None:
            return found
        return found + self.whole(features[-1], *place_axes(image, cell=self.cell))


class _Beside(nn.Module):
    """The weights of a convolution with those for two more inputs beside them."""

    def __init__(self, weight: Tensor, *, known: bool):
        super().__init__()
        place = torch.zeros_like(weight[:, :2])
        self.place = nn.Parameter(place if known else nn.init.normal_(place, std=float(weight.std())))

    def forward(self, weight: Tensor) -> Tensor:
        return torch.cat([weight, self.place], dim=1)


def _widen(encoder: nn.Module, *, known: bool) -> None:
    """The encoder's first layer takes the coordinates, too; of known weights it makes nothing of them at first."""
    stem = next(module for module in encoder.modules() if isinstance(module, nn.Conv2d))
    beside = _Beside(stem.weight.detach(), known=known)
    parametrize.register_parametrization(stem, "weight", beside, unsafe=True)  # unsafe: the shape changes
    stem.in_channels = cast(Tensor, stem.weight).shape[1]

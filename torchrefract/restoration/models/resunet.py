"""The residual U-Net baseline."""

import segmentation_models_pytorch as smp
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrefract.warping.grid import pixel_axes

_STRIDE = 32


class ResUNet(nn.Module):
    """A U-Net whose encoder is a residual network, given the pixel coordinates as two more channels.

    Without them a convolution cannot know where it looks, and what a lens does depends on that. The last layer starts
    at zero: before training the network does nothing.

    Args:
        channels: to predict.
        encoder: a name known to segmentation-models-pytorch; "tu-…" is timm's.

    Raises:
        ValueError: an encoder that is not known, or not of this kind.

    Source: Ronneberger, Fischer, Brox, "U-Net", MICCAI 2015; He, Zhang, Ren, Sun, "Deep residual learning", CVPR 2016.
    """

    def __init__(self, channels: int, *, encoder: str = "tu-resnet34"):
        super().__init__()
        try:
            self.network = smp.Unet(encoder, encoder_weights=None, in_channels=5, classes=channels)
        except (KeyError, RuntimeError) as error:
            raise ValueError(
                "encoder must be known to segmentation-models-pytorch, or to timm with tu- in front, and have features "
                f"at five scales, got {encoder}"
            ) from error
        for parameter in self.network.segmentation_head.parameters():
            nn.init.zeros_(parameter)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # missing in torch's annotations

    def forward(self, image: Tensor) -> Tensor:
        """(B, channels, H, W) of an image (B, 3, H, W) in [0, 1] of any size."""
        height, width = image.shape[2:]
        x, y = pixel_axes(height, width, dtype=image.dtype, device=image.device)
        x, y = ((2 * axis + 1) / size - 1 for axis, size in ((x, width), (y, height)))
        size = (image.shape[0], 1, height, width)
        inputs = torch.cat([4 * image - 2, x.expand(size), y.expand(size)], dim=1)
        inputs = F.pad(inputs, (0, -width % _STRIDE, 0, -height % _STRIDE), mode="replicate")
        return self.network(inputs.contiguous(memory_format=torch.channels_last))[:, :, :height, :width]

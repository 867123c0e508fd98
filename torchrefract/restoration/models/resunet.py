"""The residual U-Net baseline. A file of its own because checkpoints name the class by its module."""

import segmentation_models_pytorch as smp

from torchrefract.restoration.models.coordconv import CoordConvSegmenter


class ResUNet(CoordConvSegmenter):
    """Predict maps by a U-Net with a residual encoder. See `CoordConvSegmenter` for the arguments.

    Source: Ronneberger, Fischer, Brox, "U-Net", MICCAI 2015; He, Zhang, Ren, Sun, "Deep residual learning", CVPR 2016.
    """

    def __init__(
        self, channels: int, *, encoder: str = "tu-resnet34", pretrained: str | None = None, smooth: bool = False
    ):
        super().__init__(smp.Unet, channels, encoder=encoder, pretrained=pretrained, cell=1, smooth=smooth)

"""The SegFormer baseline. A file of its own because checkpoints name the class by its module."""

from functools import partial

import segmentation_models_pytorch as smp

from torchrefract.restoration.models.coordconv import CoordConvSegmenter


class SegFormer(CoordConvSegmenter):
    """Predict maps at a quarter of the frame by a transformer. See `CoordConvSegmenter` for the arguments.

    Each value belongs to a cell of 4 x 4 px; the task interpolates between the cells.

    Source: Xie, Wang, Yu, Anandkumar, Alvarez, Luo, "SegFormer", NeurIPS 2021.
    """

    def __init__(self, channels: int, *, encoder: str = "mit_b1", pretrained: str | None = None, smooth: bool = False):
        architecture = partial(smp.Segformer, upsampling=1)
        super().__init__(architecture, channels, encoder=encoder, pretrained=pretrained, cell=4, smooth=smooth)

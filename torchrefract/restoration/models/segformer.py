"""The SegFormer baseline."""

from functools import partial

import segmentation_models_pytorch as smp

from torchrefract.restoration.models.coordconv import Located


class SegFormer(Located):
    """A transformer whose scales are put together at a quarter of the frame; arguments as for `Located`.

    It predicts one value for each cell of 4 px: what is between them is for the task to say.

    Source: Xie, Wang, Yu, Anandkumar, Alvarez, Luo, "SegFormer", NeurIPS 2021.
    """

    def __init__(self, channels: int, *, encoder: str = "mit_b1", pretrained: str | None = None, smooth: bool = False):
        super().__init__(
            partial(smp.Segformer, upsampling=1),
            channels,
            encoder=encoder,
            pretrained=pretrained,
            cell=4,
            smooth=smooth,
        )

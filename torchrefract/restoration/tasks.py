"""The two tasks: how a prediction of a network restores an image, and the loss of that restoration."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import as_device_tensor, pad_to_multiple
from torchrefract._validation import check_choice, check_flag
from torchrefract.restoration.metrics import masked_mean
from torchrefract.types import Pair
from torchrefract.warping.warp import warp

_CELL = 4  # px
_SQUARED_ERROR = 1e-4  # of an image of 40 dB, below which the loss "psnr" ends


class Restored(NamedTuple):
    """A restored batch of images; maps that the task does not predict are None."""

    image: Tensor  # (B, 3, H, W)
    flow: Tensor | None = None  # (B, 2, H, W), px
    transmission: Tensor | None = None  # (B, 1, H, W), in (0, 1)
    deviation: Tensor | None = None  # (B, 2, H, W), px, the standard deviation of the flow, of a model that samples


class Task(ABC):
    """A kind of restoration."""

    name: str  # of its file in conf/task
    channels: int  # number of maps that the network predicts
    smooth = False  # True if the maps may be smooth over the whole frame

    @abstractmethod
    def restore(self, prediction: Tensor, degraded: Tensor) -> Restored:
        """Restore images by the prediction of a network.

        Args:
            prediction: (B, channels, H, W), or one value for each cell of 4 x 4 px,
                (B, channels, ceil(H / 4), ceil(W / 4)).
            degraded: (B, 3, H, W), in [0, 1].
        """

    @abstractmethod
    def loss_terms(self, restored: Restored, pair: Pair) -> tuple[Tensor, Tensor | None]:
        """Compute L_rec, the L1 loss of each image (B,), and L_k, that of its map; None if the task has no map."""

    def loss(self, restored: Restored, pair: Pair) -> Tensor:
        """Compute the loss (), the mean of L = L_rec + L_k over the batch."""
        reconstruction, of_map = self.loss_terms(restored, pair)
        return (reconstruction if of_map is None else reconstruction + of_map).mean()


class Undistort(Task):
    """Predict the flow that undoes a warp, and warp the degraded image along it.

        flow = limit tanh(prediction) (W, H)
        L_rec = mean |warp(degraded, flow) - clean|,  L_k = mean |flow - true flow| 2 / (W, H)

    Both means are over valid pixels. A prediction of pixels is averaged over cells of 4 x 4 px, and the cells are
    interpolated, because the flow of a lens is smooth.

    Args:
        limit: largest displacement, as a share of the width and the height of the frame.
    """

    name = "undistort"
    channels = 2
    smooth = True

    def __init__(self, limit: float = 0.25):
        self.limit = limit

    def restore(self, prediction: Tensor, degraded: Tensor) -> Restored:
        """Warp the degraded image along the predicted flow."""
        smooth = _interpolate_cells(_average_cells(prediction.float(), degraded), degraded)
        flow = self.limit * torch.tanh(smooth) * frame_sides(smooth)
        return Restored(warp(degraded, flow, padding="border")[0], flow)

    def loss_terms(self, restored: Restored, pair: Pair) -> tuple[Tensor, Tensor]:
        """Compute the L1 losses (B,) of image and flow over valid pixels."""
        flow = torch.zeros_like(pair.flow) if restored.flow is None else restored.flow
        flow_error = (flow - pair.flow).abs() * 2 / frame_sides(pair.flow)
        image_error = masked_mean((restored.image - pair.clean).abs(), pair.valid)
        return image_error, masked_mean(flow_error, pair.valid)


class Deweather(Task):
    """Predict the change from the degraded to the clean image and, optionally, the transmission of the fog.

        restored = degraded + change,  t = 1 / (1 + exp(-last channel))
        L_rec = mean |restored - clean|,  L_k = mean |t - transmission|, over all pixels

    Args:
        transmission_head: True adds a channel for t, and its term to the loss.
        loss_of_image: that is minimized: "l1" is L_rec; "psnr" is log(mean (restored - clean)^2 + 1e-4) / 10, so that
            an image in thin fog, whose errors are small, counts as much as one in dense fog.

    Raises:
        ValueError: another `loss_of_image`.
    """

    name = "deweather"

    def __init__(self, *, transmission_head: bool = False, loss_of_image: str = "l1"):
        self.loss_of_image = check_choice("loss_of_image", loss_of_image, ("l1", "psnr"))
        self.transmission_head = check_flag("transmission_head", transmission_head)
        self.channels = 4 if transmission_head else 3

    def restore(self, prediction: Tensor, degraded: Tensor) -> Restored:
        """Add the predicted change to the degraded image."""
        maps = prediction.float()
        if maps.shape[2:] != degraded.shape[2:]:
            maps = _interpolate_cells(maps, degraded)
        transmission = torch.sigmoid(maps[:, 3:]) if self.transmission_head else None
        return Restored(degraded + maps[:, :3], transmission=transmission)

    def loss_terms(self, restored: Restored, pair: Pair) -> tuple[Tensor, Tensor | None]:
        """Compute the L1 losses (B,) of the image and of a restored transmission.

        Raises:
            ValueError: the restoration has a transmission and the pair has none.
        """
        image_error = (restored.image - pair.clean).abs().mean(dim=(1, 2, 3))
        if restored.transmission is None:
            return image_error, None
        if pair.transmission.shape != restored.transmission.shape:
            raise ValueError(
                "pair must have a transmission for transmission_head: set data.transmission=true, got none"
            )
        return image_error, (restored.transmission - pair.transmission).abs().mean(dim=(1, 2, 3))

    def loss(self, restored: Restored, pair: Pair) -> Tensor:
        """Compute the loss (), with that of the image as `loss_of_image` says."""
        if self.loss_of_image == "l1":
            return super().loss(restored, pair)
        _, of_map = self.loss_terms(restored, pair)
        squared = (restored.image - pair.clean).square().mean(dim=(1, 2, 3))
        loss = (squared + _SQUARED_ERROR).log() / 10
        return (loss if of_map is None else loss + of_map).mean()


def _average_cells(prediction: Tensor, degraded: Tensor) -> Tensor:
    """Average a prediction of pixels over cells; return a prediction of cells unchanged."""
    if prediction.shape[2:] != degraded.shape[2:]:
        return prediction
    # Without full cells, the flow would be stretched along a side that 4 does not divide.
    return F.avg_pool2d(pad_to_multiple(prediction, _CELL), _CELL)


def _interpolate_cells(cells: Tensor, degraded: Tensor) -> Tensor:
    """Interpolate between the centers of cells to one value for each pixel."""
    height, width = degraded.shape[2:]
    size = [_CELL * side for side in cells.shape[2:]]
    return F.interpolate(cells, size=size, mode="bicubic", antialias=True)[:, :, :height, :width]


def frame_sides(like: Tensor, size: Sequence[int] | None = None) -> Tensor:
    """Return width and height, (1, 2, 1, 1), of maps (B, C, H, W) or of the frame (H, W) that they were cut from."""
    height, width = like.shape[2:] if size is None else size
    return as_device_tensor([width, height], dtype=like.dtype, device=like.device).view(1, 2, 1, 1)

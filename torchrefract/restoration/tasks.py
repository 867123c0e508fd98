"""The two tasks: what a network predicts, how an image comes of it, and what that costs."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._validation import check_flag
from torchrefract.restoration.metrics import masked_mean
from torchrefract.types import Pair
from torchrefract.warping.warp import warp

_CELL = 4


class Restored(NamedTuple):
    """A restoration of a batch."""

    image: Tensor  # (B, 3, H, W)
    flow: Tensor | None = None  # (B, 2, H, W), px, of a task that predicts one
    transmission: Tensor | None = None  # (B, 1, H, W) in (0, 1), of a task that predicts it


class Task(ABC):
    """What is to be restored.

    name: that of its file in conf/task.
    channels: how many maps the network has to predict.
    smooth: whether these may be smooth over the whole frame.
    """

    name: str
    channels: int
    smooth = False

    @abstractmethod
    def restore(self, prediction: Tensor, degraded: Tensor) -> Restored:
        """The restoration that a prediction stands for.

        Args:
            prediction: (B, channels, H, W), or of cells of 4 px, (B, channels, ceil(H / 4), ceil(W / 4)).
            degraded: (B, 3, H, W), in [0, 1].
        """

    @abstractmethod
    def loss(self, restored: Restored, pair: Pair) -> Tensor:
        """(), the mean over the batch."""


class Undistort(Task):
    """The flow that undoes a warp is predicted, and the image looked up along it.

        flow = limit tanh(prediction) (W, H),  loss = |warp(degraded, flow) - clean|_1 + |flow - true flow|_1,

    on the valid pixels, the flow in units of half the frame as in [-1, 1]. A prediction of pixels is averaged over
    cells of 4 px, and that of cells interpolated: a lens is smooth.

    Args:
        limit: largest displacement in widths and heights of the frame.
    """

    name = "undistort"
    channels = 2
    smooth = True

    def __init__(self, limit: float = 0.25):
        self.limit = limit

    def restore(self, prediction: Tensor, degraded: Tensor) -> Restored:
        """The degraded image looked up along the predicted flow."""
        smooth = _between_cells(_cells(prediction.float(), degraded), degraded)
        flow = self.limit * torch.tanh(smooth) * _sizes(smooth)
        return Restored(warp(degraded, flow, padding="border")[0], flow)

    def loss(self, restored: Restored, pair: Pair) -> Tensor:
        """L1 of the image and of the flow."""
        flow = torch.zeros_like(pair.flow) if restored.flow is None else restored.flow
        flow_error = (flow - pair.flow).abs() * 2 / _sizes(pair.flow)
        image_error = masked_mean((restored.image - pair.clean).abs(), pair.valid)
        return (image_error + masked_mean(flow_error, pair.valid)).mean()


class Deweather(Task):
    """The clean image is predicted, as a change of the degraded one, and, if wanted, the transmission of the air.

        restored = degraded + change,  t = 1 / (1 + exp(-last channel)),
        loss = |restored - clean|_1 + |t - transmission|_1 on all pixels

    Args:
        transmission_head: whether there is a channel for t, and its term in the loss.
    """

    name = "deweather"

    def __init__(self, *, transmission_head: bool = False):
        self.transmission_head = check_flag("transmission_head", transmission_head)
        self.channels = 4 if transmission_head else 3

    def restore(self, prediction: Tensor, degraded: Tensor) -> Restored:
        """The degraded image plus the predicted change."""
        found = prediction.float()
        found = found if _is_dense(found, degraded) else _between_cells(found, degraded)
        passed = torch.sigmoid(found[:, 3:]) if self.transmission_head else None
        return Restored(degraded + found[:, :3], transmission=passed)

    def loss(self, restored: Restored, pair: Pair) -> Tensor:
        """L1 of the image and, if predicted, of the transmission.

        Raises:
            ValueError: a transmission is predicted, and the pair has none.
        """
        image_error = (restored.image - pair.clean).abs().mean()
        if restored.transmission is None:
            return image_error
        if pair.transmission.shape != restored.transmission.shape:
            raise ValueError(
                "pair must have a transmission for transmission_head: set data.transmission=true, got none"
            )
        return image_error + (restored.transmission - pair.transmission).abs().mean()


def _is_dense(prediction: Tensor, degraded: Tensor) -> bool:
    return prediction.shape[2:] == degraded.shape[2:]


def _cells(prediction: Tensor, degraded: Tensor) -> Tensor:
    """The means of cells, where the prediction is not of cells already."""
    if not _is_dense(prediction, degraded):
        return prediction
    height, width = degraded.shape[2:]
    # Whole cells only, or the flow would be stretched along a side that 4 does not divide.
    return F.avg_pool2d(F.pad(prediction, (0, -width % _CELL, 0, -height % _CELL), mode="replicate"), _CELL)


def _between_cells(cells: Tensor, degraded: Tensor) -> Tensor:
    """The values of pixels, interpolated between the centers of cells."""
    height, width = degraded.shape[2:]
    whole = F.interpolate(cells, size=[_CELL * side for side in cells.shape[2:]], mode="bicubic", antialias=True)
    return whole[:, :, :height, :width]


def _sizes(flow: Tensor) -> Tensor:
    """(1, 2, 1, 1): width and height."""
    return torch.tensor([flow.shape[3], flow.shape[2]], dtype=flow.dtype, device=flow.device).view(1, 2, 1, 1)

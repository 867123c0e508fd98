"""Pictures of any size restored by a model that was trained at one."""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrefract._validation import check_choice, check_count
from torchrefract.restoration.tasks import Restored
from torchrefract.restoration.tiles import in_tiles
from torchrefract.warping.flow import resize_flow, resize_image
from torchrefract.warping.warp import INTERPOLATIONS, warp

_RADIUS = 1  # px of the small picture, of the windows that tell how a change depends on it
_NOISE = 1e-5  # variance below which a window tells nothing: that of rounding to bytes


class Restorer:
    """Pictures restored at their own size.

    The model sees each picture reduced to `size`. Of a model that predicts a flow the flow is brought to the size of
    the picture, which is looked up along it once. Of another one the change that it makes is brought there: by
    `with_change`, or, with a `tile`, the model sees tiles of the picture as it is, see `in_tiles`.

    Args:
        model: images (B, 3, H, W) in [0, 1] -> Restored.
        size: (height, width) of the frames that it was trained on, px.
        tile: (height, width), px; None for one look at the whole picture.
        interpolation: of the look-up along a flow.
        batch: tiles that are restored at once.

    Raises:
        ValueError: a size, tile or interpolation that is none; in a call, a tile with a model that predicts a flow.
    """

    def __init__(
        self,
        model: Callable[[Tensor], Restored],
        *,
        size: Sequence[int],
        tile: Sequence[int] | None = None,
        interpolation: str = "bicubic",
        batch: int = 4,
    ):
        self.model = model
        self.size = (check_count("size", size[0]), check_count("size", size[1]))
        self.tile = None if tile is None else (check_count("tile", tile[0]), check_count("tile", tile[1]))
        self.interpolation = check_choice("interpolation", interpolation, INTERPOLATIONS)
        self.batch = check_count("batch", batch)

    @torch.inference_mode()
    def __call__(self, images: Sequence[Tensor]) -> list[Tensor]:
        """Pictures (3, H, W) in [0, 1], of any sizes, restored."""
        if self.tile is not None:
            restored = [in_tiles(self._piece, image, tile=self.tile, batch=self.batch) for image in images]
            return [image.clamp(0, 1) for image in restored]
        small = torch.cat([resize_image(image[None], self.size) for image in images])
        seen = self.model(small)
        whole = []
        for i, image in enumerate(images):
            one = Restored(seen.image[i : i + 1], None if seen.flow is None else seen.flow[i : i + 1])
            options = {"small": small[i : i + 1], "interpolation": self.interpolation}
            whole.append(at_own_size(one, image[None], **options).image[0])
        return whole

    def _piece(self, tiles: Tensor) -> Tensor:
        seen = self.model(tiles)
        if seen.flow is not None:
            raise ValueError("tile must be None for a model that predicts a flow, and so sees the whole picture")
        return seen.image


class Restoring(nn.Module):
    """A model with what brings its restoration to the size of the images; arguments as for `Restorer`."""

    def __init__(self, model: nn.Module, *, size: Sequence[int], interpolation: str = "bicubic"):
        super().__init__()
        self.model = model
        self.size = (check_count("size", size[0]), check_count("size", size[1]))
        self.interpolation = check_choice("interpolation", interpolation, INTERPOLATIONS)

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """Images (B, 3, H, W) in [0, 1], of one size, restored, and the flow, px, of a model that predicts one."""
        small = resize_image(image, self.size)
        restored = at_own_size(self.model(small), image, small=small, interpolation=self.interpolation)
        return tuple(part for part in restored if part is not None)


def at_own_size(seen: Restored, image: Tensor, *, small: Tensor, interpolation: str) -> Restored:
    """The restoration of images (B, 3, H, W), in [0, 1], from that of small copies of them (B, 3, h, w)."""
    if seen.flow is None:
        return Restored(with_change(image, small, seen.image).clamp(0, 1))
    flow = resize_flow(seen.flow.to(image.dtype), image.shape[2:])
    return Restored(warp(image, flow, padding="border", interpolation=interpolation)[0].clamp(0, 1), flow)


def with_change(image: Tensor, small: Tensor, restored: Tensor) -> Tensor:
    """A picture changed as a small copy of it was.

        out = image + change + a (image - small),  change = restored - small,
        a = cov(small, change) / (var(small) + 1e-5) in windows of 3 x 3 px

    with all of the small copy enlarged. So a change of contrast, as of fog, is one of the fine details too, which the
    small copy lacks.

    Args:
        image: (B, C, H, W).
        small, restored: (B, C, h, w).

    Returns:
        (B, C, H, W).

    Source: after He, Sun, Tang, "Guided image filtering", IEEE TPAMI 35 (2013), whose a this is.
    """
    change = restored - small
    mean = _mean(small)
    covariance = _mean(small * change) - mean * _mean(change)
    a = covariance / (_mean(small * small) - mean * mean + _NOISE)
    enlarged = F.interpolate(torch.cat([small, change, a], dim=1), image.shape[2:], mode="bilinear")
    before, change, a = enlarged.chunk(3, dim=1)
    return image + change + a * (image - before)


def _mean(value: Tensor) -> Tensor:
    """The mean over the window around each pixel, as far as that lies on the picture."""
    return F.avg_pool2d(value, 2 * _RADIUS + 1, 1, _RADIUS, count_include_pad=False)

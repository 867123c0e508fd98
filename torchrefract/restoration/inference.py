"""Restore pictures of any size by a model that was trained at one size."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrefract._validation import check_choice, check_count, check_rgb, check_size
from torchrefract.cameras.camera import Camera
from torchrefract.effects.batch import check_image_values
from torchrefract.fields.rectification import camera_flow
from torchrefract.restoration.tasks import Restored
from torchrefract.warping.flow import resize_flow, resize_image
from torchrefract.warping.warp import INTERPOLATIONS, warp

_RADIUS = 1  # px of the small picture, of the windows of `transfer_change`
_EPSILON = 1e-5  # a window with a smaller variance shows only the rounding to bytes
_OVERLAP = 4  # a tile shares a quarter of its length with the next one


class Restorer:
    """Restore pictures at their own size.

    The model sees each picture resized to `size`. If it predicts a flow, the flow is resized to the picture, which is
    warped once. Otherwise its change is brought to the picture by `transfer_change`. With `tile` the model sees tiles
    of the picture at its own size instead, see `restore_tiles`. If the model predicts the standard deviation of the
    flow, `restore` returns its map, and its root mean square over each picture, px, is added to the list `deviations`.

    Args:
        model: maps images (B, 3, H, W) in [0, 1] to `Restored`.
        size: (height, width) of the frames that the model was trained on, px.
        tile: (height, width) of a tile, px; None for the resized picture.
        interpolation: interpolation of the warp.
        batch: number of tiles that are restored together.

    Raises:
        ValueError: an option is invalid. A call raises it if there is a tile and the model predicts a flow.
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
        self.size = check_size("size", size)
        self.tile = None if tile is None else check_size("tile", tile)
        self.interpolation = check_choice("interpolation", interpolation, INTERPOLATIONS)
        self.batch = check_count("batch", batch)
        self.deviations: list[float] = []  # px, of each picture

    def __call__(self, images: Sequence[Tensor]) -> list[Tensor]:
        """Restore pictures (3, H, W) in [0, 1], which may differ in size."""
        return [restored.image[0] for restored in self.restore(images)]

    @torch.inference_mode()
    def restore(self, images: Sequence[Tensor]) -> list[Restored]:
        """Restore pictures (3, H, W) as batches of one, with the flow and its deviation if the model predicts them."""
        for image in images:
            check_image_values(check_rgb("images", image[None]))
        if self.tile is not None:
            tiled = [restore_tiles(self._restore_tile, image, tile=self.tile, batch=self.batch) for image in images]
            return [Restored(image[None].clamp(0, 1)) for image in tiled]
        small = torch.cat([resize_image(image[None], self.size) for image in images])
        restored = self.model(small)
        rows = zip(*([None] * len(images) if part is None else part.split(1) for part in restored), strict=True)
        results = [
            at_full_size(Restored(*row), image[None], small=before, interpolation=self.interpolation)
            for row, image, before in zip(rows, images, small.split(1), strict=True)
        ]
        maps = [result.deviation for result in results if result.deviation is not None]
        self.deviations += [one.square().sum(dim=1).mean().sqrt().item() for one in maps]
        return results

    def _restore_tile(self, tiles: Tensor) -> Tensor:
        restored = self.model(tiles)
        if restored.flow is not None:
            raise ValueError(
                "tile must be None for a model that predicts a flow, because it needs the complete picture"
            )
        return restored.image


class LensRestorer:
    """Restore pictures of one camera along one flow, so that its lens is still from frame to frame.

    Args:
        camera: whose distortion is removed, from pictures of any size with the ratio of its sides.
        interpolation: of the warp.
    """

    def __init__(self, camera: Camera, *, interpolation: str = "bicubic"):
        self.camera = camera
        self.interpolation = check_choice("interpolation", interpolation, INTERPOLATIONS)
        self._flow = lru_cache(maxsize=2)(lambda h, w: camera_flow(camera.resized(width=w, height=h))[0])

    @torch.inference_mode()
    def restore(self, images: Sequence[Tensor]) -> list[Restored]:
        """Restore pictures (3, H, W) in [0, 1] as batches of one, with the flow."""
        flows = [self._flow(*image.shape[1:]).to(image.device, image.dtype) for image in images]
        options = {"padding": "border", "interpolation": self.interpolation}
        pairs = zip(images, flows, strict=True)
        return [Restored(warp(image[None], flow, **options)[0].clamp(0, 1), flow) for image, flow in pairs]


class FullSizeModel(nn.Module):
    """Restore a batch of images at their own size in one module, for `torch.export`; see `Restorer`."""

    def __init__(self, model: nn.Module, *, size: Sequence[int], interpolation: str = "bicubic"):
        super().__init__()
        self.model = model
        self.size = check_size("size", size)
        self.interpolation = check_choice("interpolation", interpolation, INTERPOLATIONS)

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """Restore images (B, 3, H, W) in [0, 1]; also return the flow, px, if the model predicts one."""
        small = resize_image(image, self.size)
        restored = at_full_size(self.model(small), image, small=small, interpolation=self.interpolation)
        return tuple(part for part in restored if part is not None)


def at_full_size(restored: Restored, image: Tensor, *, small: Tensor, interpolation: str) -> Restored:
    """Bring the restoration of small copies (B, 3, h, w) to the images (B, 3, H, W) themselves."""
    if restored.flow is None:
        return Restored(transfer_change(image, small, restored.image).clamp(0, 1))
    flow = resize_flow(restored.flow.to(image.dtype), image.shape[2:])
    deviation = None if restored.deviation is None else resize_flow(restored.deviation, image.shape[2:])
    warped, _ = warp(image, flow, padding="border", interpolation=interpolation)
    return Restored(warped.clamp(0, 1), flow, deviation=deviation)


def transfer_change(image: Tensor, small: Tensor, restored: Tensor) -> Tensor:
    """Change a picture as its small copy was changed.

        out = image + change + a (image - small),  change = restored - small
        a = cov(small, change) / (var(small) + 1e-5), in windows of 3 x 3 px

    where the maps of the small copy are enlarged. A change of contrast, as of fog, thereby also reaches fine details
    that the small copy lacks.

    Args:
        image: (B, C, H, W); the result has its shape.
        small, restored: (B, C, h, w).

    Source: He, Sun, Tang, "Guided image filtering", IEEE TPAMI 35 (2013), for a.
    """
    change = restored - small
    mean = _window_mean(small)
    covariance = _window_mean(small * change) - mean * _window_mean(change)
    a = covariance / (_window_mean(small * small) - mean * mean + _EPSILON)
    enlarged = F.interpolate(torch.cat([small, change, a], dim=1), image.shape[2:], mode="bilinear")
    before, change, a = enlarged.chunk(3, dim=1)
    return image + change + a * (image - before)


def restore_tiles(restore: Callable[[Tensor], Tensor], image: Tensor, *, tile: tuple[int, int], batch: int) -> Tensor:
    """Restore a picture (C, H, W) tile by tile, and blend the tiles where they overlap.

        out(p) = sum_i w(p - o_i) restored_i(p - o_i) / sum_i w(p - o_i),  w(x, y) = sin^2(pi x / w) sin^2(pi y / h)

    over the tiles i with corners o_i, where pixel centers are at 1/2, 3/2, … . The tiles are evenly spaced and share at
    least a quarter of their length.

    Args:
        restore: restores images (B, C, h, w).
        image: the picture; the result has its shape.
        tile, batch: as for `Restorer`; at most the size of the picture is used.
    """
    height, width = (min(side, full) for side, full in zip(tile, image.shape[1:], strict=True))
    corners = list(product(_tile_starts(image.shape[1], height), _tile_starts(image.shape[2], width)))
    window = _window(height, like=image)[:, None] * _window(width, like=image)
    total, weight = torch.zeros_like(image), torch.zeros_like(image[:1])
    for chunk in (corners[i : i + batch] for i in range(0, len(corners), batch)):
        tiles = torch.stack([image[:, y : y + height, x : x + width] for y, x in chunk])
        for (y, x), restored in zip(chunk, restore(tiles), strict=True):
            total[:, y : y + height, x : x + width] += window * restored
            weight[:, y : y + height, x : x + width] += window
    return total / weight


def _window_mean(value: Tensor) -> Tensor:
    """Average over the window around each pixel, without the part outside the picture."""
    return F.avg_pool2d(value, 2 * _RADIUS + 1, 1, _RADIUS, count_include_pad=False)


def _tile_starts(length: int, tile: int) -> list[int]:
    """Return the first pixel of each tile along an axis."""
    count = 1 + -(-(length - tile) // max(1, tile - tile // _OVERLAP))
    return [round(i * (length - tile) / max(1, count - 1)) for i in range(count)]


def _window(length: int, *, like: Tensor) -> Tensor:
    """Return (length,), sin^2 with zeros half a pixel outside both ends."""
    positions = (torch.arange(length, dtype=like.dtype, device=like.device) + 0.5) / length
    return (torch.pi * positions).sin().square()

"""Batches inside an effect: images and clips as (N, C, H, W), and parameters with B rows.

N is B for images, and B T for the frames of B clips, which follow one another. A value that is the same in all frames
of a clip keeps B rows until it meets one that is not.
"""

import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from torchrefract._tensor import expand_batch, is_channels_last, to_float, to_uint8
from torchrefract._validation import check_tensor, check_within, eager_values, requires_grad, warn, why_not_eager
from torchrefract.labels.targets import is_tv_tensor
from torchrefract.labels.vehicles import LabeledBoxes, select_vehicles
from torchrefract.warping.grid import field_dtype

_MOST_CHANNELS = 4  # of usual images; a clip of 3 frames with more is likely (B, C, T, H, W)
_MOST_CHANNELS_OF_NARROW_IMAGES = 16  # with a width of 1, 3 or 4; above it, the height of an image (H, W, C) is likely
_CHECKED_PIXELS = 16  # a side, of the values of an image
_LIMITS = ((1, 1.5, 0.25), (-1, 0.25, 0.05))  # sign, limit, and the largest share of pixels beyond it
LATEST_FRAME = 1e9  # of a clip, in both directions; float64 still resolves the drift of a field there


class BatchShape(NamedTuple):
    """The dimensions before (C, H, W) of the images that a caller passes."""

    batch: int  # B, of single images or of clips
    frames: int  # T, 1 for single images
    leading: tuple[int, ...]  # (), (B,), (T,) or (B, T)

    @property
    def is_clip(self) -> bool:
        """Return True if there is a time dimension."""
        return self.leading not in ((), (self.batch,))

    def restore(self, value: Tensor) -> Tensor:
        """Give a map with N rows, or with B rows for all frames, the leading dimensions of the images."""
        if self.leading == (self.batch,):
            return value
        value = value.reshape(self.batch, -1 if self.batch else self.frames, *value.shape[1:])
        value = value.expand(-1, self.frames, *value.shape[2:])
        return value if len(self.leading) == 2 else value[0] if self.is_clip else value[0, 0]


def check_image(image: Tensor) -> BatchShape:
    """Check images (B, C, H, W) or (C, H, W), or clips (B, T, C, H, W); a torchvision `Video` is a clip.

    Raises:
        ValueError: another number of dimensions; no channel, no pixel or no frame.
        TypeError: neither floating nor uint8; labels of torchvision; or `torch.jit.trace` runs.
    """
    if torch.jit.is_tracing():
        raise TypeError(
            "image must be a tensor with values, got one of torch.jit.trace, which would repeat a single draw; use "
            "torch.export.export or torch.compile"
        )
    if is_foreign_image(image):
        raise TypeError(
            f"image must be a tensor, got {type(image).__module__}.{type(image).__name__}; convert it by "
            "v2.functional.to_image of torchvision, or place v2.ToImage() before the effect"
        )
    check_tensor("image", image)
    if type(image) is not Tensor and is_tv_tensor(image, "Mask", "KeyPoints", "BoundingBoxes"):
        raise TypeError(
            f"image must be an image, got {type(image).__name__} of torchvision; pass labels after the image, as in "
            "effect(image, mask)"
        )
    if image.ndim not in (3, 4, 5) or 0 in image.shape[-3:]:
        raise ValueError(
            f"image must have shape (B, C, H, W), (C, H, W) or, for clips, (B, T, C, H, W), got {tuple(image.shape)}"
        )
    if image.shape[-3] > _MOST_CHANNELS_OF_NARROW_IMAGES and image.shape[-1] in (1, 3, 4):
        raise ValueError(
            f"image must have its channels before its height and width, got {tuple(image.shape)}; "
            "use image.movedim(-1, -3) if the channels are last"
        )
    if not image.is_floating_point() and image.dtype is not torch.uint8:
        raise TypeError(
            f"image must be floating in [0, 1] or uint8, got {image.dtype}; divide it by its largest possible value"
        )
    leading = tuple(image.shape[:-3])
    if len(leading) == 1 and not is_tv_tensor(image, "Video"):
        return BatchShape(leading[0], 1, leading)
    batch, frames = (1, *leading)[-2:] if leading else (1, 1)
    if frames == 0:
        raise ValueError(f"image must have at least one frame in a clip, got {tuple(image.shape)}")
    if frames == 3 and image.shape[-3] > _MOST_CHANNELS and not torch.compiler.is_compiling():
        warn(
            f"image of shape {tuple(image.shape)} is taken for clips of 3 frames with {image.shape[-3]} channels; use "
            "image.movedim(-4, -3) if its channels are before its frames"
        )
    return BatchShape(batch, frames, leading)


def is_foreign_image(value: Any) -> bool:
    """Return True for a picture of Pillow and for a NumPy array of at least two dimensions."""
    if isinstance(value, np.ndarray):
        return value.ndim >= 2
    picture = getattr(sys.modules.get("PIL.Image"), "Image", None)
    return picture is not None and isinstance(value, picture)


def check_image_values(image: Tensor) -> bool:
    """Raise ValueError for a floating image in 0...255, or after normalization, from a few of its pixels.

    An image may exceed [0, 1], as after bicubic interpolation or with highlights. The check fails if a quarter of the
    pixels lie above 1.5 or 5 % lie below -0.25; pixels of 0, as of a frame, do not count. It reads nothing where that
    waits for a device or breaks a graph. Return True if the values are unknown: nothing was read, or all is 0.
    """
    if why_not_eager(image) is not None:
        return True
    height, width = image.shape[-2:]
    pixels = image.detach()[..., :: -(-height // _CHECKED_PIXELS), :: -(-width // _CHECKED_PIXELS)]
    pixels = pixels[pixels.isfinite() & (pixels != 0)]
    if pixels.numel() == 0:
        return True
    is_high, is_low = ((sign * pixels > limit).float().mean() > share for sign, limit, share in _LIMITS)
    if is_high or is_low:
        low, high = (value.item() for value in pixels.aminmax())
        raise ValueError(
            f"image must lie in [0, 1] if it is floating, got values from {low:.3g} to {high:.3g}; divide 0...255 by "
            "255 or pass uint8, and place effects before Normalize"
        )
    return False


def fix_frame_size(image: Tensor) -> Tensor:
    """Return the image with a frame size in numbers: torch.compile makes symbols of sizes, and a plan needs numbers."""
    if not torch.compiler.is_compiling():
        return image
    height, width = [len(range(side)) for side in image.shape[-2:]]  # `int` would keep the symbol
    return image.view(*image.shape[:-2], height, width)


def check_depth_fits(depth: Any, image: Tensor, shape: BatchShape) -> Tensor:
    """Return the depth as (N, 1, H, W), or (B, 1, H, W) if it is the same in all frames of a clip.

    Raises:
        TypeError: not a floating tensor.
        ValueError: not (..., 1, H, W) for an image (..., C, H, W).
    """
    if not isinstance(depth, Tensor) or not depth.is_floating_point():
        got = depth.dtype if isinstance(depth, Tensor) else type(depth).__name__
        raise TypeError(f"depth must be a floating tensor, got {got}")
    size = (1, *image.shape[-2:])
    static = (*shape.leading[:-1], 1)
    if depth.shape != (*shape.leading, *size) and not (shape.is_clip and depth.shape == (*static, *size)):
        alternative = f", or {(*static, *size)} if it is the same in all frames" if shape.is_clip else ""
        raise ValueError(
            f"depth must have one channel and the size of the image, {(*shape.leading, *size)}{alternative}, "
            f"got {tuple(depth.shape)}"
        )
    return depth.reshape(-1, *size)


def to_batch(image: Tensor, *, keep_uint8: bool = False) -> Tensor:
    """Return (N, C, H, W), float32 or float64 in [0, 1]; uint8 stays uint8 if `keep_uint8`."""
    batch = image if image.ndim == 4 else image.reshape(-1, *image.shape[-3:])
    if image.dtype is torch.uint8:
        return batch if keep_uint8 else to_float(batch)
    return batch if image.dtype is torch.float64 else batch.float()


def from_batch(result: Tensor, image: Tensor, batch: Tensor) -> Tensor:
    """Give a result (N, C, H, W) the shape, type and memory format of the image that `to_batch` made `batch` from."""
    if result is batch:
        return image
    if image.dtype is torch.uint8 and result.is_floating_point():
        result = to_uint8(result)
    memory_format = torch.channels_last if is_channels_last(batch) else torch.contiguous_format
    result = result.to(image.dtype).contiguous(memory_format=memory_format)
    return result if image.ndim == 4 else result.view(image.shape)


def first_frames(image: Tensor, shape: BatchShape) -> Tensor:
    """Return (B, C, H, W), the first frame of each sample."""
    if not shape.is_clip:
        return image if image.ndim == 4 else image[None]
    return image.reshape(shape.batch, shape.frames, *image.shape[-3:])[:, 0]


def frame_numbers(first: float | Tensor, image: Tensor, shape: BatchShape) -> Tensor:
    """Return (B, T), the numbers of the frames in their clips, from the number of the first one, () or (B,)."""
    start = torch.as_tensor(first, dtype=field_dtype(image.dtype), device=image.device)
    if start.ndim > 1 or (start.ndim == 1 and start.shape[0] not in (1, shape.batch)):
        raise ValueError(f"frame must be a number, or one for each of {shape.batch} samples, got {tuple(start.shape)}")
    check_within("frame", start, -LATEST_FRAME, LATEST_FRAME)
    return start.view(-1, 1).expand(shape.batch, 1) + torch.arange(shape.frames, dtype=start.dtype, device=start.device)


def check_frames(params: Any, shape: BatchShape) -> None:
    """Raise ValueError unless the parameters have a frame number for each frame."""
    for child in getattr(params, "children", ()):
        check_frames(child, shape)
    if "frame" in params._fields and params.frame.shape != (shape.batch, shape.frames):
        raise ValueError(
            f"params.frame must have shape {(shape.batch, shape.frames)}, a number for each frame of each sample (or "
            f"pass frame=, that of the first), got {tuple(params.frame.shape)}"
        )


def map_params(params: Any, function: Any) -> Any:
    """Apply a function to each tensor of the parameters, and to those of the children of a composition; None stays."""
    if params is None or isinstance(params, Tensor):
        return None if params is None else function(params)
    if isinstance(params, tuple) and not hasattr(params, "_fields"):  # the children of a composition
        return tuple(map_params(child, function) for child in params)
    return type(params)(*(map_params(value, function) for value in params))


def params_to(params: Any, *args: Any, **kwargs: Any) -> Any:
    """Move the parameters as by `Tensor.to`; flags and keys keep their type."""

    def move(value: Tensor) -> Tensor:
        if value.is_floating_point():
            return value.to(*args, **kwargs)
        return value.to(torch.empty(0, dtype=torch.float32, device=value.device).to(*args, **kwargs).device)

    return map_params(params, move)


def promote_params(params: Any, dtype: torch.dtype) -> Any:
    """Convert floating parameters of a smaller type than `dtype` to it, since flows are never computed in half."""

    def promote(value: Tensor) -> Tensor:
        return value.to(torch.promote_types(value.dtype, dtype)) if value.is_floating_point() else value

    return map_params(params, promote)


def params_at_frames(params: Any, frames: Tensor) -> Any:
    """Replace the frame numbers (B, T) of the parameters; those without a `frame` stay."""
    if "children" in params._fields:
        return params._replace(children=tuple(params_at_frames(child, frames) for child in params.children))
    return params._replace(frame=frames) if "frame" in params._fields else params


def params_per_frame(params: Any, frames: int) -> Any:
    """Repeat the parameters of B clips for their T frames: B T rows, each with one frame number."""
    if frames == 1:
        return params
    repeated = map_params(params, lambda value: value.repeat_interleave(frames, dim=0))
    return repeated._replace(frame=params.frame.reshape(-1, 1)) if "frame" in params._fields else repeated


class ParamsAtDepth(NamedTuple):
    """The parameters of a warp that depends on depth, with the depth of each frame."""

    params: Any  # with N rows, each with one frame number
    depth: Tensor  # (N, 1, H, W or 1), m
    moment: Tensor | None = None  # (N,), in the exposure, as a share of it from its middle; None is the middle

    @property
    def applied(self) -> Tensor:
        """Return (N,), bool: the frame is degraded."""
        return self.params.applied

    @property
    def is_identity(self) -> Tensor:
        """Return (N,), bool: the parameters change nothing at any depth."""
        return self.params.is_identity

    @property
    def is_map(self) -> bool:
        """Return True if depth varies along rows, so that no plan of the ranges holds."""
        return self.depth.shape[3] > 1

    def at(self, moment: float) -> "ParamsAtDepth":
        """Return the same at a moment of the exposure."""
        depth = self.depth
        return self._replace(moment=torch.full(depth.shape[:1], moment, dtype=depth.dtype, device=depth.device))


def check_applied(applied: Tensor, count: int) -> None:
    """Raise ValueError unless there is a flag for each of `count` samples."""
    if applied.shape != (count,) or applied.dtype is not torch.bool:
        raise ValueError(
            f"params.applied must have one row for each of the {count} images, and be bool of shape (B,), got "
            f"{applied.dtype} of shape {tuple(applied.shape)}"
        )


def check_shapes(params: Any, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ValueError unless these fields of the parameters have rows of the given shapes."""
    for name, row in shapes.items():
        shape = getattr(params, name).shape
        if shape[1:] != row:
            raise ValueError(f"params.{name} must have shape {('B', *row)}, got {tuple(shape)}".replace("'B'", "B"))


def select_params(params: Any, index: Tensor) -> Any:
    """Return the rows of some samples."""
    return map_params(params, lambda value: value[index])


def check_kornia_keys(remedy: str = "pass torchrefract.adapters.kornia.KorniaEffect(effect) to the container") -> None:
    """Raise TypeError inside a container of kornia that passes labels, which it would not move."""
    operations = sys.modules.get("kornia.augmentation.container.ops")
    if operations is None or torch.compiler.is_compiling():
        return
    # A container calls foreign modules with the image alone; its data keys are in its own frame only.
    frame = sys._getframe(1)
    while frame is not None:
        keys = frame.f_locals.get("_data_keys", ()) if frame.f_globals is vars(operations) else ()
        names = [key.name.lower() for key in keys if key.name not in ("IMAGE", "INPUT", "CLASS", "LABEL")]
        if names:
            raise TypeError(
                f"data_keys must be ['input'] for an effect as it is, got {names} too, which kornia would not move; "
                + remedy
            )
        frame = frame.f_back


def rows_of_samples(index: Tensor, frames: int) -> Tensor:
    """Return (n T,), the rows of some samples, (n,), of T frames each."""
    return (frames * index[:, None] + torch.arange(frames, device=index.device)).flatten()


class _SwapGradient(torch.autograd.Function):
    """Return the first tensor, and pass the gradient to the second."""

    generate_vmap_rule = True

    @staticmethod
    def forward(value: Tensor, differentiable: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        return None

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]  # two inputs, two gradients
        return None, gradient


class _SwapGradientForward(_SwapGradient):
    """Add the forward mode, which torch.compile does not trace."""

    @staticmethod
    def jvp(ctx: Any, _: None, tangent: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]  # two inputs, two tangents
        return tangent


def where_active(changed: Tensor, unchanged: Tensor | float, active: Tensor, params: Any) -> Tensor:
    """Choose `changed` for active samples and `unchanged`, bit for bit, for the others.

    An applied sample at strength zero is not active, but its parameters keep their gradient, so that an optimizer can
    start there.

    Args:
        changed: (N, ...).
        unchanged: (N, ...), or a number.
        active: (N,) or (B,), bool.
        params: with B or N rows; needs `applied` and, for gradients, its tensors.
    """
    if eager_values(active.all, of=active):
        return changed
    rows = changed.shape[0]
    shape = (-1, *[1] * (changed.ndim - 1))
    value = torch.where(expand_batch(active, rows).view(shape), changed, unchanged)
    if not requires_grad(params):
        return value
    differentiable = torch.where(expand_batch(params.applied, rows).view(shape), changed, unchanged)
    swap = _SwapGradient if torch.compiler.is_compiling() else _SwapGradientForward
    return cast(Tensor, swap.apply(value.detach(), differentiable))


def uses_boxes(effect: nn.Module) -> bool:
    """Return True if an effect, or one of a composition, depends on boxes of vehicles."""
    return any(getattr(part, "vehicle_labels", None) is not None for part in effect.modules())


def with_vehicles(effect: Any, params: Any, boxes: Sequence[LabeledBoxes]) -> Any:
    """Return the parameters of an effect with the vehicles that the boxes of each image show.

    Args:
        effect: of the parameters; a composition hands the boxes to its effects as they are, so dust comes before warps.
        params: of the effect, with B rows.
        boxes: of each of the B images.
    """
    if hasattr(params, "children"):
        pairs = zip(effect.effects, params.children, strict=True)
        return params._replace(children=tuple(with_vehicles(part, child, boxes) for part, child in pairs))
    if getattr(effect, "vehicle_labels", None) is None:
        return params
    return params._replace(vehicles=select_vehicles(boxes, effect.vehicle_labels, like=params.visibility))

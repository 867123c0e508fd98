"""The base class of all effects: parameters drawn by key, then a deterministic and differentiable degradation."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from torchrefract import random
from torchrefract._validation import (
    check_count,
    check_number,
    check_values,
    check_whole,
    eager_bool,
    is_whole,
    requires_grad,
)
from torchrefract.effects.batch import (
    BatchShape,
    check_depth_fits,
    check_frames,
    check_image,
    first_frames,
    fix_frame_size,
    frame_numbers,
    from_batch,
    params_at_frames,
    promote_params,
    to_batch,
)
from torchrefract.labels.targets import is_tv_tensor, warp_moved_labels, wrap_like
from torchrefract.types import Degraded, Range
from torchrefract.warping.grid import field_dtype


class Effect(nn.Module, ABC):
    """A degradation of images.

    Images are (B, C, H, W) or (C, H, W), floating in [0, 1] or uint8, and come back with the same shape, type and
    memory format. A sample that the effect leaves alone comes back bit for bit.

    Clips are (B, T, C, H, W), or a torchvision `Video`, (T, C, H, W). A clip is one sample: its drawn parameters hold
    for all frames, fields of turbulence and fog move from frame to frame, and frame t alone, with the same seed and key
    and `frame=t`, equals frame t of the clip.

    Subclasses implement `sample_params`, `validate`, and `degrade_batch` or what `WarpEffect` and `PhotometricEffect`
    make of it.

    Args:
        p: probability that a sample is degraded, in [0, 1].
    """

    params_type: type[Any]

    def __init__(self, *, p: float = 1.0):
        super().__init__()
        self.p = check_number("p", p, low=0.0, high=1.0)

    def __init_subclass__(cls, **kwargs: Any):
        """Let `torch.load` read saved parameters with its default `weights_only=True`."""
        super().__init_subclass__(**kwargs)
        if "params_type" in vars(cls):
            torch.serialization.add_safe_globals([cls.params_type])

    def forward(self, image: Tensor, *target: Any) -> Any:
        """Degrade an image by a draw that the global torch generator seeds, and move a target along.

        Args:
            image: as for the class.
            target: at most one, any nesting of torchvision tv_tensors and plain values; see `warp_labels` for what
                moves and what raises. Photometric effects leave it as it is.

        Returns:
            The degraded image, or (image, target) if a target is passed.
        """
        if len(target) > 1:
            raise TypeError(f"target must be a single argument of any nesting, got {len(target)}")
        degraded = self.degrade(image)
        is_tv = is_tv_tensor(image, "Image") or is_tv_tensor(image, "Video")
        result = wrap_like(degraded.image, image) if is_tv else degraded.image
        if not target:
            return result
        flow = degraded.flow
        if flow is None:
            return result, target[0]
        if flow.ndim == 5:
            raise TypeError("target must be None for a batch of clips: warp_labels moves the target of each clip")
        return result, warp_moved_labels(target[0], flow)

    def degrade(
        self,
        image: Tensor,
        *,
        seed: int | Tensor | None = None,
        keys: Tensor | Sequence[int] | None = None,
        depth: Tensor | None = None,
        frame: float | Tensor = 0,
    ) -> Degraded:
        """Degrade an image and return it with its flow, masks, maps and drawn parameters.

        Args:
            image: (B, C, H, W) or (C, H, W), floating in [0, 1] or uint8; clips, (B, T, C, H, W).
            seed: of the draw; None takes one from the global torch generator.
            keys: (B,), integers: sample i depends on (seed, keys[i]) alone; None counts from 0.
            depth: (B, 1, H, W) or (1, H, W), m, for effects that need it; for clips (B, T, 1, H, W), or
                (B, 1, 1, H, W) if it is the same in all frames.
            frame: number of the image in its clip, or of the first frame of a clip, in [-1e9, 1e9]; a number or (B,).

        Raises:
            ValueError, TypeError: an invalid argument.
        """
        shape, image = check_image(image), fix_frame_size(image)
        params = self._draw(image, shape, seed, keys, 0, frame)
        return self._degrade(image, shape, params, depth)

    def sample(
        self,
        image: Tensor,
        *,
        seed: int | Tensor | None = None,
        keys: Tensor | Sequence[int] | None = None,
        place: int = 0,
        frame: float | Tensor = 0,
    ) -> Any:
        """Draw parameters for an image, a NamedTuple of tensors; `place` is the position in a pipeline."""
        shape, image = check_image(image), fix_frame_size(image)
        return self._draw(image, shape, seed, keys, place, frame)

    def apply(  # pyright: ignore[reportIncompatibleMethodOverride]  # nn.Module uses this name; both uses work
        self, image: Any, params: Any = None, *, depth: Tensor | None = None, frame: float | Tensor | None = None
    ) -> Any:
        """Degrade an image with given parameters, such as those of an earlier draw -> Degraded.

        Floating parameters of a smaller type than the flow are converted. With a function as the only argument this is
        `nn.Module.apply`, so that an effect works inside a model.

        Args:
            image, depth: as for `degrade`.
            params: of `params_type`, with B rows.
            frame: number of the (first) frame, for the same draw at another time; None keeps that of `params`.
        """
        if params is None and callable(image) and not isinstance(image, Tensor):
            return super().apply(cast(Callable[[nn.Module], None], image))
        shape, image = check_image(image), fix_frame_size(image)
        self.check_params(params, first_frames(image, shape))
        params = promote_params(params, field_dtype(image.dtype))
        if frame is not None:
            params = params_at_frames(params, frame_numbers(frame, image, shape))
        return self.for_params(params, *image.shape[-2:])._degrade(image, shape, params, depth)

    def for_params(self, params: Any, height: int, width: int) -> "Effect":
        """Return an effect whose plan covers given parameters: itself, or one without a tolerance."""
        return self

    def plan(self, height: int, width: int, *, dtype: torch.dtype = torch.float32) -> Any:
        """Return how the effect is computed under its tolerance; `print` shows it as a table.

        Args:
            height, width: px, of the frame.
            dtype: of the image.

        Raises:
            ValueError: a side below 1; a tolerance below the rounding of positions in such a frame.
        """
        check_count("height", height)
        check_count("width", width)
        return self.plan_for_dtype(height, width, field_dtype(dtype))

    @abstractmethod
    def plan_for_dtype(self, height: int, width: int, dtype: torch.dtype) -> Any:
        """Return the plan for flows or maps of a type, from the ranges alone."""

    @property
    def keeps_uint8(self) -> bool:
        """Return True if `degrade_batch` accepts uint8 images as they are."""
        return False

    @abstractmethod
    def sample_params(self, stream: random.Stream, image: Tensor) -> Any:
        """Draw parameters for images (B, C, H, W) from the random streams of the samples; a `frame` is 0."""

    @abstractmethod
    def validate(self, params: Any, image: Tensor) -> None:
        """Raise ValueError for invalid parameters, as far as reading them costs no wait for a device."""

    @abstractmethod
    def degrade_batch(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """Degrade images (N, C, H, W), floating or uint8 if `keeps_uint8`, with valid parameters of B samples."""

    def may_change(self, params: Any) -> bool:
        """Return False if no sample changes; True if one does, if that cannot be read, or if gradients are needed."""
        active = params.applied & ~params.is_identity
        return eager_bool(active.any, of=active) is not False or requires_grad(params)

    def check_params(self, params: Any, image: Tensor) -> None:
        """Raise unless these are valid parameters of this effect for images (B, C, H, W).

        Raises:
            TypeError: not of `params_type`.
            ValueError: another batch size, NaN, or values that `validate` rejects.
        """
        if not isinstance(params, self.params_type):
            raise TypeError(f"params must be {self.params_type.__name__}, got {type(params).__name__}")
        for name, value in zip(params._fields, params, strict=True):
            if not isinstance(value, Tensor) or value.ndim == 0 or value.shape[0] != image.shape[0]:
                got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise ValueError(f"params.{name} must have one row for each of the {image.shape[0]} images, got {got}")
            if value.is_floating_point():
                # Some parameters, as a visibility, may be infinite; `validate` decides.
                check_values(f"params.{name}", "not be NaN", value, lambda v: ~v.isnan())
        self.validate(params, image)

    def draw_in_ranges(self, stream: random.Stream, ranges: Sequence[Range], image: Tensor) -> tuple[Tensor, Tensor]:
        """Draw `applied`, (B,), bool, with probability `p`, and a uniform value in each of n ranges, (B, n)."""
        values = random.uniform_in_ranges(stream, [(0.0, 1.0), *ranges], dtype=field_dtype(image.dtype))
        return values[:, 0].float() < self.p, values[:, 1:]

    def extra_repr(self) -> str:
        """Show the arguments in the representation of the module."""
        return ", ".join(
            f"{name}={value}" for name, value in vars(self).items() if name[0] != "_" and name != "training"
        )

    def _draw(
        self,
        image: Tensor,
        shape: BatchShape,
        seed: int | Tensor | None,
        keys: Tensor | Sequence[int] | None,
        place: int,
        frame: float | Tensor,
    ) -> Any:
        seed = random.call_seed() if seed is None else _check_seed(seed)
        stream = random.stream(seed, _check_keys(keys, shape.batch), device=image.device)
        params = self.sample_params(stream.at(place), first_frames(image, shape))
        if not isinstance(frame, Tensor) and frame == 0 and shape.frames == 1:
            return params  # the frame numbers that were drawn
        return params_at_frames(params, frame_numbers(frame, image, shape))

    def _degrade(self, image: Tensor, shape: BatchShape, params: Any, depth: Tensor | None) -> Degraded:
        batch = to_batch(image, keep_uint8=self.keeps_uint8)
        check_frames(params, shape)
        depth = None if depth is None else check_depth_fits(depth, image, shape)
        if image.device.type != "meta" and torch.is_autocast_enabled(image.device.type):
            # Autocast would compute matrix products in half, and positions need float32.
            with torch.autocast(image.device.type, enabled=False):
                result = self.degrade_batch(batch, params, depth)
        else:
            result = self.degrade_batch(batch, params, depth)
        result.image = from_batch(result.image, image, batch)
        return result if image.ndim == 4 and not shape.is_clip else result.map(shape.restore)


def _check_seed(seed: int | Tensor) -> int | Tensor:
    if not isinstance(seed, Tensor):
        return check_whole("seed", seed)
    if not is_whole(seed):
        raise TypeError(f"seed must be a whole number, got {seed.dtype}")
    if seed.numel() != 1:
        raise ValueError(f"seed must be one number, got shape {tuple(seed.shape)}")
    return seed.reshape(())


def _check_keys(keys: Tensor | Sequence[int] | None, batch: int) -> Tensor | range:
    if keys is None:
        return range(batch)
    # An empty list has no type of its own.
    dtype = None if isinstance(keys, Tensor) or len(keys) else torch.int64
    device = keys.device if isinstance(keys, Tensor) else "cpu"
    keys = torch.as_tensor(keys, dtype=dtype, device=device)
    if not is_whole(keys):
        raise TypeError(f"keys must be whole numbers, got {keys.dtype}")
    if keys.reshape(-1).shape[0] != batch or keys.ndim > 1:
        raise ValueError(f"keys must have one key for each of the {batch} images, got shape {tuple(keys.shape)}")
    return keys.reshape(-1)

"""What every effect is: parameters drawn by key, then a deterministic and differentiable function of them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from torchrefract import random
from torchrefract._validation import check_number, check_values, check_whole, check_within, is_whole
from torchrefract.effects.door import Layout, check_depth_fits, check_image, enter, leave
from torchrefract.effects.motion import LATEST_FRAME
from torchrefract.effects.plan import check_sides
from torchrefract.effects.rows import Undrawn, at_frames, promote_params
from torchrefract.labels.rows import is_tv, wrapped
from torchrefract.labels.targets import follow
from torchrefract.types import Degraded, Range
from torchrefract.warping.grid import field_dtype


class Effect(nn.Module, ABC):
    """A degradation of images.

    Images are (B, C, H, W) or (C, H, W), floating in [0, 1] or uint8, and come back in shape, type and memory format
    as they were. A sample that the effect leaves alone comes back bit for bit.

    Clips are (B, T, C, H, W), or a `Video` of torchvision, (T, C, H, W). A clip is one sample: what an effect draws
    holds for all its frames, fields of air and fog move and change from frame to frame, and frame t alone, by the same
    seed and key and `frame=t`, is that of the clip.

    Args:
        p: chance that a sample is degraded at all, in [0, 1].
    """

    def __init__(self, *, p: float = 1.0):
        super().__init__()
        self.p = check_number("p", p, low=0.0, high=1.0)

    def forward(self, image: Tensor, *target: Any) -> Any:
        """The image degraded, by a draw that torch's global generator seeds; beside a target, both of them.

        The target is any nesting of torchvision's tv_tensors and plain values. What has a place in the image moves as
        by `warp_labels`, which says what raises; light moves nothing, and labels of a sample that stays where it is are
        neither clipped nor filtered.
        """
        if len(target) > 1:
            raise TypeError(f"target must be one, of any nesting, got {len(target)}")
        degraded = self.degrade(image)
        tv = is_tv(image, "Image") or is_tv(image, "Video")
        result = wrapped(degraded.image, image) if tv else degraded.image
        if not target:
            return result
        flow = degraded.flow
        if flow is None:
            return result, target[0]
        if flow.ndim == 5:
            raise TypeError("target must be None beside several clips: warp_labels moves that of each, got one for all")
        return result, follow(target[0], flow)

    def degrade(
        self,
        image: Tensor,
        *,
        seed: int | Tensor | None = None,
        keys: Tensor | Sequence[int] | None = None,
        depth: Tensor | None = None,
        frame: float | Tensor = 0,
    ) -> Degraded:
        """The image degraded, with the maps of what was done.

        Args:
            image: (B, C, H, W) or (C, H, W), floating in [0, 1] or uint8; clips, (B, T, C, H, W).
            seed: of the draw; None takes one from torch's global generator.
            keys: (B,), whole numbers: sample i depends on (seed, keys[i]) alone; None counts from 0.
            depth: (B, 1, H, W) or (1, H, W), m, for the effects that ask for it; of clips (B, T, 1, H, W), or
                (B, 1, 1, H, W) if it is the same in all frames.
            frame: the number of the image in its clip, or of a clip's first frame, in [-1e9, 1e9]; a number, or (B,).

        Raises:
            ValueError, TypeError: arguments that do not fit.
        """
        layout = check_image(image)
        params = self._sample(self.draw_sparingly, image, layout, seed, keys, 0, frame)
        return self._run(image, layout, params, depth)

    def sample(
        self,
        image: Tensor,
        *,
        seed: int | Tensor | None = None,
        keys: Tensor | Sequence[int] | None = None,
        place: int = 0,
        frame: float | Tensor = 0,
    ) -> Any:
        """The parameters of one draw for this image, a NamedTuple of tensors; `place` is that in a pipeline."""
        return self._sample(self.draw, image, check_image(image), seed, keys, place, frame)

    def _sample(
        self,
        draw: Callable[[random.Stream, Tensor], Any],
        image: Tensor,
        layout: Layout,
        seed: int | Tensor | None,
        keys: Tensor | Sequence[int] | None,
        place: int,
        frame: float | Tensor,
    ) -> Any:
        seed = random.call_seed() if seed is None else _seed(seed)
        source = random.stream(seed, _keys(keys, layout.batch), device=image.device)
        params = draw(source.at(place), _samples(image, layout))
        return at_frames(params, lambda: _frames(frame, image, layout))

    def apply(  # pyright: ignore[reportIncompatibleMethodOverride]  # nn.Module has taken the name; both uses work
        self, image: Any, params: Any = None, *, depth: Tensor | None = None, frame: float | Tensor | None = None
    ) -> Any:
        """The image degraded by parameters that are given, as by those of an earlier draw -> Degraded.

        With `frame` they are those of the same draw at another frame of its clip. Parameters of a smaller type than
        fields have are taken in that of fields. With a function as its one argument this is `nn.Module.apply`, so that
        an effect can sit inside a model.
        """
        if params is None and callable(image) and not isinstance(image, Tensor):
            return super().apply(cast(Callable[[nn.Module], None], image))
        layout = check_image(image)
        self.check_params(params, _samples(image, layout))
        params = promote_params(params, field_dtype(image.dtype))
        if frame is not None:
            params = at_frames(params, lambda: _frames(frame, image, layout))
        return self.for_params(params, *image.shape[-2:])._run(image, layout, params, depth)

    def for_params(self, params: Any, height: int, width: int) -> "Effect":
        """The effect that takes parameters which are given: itself, unless it relies on what it draws itself."""
        return self

    params_type: type[Any]

    def plan(self, height: int, width: int, *, dtype: torch.dtype = torch.float32) -> Any:
        """What the effect does for frames of this size under its tolerance, if no depth is passed in; printed, too.

        Args:
            height, width: px, of the frame.
            dtype: of the image.

        Returns:
            `Plan` of a warp, `LightPlan`, or `ComposePlan`.

        Raises:
            ValueError: a frame without a pixel; a tolerance below the rounding of such a frame.
        """
        check_sides(height, width)
        plan = self.planned(height, width, field_dtype(dtype))
        print(plan)
        return plan

    @abstractmethod
    def planned(self, height: int, width: int, dtype: torch.dtype) -> Any:
        """The plan for fields of a type, from the ranges alone."""

    @property
    def idle(self) -> bool:
        """Whether no draw changes anything, by its chance or by the ranges."""
        return self.p == 0 or self.at_rest()

    def at_rest(self) -> bool:
        """Whether the ranges leave no draw that changes anything."""
        return False

    @property
    def takes_levels(self) -> bool:
        """Whether `compute` takes the levels of uint8 as they are, not as numbers in [0, 1]."""
        return False

    @abstractmethod
    def draw(self, source: random.Stream, image: Tensor) -> Any:
        """The parameters of a batch (B, C, H, W), drawn from the streams of its samples; a `frame` among them is 0."""

    def draw_sparingly(self, source: random.Stream, image: Tensor) -> Any:
        """The same; what a composition has that is idle may still be `Undrawn`."""
        return self.draw(source, image)

    @abstractmethod
    def check(self, params: Any, image: Tensor) -> None:
        """Raise for parameters outside their domain, where reading them costs nothing."""

    @abstractmethod
    def compute(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """The rows (N, C, H, W), floating, degraded by checked parameters of B samples, of N / B frames each.

        They are uint8 where images are and the effect takes levels.
        """

    def _run(self, image: Tensor, layout: Layout, params: Any, depth: Tensor | None) -> Degraded:
        rows = enter(image, levels=self.takes_levels)
        _check_frames(params, layout)
        fitting = None if depth is None else check_depth_fits(depth, image, layout)
        if torch.is_autocast_enabled(image.device.type):
            # Fields are never half, and matrix products would be.
            with torch.autocast(image.device.type, enabled=False):
                result = self.compute(rows, params, fitting)
        else:
            result = self.compute(rows, params, fitting)
        result.image = leave(result.image, image, rows)
        return result if image.ndim == 4 and not layout.is_clip else result.map(layout.unrolled)

    def _uniform(self, source: random.Stream, ranges: Sequence[Range], image: Tensor) -> tuple[Tensor, Tensor]:
        """The gate, (B,), bool, and a value out of each range, (B, n)."""
        values = random.uniform_in_ranges(source, [(0.0, 1.0), *ranges], dtype=field_dtype(image.dtype))
        return values[:, 0].float() < self.p, values[:, 1:]

    def check_params(self, params: Any, image: Tensor) -> None:
        """Raise unless these are parameters of this effect for the batch (B, C, H, W)."""
        if not isinstance(params, self.params_type):
            raise TypeError(f"params must be {self.params_type.__name__}, got {type(params).__name__}")
        for name, value in zip(params._fields, params, strict=True):
            if not isinstance(value, Tensor) or value.ndim == 0 or value.shape[0] != image.shape[0]:
                found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise ValueError(
                    f"params.{name} must have one row for each of the {image.shape[0]} images, got {found}"
                )
            if value.is_floating_point():
                # A visibility may be infinite; what may not is for the effect to say.
                check_values(f"params.{name}", "not be NaN", value, lambda v: ~v.isnan())
        self.check(params, image)

    def extra_repr(self) -> str:
        """The arguments, as they were given."""
        return ", ".join(
            f"{name}={value}" for name, value in vars(self).items() if name[0] != "_" and name != "training"
        )


def _seed(seed: int | Tensor) -> int | Tensor:
    if not isinstance(seed, Tensor):
        return check_whole("seed", seed)
    if not is_whole(seed):
        raise TypeError(f"seed must be a whole number, got {seed.dtype}")
    if seed.numel() != 1:
        raise ValueError(f"seed must be one number, got shape {tuple(seed.shape)}")
    return seed.reshape(())


def _keys(keys: Tensor | Sequence[int] | None, batch: int) -> Tensor | range:
    if keys is None:
        return range(batch)
    # An empty list has no type of its own.
    dtype = None if isinstance(keys, Tensor) or len(keys) else torch.int64
    keys = torch.as_tensor(keys, dtype=dtype)
    if not is_whole(keys):
        raise TypeError(f"keys must be whole numbers, got {keys.dtype}")
    if keys.reshape(-1).shape[0] != batch or keys.ndim > 1:
        raise ValueError(f"keys must have one key for each of the {batch} images, got shape {tuple(keys.shape)}")
    return keys.reshape(-1)


def _samples(image: Tensor, layout: Layout) -> Tensor:
    """(B, C, H, W): the first frame of each sample."""
    if not layout.is_clip:
        return image if image.ndim == 4 else image[None]
    return image.reshape(layout.batch, layout.frames, *image.shape[-3:])[:, 0]


def _frames(first: float | Tensor, image: Tensor, layout: Layout) -> Tensor:
    """(B, T), the numbers of the frames."""
    options: Any = {"dtype": field_dtype(image.dtype), "device": image.device}
    if not isinstance(first, Tensor):
        first = check_number("frame", first, low=-LATEST_FRAME, high=LATEST_FRAME)
        if layout.frames == 1:
            return torch.full((layout.batch, 1), first, **options)
    start = torch.as_tensor(first, **options)
    if start.ndim > 1 or (start.ndim == 1 and start.shape[0] not in (1, layout.batch)):
        raise ValueError(f"frame must be a number, or one for each of {layout.batch} samples, got {tuple(start.shape)}")
    check_within("frame", start, -LATEST_FRAME, LATEST_FRAME)
    return start.view(-1, 1).expand(layout.batch, 1) + torch.arange(layout.frames, **options)


def _check_frames(params: Any, layout: Layout) -> None:
    """Raise unless the parameters are for as many frames as there are."""
    if isinstance(params, Undrawn):
        return
    for child in getattr(params, "children", ()):
        _check_frames(child, layout)
    if "frame" in params._fields and params.frame.shape != (layout.batch, layout.frames):
        raise ValueError(
            f"params.frame must have shape {(layout.batch, layout.frames)}, a number for each frame of each sample (or "
            f"give frame=, that of the first), got {tuple(params.frame.shape)}"
        )


def params_to(params: Any, *args: Any, **kwargs: Any) -> Any:
    """The parameters with each tensor moved as by `Tensor.to`; flags and keys keep their type, and so their bits."""
    return type(params)(*(moved(value, *args, **kwargs) for value in params))


def moved(value: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    """The tensor moved as by `Tensor.to`; what is not floating keeps its type."""
    floating = value if value.is_floating_point() else torch.empty(0, device=value.device)
    target = floating.to(*args, **kwargs)
    return target if value.is_floating_point() else value.to(target.device)

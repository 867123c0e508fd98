"""What every effect is: parameters drawn by key, then a deterministic and differentiable function of them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from torchrefract import draws
from torchrefract._checks import check_all, check_number, is_true
from torchrefract.effects.door import check_image, enter, leave
from torchrefract.labels.rows import is_tv, wrapped
from torchrefract.labels.targets import warp_labels
from torchrefract.types import Degraded, Range
from torchrefract.warping.grid import field_dtype


class Effect(nn.Module, ABC):
    """A degradation of images.

    Images are (B, C, H, W) or (C, H, W), floating in [0, 1] or uint8, and come back in shape, type and memory format
    as they were. A sample that the effect leaves alone comes back bit for bit.

    Args:
        p: chance that a sample is degraded at all, in [0, 1].
    """

    def __init__(self, *, p: float = 1.0):
        super().__init__()
        self.p = check_number("p", p, low=0.0, high=1.0)

    def forward(self, image: Tensor, *target: Any) -> Any:
        """The image degraded, by a draw that torch's global generator seeds; beside a target, both of them.

        The target is any nesting of torchvision's tv_tensors and plain values. What has a place in the image moves as
        by `warp_labels`, which says what raises; light moves nothing.
        """
        if len(target) > 1:
            raise TypeError(f"target must be one, of any nesting, got {len(target)}")
        degraded = self.degrade(image)
        result = wrapped(degraded.image, image) if is_tv(image, "Image") else degraded.image
        if not target:
            return result
        flow = degraded.flow
        # Labels of what stays where it is are not clipped or filtered either.
        if flow is None or is_true((flow == 0).all):
            return result, target[0]
        return result, warp_labels(target[0], flow)

    def degrade(
        self,
        image: Tensor,
        *,
        seed: int | Tensor | None = None,
        keys: Tensor | Sequence[int] | None = None,
        depth: Tensor | None = None,
    ) -> Degraded:
        """The image degraded, with the maps of what was done.

        Args:
            image: (B, C, H, W) or (C, H, W), floating in [0, 1] or uint8.
            seed: of the draw; None takes one from torch's global generator.
            keys: (B,), whole numbers: sample i depends on (seed, keys[i]) alone; None counts from 0.
            depth: (B, 1, H, W) or (1, H, W), m, for the effects that ask for it.

        Raises:
            ValueError, TypeError: arguments that do not fit.
        """
        return self._run(image, self.sample(image, seed=seed, keys=keys), depth)

    def sample(
        self,
        image: Tensor,
        *,
        seed: int | Tensor | None = None,
        keys: Tensor | Sequence[int] | None = None,
        place: int = 0,
    ) -> Any:
        """The parameters of one draw for this image, a NamedTuple of tensors; `place` is that in a pipeline."""
        check_image(image)
        batch = 1 if image.ndim == 3 else image.shape[0]
        seed = draws.call_seed() if seed is None else _seed(seed)
        source = draws.stream(seed, _keys(keys, batch, image.device), device=image.device)
        return self.draw(source.at(place), image if image.ndim == 4 else image[None])

    def apply(  # pyright: ignore[reportIncompatibleMethodOverride]  # nn.Module has taken the name; both uses work
        self, image: Any, params: Any = None, *, depth: Tensor | None = None
    ) -> Any:
        """The image degraded by parameters that are given, as by those of an earlier draw -> Degraded.

        With a function as its one argument this is `nn.Module.apply`, so that an effect can sit inside a model.
        """
        if params is None and callable(image) and not isinstance(image, Tensor):
            return super().apply(cast(Callable[[nn.Module], None], image))
        check_image(image)
        self.check_params(params, image if image.ndim == 4 else image[None])
        return self._run(image, params, depth)

    params_type: type[Any]

    @abstractmethod
    def draw(self, source: draws.Stream, image: Tensor) -> Any:
        """The parameters of a batch (B, C, H, W), drawn from the streams of its samples."""

    @abstractmethod
    def check(self, params: Any, image: Tensor) -> None:
        """Raise for parameters outside their domain, where reading them costs nothing."""

    @abstractmethod
    def compute(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """The batch (B, C, H, W), floating, degraded by checked parameters."""

    def _run(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        batched = enter(image)
        result = self.compute(batched, params, _batched_depth(depth, image))
        result.image = leave(result.image, image, untouched=result.image is batched)
        return result if image.ndim == 4 else result.map(lambda value: value[0])

    def _uniform(self, source: draws.Stream, ranges: Sequence[Range], image: Tensor) -> tuple[Tensor, Tensor]:
        """The gate, (B,), bool, and a value out of each range, (B, n)."""
        values = draws.between(source, [(0.0, 1.0), *ranges], dtype=field_dtype(image.dtype))
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
                check_all(f"params.{name}", "not be NaN", value, lambda v: ~v.isnan())
        self.check(params, image)

    def extra_repr(self) -> str:
        """The arguments, as they were given."""
        return ", ".join(
            f"{name}={value}" for name, value in vars(self).items() if name[0] != "_" and name != "training"
        )


def _seed(seed: int | Tensor) -> int | Tensor:
    if isinstance(seed, bool) or not isinstance(seed, int | Tensor):
        raise TypeError(f"seed must be a whole number, got {seed!r}")
    return seed


def _keys(keys: Tensor | Sequence[int] | None, batch: int, device: torch.device) -> Tensor | range:
    if keys is None:
        return range(batch)
    keys = torch.as_tensor(keys, device=device)
    if keys.is_floating_point() or keys.is_complex() or keys.dtype is torch.bool:
        raise TypeError(f"keys must be whole numbers, got {keys.dtype}")
    if keys.reshape(-1).shape[0] != batch or keys.ndim > 1:
        raise ValueError(f"keys must have one key for each of the {batch} images, got shape {tuple(keys.shape)}")
    return keys.reshape(-1)


def _batched_depth(depth: Tensor | None, image: Tensor) -> Tensor | None:
    if depth is None:
        return None
    if not isinstance(depth, Tensor) or not depth.is_floating_point():
        raise TypeError(f"depth must be a floating tensor, got {getattr(depth, 'dtype', type(depth).__name__)}")
    if depth.shape != (*image.shape[:-3], 1, *image.shape[-2:]):
        raise ValueError(
            f"depth must have one channel of the size of the image {tuple(image.shape)}, got {tuple(depth.shape)}"
        )
    return depth if image.ndim == 4 else depth[None]


def params_to(params: Any, *args: Any, **kwargs: Any) -> Any:
    """The parameters with each tensor moved as by `Tensor.to`; a change of type leaves flags as they are."""
    floating = [value.to(*args, **kwargs) for value in params]
    return type(params)(
        *(new.to(old.dtype) if not old.is_floating_point() else new for old, new in zip(params, floating, strict=True))
    )


def column(flags: Tensor) -> Tensor:
    """(B, 1, 1, 1) of (B,)."""
    return flags.view(-1, 1, 1, 1)

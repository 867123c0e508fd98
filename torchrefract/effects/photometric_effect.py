"""The base class of effects that change light and move nothing."""

from abc import abstractmethod
from collections.abc import Callable, Iterable
from copy import copy
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from torchrefract._tensor import assume_constant_result, expand_batch
from torchrefract._validation import eager_bool, eager_values, requires_grad
from torchrefract.effects.base import Effect
from torchrefract.effects.batch import per_sample, select_params, where_active
from torchrefract.planning.photometric import PhotometricPlan, PhotometricRequest, exact_plan
from torchrefract.planning.plan import check_tolerance
from torchrefract.types import Degraded, Map
from torchrefract.warping.grid import field_dtype

# Values of the maps where nothing changes.
_UNCHANGED = {"transmission": 1.0, "extinction": 0.0, "intensity": 0.0}


class Rendered(NamedTuple):
    """A degraded batch.

    image: (N, C, H, W).
    valid: computes (N or B, 1, H, W), bool, the pixels from which the clean image can be recovered.
    transmission, extinction, intensity: (N or B, 1, H or 1, W or 1), or functions that compute them; see `Degraded`.
    """

    image: Tensor
    valid: Callable[[], Tensor]
    transmission: Map | None = None
    extinction: Map | None = None
    intensity: Map | None = None


class PhotometricEffect(Effect):
    """An effect that changes light and moves nothing.

    Subclasses implement `sample_params`, `validate`, `render`, `make_plan` and `params_in_range`. Their parameters are
    a NamedTuple with `applied` and a property `is_identity`, both (B,), bool.

    Args:
        tolerance: largest error of the image in levels of 1/255, for images in [0, 1] and all parameters in the ranges
            of the effect; terms that cannot change a pixel by more are left out, see `plan`. None is exact. The error
            counts before the image is rounded to its type.
        p: probability that a sample is degraded.
    """

    maps: tuple[str, ...]  # of `Degraded` that the effect computes

    def __init__(self, *, tolerance: float | None = None, p: float = 1.0):
        super().__init__(p=p)
        self.tolerance = check_tolerance(tolerance, name="tolerance")

    @abstractmethod
    def render(self, image: Tensor, params: Any, depth: Tensor | None) -> Rendered:
        """Degrade images (N, C, H, W), floating, with valid parameters of B samples, all of them."""

    @abstractmethod
    def make_plan(self, request: PhotometricRequest, *, has_depth: bool) -> PhotometricPlan:
        """Plan frames from the ranges, for the depth of the effect or, with `has_depth`, for any depth."""

    @abstractmethod
    def params_in_range(self, params: Any) -> Tensor:
        """Return (), bool: all parameters lie in the ranges of the effect, up to rounding."""

    def plan_for_dtype(
        self, height: int, width: int, dtype: torch.dtype, *, has_depth: bool = False
    ) -> PhotometricPlan:
        """Return the plan for images of a type, for the depth of the effect or, with `has_depth`, for any depth."""
        request = PhotometricRequest(height, width, self.tolerance, dtype is torch.float64)
        return self.make_plan(request, has_depth=has_depth)

    def plan_for(self, image: Tensor, params: Any, depth: Tensor | None) -> PhotometricPlan:
        """Return the plan for a batch; the exact one without a tolerance or if parameters require gradients."""
        height, width = image.shape[2:]
        if self.tolerance is None or requires_grad(params):
            return exact_plan(height, width)
        return self._constant_plan(id(self), height, width, field_dtype(image.dtype), depth is not None)

    def for_params(self, params: Any, height: int, width: int) -> "PhotometricEffect":
        """Return this effect, or an exact one if parameters lie outside the ranges that its plan holds for."""
        if self.tolerance is None or eager_bool(lambda: self.params_in_range(params), of=params.applied) is not False:
            return self
        return self.exact()

    def exact(self) -> "PhotometricEffect":
        """Return the effect without a tolerance."""
        effect = copy(self)
        effect.tolerance = None
        return effect

    def degrade_batch(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """Degrade images (N, C, H, W), floating, with valid parameters of B samples."""
        active = params.applied & ~params.is_identity
        if not self.may_change(params):
            valid = active.new_ones(()).expand(_map_shape(image))
            return Degraded(image, params, valid=valid, light=unchanged_maps(self.maps, image))
        index, batch = _active_samples(active, params), len(active)
        if eager_bool(active.any, of=active) is False:
            depth = None  # its values do not matter, so they are not checked either
        if index is None:
            rendered = self.render(image, params, depth)
        else:
            part = None if depth is None else _select(depth, index, batch)
            rendered = self.render(_select(image, index, batch), select_params(params, index), part)
        height, width = image.shape[2:]

        def map_of_all(value: Tensor, unchanged: float | bool) -> Tensor:
            if index is not None:
                value = _insert(value, index, unchanged, batch)
            elif eager_bool(active.all, of=active) is not True:
                rows = max(value.shape[0], batch)
                value = torch.where(per_sample(expand_batch(active, rows)), expand_batch(value, rows), unchanged)
            return value.expand(-1, 1, height, width)

        def lazy_map(name: str) -> Map | None:
            value = cast(Map | None, getattr(rendered, name))
            if value is None:
                return None
            return lambda: map_of_all(value() if callable(value) else value, _UNCHANGED[name])

        if rendered.image is image:
            result = image
        elif index is not None:
            result = _insert(rendered.image, index, image, batch)
        else:
            result = where_active(rendered.image, image, active, params)
        return Degraded(
            result,
            params,
            valid=lambda: map_of_all(rendered.valid(), True),
            light={name: value for name in _UNCHANGED if (value := lazy_map(name)) is not None},
        )

    @assume_constant_result
    def _constant_plan(self, _: int, height: int, width: int, dtype: torch.dtype, has_depth: bool) -> PhotometricPlan:
        # torch.compile takes the plan as a constant and does not trace how it is made. PyTorch 2.11 does so for methods
        # alone; the identity of the effect among the arguments keeps the plans of different effects apart.
        return self.plan_for_dtype(height, width, dtype, has_depth=has_depth)


def unchanged_maps(names: Iterable[str], image: Tensor) -> dict[str, Map]:
    """Return lazy maps with the values that they have where an effect changes nothing."""
    shape, dtype, device = _map_shape(image), field_dtype(image.dtype), image.device

    def constant(value: float) -> Map:
        return lambda: torch.full((), value, dtype=dtype, device=device).expand(shape)

    return {name: constant(_UNCHANGED[name]) for name in names}


def _map_shape(image: Tensor) -> tuple[int, ...]:
    return (image.shape[0], 1, *image.shape[2:])


def _active_samples(active: Tensor, params: Any) -> Tensor | None:
    """(n,): the indices of the active samples, so that only these are computed.

    None if all or none are active, if that cannot be read without waiting, or if parameters require gradients.
    """
    flags = None if requires_grad(params) else eager_values(lambda: active)
    if flags is None or all(flags) or not any(flags):
        return None
    return torch.tensor([i for i, flag in enumerate(flags) if flag])


def _select(value: Tensor, index: Tensor, batch: int) -> Tensor:
    """The rows of some samples; (N, ...) has the frames of the B clips one after the other."""
    return value[_row_numbers(index, value.shape[0] // batch)]


def _insert(value: Tensor, index: Tensor, unchanged: Tensor | float, batch: int) -> Tensor:
    """Put the rows of some samples into a batch whose other rows are `unchanged`."""
    value = expand_batch(value, max(len(index), value.shape[0]))
    frames = value.shape[0] // len(index)
    if not isinstance(unchanged, Tensor):
        unchanged = value.new_full((batch * frames, *value.shape[1:]), unchanged)
    return unchanged.index_copy(0, _row_numbers(index, frames), value)


def _row_numbers(index: Tensor, frames: int) -> Tensor:
    return (frames * index[:, None] + torch.arange(frames)).flatten()

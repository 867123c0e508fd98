"""The base class of effects that change light and move nothing."""

from abc import abstractmethod
from collections.abc import Callable
from copy import copy
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import assume_constant_result, expand_batch
from torchrefract._validation import eager_values, requires_grad
from torchrefract.effects.base import Effect
from torchrefract.effects.batch import rows_of_samples, select_params, where_active
from torchrefract.planning.photometric import PhotometricPlan, PhotometricRequest, exact_plan
from torchrefract.planning.plan import check_tolerance
from torchrefract.types import Degraded, Map
from torchrefract.warping.grid import field_dtype

# Values of the maps where nothing changes.
_UNCHANGED = {"valid": True, "transmission": 1.0, "extinction": 0.0, "intensity": 0.0}


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

    Subclasses implement `sample_params`, `validate` and `render`, and where an error bound is known `make_plan` and
    `params_in_range`. Their parameters are a NamedTuple with `applied` and a property `is_identity`, both (B,), bool.

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

    def make_plan(self, request: PhotometricRequest, *, has_depth: bool) -> PhotometricPlan:
        """Plan frames from the ranges, for the depth of the effect or, with `has_depth`, for any depth.

        By default all of the effect is computed.
        """
        return exact_plan(request, "no error bound is known for this effect")

    def params_in_range(self, params: Any) -> Tensor:
        """Return (), bool: the plan of the ranges holds for these parameters, as the default plan always does."""
        return torch.ones((), dtype=torch.bool, device=params.applied.device)

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
            return exact_plan(PhotometricRequest(height, width, None, False))
        return self._constant_plan(id(self), height, width, field_dtype(image.dtype), depth is not None)

    def for_params(self, params: Any, height: int, width: int) -> "PhotometricEffect":
        """Return this effect, or an exact one if parameters lie outside the ranges that its plan holds for."""
        if self.tolerance is None or eager_values(lambda: self.params_in_range(params), of=params.applied) is not False:
            return self
        return self.exact()

    def exact(self) -> "PhotometricEffect":
        """Return the effect without a tolerance."""
        effect = copy(self)
        effect.tolerance = None
        return effect

    def degrade_batch(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """Degrade images (N, C, H, W), floating, with valid parameters of B samples."""
        if not self.may_change(params):
            return self._unchanged(image, params)
        active = self.active(params)
        index = _active_samples(active, params)
        if index is not None:
            return self._degrade_samples(image, params, depth, index)
        if eager_values(active.any, of=active) is False:
            depth = None  # its values do not matter, so they are not checked either
        rendered = self.render(image, params, depth)

        def masked_map(name: str) -> Tensor:
            value: Any = getattr(rendered, name)
            value = value() if callable(value) else value
            if eager_values(active.all, of=active) is not True:
                rows = max(value.shape[0], len(active))
                unchanged = _UNCHANGED[name]
                value = torch.where(expand_batch(active, rows).view(-1, 1, 1, 1), expand_batch(value, rows), unchanged)
            return value.expand(-1, 1, *image.shape[2:])

        is_same = rendered.image is image
        result = image if is_same else where_active(rendered.image, image, active, params)
        return self._with_maps(result, params, masked_map)

    def _with_maps(self, image: Tensor, params: Any, map_of: Callable[[str], Tensor]) -> Degraded:
        """Build a result whose maps are computed from their names when they are first read."""
        return Degraded(image, params, {name: lambda _, name=name: map_of(name) for name in ("valid", *self.maps)})

    def _unchanged(self, image: Tensor, params: Any) -> Degraded:
        def constant(name: str) -> Tensor:
            dtype = torch.bool if name == "valid" else field_dtype(image.dtype)
            value = torch.full((), _UNCHANGED[name], dtype=dtype, device=image.device)
            return value.expand(image.shape[0], 1, *image.shape[2:])

        return self._with_maps(image, params, constant)

    def _degrade_samples(self, image: Tensor, params: Any, depth: Tensor | None, index: Tensor) -> Degraded:
        """Degrade some samples of a batch, (n,), and leave the others."""
        batch = len(params.applied)
        part, part_depth = (None if v is None else v[rows_of_samples(index, len(v) // batch)] for v in (image, depth))
        assert part is not None
        degraded = self.degrade_batch(part, select_params(params, index), part_depth)

        def with_others(value: Tensor, others: Tensor | float) -> Tensor:
            frames = max(1, len(value) // len(index))
            value = expand_batch(value, frames * len(index))
            if not isinstance(others, Tensor):
                others = value.new_full((batch * frames, *value.shape[1:]), others)
            return others.index_copy(0, rows_of_samples(index, frames), value)

        result = image if degraded.image is part else with_others(degraded.image, image)
        return self._with_maps(result, params, lambda name: with_others(getattr(degraded, name), _UNCHANGED[name]))

    @assume_constant_result
    def _constant_plan(self, _: int, height: int, width: int, dtype: torch.dtype, has_depth: bool) -> PhotometricPlan:
        # torch.compile takes the plan as a constant and does not trace how it is made. PyTorch 2.11 does so for methods
        # alone; the identity of the effect among the arguments keeps the plans of different effects apart.
        return self.plan_for_dtype(height, width, dtype, has_depth=has_depth)


def _active_samples(active: Tensor, params: Any) -> Tensor | None:
    """Return (n,), the indices of the active samples; None for all, none, gradients, or values unread."""
    flags = None if requires_grad(params) else eager_values(lambda: active)
    if flags is None or all(flags) or not any(flags):
        return None
    return torch.tensor([i for i, flag in enumerate(flags) if flag], device="cpu")

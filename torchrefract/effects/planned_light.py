"""Effects of light that compute only what a tolerance asks for."""

from abc import abstractmethod
from copy import copy
from typing import Any

import torch
from torch import Tensor

from torchrefract._tensor import assume_constant_result
from torchrefract._validation import eager_bool, requires_grad
from torchrefract.effects.photometric_effect import RadianceEffect
from torchrefract.effects.plan import check_tolerance
from torchrefract.planning.photometric import LightPlan
from torchrefract.warping.grid import field_dtype


class PlannedLight(RadianceEffect):
    """An effect of light with a plan.

    Args:
        tolerance: how far an image in [0, 1] may be from the exact one, in levels of 1/255, anywhere and for all
            parameters in the ranges of the effect, see `plan`; None is exact. It counts before the image is rounded to
            its own type.
        p: as for every effect.
    """

    def __init__(self, *, tolerance: float | None = None, p: float = 1.0):
        super().__init__(p=p)
        self.tolerance = check_tolerance(tolerance, name="tolerance")

    def for_params(self, params: Any, height: int, width: int) -> "PlannedLight":
        """The effect itself; an exact one for parameters outside the ranges that its plan is for."""
        if self.tolerance is None or eager_bool(lambda: self.params_in_range(params), of=params.applied) is not False:
            return self
        return self.exact()

    def exact(self) -> "PlannedLight":
        """The effect without a tolerance."""
        exact = copy(self)
        exact.tolerance = None
        return exact

    def plan_for(self, params: Any, image: Tensor, depth: Tensor | None) -> Any:
        """The plan for rows (N, C, H, W); an exact one where a gradient of the parameters is asked for."""
        exact = self.tolerance is not None and requires_grad(params)
        size = image.shape[2], image.shape[3]
        return self._constant(id(self), *size, field_dtype(image.dtype), any_depth=depth is not None, exact=exact)

    @assume_constant_result
    def _constant(self, _: int, height: int, width: int, dtype: torch.dtype, *, any_depth: bool, exact: bool) -> Any:
        # Compilers take the plan as it is, and need not follow how it was made; that of PyTorch 2.11 from a method
        # alone. What asks for the identity of this effect is not taken for another one's.
        return (self.exact() if exact else self).planned(height, width, dtype, any_depth=any_depth)

    @abstractmethod
    def planned(self, height: int, width: int, dtype: torch.dtype, *, any_depth: bool = False) -> LightPlan:
        """The plan for images of a type, from the ranges alone; for the depth of the effect, or for any."""

    @abstractmethod
    def params_in_range(self, params: Any) -> Tensor:
        """(), bool: all parameters lie in the ranges that the plan is for."""

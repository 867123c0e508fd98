"""One effect out of several."""

import itertools
from collections.abc import Sequence
from copy import copy

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor
from torchrefract._validation import check_number, eager_bool
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose, ComposeParams
from torchrefract.effects.plan import TOLERANCE_PX


class OneOf(Compose):
    """One of several effects for each sample.

    Args:
        effects: to choose from.
        weights: how often each is chosen, relative to one another, above 0; None chooses all alike.
        padding, interpolation, backend, tolerance_px, p: as for `Compose`; each effect has the whole tolerance.

    Raises:
        ValueError, TypeError: as for `Compose`; weights that are not one positive number for each effect.
    """

    def __init__(
        self,
        effects: Sequence[Effect],
        *,
        weights: Sequence[float] | None = None,
        padding: str | None = None,
        interpolation: str | None = None,
        backend: str | None = None,
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        options = {"padding": padding, "interpolation": interpolation, "backend": backend}
        super().__init__(effects, **options, tolerance_px=tolerance_px, p=p)
        weights = [1.0] * len(effects) if weights is None else weights
        if len(weights) != len(effects):
            raise ValueError(f"weights must be one number for each of {len(effects)} effects, got {len(weights)}")
        self.weights = tuple(check_number("weights", weight, low=1e-9) for weight in weights)

    def _gates(self, source: random.Stream) -> tuple[Tensor, list[Tensor]]:
        """As for `Compose`, those of the effects by a choice for each sample."""
        values = random.uniform(source, 2)
        applied, choice = values[:, 0] < self.p, values[:, 1] * sum(self.weights)
        ends = as_device_tensor(self.weights, device=choice.device).cumsum(dim=0)[:-1]
        chosen = torch.bucketize(choice, ends, right=True)
        return applied, [applied & (chosen == i) for i in range(len(self.effects))]

    def for_params(self, params: ComposeParams, height: int, width: int) -> "Compose":
        """As for `Compose`; exact, too, for parameters by which several effects act on a sample."""
        acting = torch.stack([child.applied for child in params.children]).sum(dim=0)
        for_params = super().for_params(params, height, width)
        if self.tolerance_px is None or eager_bool((acting <= 1).all, of=acting) is not False:
            return for_params
        exact = copy(for_params)
        exact.tolerance_px = None
        return exact

    def _joined(self, sets: Sequence[Sequence[tuple[int, ...]]]) -> list[tuple[int, ...]]:
        return list(itertools.chain.from_iterable(sets))

"""One effect out of several."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import as_device_tensor
from torchrefract._validation import check_number
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose
from torchrefract.planning.plan import TOLERANCE_PX


class OneOf(Compose):
    """One of several effects for each sample.

    Args:
        effects: to choose from.
        weights: relative frequency of each effect, above 0; None chooses all with the same probability.
        padding, interpolation, backend, tolerance_px, p: as for `Compose`.

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
        super().__init__(
            effects, padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p
        )
        weights = [1.0] * len(effects) if weights is None else weights
        if len(weights) != len(effects):
            raise ValueError(f"weights must be one number for each of {len(effects)} effects, got {len(weights)}")
        self.weights = tuple(check_number("weights", weight, low=1e-9) for weight in weights)

    def sample_applied(self, stream: random.Stream) -> tuple[Tensor, list[Tensor]]:
        """Draw whether the composition is applied, and for each sample which effect is."""
        values = random.uniform(stream, 2)
        applied, choice = values[:, 0] < self.p, values[:, 1] * sum(self.weights)
        ends = as_device_tensor(self.weights, device=choice.device).cumsum(dim=0)[:-1]
        chosen = torch.bucketize(choice, ends, right=True)
        return applied, [applied & (chosen == i) for i in range(len(self.effects))]

"""A loss that is no number stops a training, and tells of the batch so that it can be looked at again."""

import math

from torch import Tensor

from torchrefract._validation import UsageError


class NotFiniteError(UsageError):
    """A loss that is NaN or infinite; the message says in which step and for which keys."""


def check_finite(loss: Tensor, keys: Tensor, *, step: int, epoch: int) -> None:
    """Raise NotFiniteError unless the loss () of the batch with the keys (B,) is finite.

    A frame is corrupted by the draw of (seed, epoch, key), so these repeat the batch.
    """
    value = float(loss.detach())
    if not math.isfinite(value):
        listed = ", ".join(str(key) for key in keys.tolist())
        raise NotFiniteError(
            f"loss must be finite, got {value:g} in step {step} of epoch {epoch} for the keys {listed}"
        )

"""How the learning rate goes."""

from typing import Any

from diffusers.optimization import get_cosine_schedule_with_warmup
from torch.optim import Optimizer
from torch.optim.lr_scheduler import ReduceLROnPlateau

SCHEDULES = ("cosine", "plateau")


def schedule(name: str, optimizer: Optimizer, *, warmup_steps: int, steps: int) -> dict[str, Any]:
    """The scheduler of a name, in Lightning's form.

    Args:
        name: "cosine", a linear warm-up and a cosine down to zero, or "plateau", half the rate when val/loss has not
            become less for 5 epochs.
        optimizer: whose rate it is.
        warmup_steps: of a cosine; a tenth of all steps at most.
        steps: of the whole training.
    """
    if name == "plateau":
        return {"scheduler": ReduceLROnPlateau(optimizer, factor=0.5, patience=5), "monitor": "val/loss"}
    cosine = get_cosine_schedule_with_warmup(optimizer, min(warmup_steps, steps // 10), steps)
    return {"scheduler": cosine, "interval": "step"}

"""Newton's method on a flow by numba's kernels: all steps of a pixel at once."""

from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchrefract._compiled import SMALLEST, kernels
from torchrefract._threads import share


def solved(
    flow: Tensor, steps: int, *, at_once: int, near: float, farthest: float, upright: float
) -> tuple[Tensor, Tensor, Tensor | None]:
    """The inverse (B, 2, H, W) after some steps and its error (B, 1, H, W), px, and where the sheet is upright.

    That is (B, 1, H, W), bool, or None for everywhere.

    Args:
        flow: (B, 2, H, W), px, finite, contiguous, of which `compiled.obstacle` has nothing to say.
        steps: beside the first, at most.
        at_once: how many of them take the slopes at p; later ones take those at p + inverse.
        near: px, the error that calls for no further step.
        farthest: px, how long the inverse may be.
        upright: of determinants of I + slopes; pixels of a smaller one begin without slopes.
    """
    newton, (batch, _, height, width) = kernels("warping.kernels.newton"), flow.shape
    share_rows = partial(share, count=batch * height, least=SMALLEST // width + 1)
    values, inverse, error = flow.numpy(), torch.empty_like(flow), torch.empty_like(flow[:, :1])
    solve = partial(newton.solve, values, np.float32(upright), steps, at_once, np.float32(near), np.float32(farthest))
    ends = inverse.numpy(), error[:, 0].numpy()
    share_rows(lambda start, stop: solve(start, stop, *ends))
    least = np.empty(batch * height, np.float32)
    share_rows(lambda start, stop: newton.least_determinants(values, start, stop, least))
    # Where it is at every pixel, what is read between them is above zero, too.
    if least.min() >= upright:
        return inverse, error, None
    sheet, there = np.empty_like(ends[1]), np.empty_like(ends[1])
    share_rows(lambda start, stop: newton.determinants(values, start, stop, sheet))
    share_rows(lambda start, stop: newton.read_at(sheet, ends[0], start, stop, there))
    return inverse, error, torch.from_numpy(there > 0)[:, None]

"""Thin plates through points that stay the same from draw to draw: what each point does to all places is kept.

    f(p) = sum_i d_i c_i(p),  c_i the spline that is 1 at point i and 0 at the others

A spline is linear in what its points are moved by, so this is `spline_at`, but for rounding.
"""

from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor

from torchrefract import _compiled as compiled
from torchrefract._threads import share
from torchrefract._validation import requires_grad
from torchrefract.fields.spline import fit_spline, spline_at

_SMALLEST = 1 << 10  # places, from which on it is faster
_MOST_KEPT = 1 << 22  # numbers of four bytes, of each of the latest lattices


def drawn_plates(points: Tensor, displacement: Tensor, smoothing: Tensor, x: Tensor, y: Tensor) -> Tensor | None:
    """The flows (B, 2, n, m) in px, float32, of thin plates; None where that would not be faster, or gradients ask.

    On the CPU. Of the latest four sets of points and places up to 16 MB each are kept.

    Args:
        points, displacement, smoothing: of `fit_spline`; the points are known to be such.
        x, y: (1, 1, 1, m) and (1, 1, n, 1), px, float64, the places.
    """
    values, rows, columns = (points, displacement, smoothing), y.shape[2], x.shape[3]
    few = points.shape[1] * rows * columns <= _MOST_KEPT
    if not few or rows * columns < _SMALLEST or len(points) == 0 or requires_grad(values) or compiled.obstacle(*values):
        return None
    at, soft = points.numpy(), smoothing.numpy()
    if not ((at == at[0]).all() and (soft == soft[0]).all()):
        return None
    known = _kept(at[0].tobytes(), soft[0].tobytes(), *(own.numpy().tobytes() for own in (x, y)))
    out = displacement.new_empty(len(points), 2, rows, columns)
    work = partial(compiled.kernels("fields.kernels.plates").sums, known, displacement.contiguous().numpy())
    share(lambda start, stop: work(start, stop, out.numpy()), len(out) * rows, least=_SMALLEST // columns + 1)
    return out


@lru_cache(maxsize=4)
def _kept(points: bytes, smoothing: bytes, x: bytes, y: bytes) -> np.ndarray:
    """(n, N, m), float32: the splines that are 1 at one of the points, at the places."""
    # Tensors made in inference mode could not be used outside of it.
    with torch.inference_mode(False), torch.no_grad():
        at = torch.from_numpy(np.frombuffer(points, np.float32).copy()).view(1, -1, 2)
        soft = torch.from_numpy(np.frombuffer(smoothing, np.float32).copy())
        places = torch.from_numpy(np.frombuffer(x).copy()).view(1, 1, 1, -1)
        own_y = torch.from_numpy(np.frombuffer(y).copy()).view(1, 1, -1, 1)
        each = torch.eye(at.shape[1])[..., None].expand(-1, -1, 2)
        found = spline_at(
            fit_spline(at.expand(len(each), -1, -1), each, soft.expand(len(each)), checked=True),
            places,
            own_y,
            dtype=torch.float32,
        )
        return found[:, 0].transpose(0, 1).contiguous().numpy()

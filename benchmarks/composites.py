"""Composites of flows in float64: the truth that `compose_flows` and one look-up for several warps are held against."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from torchrefract import ComposeParams
from torchrefract.cameras.distortion import undistort_polynomial
from torchrefract.fields.lens import frame_limit
from torchrefract.fields.spline import evaluate_spline, fit_spline
from torchrefract.warping.grid import pixel_axes

SINE_PX, SINE_WAVELENGTH_PX = 4.0, 200.0

Flow = Callable[[Tensor], Tensor]  # positions (1, 2, H, W), px -> displacement (1, 2, H, W), px


def composite(flows: Sequence[Tensor]) -> Tensor:
    """(1, 2, H, W), px: the composite of flows, the first applied first, each read once where the later ones look."""
    *before, flow = flows
    for first in reversed(before):
        flow = flow + spline_read(first, flow)
    return flow


def spline_read(image: Tensor, flow: Tensor) -> Tensor:
    """(1, C, H, W), float64: the image at p + flow(p), by the quintic spline through its pixels.

    Args:
        image: (1, C, H, W); beyond the frame it is as at the border.
        flow: (1, 2, H, W), px.
    """
    at = positions(flow)[0].flip(0).numpy()  # row and column
    channels = [map_coordinates(channel, at, order=5, mode="nearest") for channel in image[0].double().numpy()]
    return torch.from_numpy(np.stack(channels))[None]


def positions(flow: Tensor) -> Tensor:
    """(1, 2, H, W), float64, px: p + flow(p)."""
    x, y = pixel_axes(*flow.shape[2:], dtype=torch.float64, device=flow.device)
    return torch.cat([x + flow[:, :1], y + flow[:, 1:]], dim=1)


def closed_forms(params: ComposeParams, *, height: int, width: int) -> Mapping[str, Flow]:
    """The lens and the plate of a draw, and a sine, at any positions of the frame."""
    lens, _, plate, _ = params.to(torch.float64).children
    middle = torch.tensor([width - 1, height - 1], dtype=torch.float64) / 2 + lens.center * width
    camera = lens.coefficients, lens.focal * width, middle
    spline = fit_spline(plate.points, plate.displacement, plate.smoothing)
    return {
        "lens": lambda at: _lens(at, camera, height=height, width=width),
        "plate": lambda at: evaluate_spline(spline, at.flatten(2).mT).mT.reshape(at.shape),
        "sine": lambda at: SINE_PX * torch.sin(2 * math.pi / SINE_WAVELENGTH_PX * at.flip(1)),
    }


def _lens(at: Tensor, camera: tuple[Tensor, Tensor, Tensor], *, height: int, width: int) -> Tensor:
    coefficients, focal, center = camera
    limit = frame_limit(*camera, height=height, width=width)
    x, y = ((at - center[:, :, None, None]) / focal[:, :, None, None]).split(1, dim=1)
    u, v, _ = undistort_polynomial(x, y, coefficients[:, :, None, None, None], limit=limit)
    return torch.cat([u - x, v - y], dim=1) * focal[:, :, None, None]

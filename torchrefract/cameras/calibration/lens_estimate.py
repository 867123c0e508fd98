"""The lens of a camera from the frames of a drive: from straight edges, and from the flows that a network predicts."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from torchrefract._tensor import to_float, to_uint8
from torchrefract._validation import check_flow, check_number, check_tensor, is_whole
from torchrefract.cameras.calibration.fit import prior_deviations
from torchrefract.cameras.calibration.plumb_line import (
    Chains,
    Gaussian,
    find_chains,
    fit_lens,
    pool_chains,
    published_prior,
)
from torchrefract.cameras.calibration.uncertainty import rectified_deviation
from torchrefract.cameras.camera import UNKNOWN_FOCAL, Camera

_MIN_STRAIGHT = 10  # chains
_VAGUE = 0.02  # widths of the frame; standard deviation from which a lens is warned of
_FLOW_GRID = 33  # points along each side of the frame to which a camera is fitted


@dataclass(frozen=True, kw_only=True)
class LensEstimate:
    """A camera that was estimated from the frames of a drive.

    `covariance` (8, 8) is of fx, fy, cx, cy, k1, k2, p1, p2. The focal length is assumed and counts as exact, since
    the mapping from distorted to rectified pixels does not depend on it; the principal point is the middle of the
    frame, with the deviation of published cameras; p1 and p2 are zero.
    """

    camera: Camera  # of the model "opencv"
    covariance: np.ndarray
    num_frames: int
    num_chains: int  # edge chains that could tell a lens
    num_straight: int  # those of them that the lens makes straight
    edge_px: float  # standard deviation of where `rectify` shows the middle of the left or right edge
    corner_px: float  # and a corner; NaN where it shows nothing
    is_distorted: bool  # the lens differs from no distortion, at 95 %
    warnings: tuple[str, ...]


def estimate_lens(
    frames: Iterable[Tensor], *, fov_deg: float | None = None, predict: Callable[[Tensor], Tensor] | None = None
) -> LensEstimate:
    """Estimate k1 and k2 of one camera from frames of a drive, without a board.

    Straight edges of the world must be straight in the rectified frame, see `plumb_line`. Frames of a moving camera
    are needed: an edge that stays at one place counts as a part of the car. Flows of a network, if there are any, are
    fitted by cameras, whose median and scatter replace the distribution of published lenses as a prior.

    Args:
        frames: (3, H, W) or (1, 3, H, W), RGB, floating in [0, 1] or uint8, all of one size; read one at a time.
        fov_deg: horizontal field of view of the camera; None assumes a focal length of 0.9 widths. k1 and k2 are
            relative to it; the mapping that rectifies frames is not.
        predict: maps a frame (1, 3, H, W) to the flow (1, 2, h, w), px of its own size, that undistorts it.

    Raises:
        ValueError: there are no frames, they differ in size or lie in 0...255, or `fov_deg` is not in [1, 170].
    """
    focal = focal_of_view(fov_deg)
    size, chains, lenses = None, list[Tensor](), list[Tensor]()
    for i, frame in enumerate(frames):
        image = _check_frame(frame, i, size)
        size = image.shape[2], image.shape[3]
        chains.append(find_chains(_to_gray(image)))
        if predict is not None:
            lenses.append(radial_lens_of_flow(predict(image), aspect=size[1] / size[0]))
    if size is None:
        raise ValueError("frames must hold at least one frame, got none")
    pooled = pool_chains(chains, size)
    prior = pool_lenses(torch.stack(lenses)) if lenses else published_prior()
    return _to_estimate(pooled, prior, len(chains), focal * size[1])


def focal_of_view(fov_deg: float | None) -> float:
    """Return the focal length, in widths of the frame, of a horizontal field of view; None is an unknown one.

    Raises:
        ValueError: `fov_deg` is not in [1, 170].
    """
    if fov_deg is None:
        return UNKNOWN_FOCAL
    return 0.5 / math.tan(math.radians(check_number("fov_deg", fov_deg, low=1.0, high=170.0) / 2))


def radial_lens_of_flow(flow: Tensor, *, aspect: float | None = None) -> Tensor:
    """Fit k1 and k2 to the flow that undistorts frames, by linear least squares.

        p + flow(p) = c + s (p - c) (1 + k1 r^2 + k2 r^4),  r = s |p - c| in half diagonals

    for s, s^3 k1 and s^5 k2, at 33 x 33 points; c is the middle of the frame and s an unknown zoom, by which
    the flow of a filled frame magnifies the rectified frame.

    Args:
        flow: (1, 2, h, w), px.
        aspect: width / height of the frames; None is that of the flow, whose pixels are then square.

    Returns:
        (2,), float64, k1 and k2, relative to the half diagonal.
    """
    height, width = check_flow("flow", flow).shape[2:]
    stretch = (aspect or width / height) * height / width  # of the flow's pixels, x / y
    y, x = (
        torch.linspace(0, side - 1, _FLOW_GRID, dtype=torch.float64, device="cpu").round() for side in (height, width)
    )
    u, v = flow.detach().cpu().double()[0][:, y.long()][:, :, x.long()]
    half_diagonal = math.hypot(width * stretch, height) / 2
    x, y = (x - (width - 1) / 2) * stretch / half_diagonal, (y - (height - 1) / 2)[:, None] / half_diagonal
    r2 = x * x + y * y
    target = torch.stack([x + u * stretch / half_diagonal, y + v / half_diagonal])
    base = torch.stack(torch.broadcast_tensors(x, y))
    columns = torch.stack([base, base * r2, base * r2 * r2], dim=-1).reshape(-1, 3)
    zoom, cubic, quintic = torch.linalg.lstsq(columns, target.reshape(-1, 1)).solution[:, 0]
    return torch.stack([cubic / zoom**3, quintic / zoom**5])


def _check_frame(frame: Tensor, index: int, size: tuple[int, int] | None) -> Tensor:
    image = check_tensor("frames", frame)
    image = image[None] if image.ndim == 3 else image
    image = to_float(image) if is_whole(image) else image
    if image.ndim != 4 or image.shape[:2] != (1, 3):
        raise ValueError(f"frames must have shape (3, H, W) or (1, 3, H, W), got {tuple(frame.shape)}")
    if size not in (None, image.shape[2:]):
        height, width = image.shape[2:]
        raise ValueError(
            f"frames must be of one size, since they are of one camera, got {size[1]} x {size[0]} px and, in frame "
            f"{index}, {width} x {height} px"
        )
    if (mean := image.mean().item()) > 1:
        raise ValueError(f"frames must lie in [0, 1] or be uint8, got a mean of {mean:.3g}; divide 0...255 by 255")
    return image


def _to_gray(image: Tensor) -> np.ndarray:
    pixels = to_uint8(image.cpu())[0].permute(1, 2, 0).contiguous().numpy()
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)


def pool_lenses(lenses: Tensor) -> Gaussian:
    """Return the median of lenses (N, 2) and their scatter about it, to which published lenses count as one more.

    The scatter is not divided by N: the errors of a network are similar in all frames of a drive.
    """
    median = lenses.median(dim=0).values
    shift = lenses - median
    return Gaussian(median, (published_prior().covariance + shift.T @ shift) / (1 + len(lenses)))


def _to_estimate(chains: Chains, prior: Gaussian, num_frames: int, focal: float) -> LensEstimate:
    fit, (height, width) = fit_lens(chains, prior), chains.size
    # k1 r^2 stays if r is counted in focal lengths instead of half diagonals.
    scale = focal / (math.hypot(height, width) / 2)
    units = torch.tensor([scale**2, scale**4], dtype=torch.float64, device="cpu")
    k1, k2 = (fit.coefficients * units).tolist()
    camera = Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        coefficients=(k1, k2, 0.0, 0.0),
    )
    covariance = np.zeros((8, 8))
    covariance[[2, 3], [2, 3]] = prior_deviations(camera, "published")[2:4] ** 2
    covariance[4:6, 4:6] = (fit.covariance * units * units[:, None]).numpy()
    border = np.array([[0.0, (height - 1) / 2], [0.0, 0.0]])
    edge_px, corner_px = rectified_deviation(camera, covariance, border).tolist()
    num_straight, warnings = int(fit.is_straight.sum()), []
    if num_straight < _MIN_STRAIGHT:
        warnings.append(
            f"the frames hold {num_straight} straight edges that could tell a lens, fewer than {_MIN_STRAIGHT}: add "
            "frames of a moving camera with buildings, poles or signs near the border"
        )
    if not fit.is_distorted:
        warnings.append(
            "the lens cannot be distinguished from no distortion (95 %): add frames, or calibrate with a board"
        )
    elif (deviation := np.nanmax([edge_px, corner_px, 0.0])) > _VAGUE * width:
        warnings.append(
            f"the lens is vague: the rectified position has a standard deviation of {deviation:.0f} px, more than "
            f"{_VAGUE:.0%} of the width; add frames with straight edges near the border, or calibrate with a board"
        )
    return LensEstimate(
        camera=camera,
        covariance=covariance,
        num_frames=num_frames,
        num_chains=len(chains.points),
        num_straight=num_straight,
        edge_px=edge_px,
        corner_px=corner_px,
        is_distorted=fit.is_distorted,
        warnings=tuple(warnings),
    )

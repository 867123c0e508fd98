"""The radial lens that makes straight edges of pictures straight, without a board.

A lens of k1 and k2 is fitted to edge chains: smooth pieces of edges, long enough to tell whether they bend. Many chains
of a road picture are really curved, so that the cost of a chain is bounded. Coefficients are relative to the half
diagonal of the frame here: k1 + k2 is the shift of a corner, in half diagonals. They need no focal length.

Source: Devernay and Faugeras, "Straight lines have to be straight", Machine Vision and Applications 13 (2001).
"""

import math
from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from torchrefract.cameras.brown_conrady import POLYNOMIAL12, Terms, distort_with_jacobian
from torchrefract.cameras.projection import undistort, valid_radius

NUM_POINTS = 24  # of a chain
_MAX_WIDTH = 1280  # px, to which wider frames are reduced for the detection: edges of larger frames break in noise
_BLUR_PX = 1.0
_GRADIENT, _ANCHOR = 20, 4  # thresholds of edge drawing, in levels of an 8-bit picture
_BORDER_PX = 4  # chains this close to the border may be the border
_MIN_LENGTH = 0.05  # widths
_ARM, _MAX_TURN_DEG = 0.006, 12.0  # widths, of the chords between which a chain turns less than the angle
_TRIMMED = 3  # points next to a corner

_RASTER = 320  # px, width of the map that tells the edges of the car from those of the road
_MIN_STATIC, _STATIC_SHARE = 2.5, 0.2  # frames, and their share, with an edge at one place
_MIN_OFFSET = 0.2  # half diagonals, of the chain's line from the center
_MIN_LEVERAGE = 0.3  # standard deviations of bend that a lens of k1 = -0.1 adds
_MAX_CHAINS = 600

_NOISE_FACTOR, _MIN_NOISE_PX, _WORLD_BEND = 1.5, 0.03, 6e-4  # of the bend; the last in lengths of the chain
_CURVED_BEND = 0.004  # lengths, typical bend of edges that are curved
_OUTLIERS = 0.2  # relative density of curved edges
# Standard deviations of k1, and of k2 + 0.4 k1: published lenses lie within about one.
_PRIOR_K1, _PRIOR_K2, _SLOPE = 0.2, 0.07, -0.4
_K1 = np.linspace(-0.45, 0.25, 29)
_K2 = np.linspace(-0.15, 0.15, 11)  # minus the slope times k1
_MIN_FRAMES = 8  # for a bootstrap over frames; below, over chains
_NUM_BOOTSTRAPS = 200
_DISTINCT = 5.99  # squared distance from no distortion in standard deviations: 95 % of a normal distribution in 2D
_LENSES_AT_ONCE = 16
_MAX_STEPS, _SMALL_STEP = 30, 1e-6  # of Newton's method


class Chains(NamedTuple):
    """Chains of several frames of one camera that tell something about its lens."""

    points: Tensor  # (C, 24, 2), px, float64
    noise: Tensor  # (C,), px, standard deviation of the bend of a straight edge
    curved: Tensor  # (C,), px, scale of the bend of a curved edge
    frame: Tensor  # (C,), number of the frame
    size: tuple[int, int]  # height and width of the frames, px


class Gaussian(NamedTuple):
    """A normal distribution of k1 and k2, relative to the half diagonal."""

    mean: Tensor  # (2,)
    covariance: Tensor  # (2, 2)


class LineFit(NamedTuple):
    """A lens that makes chains straight."""

    coefficients: Tensor  # (2,), k1 and k2, relative to the half diagonal
    covariance: Tensor  # (2, 2)
    is_distorted: bool  # the lens differs from no distortion, at 95 %
    is_straight: Tensor  # (C,), bool: the chain is more likely straight than curved


def published_prior() -> Gaussian:
    """Return the distribution of published lenses, centered at no distortion; a barrel mostly has a positive k2."""
    variance = _PRIOR_K1**2
    rows = [[variance, _SLOPE * variance], [_SLOPE * variance, _SLOPE**2 * variance + _PRIOR_K2**2]]
    return Gaussian(
        torch.zeros(2, dtype=torch.float64, device="cpu"), torch.tensor(rows, dtype=torch.float64, device="cpu")
    )


def find_chains(gray: np.ndarray) -> Tensor:
    """Find edge chains (C, 24, 2), px, float64, in a gray picture (H, W), uint8.

    Edge drawing finds connected edges. They are moved to the maximum of the gradient along its direction, cut at
    corners, and kept from a length of 0.05 widths on. The points of a chain are means over 24 equal parts of it.

    Source: Topal and Akinlar, "Edge Drawing", Journal of Visual Communication and Image Representation 23 (2012).
    """
    scale = min(1.0, _MAX_WIDTH / gray.shape[1])
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    height, width = gray.shape
    smooth = cv2.GaussianBlur(gray, (0, 0), _BLUR_PX)
    options = cv2.ximgproc.EdgeDrawing.Params()
    options.EdgeDetectionOperator = cv2.ximgproc.EDGE_DRAWING_SOBEL
    options.GradientThresholdValue, options.AnchorThresholdValue = _GRADIENT, _ANCHOR
    options.MinPathLength, options.NFAValidation = round(_MIN_LENGTH * width), False
    options.Sigma = 1e-3  # the picture is smooth already
    detector = cv2.ximgproc.createEdgeDrawing()
    detector.setParams(options)
    detector.detectEdges(smooth)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))]
    chains = [
        _resample(piece)
        for edge in detector.getSegments()
        for piece in _smooth_pieces(_to_subpixel(np.asarray(edge, np.float32).reshape(-1, 2), *slopes), width)
    ]
    points = np.array(chains, dtype=np.float64).reshape(-1, NUM_POINTS, 2)
    inside = (points > _BORDER_PX) & (points < np.array([width, height]) - 1 - _BORDER_PX)
    return torch.from_numpy((points[inside.all(axis=(1, 2))] + 0.5) / scale - 0.5)


def pool_chains(chains: Sequence[Tensor], size: tuple[int, int]) -> Chains:
    """Pool the chains of frames of one camera, and drop those that tell nothing about its lens.

    Dropped are edges that stay at one place, as those of the bonnet; lines through the middle of the frame, which a
    lens bends less than a road does; and chains whose noise exceeds what a lens of k1 = -0.1 bends them by.

    Args:
        chains: of each frame, by `find_chains`.
        size: height and width of the frames, px.
    """
    points = torch.cat([*chains, torch.empty(0, NUM_POINTS, 2, dtype=torch.float64, device="cpu")])
    counts = torch.tensor([len(of_frame) for of_frame in chains], dtype=torch.int64, device="cpu")
    frame = torch.arange(len(counts), device="cpu").repeat_interleave(counts)
    half_diagonal, center = _frame(size)
    chord = points[:, -1] - points[:, 0]
    normal = torch.stack([-chord[:, 1], chord[:, 0]], dim=1) / chord.norm(dim=1, keepdim=True)
    offset = ((points.mean(dim=1) - center) * normal).sum(dim=1).abs() / half_diagonal
    keep = ~_is_static(points, frame, len(chains), size) & (offset > _MIN_OFFSET)
    points, frame, length = points[keep], frame[keep], chord[keep].norm(dim=1)
    none_and_barrel = points.new_tensor([[0.0, 0.0], [-0.1, 0.0]])
    errors = _line_errors(points, none_and_barrel[:1], size)[0][0]
    shapes = _polynomials(NUM_POINTS, 4)
    rough = (errors - errors @ shapes @ shapes.T).square().mean(dim=1)
    pixel = max(1.0, size[1] / _MAX_WIDTH)
    noise = (_NOISE_FACTOR**2 * rough / NUM_POINTS + (_MIN_NOISE_PX * pixel) ** 2 + (_WORLD_BEND * length) ** 2).sqrt()
    none, barrel = bends(points, none_and_barrel, size)[0]
    leverage = (barrel - none).abs() / noise
    best = leverage.argsort(descending=True)[:_MAX_CHAINS]
    best = best[leverage[best] > _MIN_LEVERAGE].sort().values
    return Chains(points[best], noise[best], _CURVED_BEND * length[best], frame[best], size)


def bends(points: Tensor, coefficients: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Compute how far chains are bent after undistortion, measured back in px of the distorted frame.

        bend = sum_i q_i e_i / sqrt(M),  e_i = n (u_i - mean u) / |J^T n|,  J = du / dp

    u_i are the undistorted points p_i of a chain, n is the normal of the line fitted to them by total least squares,
    and q is the unit vector of a parabola along the chain. The division by |J^T n| turns a distance from the line into
    a distance in the distorted frame, so that a lens that shrinks the frame gains nothing. Differentiable.

    Args:
        points: (C, M, 2), px, float64.
        coefficients: (L, 2), k1 and k2 of lenses, relative to the half diagonal.
        size: height and width of the frame, px; its middle is the center of the lens.

    Returns:
        (L, C), px, and (L, C), bool: the lens does not fold back at the chain.

    Source: Sampson, "Fitting conic sections to very scattered data", Computer Graphics and Image Processing 18 (1982).
    """
    errors, valid = _line_errors(points, coefficients, size)
    return errors @ _polynomials(points.shape[1], 3)[:, 2] / math.sqrt(points.shape[1]), valid


def line_costs(chains: Chains, coefficients: Tensor) -> Tensor:
    """Return the costs (L, C) of chains for lenses (L, 2), by the likelihood of a mixture of straight and curved edges.

        cost = -log((exp(-z^2 / 2) + e) / (1 + e)),  z = bend / noise,  e = 0.2 noise / curved

    A chain at which the lens folds back has the cost of a curved one. Differentiable.
    """
    bend, valid = bends(chains.points, coefficients, chains.size)
    floor = _OUTLIERS * chains.noise / chains.curved
    likelihood = torch.where(valid, torch.exp(-(bend / chains.noise).square() / 2), 0.0)
    return -torch.log((likelihood + floor) / (1 + floor))


def fit_lens(chains: Chains, prior: Gaussian) -> LineFit:
    """Fit k1 and k2 to chains: the minimum of the sum of `line_costs` and the prior.

    The cost has several minima. The search starts at the best of a grid of lenses that do not fold back inside the
    frame; Newton's method refines it. The covariance is that of the posterior on the grid, over 200 resamples of the
    frames (of the chains, for less than eight frames). If it does not tell the lens from no distortion, the result is
    the mean of the same distribution, which is nearer to the truth than the minimum of a shallow cost.
    """
    grid = _lens_grid()
    sparse = chains._replace(points=chains.points[:, 1::2])
    with torch.no_grad():
        table = torch.cat([line_costs(sparse, lenses) for lenses in grid.split(_LENSES_AT_ONCE)])
    lens = _refine(chains, prior, grid[(table.sum(dim=1) + _prior_cost(grid, prior)).argmin()])
    weight = _bootstrap(table, _prior_cost(grid, prior), chains.frame)
    covariance = _covariance(grid, weight, lens)
    is_distorted = is_distinct(lens, covariance)
    if not is_distorted:
        lens = _posterior_mean(grid, weight, prior)
        covariance = _covariance(grid, weight, lens)
    bend, valid = bends(chains.points, lens[None], chains.size)
    odds = torch.exp(-(bend / chains.noise).square() / 2) * chains.curved / (_OUTLIERS * chains.noise)
    return LineFit(lens, covariance, is_distorted, (valid & (odds > 1))[0])


def is_distinct(lens: Tensor, covariance: Tensor) -> bool:
    """Return True if a lens (2,) with a covariance (2, 2) differs from no distortion, at 95 %."""
    return (lens @ torch.linalg.solve(covariance, lens)).item() > _DISTINCT


def covers_frame(coefficients: Tensor) -> bool:
    """Return True if a lens (2,), relative to the half diagonal, shows a ray in every pixel of its frame."""
    radius = min(valid_radius(_polynomial(coefficients[None]), model="polynomial12").item(), 10.0)
    k1, k2 = coefficients.tolist()
    return radius * (1 + k1 * radius**2 + k2 * radius**4) >= 1


def _to_subpixel(edge: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray) -> np.ndarray:
    """Move points (N, 2) by at most 1 px to the maximum of the gradient along it, by a parabola."""
    x, y = edge.astype(int).T
    strength = np.hypot(slope_x[y, x], slope_y[y, x])
    normal = np.stack([slope_x[y, x], slope_y[y, x]], axis=1) / np.maximum(strength, 1e-6)[:, None]

    def gradient(shift: int) -> np.ndarray:
        u, v = (edge + shift * normal).T.copy()
        return np.hypot(*(cv2.remap(slope, u, v, cv2.INTER_LINEAR).ravel() for slope in (slope_x, slope_y)))

    before, after = gradient(-1), gradient(1)
    curvature = np.minimum(before - 2 * strength + after, -1e-3)
    return edge.astype(np.float64) + ((before - after) / (2 * curvature)).clip(-1, 1)[:, None] * normal


def _smooth_pieces(edge: np.ndarray, width: int) -> Iterator[np.ndarray]:
    """Cut an edge (N, 2) where the chords before and behind a point turn, and yield the long pieces."""
    arm = max(6, round(_ARM * width))
    forward, backward = edge[2 * arm :] - edge[arm:-arm], edge[arm:-arm] - edge[: -2 * arm]
    cross = backward[:, 0] * forward[:, 1] - backward[:, 1] * forward[:, 0]
    turn = np.abs(np.arctan2(cross, (backward * forward).sum(axis=1)))
    corners = arm + np.flatnonzero(turn > math.radians(_MAX_TURN_DEG))
    for piece in np.split(edge, corners):
        kept = piece[_TRIMMED:-_TRIMMED]
        if len(kept) >= NUM_POINTS and np.hypot(*(kept[-1] - kept[0])) >= _MIN_LENGTH * width:
            yield kept


def _resample(piece: np.ndarray) -> np.ndarray:
    """Return the means (24, 2) over equal parts of a chain (N, 2)."""
    return np.array([part.mean(axis=0) for part in np.array_split(piece, NUM_POINTS)])


def _is_static(points: Tensor, frame: Tensor, num_frames: int, size: tuple[int, int]) -> Tensor:
    """Return (C,), bool: other frames have an edge at the same place, so that it belongs to the car or the lens."""
    scale = _RASTER / size[1]
    shape = math.ceil(size[0] * scale) + 1, _RASTER + 1
    pixels, count = (points.numpy() * scale).round().astype(np.int32), np.zeros(shape, np.int32)
    for i in range(num_frames):
        drawn = np.zeros(shape, np.uint8)
        cv2.polylines(drawn, list(pixels[frame.numpy() == i]), isClosed=False, color=1)
        count += drawn
    mean = count[pixels[..., 1], pixels[..., 0]].mean(axis=1)
    return torch.from_numpy(mean >= max(_MIN_STATIC, _STATIC_SHARE * num_frames))


def _frame(size: tuple[int, int]) -> tuple[float, Tensor]:
    """Return the half diagonal, px, and the center (2,) of a frame."""
    height, width = size
    center = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64, device="cpu")
    return math.hypot(height, width) / 2, center


def _polynomials(count: int, number: int) -> Tensor:
    """Return orthonormal polynomials of degrees 0, 1, ... at evenly spaced points, (count, number)."""
    t = torch.linspace(-1, 1, count, dtype=torch.float64, device="cpu")
    basis, triangle = torch.linalg.qr(torch.stack([t**i for i in range(number)], dim=1))
    return basis * triangle.diagonal().sign()


def _polynomial(coefficients: Tensor) -> Tensor:
    """Return k1 and k2 (L, 2) as coefficients (L, 12) of "polynomial12"."""
    return torch.cat([coefficients, coefficients.new_zeros(len(coefficients), len(POLYNOMIAL12) - 2)], dim=1)


def _line_errors(points: Tensor, coefficients: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return e_i of `bends` for lenses (L, 2), (L, C, M), px, and the validity (L, C)."""
    half_diagonal, center = _frame(size)
    lens, shape = _polynomial(coefficients), (len(coefficients), *points.shape[:2])
    distorted = ((points - center) / half_diagonal).reshape(1, -1, 2).expand(len(coefficients), -1, -1)
    result = undistort(distorted, lens, model="polynomial12")
    x, y = result.points.unbind(-1)
    _, jacobian = distort_with_jacobian(x, y, lens[..., None], Terms(2, False, False))
    xx, xy, yx, yy = (value.view(shape) for value in jacobian)
    x, y = (axis.view(shape) - axis.view(shape).mean(dim=2, keepdim=True) for axis in (x, y))
    # The direction of least variance: half the angle of the covariance, plus a right angle.
    angle = torch.atan2(2 * (x * y).sum(dim=2), (x * x - y * y).sum(dim=2)) / 2
    normal_x, normal_y = -angle.sin()[..., None], angle.cos()[..., None]
    # J is the inverse of the Jacobian of the distortion.
    slope = torch.hypot(yy * normal_x - yx * normal_y, xx * normal_y - xy * normal_x) / (xx * yy - xy * yx).abs()
    return half_diagonal * (x * normal_x + y * normal_y) / slope, result.valid.view(shape).all(dim=2)


@cache
def _lens_grid() -> Tensor:
    """Return lenses (G, 2) that do not fold back inside the frame."""
    lenses = torch.tensor([(k1, _SLOPE * k1 + k2) for k1 in _K1 for k2 in _K2], dtype=torch.float64, device="cpu")
    return torch.stack([lens for lens in lenses if covers_frame(lens)])


def _prior_cost(lenses: Tensor, prior: Gaussian) -> Tensor:
    shift = lenses - prior.mean
    return (shift @ torch.linalg.inv(prior.covariance) * shift).sum(dim=-1) / 2


def _refine(chains: Chains, prior: Gaussian, start: Tensor) -> Tensor:
    """Minimize the cost by Newton's method with halved steps, from a lens (2,), inside the lenses that do not fold."""

    def cost(lens: Tensor) -> Tensor:
        return line_costs(chains, lens[None]).sum() + _prior_cost(lens, prior)

    lens, value = start, cost(start)
    for _ in range(_MAX_STEPS):
        gradient = torch.autograd.functional.jacobian(cost, lens)
        curvatures, axes = torch.linalg.eigh(torch.autograd.functional.hessian(cost, lens))
        step = -axes @ (axes.T @ gradient / curvatures.abs().clamp(min=1.0))
        while step.norm() > _SMALL_STEP and not (covers_frame(lens + step) and cost(lens + step) < value):
            step = step / 2
        if step.norm() <= _SMALL_STEP:
            break
        lens, value = lens + step, cost(lens + step)
    return lens


def _bootstrap(table: Tensor, prior_cost: Tensor, frame: Tensor) -> Tensor:
    """Return the posterior of lenses (G,), the mean over resamples of the columns of their costs (G, C)."""
    groups = frame.unique(return_inverse=True)[1]
    number = int(groups.max()) + 1 if len(groups) else 1
    if number < _MIN_FRAMES:
        groups, number = torch.arange(len(frame), device="cpu"), max(1, len(frame))
    drawn = torch.randint(number, (_NUM_BOOTSTRAPS, number), generator=torch.Generator().manual_seed(0), device="cpu")
    counts = torch.stack([row.bincount(minlength=number) for row in drawn]).to(table.dtype)
    return torch.softmax(-(table @ counts[:, groups].T + prior_cost[:, None]), dim=0).mean(dim=1)


def _posterior_mean(grid: Tensor, weight: Tensor, prior: Gaussian) -> Tensor:
    """Return the mean of a posterior on the grid, as if the grid held the folding lenses of the prior as well.

    mean + covariance prior covariance^-1 (true prior mean - prior mean),  all on the grid
    """
    mean, prior_weight = weight @ grid, torch.softmax(-_prior_cost(grid, prior), dim=0)
    prior_mean = prior_weight @ grid
    gain = _covariance(grid, weight, mean) @ torch.linalg.inv(_covariance(grid, prior_weight, prior_mean))
    return mean + gain @ (prior.mean - prior_mean)


def _covariance(lenses: Tensor, weight: Tensor, center: Tensor) -> Tensor:
    shift = lenses - center
    return (weight[:, None] * shift).T @ shift

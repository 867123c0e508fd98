"""Least-squares fit of a camera to views of a board, with standard deviations, cross-validation and outliers."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.conversion import least_squares
from torchrefract.cameras.lens_database import read_lenses
from torchrefract.cameras.projection import COEFFICIENTS

_RADIAL_ONLY = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
_RATIONAL, _PRISM = cv2.CALIB_RATIONAL_MODEL, cv2.CALIB_THIN_PRISM_MODEL
_OF_FISHEYE: Any = cv2 if hasattr(cv2, "CALIB_FIX_SKEW") else cv2.fisheye  # has its flags: in OpenCV 5, and in 4
_FISHEYE = _OF_FISHEYE.CALIB_RECOMPUTE_EXTRINSIC | _OF_FISHEYE.CALIB_FIX_SKEW
_FLAGS = {
    "opencv0": _RADIAL_ONLY | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2,
    "opencv1": _RADIAL_ONLY | cv2.CALIB_FIX_K2,
    "opencv2": _RADIAL_ONLY,
    "opencv4": cv2.CALIB_FIX_K3,
    "opencv5": 0,
    "opencv8": _RATIONAL,
    "opencv12": _RATIONAL | _PRISM,
    "opencv14": _RATIONAL | _PRISM | cv2.CALIB_TILTED_MODEL,
    "fisheye1": _FISHEYE | _OF_FISHEYE.CALIB_FIX_K2 | _OF_FISHEYE.CALIB_FIX_K3 | _OF_FISHEYE.CALIB_FIX_K4,
    "fisheye2": _FISHEYE | _OF_FISHEYE.CALIB_FIX_K3 | _OF_FISHEYE.CALIB_FIX_K4,
    "fisheye": _FISHEYE,
}
DIVISION = "division"
LENS_MODELS = (*_FLAGS, DIVISION)
PRIORS = ("none", "published", "centered")
_CENTERED_PX = 1e-3  # standard deviation of a principal point that is fixed in the middle
MIN_VIEWS = 3  # of a fit; cross-validation needs one more
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-10)
_ONE_SIGMA = 0.683  # share of a normal distribution within its standard deviation
_MAX_STEPS, _CONVERGED, _MAX_DAMPING = 50, 1e-9, 1e9  # of the fit under a prior
_MAX_RMS = 0.05  # of the width of the frame; a larger error means that the fit failed
_NUM_DEVIATIONS = 6.0  # standard deviations of the rms of the other views
_RATIO = 3.0  # to the median rms of the other views
_MAD_TO_SIGMA = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


class Fit(NamedTuple):
    """A fitted camera, the poses of the board, and the errors that remain."""

    model: str  # of `LENS_MODELS`
    camera: Camera
    covariance: np.ndarray  # (n, n), of `values`; zero for coefficients that the model fixes at zero
    poses: list[np.ndarray]  # for each view (6,), rotation vector and translation, mm
    errors: list[np.ndarray]  # for each view (N, 2), px, detected minus projected corners
    prior: str = "none"  # of `PRIORS`

    @property
    def values(self) -> np.ndarray:
        """Return fx, fy, cx, cy and the coefficients."""
        return camera_values(self.camera)

    @property
    def deviations(self) -> np.ndarray:
        """Return the standard deviations of `values`."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of `values`."""
        return ("fx", "fy", "cx", "cy", *COEFFICIENTS[self.camera.model][: len(self.camera.coefficients)])

    @property
    def rms(self) -> float:
        """Return the rms error of all corners, px."""
        return rms(np.concatenate(self.errors))


def camera_values(camera: Camera) -> np.ndarray:
    """Return fx, fy, cx, cy and the coefficients."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients])


def with_values(camera: Camera, values: np.ndarray) -> Camera:
    """Return the camera with other values than `camera_values`."""
    fx, fy, cx, cy, *coefficients = values.tolist()
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(coefficients))


def num_coefficients(model: str) -> int:
    """Return the number of coefficients that a model of `LENS_MODELS` fits."""
    return 1 if model == DIVISION else int(model.removeprefix("opencv").removeprefix("fisheye") or 4)


def rms(errors: np.ndarray) -> float:
    """Return sqrt(mean |error|^2) of errors (N, 2), px."""
    return float(np.sqrt((errors**2).sum(axis=1).mean())) if len(errors) else 0.0


def fit_camera(
    views: Sequence[View],
    board: Board,
    *,
    model: str,
    size: tuple[int, int],
    prior: str = "none",
    start: Fit | None = None,
) -> Fit:
    """Fit a camera to views of a board by OpenCV's calibration, and the division model by the method of a prior.

        camera, poses = argmin sum |detected - projected corner|^2
        covariance = (J^T J)^-1 sum |error|^2 / (2 N - parameters),  J with respect to all parameters and poses

    Args:
        views: at least three.
        board: that the views show.
        model: of `LENS_MODELS`; the number counts the coefficients that are fitted, the others are zero.
        size: width and height of the pictures, px.
        prior: of `PRIORS`. All but "none" add sum (value - mean)^2 / deviation^2, in units of the variance of the
            errors, and minimize again by the Levenberg-Marquardt method. The mean is the middle of the frame, and zero.
            "published": with the deviations of `prior_deviations`. "centered": the principal point is the middle.
        start: an earlier fit of the same model to the same views, to start from; None starts from homographies.

    Raises:
        ValueError: there are too few views, or no camera fits them.
    """
    if len(views) < MIN_VIEWS:
        raise ValueError(f"views must be at least {MIN_VIEWS}, got {len(views)}")
    objects, images = [board.corners(view.ids) for view in views], [view.corners for view in views]
    try:
        if start is None or prior == "none":
            camera, poses = _minimize(objects, images, model, size, start.camera if start else None)
        else:
            camera, poses = start.camera, start.poses
    except (cv2.error, ValueError) as error:
        reason = " ".join(str(getattr(error, "err", None) or error).split())
        raise ValueError(
            f"views must be enough for the model {model}, got {len(views)} that fit no camera: {reason}"
        ) from error
    num_fitted = 4 + num_coefficients(model)
    precision = np.zeros(num_fitted)
    if prior != "none":
        precision = prior_deviations(camera, prior)[:num_fitted] ** -2.0
        camera, poses = _refine(objects, images, camera, poses, precision)
    errors, normal, *_ = _linearize(objects, images, camera, poses, num_fitted)
    variance = _variance(errors, num_fitted)
    covariance = np.zeros((4 + len(camera.coefficients),) * 2)
    covariance[:num_fitted, :num_fitted] = variance * _inverse(normal + np.diag(variance * precision))
    fit = Fit(model, camera, covariance, poses, errors, prior)
    if fit.rms > _MAX_RMS * size[0]:
        raise ValueError(
            f"views must be of one camera of the model {model}, got {len(views)} that leave {fit.rms:.1f} px rms"
        )
    return fit


def project(camera: Camera, pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points (N, 3), mm, of a board in a pose to pixels (N, 2).

    Returns their derivatives too: with respect to the pose (2 N, 6), and to fx, fy, cx, cy, coefficients (2 N, n).
    """
    if camera.model == DIVISION:
        return _project_division(camera, pose, points)
    arguments = points.reshape(-1, 1, 3), pose[:3], pose[3:], np.array(camera.matrix), np.array(camera.coefficients)
    if camera.model == "fisheye":
        pixels, slopes = cv2.fisheye.projectPoints(*arguments)
        return pixels.reshape(-1, 2), slopes[:, 8:14], slopes[:, :8]
    pixels, slopes = cv2.projectPoints(*arguments)
    return pixels.reshape(-1, 2), slopes[:, :6], slopes[:, 6:]


def _project_division(
    camera: Camera, pose: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project as `project` does; NaN beyond the fold of the lens.

    s = 2 / (1 + q),  q = sqrt(1 - 4 k r^2),  d(s x) = s dx + 4 / (q (1 + q)^2) x (2 k x^T dx + r^2 dk)
    """
    x, pose_slopes = cv2.projectPoints(points.reshape(-1, 1, 3), pose[:3], pose[3:], np.eye(3), np.zeros(4))
    x, pose_slopes, (k,) = x.reshape(-1, 2), pose_slopes[:, :6].reshape(-1, 2, 6), camera.coefficients
    r2 = (x * x).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(1 - 4 * k * r2)
        scale, bend = 2 / (1 + root), 4 / (root * (1 + root) ** 2)
    jacobian = scale[:, None, None] * np.eye(2) + (2 * k * bend)[:, None, None] * x[:, :, None] * x[:, None]
    focal, distorted = np.array([camera.fx, camera.fy]), scale[:, None] * x
    by_focal, by_center = distorted[:, :, None] * np.eye(2), np.broadcast_to(np.eye(2), jacobian.shape)
    by_k = (focal * (bend * r2)[:, None] * x)[:, :, None]
    slopes = np.concatenate([by_focal, by_center, by_k], axis=2).reshape(-1, 5)
    pose_slopes = (focal[:, None] * (jacobian @ pose_slopes)).reshape(-1, 6)
    return focal * distorted + (camera.cx, camera.cy), pose_slopes, slopes


def errors_in_best_pose(view: View, board: Board, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Return the errors (N, 2), px, of a view that the camera was not fitted to.

    Only the pose is fitted, by the Levenberg-Marquardt method from `pose`: six parameters for 2 N values.
    """
    points = board.corners(view.ids)

    def function(pose: Tensor) -> tuple[Tensor, Tensor]:
        pixels, slopes, _ = project(camera, pose.numpy(), points)
        return torch.from_numpy((pixels - view.corners).ravel()), torch.from_numpy(slopes)

    best = least_squares(function, torch.from_numpy(pose))
    return view.corners - project(camera, best.numpy(), points)[0]


def cross_validate(views: Sequence[View], board: Board, fit: Fit, *, folds: int = 5) -> list[np.ndarray]:
    """Return for each of at least four views its errors (N, 2), px, with a camera fitted to the views of other folds.

    `fit` is to all views. View i is in fold i mod folds.
    """
    errors, folds = [np.empty((0, 2))] * len(views), min(folds, len(views))
    for fold in range(folds):
        held_out = range(fold, len(views), folds)
        camera = _fit_without(held_out, views, board, fit).camera
        for i in held_out:
            errors[i] = errors_in_best_pose(views[i], board, camera, fit.poses[i])
    return errors


def _fit_without(held_out: Collection[int], views: Sequence[View], board: Board, fit: Fit) -> Fit:
    others = [view for i, view in enumerate(views) if i not in held_out]
    size = fit.camera.width, fit.camera.height
    start = fit._replace(poses=[pose for i, pose in enumerate(fit.poses) if i not in held_out])
    return fit_camera(others, board, model=fit.model, size=size, prior=fit.prior, start=start)


class LeaveOneOut(NamedTuple):
    """The effect of leaving one view out of the fit; all errors in px rms."""

    name: str  # of the view
    error: float  # of the view with the camera fitted to the others
    others: float  # error of the others without the view
    median: float  # of the errors of each of the others
    limit: float  # of the error, above which the view is an outlier


class Selection(NamedTuple):
    """The views that fit each other."""

    views: list[View]
    fit: Fit  # to these views
    ranking: list[LeaveOneOut]  # of these views, the one that costs the others most first
    dropped: dict[str, str]  # the reason by the name of each dropped view


def leave_each_out(views: Sequence[View], board: Board, fit: Fit) -> list[LeaveOneOut]:
    """Leave each of at least four views, which `fit` is to, out in turn.

    limit = max(3 m, m + 6 * 1.4826 median |e_j - m|),  m = median e_j,  e_j the rms of the other views
    """
    results = []
    for i, view in enumerate(views):
        other_fit = _fit_without([i], views, board, fit)
        errors = np.array([rms(errors) for errors in other_fit.errors])
        median = float(np.median(errors))
        deviation = _MAD_TO_SIGMA * float(np.median(np.abs(errors - median)))
        error = rms(errors_in_best_pose(view, board, other_fit.camera, fit.poses[i]))
        limit = max(_RATIO * median, median + _NUM_DEVIATIONS * deviation)
        results.append(LeaveOneOut(view.name, error, other_fit.rms, median, limit))
    return results


def drop_outliers(
    views: Sequence[View],
    board: Board,
    *,
    model: str,
    size: tuple[int, int],
    max_share: float = 0.25,
    prior: str = "none",
) -> Selection:
    """Drop views that do not fit the others, one at a time.

    Of all outliers, drops the one whose absence gives the others the smallest rms. Then fits again, until no outlier
    remains or no more views may be dropped.

    Args:
        views, board, model, size, prior: as for `fit_camera`, with at least four views.
        max_share: of the views that may be dropped; at least four views always stay.
    """
    kept, dropped = list(views), dict[str, str]()
    max_dropped = min(int(max_share * len(kept)), len(kept) - MIN_VIEWS - 1)
    while True:
        fit = fit_camera(kept, board, model=model, size=size, prior=prior)
        ranking = sorted(leave_each_out(kept, board, fit), key=lambda result: result.others)
        outliers = [result for result in ranking if result.error > result.limit]
        if not outliers or len(dropped) >= max_dropped:
            return Selection(kept, fit, ranking, dropped)
        worst = outliers[0]
        others = [errors for view, errors in zip(kept, fit.errors, strict=True) if view.name != worst.name]
        dropped[worst.name] = (
            f"its error is {worst.error:.2f} px rms if it is left out of the fit; the others have a median of "
            f"{worst.median:.2f} px, and the limit is {worst.limit:.2f} px. Without it the others have "
            f"{worst.others:.2f} px instead of {rms(np.concatenate(others)):.2f} px"
        )
        kept = [view for view in kept if view.name != worst.name]


def _minimize(
    objects: list[np.ndarray], images: list[np.ndarray], model: str, size: tuple[int, int], start: Camera | None
) -> tuple[Camera, list[np.ndarray]]:
    """Run OpenCV's calibration, whose fisheye takes float64 and four coefficients; return the camera and the poses.

    The division model starts from OpenCV's k1, which is its k to first order.
    """
    if model == DIVISION:
        camera, poses = _minimize(objects, images, "opencv1", size, None)
        camera = replace(camera, coefficients=camera.coefficients[:1], model=DIVISION)
        return _refine(objects, images, camera, poses, np.zeros(4 + num_coefficients(model)))
    is_fisheye, flags = model.startswith("fisheye"), _FLAGS[model]
    count = 4 if is_fisheye else max(4, num_coefficients(model))
    matrix, vector = np.eye(3), np.zeros((4 if is_fisheye else max(5, count), 1))
    if start is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        matrix, vector[:count, 0] = np.array(start.matrix), start.coefficients
    run, dtype = (cv2.fisheye.calibrate, np.float64) if is_fisheye else (cv2.calibrateCamera, np.float32)
    on_board, in_picture = ([points[None].astype(dtype) for points in group] for group in (objects, images))
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # on several, OpenCV sums over the views in a different order in each run
    try:
        result = run(on_board, in_picture, size, matrix, vector, flags=flags, criteria=_STOP)
    finally:
        cv2.setNumThreads(threads)
    _, matrix, vector, rotations, translations = result
    poses = [np.concatenate([r.ravel(), t.ravel()]) for r, t in zip(rotations, translations, strict=True)]
    pinhole = dict(zip(("fx", "fy", "cx", "cy"), matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True))
    coefficients, kind = tuple(vector.ravel()[:count].tolist()), "fisheye" if is_fisheye else "opencv"
    return Camera(width=size[0], height=size[1], **pinhole, coefficients=coefficients, model=kind), poses


@lru_cache
def _published_deviations(model: str) -> np.ndarray:
    """Return for the principal point, in widths, and five coefficients what 68 % of the database's lenses stay below.

    A normal distribution stays within its standard deviation for 68 % of the draws. A few extreme lenses do not count.
    """
    cameras = [lens.camera for lens in read_lenses()]
    lenses = [c.coefficients for c in cameras if c.model == model and len(c.coefficients) <= 5]
    values = [[(c.cx - (c.width - 1) / 2) / c.width for c in cameras]]
    values.append([(c.cy - (c.height - 1) / 2) / c.width for c in cameras])
    values += [[lens[k] for lens in lenses if len(lens) > k and lens[k]] for k in range(5 if model == "opencv" else 4)]
    return np.array([np.quantile(np.abs(column), _ONE_SIGMA) for column in values])


def prior_deviations(camera: Camera, prior: str) -> np.ndarray:
    """Return standard deviations of fx, fy (infinite), cx, cy and the coefficients, from published lenses."""
    # The k of the division model is OpenCV's k1 to first order.
    center, lens = np.split(_published_deviations("opencv" if camera.model == DIVISION else camera.model), [2])
    if prior == "centered":
        center = np.full(2, _CENTERED_PX / camera.width)
    rest = np.full(max(0, len(camera.coefficients) - len(lens)), np.inf)
    return np.concatenate([(np.inf, np.inf), camera.width * center, lens, rest])


def _linearize(
    objects: Sequence[np.ndarray], images: Sequence[np.ndarray], camera: Camera, poses: Sequence[np.ndarray], count: int
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, Callable[[np.ndarray], list[np.ndarray]]]:
    """Return the errors, and the normal equations of the camera's first `count` values without the poses.

    The Schur complement eliminates the poses. The last result maps a step of the values to the poses after it.
    """
    errors, normal, right, parts = [], np.zeros((count, count)), np.zeros(count), []
    for points, image, pose in zip(objects, images, poses, strict=True):
        pixels, pose_slopes, slopes = project(camera, pose, points)
        errors.append(image - pixels)
        inverse = np.linalg.pinv(pose_slopes)
        slopes, error = slopes[:, :count], errors[-1].ravel()
        free = slopes - pose_slopes @ (inverse @ slopes)  # the part that no motion of the board explains
        normal += free.T @ free
        right += free.T @ error
        parts.append((pose, inverse @ error, inverse @ slopes))
    return errors, normal, right, lambda step: [pose + move - turn @ step for pose, move, turn in parts]


def _refine(
    objects: Sequence[np.ndarray],
    images: Sequence[np.ndarray],
    camera: Camera,
    poses: list[np.ndarray],
    precision: np.ndarray,
) -> tuple[Camera, list[np.ndarray]]:
    """Minimize the errors and the prior from a fit without it, by the Levenberg-Marquardt method."""
    count, damping = len(precision), 1e-3
    mean = np.zeros(count)
    mean[2:4] = (camera.width - 1) / 2, (camera.height - 1) / 2
    errors, normal, right, move = _linearize(objects, images, camera, poses, count)
    weight = _variance(errors, count) * precision

    def cost(errors: list[np.ndarray], camera: Camera) -> float:
        return float(sum((e**2).sum() for e in errors) + (weight * (camera_values(camera)[:count] - mean) ** 2).sum())

    for _ in range(_MAX_STEPS):
        before, values = cost(errors, camera), camera_values(camera)
        system, target = normal + np.diag(weight), right + weight * (mean - values[:count])
        while damping < _MAX_DAMPING:
            step = _inverse(system + damping * np.diag(np.diag(system))) @ target
            values[:count] = camera_values(camera)[:count] + step
            try:
                candidate = with_values(camera, values)
                candidate_poses = move(step)
                result = _linearize(objects, images, candidate, candidate_poses, count)
                if cost(result[0], candidate) < before:
                    break
            except ValueError:  # the lens folds within a pixel
                pass
            damping *= 10
        else:
            break
        camera, poses, (errors, normal, right, move) = candidate, candidate_poses, result
        damping /= 10
        if before - cost(errors, camera) <= _CONVERGED * before:
            break
    return camera, poses


def _variance(errors: Sequence[np.ndarray], num_fitted: int) -> float:
    """Return sum |error|^2 / (2 N - parameters)."""
    degrees_of_freedom = sum(e.size for e in errors) - num_fitted - 6 * len(errors)
    return float(sum((e**2).sum() for e in errors)) / max(1, degrees_of_freedom)


def _inverse(normal: np.ndarray) -> np.ndarray:
    # Correlated coefficients make the matrix nearly singular; scaled to a unit diagonal it can be inverted.
    scale = np.sqrt(np.diag(normal).clip(min=np.finfo(float).tiny))
    return np.linalg.pinv(normal / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)

"""A camera fitted to views of a board, and how far it can be trusted."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import cv2
import numpy as np

from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.detection import View

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
_FLAGS = {
    "opencv4": cv2.CALIB_FIX_K3,
    "opencv5": 0,
    "opencv8": cv2.CALIB_RATIONAL_MODEL,
    "opencv12": cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL,
    "opencv14": cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL,
}
MODELS = (*_FLAGS, "fisheye")
FEWEST_VIEWS = 3  # of a fit; judging it takes one more
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-10)
_NO_FIT = 0.05  # of the width of the frame, rms
_STEPS = 30  # of a pose


class Lens(NamedTuple):
    """What a fit finds of a camera."""

    model: str  # of `MODELS`
    matrix: np.ndarray  # (3, 3), px
    coefficients: np.ndarray  # (n,), of OpenCV's vector, or k1 ... k4 of its fisheye

    @property
    def numbers(self) -> np.ndarray:
        """fx, fy, cx, cy and the coefficients."""
        return np.concatenate([self.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], self.coefficients])

    @property
    def names(self) -> tuple[str, ...]:
        """Of `numbers`."""
        named = ("k1", "k2", "k3", "k4") if self.model == "fisheye" else COEFFICIENTS[: len(self.coefficients)]
        return ("fx", "fy", "cx", "cy", *named)


class Fit(NamedTuple):
    """A camera, where the board was in each view, and what is left over.

    rms: px, sqrt(mean |error|^2) over all corners, |.| being the distance in the picture.
    """

    lens: Lens
    deviations: np.ndarray  # of `lens.numbers`, one standard deviation
    poses: list[np.ndarray]  # (6,) each, rotation vector and translation, mm
    errors: list[np.ndarray]  # (N, 2) each, px, corners found less corners expected

    @property
    def rms(self) -> float:
        """Of all views."""
        return rms(np.concatenate(self.errors))


def rms(errors: np.ndarray) -> float:
    """sqrt(mean |error|^2) of (N, 2), px."""
    return float(np.sqrt((errors**2).sum(axis=1).mean())) if len(errors) else 0.0


def fit(views: Sequence[View], board: Board, *, model: str, size: tuple[int, int], start: Lens | None = None) -> Fit:
    """The camera that OpenCV's calibration finds: the least squares of |corner found - corner projected|.

        deviation^2 = diag((J^T J)^-1) sum |error|^2 / (2 N - parameters),  J of all numbers and poses

    Args:
        views: at least three.
        board: the one that they show.
        model: of `MODELS`; the number is how many coefficients of OpenCV's vector there are, of 4 being k3 = 0.
        size: width and height of the pictures, px.
        start: from where to look, else from homographies.

    Raises:
        ValueError: too few views, or views from which no camera follows.
    """
    if len(views) < FEWEST_VIEWS:
        raise ValueError(f"views must be at least {FEWEST_VIEWS}, got {len(views)}")
    objects, images = [board.corners(view.ids) for view in views], [view.corners for view in views]
    try:
        calibrate = _calibrate_fisheye if model == "fisheye" else _calibrate_opencv
        lens, poses = calibrate(objects, images, model, size, start)
    except cv2.error as error:
        reason = " ".join(str(error.err or error).split())
        raise ValueError(f"views must be enough for the model {model}, got {len(views)}: {reason}") from error
    if not np.isfinite(lens.numbers).all():
        raise ValueError(f"views must be enough for the model {model}, got {len(views)} that fit no camera")
    errors = [
        image - project(lens, pose, points)[0] for points, pose, image in zip(objects, poses, images, strict=True)
    ]
    found = Fit(lens, _deviations(lens, poses, objects, errors), poses, errors)
    if found.rms > _NO_FIT * size[0]:
        raise ValueError(
            f"views must be of one camera of the model {model}, got {len(views)} that leave {found.rms:.1f} px rms"
        )
    return found


def project(lens: Lens, pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a camera shows points (N, 3), mm, of a board in a pose: (N, 2), px.

    With it come the derivatives, (2 N, 6) with respect to the pose and (2 N, n) to `lens.numbers`.
    """
    points, rotation, translation = points.reshape(-1, 1, 3).astype(np.float64), pose[:3], pose[3:]
    if lens.model == "fisheye":
        places, slopes = cv2.fisheye.projectPoints(points, rotation, translation, lens.matrix, lens.coefficients)
        return places.reshape(-1, 2), slopes[:, 8:14], slopes[:, :8]
    places, slopes = cv2.projectPoints(points, rotation, translation, lens.matrix, lens.coefficients)
    return places.reshape(-1, 2), slopes[:, :6], slopes[:, 6:]


def errors_of(view: View, board: Board, lens: Lens, pose: np.ndarray) -> np.ndarray:
    """(N, 2), px, what a camera leaves over in a view that it was not fitted to, in the best pose near one.

    The pose is found by Levenberg-Marquardt; six numbers for 2 N.
    """
    points, damping = board.corners(view.ids), 1e-3
    places, slopes, _ = project(lens, pose, points)
    errors = view.corners - places
    for _ in range(_STEPS):
        normal = slopes.T @ slopes
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slopes.T @ errors.ravel())
        places, new_slopes, _ = project(lens, pose + step, points)
        found = view.corners - places
        if (found**2).sum() <= (errors**2).sum():
            pose, errors, slopes, damping = pose + step, found, new_slopes, damping / 10
        else:
            damping *= 10
        if np.abs(step).max() < 1e-9:
            break
    return errors


def held_out(
    views: Sequence[View], board: Board, fitted: Fit, *, size: tuple[int, int], folds: int = 5
) -> list[np.ndarray]:
    """(N, 2) of each view, px, its errors with the camera that the views of the other folds give.

    Args:
        views, board, size: as for `fit`, one view more than it needs.
        fitted: to all of them.
        folds: at most; the i-th view is in the fold i mod folds.
    """
    found, folds = [np.empty((0, 2))] * len(views), min(folds, len(views))
    for fold in range(folds):
        others = [view for i, view in enumerate(views) if i % folds != fold]
        lens = fit(others, board, model=fitted.lens.model, size=size, start=fitted.lens).lens
        for i in range(fold, len(views), folds):
            found[i] = errors_of(views[i], board, lens, fitted.poses[i])
    return found


def _calibrate_opencv(
    objects: list[np.ndarray], images: list[np.ndarray], model: str, size: tuple[int, int], start: Lens | None
) -> tuple[Lens, list[np.ndarray]]:
    flags, matrix, vector = _FLAGS[model], np.eye(3), np.zeros(14)
    if start is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        matrix, vector[: len(start.coefficients)] = start.matrix.copy(), start.coefficients
    points = [points.astype(np.float32) for points in objects], [points.astype(np.float32) for points in images]
    with _on_one_thread():
        found = cv2.calibrateCamera(*points, size, matrix, vector, flags=flags, criteria=_STOP)
    _, matrix, vector, turns, moves = found
    count = int(model.removeprefix("opencv"))
    return Lens(model, matrix, vector.ravel()[:count].copy()), _poses(turns, moves)


def _calibrate_fisheye(
    objects: list[np.ndarray], images: list[np.ndarray], model: str, size: tuple[int, int], start: Lens | None
) -> tuple[Lens, list[np.ndarray]]:
    flags, matrix, vector = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW, np.eye(3), np.zeros(4)
    if start is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        matrix, vector = start.matrix.copy(), start.coefficients.copy()
    on_board, in_picture = ([p[None] for p in group] for group in (objects, images))
    _, matrix, vector, turns, moves = cv2.fisheye.calibrate(
        on_board, in_picture, size, matrix, vector.reshape(4, 1), flags=flags, criteria=_STOP
    )
    return Lens(model, matrix, vector.ravel()), _poses(turns, moves)


@contextmanager
def _on_one_thread() -> Iterator[None]:
    """Several threads of OpenCV add up the views in the order in which they are done, another one in each run."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _poses(turns: Sequence[np.ndarray], moves: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [np.concatenate([turn.ravel(), move.ravel()]) for turn, move in zip(turns, moves, strict=True)]


def _deviations(lens: Lens, poses: list[np.ndarray], objects: list[np.ndarray], errors: list[np.ndarray]) -> np.ndarray:
    """Of `lens.numbers`; the poses, each of which matters to its own view alone, are eliminated."""
    count = len(lens.numbers)
    normal = np.zeros((count, count))
    for pose, points in zip(poses, objects, strict=True):
        _, of_pose, of_lens = project(lens, pose, points)
        shared = of_pose.T @ of_lens
        normal += of_lens.T @ of_lens - shared.T @ np.linalg.solve(of_pose.T @ of_pose, shared)
    left = np.concatenate(errors)
    free = max(1, left.size - count - 6 * len(poses))
    # Of numbers that hang together the matrix is all but singular: scaled first.
    scale = np.sqrt(np.diag(normal).clip(min=np.finfo(float).tiny))
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), hermitian=True)
    return np.sqrt(np.diag(inverse).clip(min=0) * (left**2).sum() / free) / scale

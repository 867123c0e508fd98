"""Choice of the lens model by the errors of views that are left out of the fit."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.fit import PRIORS, cross_validate, fit_camera, num_coefficients, rms
from torchrefract.cameras.camera import Camera

AUTO = "auto"
# OpenCV's denominators (opencv8 and more) are not among them: few views leave them undetermined.
CANDIDATES = ("opencv0", "opencv1", "fisheye1", "opencv2", "fisheye2", "opencv4", "fisheye", "opencv5")
FOLDS = "it folds back inside the frame"
_NUM_ERRORS = 2.0  # standard errors of the difference to the best model
_GRID = 65  # points along each side of the rectified frame


class Candidate(NamedTuple):
    """A lens model that was tried; its errors are of held-out views."""

    model: str  # of `LENS_MODELS`
    prior: str  # of `PRIORS`
    num_coefficients: int
    held_out: float  # px rms; infinite if no camera fits
    excess: float  # mean squared error above that of the best model, in standard errors of the latter
    paired_excess: float  # the same, in standard errors of the difference between the two
    problem: str  # why the model is refused; empty if it is not


def choose_model(views: Sequence[View], board: Board, *, size: tuple[int, int]) -> tuple[Candidate, list[Candidate]]:
    """Choose the lens model by the errors of held-out views.

    Of the models that are one-to-one over the frame, takes the one of fewest coefficients whose mean squared error is
    within one standard error of the best, and within two standard errors of the difference to the best. Both are over
    views; the second is the smaller one where the same views are difficult for all models. Between equal numbers, and
    between a fitted and a centered principal point, the held-out error decides. Without distortion the centered one is
    preferred, since other poses explain nearly all of its motion.

    Returns the chosen model and all that were tried.

    Raises:
        ValueError: no model fits the views.
    """
    tried, errors = list[Candidate](), list[np.ndarray]()
    for model in CANDIDATES:
        fit = None
        for prior in PRIORS[1:]:
            held_out, problem = np.inf, ""
            error = np.full(len(views), np.inf)
            try:
                fit = fit_camera(views, board, model=model, size=size, prior=prior, start=fit)
                errors_px = cross_validate(views, board, fit)
                held_out, error = rms(np.concatenate(errors_px)), np.array([rms(e) ** 2 for e in errors_px])
                problem = "" if is_one_to_one(fit.camera) else FOLDS
            except ValueError as reason:
                problem = str(reason)
            tried.append(Candidate(model, prior, num_coefficients(model), held_out, np.inf, np.inf, problem))
            errors.append(error)
    accepted = [k for k, candidate in enumerate(tried) if not candidate.problem]
    if not accepted:
        raise ValueError(f"views must fit a lens model, got {len(views)} that fit none: {tried[0].problem}")
    best = errors[min(accepted, key=lambda k: errors[k].mean())]
    for k, error in enumerate(errors):
        if np.isfinite(error).all():
            difference = error - best
            excess, paired = (difference.mean() / max(e.std(ddof=1) / len(e) ** 0.5, 1e-12) for e in (best, difference))
            tried[k] = tried[k]._replace(excess=float(excess), paired_excess=float(paired))
    close = [tried[k] for k in accepted if tried[k].excess <= 1 and tried[k].paired_excess <= _NUM_ERRORS]

    def rank(one: Candidate) -> tuple[int, bool, float]:
        return one.num_coefficients, one.num_coefficients == 0 and one.prior != "centered", one.held_out

    return min(close, key=rank), tried


def is_one_to_one(camera: Camera) -> bool:
    """Return True if the camera shows a ray in all of its frame, and in all of its rectified frame."""
    if camera.coverage() < 1:
        return False
    rays = camera.without_lens().unproject(camera.grid(_GRID)).points
    return bool(camera.project(rays).valid.all())

"""Detection of views that do not fit the others, by leaving each one out."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.fit import MIN_VIEWS, Fit, errors_in_best_pose, fit_camera, rms

_NUM_DEVIATIONS = 6.0  # standard deviations of the rms of the other views
_RATIO = 3.0  # to the median rms of the other views
_MAD_TO_SIGMA = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


class LeaveOneOut(NamedTuple):
    """The effect of leaving one view out of the fit; all errors in px rms.

    name: of the view.
    error: of the view with the camera fitted to the others.
    others: of the others without the view.
    median: of the errors of each of the others.
    limit: above which the view is an outlier.
    """

    name: str
    error: float
    others: float
    median: float
    limit: float

    @property
    def is_outlier(self) -> bool:
        """Return True if the view fits the others far worse than they fit each other."""
        return self.error > self.limit

    def reason(self, before: float) -> str:
        """Say why the view is dropped; `before` is the rms of the other views in a fit to all of them, px."""
        return (
            f"its error is {self.error:.2f} px rms if it is left out of the fit; the others have a median of "
            f"{self.median:.2f} px, and the limit is {self.limit:.2f} px. Without it the others have "
            f"{self.others:.2f} px instead of {before:.2f} px"
        )


class Selection(NamedTuple):
    """The views that fit each other."""

    views: list[View]
    fit: Fit  # to these views
    ranking: list[LeaveOneOut]  # of these views, the one that costs the others most first
    dropped: dict[str, str]  # the reason by the name of each dropped view


def leave_each_out(views: Sequence[View], board: Board, fit: Fit, *, size: tuple[int, int]) -> list[LeaveOneOut]:
    """Leave each view out in turn.

        limit = max(3 m, m + 6 * 1.4826 median |e_j - m|),  m = median e_j,  e_j the rms of the other views

    Args:
        views, board, size: as for `fit_camera`, with at least four views.
        fit: to all views.
    """
    return [_leave_out(i, views, board, fit, size) for i in range(len(views))]


def drop_outliers(
    views: Sequence[View], board: Board, *, model: str, size: tuple[int, int], max_share: float = 0.25
) -> Selection:
    """Drop views that do not fit the others, one at a time.

    Of all outliers, drops the one whose absence gives the others the smallest rms. Then fits again, until no outlier
    remains or no more views may be dropped.

    Args:
        views, board, model, size: as for `fit_camera`, with at least four views.
        max_share: of the views that may be dropped; at least four views always stay.
    """
    kept, dropped = list(views), dict[str, str]()
    max_dropped = min(int(max_share * len(kept)), len(kept) - MIN_VIEWS - 1)
    while True:
        fit = fit_camera(kept, board, model=model, size=size)
        ranking = sorted(leave_each_out(kept, board, fit, size=size), key=lambda result: result.others)
        outliers = [result for result in ranking if result.is_outlier]
        if not outliers or len(dropped) >= max_dropped:
            return Selection(kept, fit, ranking, dropped)
        worst = outliers[0]
        before = [errors for view, errors in zip(kept, fit.errors, strict=True) if view.name != worst.name]
        dropped[worst.name] = worst.reason(rms(np.concatenate(before)))
        kept = [view for view in kept if view.name != worst.name]


def _leave_out(i: int, views: Sequence[View], board: Board, fit: Fit, size: tuple[int, int]) -> LeaveOneOut:
    others = [view for j, view in enumerate(views) if j != i]
    other_fit = fit_camera(others, board, model=fit.intrinsics.model, size=size, start=fit.intrinsics)
    errors = np.array([rms(errors) for errors in other_fit.errors])
    median = float(np.median(errors))
    deviation = _MAD_TO_SIGMA * float(np.median(np.abs(errors - median)))
    error = rms(errors_in_best_pose(views[i], board, other_fit.intrinsics, fit.poses[i]))
    limit = max(_RATIO * median, median + _NUM_DEVIATIONS * deviation)
    return LeaveOneOut(views[i].name, error, other_fit.rms, median, limit)

"""Views that do not fit the others, found by leaving each one out."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.fit import FEWEST_VIEWS, Fit, errors_of, fit, rms

_DEVIATIONS = 6.0  # of the other views' errors, by their median deviation
_TIMES = 3.0  # the median of the others
_TO_SIGMA = 1.4826  # a normal distribution's standard deviation, in median deviations


class Left(NamedTuple):
    """What leaving a view out shows."""

    name: str
    error: float  # px rms, of this view, with the camera that the others give
    others: float  # px rms, of the others without it
    median: float  # px, the median of the rms of each other view
    limit: float  # px, from where on this view is an outlier

    @property
    def is_outlier(self) -> bool:
        """Whether the view fits the others far worse than they fit one another."""
        return self.error > self.limit

    def reason(self, before: float) -> str:
        """Why the view is dropped, where all views together have so many px rms."""
        return (
            f"held out it is off by {self.error:.2f} px rms, where the others are by {self.median:.2f} in the median "
            f"and {self.limit:.2f} is the limit; without it all others come to {self.others:.2f} px instead of "
            f"{before:.2f} with it"
        )


class Kept(NamedTuple):
    """The views that fit one another."""

    views: list[View]
    fitted: Fit  # to these
    ranking: list[Left]  # of these, the one that costs the others most first
    dropped: dict[str, str]  # by name, the reason


def leave_each_out(views: Sequence[View], board: Board, fitted: Fit, *, size: tuple[int, int]) -> list[Left]:
    """What leaving each view out shows, in their order.

        limit = max(3 m, m + 6 * 1.4826 median |e_j - m|),  m = median e_j,  e_j the rms of the other views

    Args:
        views, board, size: as for `fit`, one view more than it needs.
        fitted: to all of them.
    """
    return [_leave_out(i, views, board, fitted, size) for i in range(len(views))]


def drop_outliers(
    views: Sequence[View], board: Board, *, model: str, size: tuple[int, int], most: float = 0.25
) -> Kept:
    """The views without those that do not fit the others.

    Of the outliers the one goes whose absence leaves the others the smallest rms; then all is fitted again, until there
    is no outlier, or no view more may go.

    Args:
        views, board, model, size: as for `fit`, one view more than it needs.
        most: the share of the views that may go; those that must stay for a fit stay.
    """
    kept, dropped = list(views), dict[str, str]()
    may_go = min(int(most * len(kept)), len(kept) - FEWEST_VIEWS - 1)
    while True:
        fitted = fit(kept, board, model=model, size=size)
        ranking = sorted(leave_each_out(kept, board, fitted, size=size), key=lambda left: left.others)
        outliers = [left for left in ranking if left.is_outlier]
        if not outliers or len(dropped) >= may_go:
            return Kept(kept, fitted, ranking, dropped)
        worst = outliers[0]
        before = [errors for view, errors in zip(kept, fitted.errors, strict=True) if view.name != worst.name]
        dropped[worst.name] = worst.reason(rms(np.concatenate(before)))
        kept = [view for view in kept if view.name != worst.name]


def _leave_out(i: int, views: Sequence[View], board: Board, fitted: Fit, size: tuple[int, int]) -> Left:
    others = [view for j, view in enumerate(views) if j != i]
    found = fit(others, board, model=fitted.lens.model, size=size, start=fitted.lens)
    each = np.array([rms(errors) for errors in found.errors])
    middle = float(np.median(each))
    spread = _TO_SIGMA * float(np.median(np.abs(each - middle)))
    error = rms(errors_of(views[i], board, found.lens, fitted.poses[i]))
    return Left(views[i].name, error, found.rms, middle, max(_TIMES * middle, middle + _DEVIATIONS * spread))

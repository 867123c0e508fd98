"""Which parts of the frame have corners, and what a calibration cannot know without them."""

from collections.abc import Sequence

import numpy as np

from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.fit import Fit
from torchrefract.cameras.camera import Camera

CELLS = (6, 8)  # rows and columns of parts of the frame
_SIGMAS = 2.0  # standard deviations, within which a coefficient is not told from zero
_SIDES = {"left": np.s_[:, 0], "right": np.s_[:, -1], "top": np.s_[0], "bottom": np.s_[-1]}


def coverage(views: Sequence[View], size: tuple[int, int]) -> np.ndarray:
    """(6, 8), how many corners lie in each part of a frame of that width and height."""
    corners = np.concatenate([view.corners for view in views]) + 0.5
    limits = [(0, size[1]), (0, size[0])]
    return np.histogram2d(corners[:, 1], corners[:, 0], bins=CELLS, range=limits)[0].astype(int)


def doubts(views: Sequence[View], fitted: Fit, camera: Camera) -> list[str]:
    """What a calibration cannot know: sides without corners, coefficients like zero, a model that folds."""
    counts, found = coverage(views, (camera.width, camera.height)), []
    empty = [
        f"{side} ({np.sum(counts[part] == 0)} of {counts[part].size} parts)"
        for side, part in _SIDES.items()
        if (counts[part] == 0).mean() >= 0.5
    ]
    if empty:
        found.append(
            f"There are few corners at the {', '.join(empty)} of the frame: what the lens does there is a guess."
        )
    vague = [
        f"{name} = {value:.4g} +- {deviation:.2g}"
        for name, value, deviation in zip(
            fitted.lens.names[4:], fitted.lens.numbers[4:], fitted.deviations[4:], strict=True
        )
        if abs(value) < _SIGMAS * deviation
    ]
    if vague:
        found.append(f"These coefficients cannot be told from zero: {', '.join(vague)}; fewer may do.")
    return [*found, *faults(camera)]


def faults(camera: Camera) -> list[str]:
    """What makes a camera useless in a part of its frame: a model that folds, a denominator that crosses zero."""
    found = []
    if (share := camera.coverage()) < 1:
        found.append(
            f"The model folds back inside the frame: {1 - share:.1%} of it has no ray. Fewer coefficients, or corners "
            "nearer to the border, may help."
        )
    try:
        camera.check_pole()
    except ValueError as error:
        found.append(f"The model breaks down inside the frame: {error}. Fewer coefficients may help.")
    return found

"""Calibration of a camera from pictures of a board, and estimation of its lens from the frames of a drive.

`boards` defines boards and draws them to print. `detection` finds corners and explains why a picture has none. `fit`
estimates the camera and drops views that do not fit. `choice` chooses the lens model. `uncertainty` computes the
standard deviation of rectified pictures. `report` says how far to trust the result. `synthetic` renders pictures of a
board through a known camera. `lens_estimate` needs no board: `plumb_line` finds the lens that makes edges straight.
"""

from torchrefract.cameras.calibration.lens_estimate import LensEstimate, estimate_lens

__all__ = ["LensEstimate", "estimate_lens"]

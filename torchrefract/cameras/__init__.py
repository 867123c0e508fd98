"""Cameras: a pinhole and one of four lens models, and points, rays and tables of them.

`Camera` is one camera in plain numbers; `distort`, `undistort`, `project` and `unproject` take a batch of them as
tensors, with gradients. `convert` finds the nearest camera of another model, `read_lenses` reads a table of real
lenses. Files of other programs are read and written by the modules of `torchrefract.cameras.io`.
"""

from torchrefract.cameras.conversion import Conversion, convert
from torchrefract.cameras.lens_database import Lens, read_lenses
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.projection import PointResult, distort, project, undistort, unproject, valid_radius

__all__ = [
    "Camera",
    "Conversion",
    "Lens",
    "PointResult",
    "convert",
    "distort",
    "project",
    "read_lenses",
    "undistort",
    "unproject",
    "valid_radius",
]

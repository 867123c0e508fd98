"""Cameras: a pinhole and one of four lens models, with points, rays, conversion and a database of real lenses.

`Camera` is one camera in plain numbers. `distort`, `undistort`, `project` and `unproject` take a batch of cameras as
tensors, with gradients. `convert` fits another lens model to a camera. `read_lenses` reads real lenses.
`torchrefract.cameras.io.read_camera` reads the files of other programs; others there write them.
"""

from torchrefract.cameras.camera import Camera
from torchrefract.cameras.conversion import Conversion, convert
from torchrefract.cameras.lens_database import Lens, read_lenses
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

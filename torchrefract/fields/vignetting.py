"""The light that a lens loses towards the corners of a frame."""

from torch import Tensor

from torchrefract.cameras.camera import Pinhole
from torchrefract.warping.grid import pixel_axes


def vignetting(strength: Tensor, pinhole: Pinhole, *, height: int, width: int) -> Tensor:
    """Return the share of light t = 1 - s (1 - cos^4 a) that natural vignetting leaves.

    a is the angle between the ray of a pixel and the axis, tan^2 a = ((x - cx) / fx)^2 + ((y - cy) / fy)^2.

    Args:
        strength: (B,), s in [0, 1]; 1 is the cos^4 law.
        pinhole: of the camera.
        height, width: px, of the frame.

    Returns:
        (B, 1, H, W), in [0, 1].

    Source: Reiss, "The cos^4 law of illumination", Journal of the Optical Society of America 35 (1945).
    """
    (fx, fy), (cx, cy) = pinhole
    x, y = pixel_axes(height, width, dtype=strength.dtype, device=strength.device)
    squared_tangent = ((x - cx) / fx).square() + ((y - cy) / fy).square()
    return 1 - strength.view(-1, 1, 1, 1) * (1 - (1 + squared_tangent) ** -2)

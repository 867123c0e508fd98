"""The division model, in closed form in both directions."""

import torch
from torch import Tensor


def undistort_division(x_d: Tensor, y_d: Tensor, k: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Undistort points by the division model, which is defined from the image to the plane z = 1.

        x = x_d / (1 + k r_d^2),  y = y_d / (1 + k r_d^2)

    Args:
        x_d, y_d: (B, N), in focal lengths.
        k: (B, 1).

    Returns:
        x, y: (B, N), on the plane z = 1; 0 where no point exists.
        exists: (B, N), bool: 1 + k r_d^2 and 1 - k r_d^2, to which dr / dr_d is proportional, are above zero.

    Source: Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens distortion", CVPR 2001.
    """
    with torch.no_grad():
        exists = (k * (x_d * x_d + y_d * y_d)).abs() < 1
    x_d, y_d = torch.where(exists, x_d, 0.0), torch.where(exists, y_d, 0.0)
    scale = 1 / (1 + k * (x_d * x_d + y_d * y_d))
    return scale * x_d, scale * y_d, exists


def distort_division(x: Tensor, y: Tensor, k: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distort points by the inverse of `undistort_division`, the nearest root of k r r_d^2 - r_d + r = 0.

        x_d = 2 x / (1 + sqrt(1 - 4 k r^2)),  y_d = 2 y / (1 + sqrt(1 - 4 k r^2))

    Args:
        x, y: (B, N), on the plane z = 1.
        k: (B, 1).

    Returns:
        x_d, y_d: (B, N), in focal lengths; 0 where no point exists.
        exists: (B, N), bool: 1 - 4 k r^2 is above zero.
    """
    with torch.no_grad():
        exists = 4 * k * (x * x + y * y) < 1
    x, y = torch.where(exists, x, 0.0), torch.where(exists, y, 0.0)
    scale = 2 / (1 + (1 - 4 * k * (x * x + y * y)).sqrt())
    return scale * x, scale * y, exists

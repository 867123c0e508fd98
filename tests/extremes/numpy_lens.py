"""The lens polynomial in NumPy, from the formula of the model alone."""

import numpy as np
from torch import Tensor

import torchrefract as tr


def to_numpy(value: Tensor) -> np.ndarray:
    """Return the values of a tensor in double precision."""
    return value.detach().double().numpy()


class NumpyLens:
    """The lens of one sample in px of a frame, its derivatives, and a bound of its rounding.

    x and y are arrays of one shape (n,) on the plane z = 1; pixels are (2, n).
    """

    def __init__(self, params: tr.LensParams, i: int, height: int, width: int):
        assert params.zoom is not None
        assert params.shift is not None
        self.k, (self.p1, self.p2, *self.s) = np.split(to_numpy(params.coefficients[i]), [6])
        self.focal = to_numpy(params.focal[i])[:, None] * width
        self.center = (np.array([[width], [height]]) - 1) / 2 + to_numpy(params.center[i])[:, None] * width
        self.clean_focal = self.focal * to_numpy(params.zoom[i])
        self.clean_center = self.center + to_numpy(params.shift[i])[:, None] * width

    def distorted(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        r2 = x * x + y * y
        g = 1 + sum(k * r2 ** (i + 1) for i, k in enumerate(self.k))
        s1, s2, s3, s4 = self.s
        return np.stack(
            [
                x * g + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2,
                y * g + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y + s3 * r2 + s4 * r2**2,
            ]
        )

    def jacobian(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Compute the Jacobian (2, 2, n) by central differences."""
        h = 1e-6 * (1e-3 + np.hypot(x, y))
        along = (self.distorted(x + h, y) - self.distorted(x - h, y)) / (2 * h)
        down = (self.distorted(x, y + h) - self.distorted(x, y - h)) / (2 * h)
        return np.stack([along, down], axis=1)

    def magnitude(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Add the magnitudes of all terms, which the rounding error is proportional to."""
        r = np.hypot(x, y)
        decentering = sum(np.abs(v) for v in (*[self.p1] * 3, *[self.p2] * 3, self.s[0], self.s[2]))
        return (
            r * (1 + sum(abs(k) * r ** (2 * i + 2) for i, k in enumerate(self.k)))
            + decentering * r**2
            + (abs(self.s[1]) + abs(self.s[3])) * r**4
        )

    def undistorted(self, points: np.ndarray) -> np.ndarray:
        """Invert `distorted` at (2, n) by Newton steps along central differences."""
        result = points.copy()
        for _ in range(60):
            error = self.distorted(*result) - points
            if np.abs(error).max() < 1e-14:
                break
            result = result - np.linalg.solve(self.jacobian(*result).transpose(2, 0, 1), error.T[..., None])[..., 0].T
        assert np.abs(self.distorted(*result) - points).max() < 1e-12
        return result

    def source(self, pixels: np.ndarray) -> np.ndarray:
        """Return the clean pixels that the lens shows at pixels."""
        return self.clean_focal * self.undistorted((pixels - self.center) / self.focal) + self.clean_center

    def target(self, pixels: np.ndarray) -> np.ndarray:
        """Return the pixels at which the lens shows clean pixels."""
        return self.focal * self.distorted(*((pixels - self.clean_center) / self.clean_focal)) + self.center

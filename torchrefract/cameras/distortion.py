"""Re-export the Brown-Conrady model under its former module name, for modules that have not moved yet."""

from torchrefract.cameras.brown_conrady import ALL_TERMS, POLYNOMIAL12, Terms, distort_polynomial, undistort_polynomial

__all__ = ["ALL_TERMS", "POLYNOMIAL12", "Terms", "distort_polynomial", "undistort_polynomial"]

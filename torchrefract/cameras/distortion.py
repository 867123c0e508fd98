"""Re-export the Brown-Conrady model under its former module name, for modules that have not moved yet."""

from torchrefract.cameras.brown_conrady import (
    ALL_TERMS,
    POLYNOMIAL12,
    Terms,
    distort_polynomial,
    distort_with_jacobian,
    implicit,
    jacobian_polynomial,
    newton_iterates,
    newton_undistort,
    undistort_polynomial,
    used_terms,
)

__all__ = [
    "ALL_TERMS",
    "POLYNOMIAL12",
    "Terms",
    "distort_polynomial",
    "distort_with_jacobian",
    "implicit",
    "jacobian_polynomial",
    "newton_iterates",
    "newton_undistort",
    "undistort_polynomial",
    "used_terms",
]

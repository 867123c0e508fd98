"""Tests of a model: the parameters of an effect that harm it most."""

from torchrefract.robustness.worst_case import WorstCase, worst_case

__all__ = ["WorstCase", "worst_case"]

"""Tests of a model: its scores by scene and severity, and the parameters of an effect that harm it most."""

from torchrefract.robustness.evaluate import Level, Quantity, Robustness, Row, evaluate
from torchrefract.robustness.statistics import Estimate
from torchrefract.robustness.worst_case import WorstCase, worst_case

__all__ = ["Estimate", "Level", "Quantity", "Robustness", "Row", "WorstCase", "evaluate", "worst_case"]

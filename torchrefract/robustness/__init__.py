"""Tests of a model: its scores by scene and severity, and the parameters of an effect that harm it most."""

from torchrefract.robustness.corruption_error import corruption_error, images_of_both
from torchrefract.robustness.evaluate import Level, Quantity, Robustness, Row, evaluate
from torchrefract.robustness.statistics import Estimate
from torchrefract.robustness.worst_case import WorstCase, worst_case

__all__ = [
    "Estimate",
    "Level",
    "Quantity",
    "Robustness",
    "Row",
    "WorstCase",
    "corruption_error",
    "evaluate",
    "images_of_both",
    "worst_case",
]

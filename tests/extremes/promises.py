"""One promise of the contract, and what the tables of them are written with."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import torch

import torchrefract as tr

HERE = "tests/extremes/test_rows.py::"
REFUSED = HERE + "test_what_is_none_is_refused_by_parameter_rule_and_value"
NOTHING = HERE + "test_nothing_to_do_leaves_every_bit"
MASKED = HERE + "test_what_leaves_its_domain_is_finite_and_masked"
LEARNED = HERE + "test_gradients_are_finite_where_nothing_is_known"
TOLD = HERE + "test_what_is_masked_is_told_once"
FLOWS = HERE + "test_a_flow_that_is_no_flow_is_masked"
EFFECTS = "tests/effects/test_"
EACH = EFFECTS + "contract.py::test_"
HABITS = EFFECTS + "habits.py::test_"
PROPERTIES = "tests/extremes/test_properties.py::test_"
TRUTH = "tests/extremes/test_truth.py::test_"
RESAMPLE = "tests/warping/test_resample.py::test_"
ZERO = (0.0, 0.0)
CLEAR = (math.inf, math.inf)
KINDS = {
    "lens": tr.LensDistortion,
    "turbulence": tr.Turbulence,
    "thin plate": tr.ThinPlateSpline,
    "divergence-free": tr.DivergenceFree,
    "uniform fog": tr.UniformFog,
    "fog in drifts": tr.HeterogeneousFog,
    "flare": tr.LensFlare,
}


class Row(NamedTuple):
    """One promise.

    effect: whose.
    extreme: what is put in.
    letters: of LETTERS.
    promise: in words.
    test: the id of the test that shows it.
    cases: what that test is parametrized by, each with its name: calls that make an effect from the options of a warp,
        or calls that raise, whose names begin with the parameter.
    """

    effect: str
    extreme: str
    letters: str
    promise: str
    test: str
    cases: Mapping[str, Callable[..., Any]] = MappingProxyType({})


def frame(*shape: int) -> torch.Tensor:
    """A gray image."""
    return torch.full(shape or (1, 3, 8, 9), 0.5)

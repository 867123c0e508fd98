import math
import re
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn
from torchvision.transforms import v2

import torchrefract as tr
from torchrefract._validation import (
    check_choice,
    check_count,
    check_flow,
    check_number,
    check_range,
    check_tensor,
    check_values,
    check_within,
    eager_values,
)


def positive(value):
    return value > 0


def check_zero_flow(shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> None:
    check_flow("flow", torch.zeros(shape, dtype=dtype))


in_unit = partial(check_number, "p", low=0.0, high=1.0)
unit_range = partial(check_range, "r", low=0.0, high=1.0)


@pytest.mark.quick
def test_check_number_returns_a_float():
    value = check_number("p", 1, low=0.0, high=1.0)
    assert (value, type(value)) == (1.0, float)
    assert check_number("depth", math.inf, low=0.0, high=math.inf) == math.inf
    assert check_number("shift", -1e300) == -1e300


REFUSED: list[tuple[Callable[[Any], Any], tuple[Any, ...], type[Exception], str]] = [  # check, values, error, rule
    (in_unit, (-0.1,), ValueError, r"p must be a number in \[0, 1\], got -0\.1"),
    (in_unit, (1.5,), ValueError, r"p must be a number in \[0, 1\], got 1\.5"),
    (in_unit, (math.inf,), ValueError, r"p must be a number in \[0, 1\], got inf"),
    (in_unit, (math.nan,), ValueError, "p must not be NaN"),
    (in_unit, ("1", None, True, np.True_, [1.0], 1j), TypeError, "p must be a real number, got"),
    (in_unit, (torch.tensor(1.0), np.array([1.0])), TypeError, "p must be a real number, got"),
    (unit_range, ((2.0, 1.0), (-1.0, 0.5), (0.5, 1.5), (math.nan, 1.0), (0.0, math.nan)), ValueError, "r must"),
    (unit_range, (1.0, (1.0,), (1.0, 2.0, 3.0), "12", None, {1.0, 2.0}), ValueError, r"r must be \(low, high\), got"),
    (unit_range, (("0", "1"), (None, 1.0), (False, True)), TypeError, "r must be a real number"),
    (partial(check_count, "steps"), (0,), ValueError, "steps must be at least 1, got 0"),
    (partial(check_count, "steps"), (1.0, "1", True, None), TypeError, "steps must be a whole number, got"),
    (partial(check_tensor, "image"), ([1.0],), TypeError, "image must be a tensor, got list"),
    (check_zero_flow, ((2, 3, 4), (1, 3, 4, 5), (2,), (1, 1, 2, 4, 5)), ValueError, r"have shape \(B, 2, H, W\), got"),
    (
        partial(check_zero_flow, (1, 2, 3, 4)),
        (torch.int64, torch.uint8, torch.bool, torch.complex64),
        TypeError,
        "of a floating type, got",
    ),
]


@pytest.mark.parametrize(("check", "values", "error", "rule"), REFUSED)
def test_a_value_out_of_bounds_or_of_another_kind_raises(check, values, error, rule):
    for value in values:
        with pytest.raises(error, match=rule):
            check(value)


def test_counts_and_choices_are_returned():
    assert (check_count("steps", 1), check_count("steps", 0, low=0)) == (1, 0)
    assert check_choice("padding", "zeros", ("zeros", "border")) == "zeros"
    with pytest.raises(ValueError, match="padding must be one of zeros, border, got 'wrap'"):
        check_choice("padding", "wrap", ("zeros", "border"))


def test_check_within_allows_rounding_and_names_the_wrong_value():
    check_within("v", torch.tensor([1e-3, 5.0, 1e6 * (1 + 5e-6), 1e-3 * (1 - 5e-6)], dtype=torch.float64), 1e-3, 1e6)
    for value in (9e-4, 1.1e6, math.inf, -1.0):
        with pytest.raises(ValueError, match=re.escape(f"v must lie in [0.001, 1e+06], got {value:g}")):
            check_within("v", torch.tensor([1.0, value]), 1e-3, 1e6)


def test_numpy_numbers_are_accepted():
    numbers: list[Any] = [np.float32(0.5), np.int64(1), np.int8(0), np.uint8(3), np.float64(3)]
    half, one, zero, three, broken = numbers
    result = [check_number("p", half), check_number("p", one), *check_range("r", (zero, one))]
    assert [(value, type(value)) for value in result] == [(0.5, float), (1.0, float), (0.0, float), (1.0, float)]
    count = check_count("steps", three)
    assert (count, type(count)) == (3, int)
    with pytest.raises(TypeError, match="steps must be a whole number, got"):
        check_count("steps", broken)


@pytest.mark.parametrize("value", [(1, 2), [1, 2], (1.0, 1.0)])
def test_check_range_returns_two_floats(value):
    result = check_range("k1_range", value)
    assert result == tuple(value)
    assert [type(end) for end in result] == [float, float]


def test_infinite_ends_need_an_infinite_bound():
    assert check_range("visibility_range", (1.0, math.inf), low=0.0, high=math.inf) == (1.0, math.inf)
    with pytest.raises(ValueError, match="visibility_range must be"):
        check_range("visibility_range", (math.inf, math.inf), low=0.0, high=100.0)


def test_check_values_names_the_first_wrong_value():
    check_values("depth", "be above 0, in m", torch.tensor([1.0, 2.0]), positive)
    with pytest.raises(ValueError, match=r"depth must be above 0, in m, got -2\.5"):
        check_values("depth", "be above 0, in m", torch.tensor([1.0, -2.5, -3.0]), positive)


def test_values_on_a_device_are_not_computed():
    on_meta, computed = torch.empty(3, device="meta"), list[torch.Tensor]()

    def record(value: torch.Tensor) -> torch.Tensor:
        computed.append(value)
        return value

    assert eager_values(lambda: record(on_meta).all(), of=on_meta) is None
    assert eager_values(lambda: record(on_meta), of=on_meta) is None
    check_values("depth", "be above 0, in m", on_meta, lambda value: record(value) > 0)
    assert computed == []
    assert eager_values(lambda: record(torch.arange(2)), of=torch.empty(0)) == [0, 1]
    assert len(computed) == 1


def test_values_are_not_checked_while_compiling_or_inside_vmap():
    def check_and_add(value):
        check_values("depth", "be above 0, in m", value, positive)
        return value + 1

    compiled = torch.compile(check_and_add, fullgraph=True, backend="eager")
    assert torch.equal(compiled(torch.tensor([-1.0])), torch.tensor([0.0]))
    assert torch.equal(torch.vmap(check_and_add)(torch.tensor([[-1.0], [1.0]])), torch.tensor([[0.0], [2.0]]))


def test_eager_values_returns_one_value_as_a_bool():
    assert eager_values(lambda: torch.tensor(True)) is True
    assert eager_values(lambda: torch.tensor(False)) is False


def test_a_warning_names_the_line_of_the_caller_whatever_calls_the_effect():
    image = torch.rand(1, 3, 8, 8)
    effects = tr.HeterogeneousFog(depth=tr.CorridorDepth()), tr.Turbulence(amplitude_range=(9, 9), length_range=(2, 2))
    for effect in effects:
        for call in (effect, nn.Sequential(effect), v2.Compose([effect])):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                call(image)
            assert {warning.filename for warning in caught} == {__file__}

import math

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import isotonic_regression

from torchrefract.robustness.statistics import isotonic_decreasing, mean_estimate, tolerated_value

RANGES = ((500, 1000), (200, 500), (60, 200), (40, 60), (20, 40))  # visibility in m at each severity


@pytest.mark.quick
def test_pooled_neighbors_are_the_isotonic_regression_of_scipy():
    values = np.random.default_rng(0).normal(size=200) - np.linspace(0, 2, 200)
    np.testing.assert_allclose(isotonic_decreasing(values), isotonic_regression(values, increasing=False).x, atol=1e-12)


@pytest.mark.quick
def test_the_interval_of_a_mean_holds_it_as_often_as_it_says():
    hits = 0
    for seed in range(200):
        estimate = mean_estimate(np.random.default_rng(seed).exponential(size=100), seed=seed)
        hits += estimate.low <= 1 <= estimate.high
    assert 180 <= hits <= 198


@pytest.mark.parametrize("spread", [0.5, 0.1])
def test_the_interval_of_the_tolerated_visibility_holds_the_truth_for_90_of_100_models(spread):
    hits, errors = 0, []
    for seed in range(100):
        generator = np.random.default_rng(seed)
        # An image is lost below a visibility of its own; one in ten is lost at the true value.
        median = generator.uniform(60, 400)
        threshold = median * np.exp(spread * generator.standard_normal(60))
        visibility = np.stack([generator.uniform(low, high, 60) for low, high in RANGES])
        truth = median * math.exp(spread * stats.norm.ppf(0.9))
        estimate = tolerated_value(
            visibility.ravel(), (visibility > threshold).astype(float).ravel(), least=0.9, is_harm=False
        )
        assert estimate.low <= estimate.value <= estimate.high
        hits += estimate.low <= truth <= estimate.high
        errors.append(math.log(estimate.value / truth))
    assert hits >= 90
    assert abs(np.mean(errors)) < 0.15


@pytest.mark.quick
@pytest.mark.parametrize("sign", [1, -1])
def test_the_direction_of_harm_is_that_of_the_scores(sign):
    generator = np.random.default_rng(0)
    strength = generator.uniform(0, 1, 250)
    estimate = tolerated_value(
        sign * strength, 1 - strength + 0.05 * generator.normal(size=250), least=0.7, is_harm=sign == 1
    )
    assert estimate.value == pytest.approx(sign * 0.3, abs=0.05)
    assert estimate.low < estimate.value < estimate.high


@pytest.mark.quick
def test_a_value_outside_the_levels_has_an_open_interval():
    visibility = np.random.default_rng(0).uniform(50, 100, 200)
    harmless = tolerated_value(visibility, visibility / 1000 + 0.9, least=0.5, is_harm=False)
    assert harmless.low == -math.inf
    assert harmless.value == visibility.min()
    hopeless = tolerated_value(visibility, visibility / 1000, least=0.5, is_harm=False)
    assert hopeless.high == math.inf
    assert hopeless.value == visibility.max()

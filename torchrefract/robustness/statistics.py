"""Means with intervals, and the value of a quantity up to which a score stays high."""

import math
from typing import NamedTuple

import numpy as np

_RESAMPLES = 1000
_LEVEL = 0.95  # of intervals
_CRITICAL = 2.26916  # 95 % quantile of the likelihood ratio of a monotone function at a point
_MAX_SPLITS = 150  # values of the quantity that are tried as ends of an interval


class Estimate(NamedTuple):
    """A value with the ends of its 95 % interval; an end is infinite where the data do not bound it."""

    value: float
    low: float
    high: float


def mean_estimate(values: np.ndarray, *, seed: int = 0) -> Estimate:
    """Estimate the mean of values (n,), with percentiles of the means of resampled values.

    Source: Efron, "Bootstrap methods: another look at the jackknife", Annals of Statistics 7 (1979).
    """
    rows = np.random.default_rng(seed).integers(0, len(values), (_RESAMPLES, len(values)))
    low, high = np.quantile(values[rows].mean(axis=1), [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return Estimate(float(values.mean()), float(low), float(high))


def tolerated_value(quantity: np.ndarray, score: np.ndarray, *, least: float, is_harm: bool) -> Estimate:
    """Estimate up to which value of a quantity the mean score stays at `least` or above.

    The mean score is taken for a monotone function of the quantity, fitted by isotonic regression. The interval holds
    the values at which that function may reach `least`, by the likelihood ratio with the largest variance that scores
    with such a mean can have.

    Args:
        quantity: (n,), such as the visibility in m.
        score: (n,), in [0, 1], higher is better.
        least: the lowest mean score that is tolerated, in (0, 1).
        is_harm: True if scores fall with the quantity, False if they rise with it, as with visibility.

    Returns:
        The value, with an interval that is open on a side on which the data do not bound it. Where no value is
        tolerated, it is the mildest one; where all are, the strongest.

    Source: Barlow, Bartholomew, Bremner and Brunk, "Statistical inference under order restrictions", Wiley 1972;
    Banerjee and Wellner, "Likelihood ratio tests for monotone functions", Annals of Statistics 29 (2001).
    """
    sign = 1.0 if is_harm else -1.0
    order = np.argsort(sign * quantity, kind="stable")
    harm, score = sign * quantity[order], score[order]
    monotone = isotonic_decreasing(score)
    value = _end(harm, int((monotone >= least).sum()), outside=False)
    # Before a split the function is at least `least`, after it at most.
    splits = np.unique(np.linspace(0, len(score), min(len(score), _MAX_SPLITS) + 1).round().astype(int))
    of_splits = np.array([_squares(score, _split_fit(score, split, least)) for split in splits])
    excess = (of_splits - _squares(score, monotone)) / (least * (1 - least))
    possible = splits[excess <= max(_CRITICAL, excess.min())]
    ends = sorted((sign * _end(harm, possible[0] - 1), sign * _end(harm, possible[-1] + 1)))
    return Estimate(sign * value, *ends)


def isotonic_decreasing(values: np.ndarray) -> np.ndarray:
    """Return the decreasing sequence nearest to values (n,) in the least squares sense, by pooling neighbors."""
    means: list[float] = []
    counts: list[int] = []
    for value in values.tolist():
        mean, count = value, 1
        while means and means[-1] < mean:
            mean = (mean * count + means[-1] * counts[-1]) / (count + counts[-1])
            count += counts.pop()
            means.pop()
        means.append(mean)
        counts.append(count)
    return np.repeat(means, counts)


def _split_fit(score: np.ndarray, split: int, least: float) -> np.ndarray:
    before = np.maximum(isotonic_decreasing(score[:split]), least)
    return np.concatenate([before, np.minimum(isotonic_decreasing(score[split:]), least)])


def _squares(score: np.ndarray, monotone: np.ndarray) -> float:
    return float(np.square(score - monotone).sum())


def _end(harm: np.ndarray, count: int, *, outside: bool = True) -> float:
    """Return the harm halfway between the first `count` values and the others; beyond all, infinite or the nearest."""
    if count <= 0:
        return -math.inf if outside else float(harm[0])
    if count >= len(harm):
        return math.inf if outside else float(harm[-1])
    return float((harm[count - 1] + harm[count]) / 2)

"""Statistics of returns: by hand, against SciPy, and the coverage of intervals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from mcaprl.sims.evaluation.statistics import (
    bootstrap_interval,
    improvement_interval,
    improvement_probability,
    interquartile_mean,
    mean,
    median,
)

returns = arrays(
    np.float64,
    st.tuples(st.integers(1, 4), st.integers(1, 7)),
    elements=st.integers(-5, 5).map(float),
)


def test_means_by_hand() -> None:
    numbers = np.array([[100.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, -100.0]])
    assert mean(numbers) == pytest.approx(21 / 8)
    assert median(numbers) == 3.5
    # Two of eight are dropped at each end: 2, 3, 4, 5 remain.
    assert interquartile_mean(numbers) == 3.5
    assert interquartile_mean(np.array([[1.0, 2.0, 6.0]])) == 3.0, "a quarter of three is none"


def test_improvement_by_hand() -> None:
    first, second = np.array([[1.0, 3.0]]), np.array([[2.0], [3.0]])
    # 1 loses twice; 3 wins against 2 and ties with 3.
    assert improvement_probability(first, second) == (0 + 0 + 1 + 0.5) / 4
    assert improvement_probability(second, first) == 1 - 1.5 / 4
    assert improvement_probability(first, first) == 0.5


@given(returns)
def test_the_interquartile_mean_is_scipys_trimmed_mean(numbers: NDArray[Any]) -> None:
    expected = scipy.stats.trim_mean(numbers, 0.25, axis=None)
    assert interquartile_mean(numbers) == pytest.approx(expected)


@given(returns, returns)
def test_improvement_is_scipys_mann_whitney(first: NDArray[Any], second: NDArray[Any]) -> None:
    wins = scipy.stats.mannwhitneyu(first.ravel(), second.ravel(), method="asymptotic").statistic
    assert improvement_probability(first, second) == pytest.approx(
        wins / (first.size * second.size)
    )


def test_the_interval_of_an_improvement_holds_it() -> None:
    random = np.random.default_rng(0)
    first, second = random.normal(1, 1, (4, 30)), random.normal(0, 1, (4, 30))
    low, high = improvement_interval(first, second)
    # For two normal distributions with means one standard deviation apart, the probability is .76.
    assert 0.5 < low < 0.76 < high < 1.0
    assert low < improvement_probability(first, second) < high


def test_bootstrap_interval_covers_as_often_as_it_says() -> None:
    """Of 95 % intervals of the mean of 30 normal numbers, about 93 % contain the true mean."""
    random = np.random.default_rng(0)
    hits = 0
    for trial in range(200):
        low, high = bootstrap_interval(random.normal(size=(1, 30)), seed=trial)
        hits += low < 0 < high
    assert 0.88 <= hits / 200 <= 0.99


def test_interval_grows_with_differences_between_seeds() -> None:
    alike = np.tile(np.arange(10.0), (4, 1))
    apart = alike + np.array([[0.0], [10], [20], [30]])
    low, high = bootstrap_interval(alike)
    wide_low, wide_high = bootstrap_interval(apart)
    assert wide_high - wide_low > 3 * (high - low)
    assert bootstrap_interval(np.full((1, 5), 2.0)) == (2.0, 2.0)

"""Tests of statistics of returns: by hand, against SciPy, and the coverage of intervals."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from mcaprl.sims.evaluation.evaluate import (
    bootstrap_interval,
    improvement_interval,
    improvement_probability,
    interquartile_mean,
    mean_interval,
    median,
    student_quantile,
)
from tests.support.sampled_returns import Returns, coverage

returns = arrays(
    np.float64,
    st.tuples(st.integers(1, 4), st.integers(1, 7)),
    elements=st.integers(-5, 5).map(float),
)


def test_means_by_hand() -> None:
    numbers = np.array([[100.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, -100.0]])
    assert median(numbers) == 3.5
    # Two of eight returns are dropped at each end; 2, 3, 4 and 5 remain.
    assert interquartile_mean(numbers) == 3.5
    assert interquartile_mean(np.array([[1.0, 2.0, 6.0]])) == 3.0, "a quarter of three is none"


def test_improvement_by_hand() -> None:
    first, second = np.array([[1.0, 3.0]]), np.array([[2.0], [3.0]])
    # In `first`, 1 is below 2 and 3; 3 is above 2 and equal to 3, which counts as half.
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


@pytest.mark.parametrize(
    ("of", "least", "most"),
    [
        (Returns(1, 3), 0.94, 0.96),
        (Returns(1, 5), 0.94, 0.96),
        (Returns(1, 9), 0.94, 0.96),
        # A few episodes do not show that returns are skewed.
        (Returns(1, 5, skewed=True), 0.80, 0.86),
        (Returns(1, 30), 0.94, 0.97),
        (Returns(1, 30, skewed=True), 0.93, 0.97),
        (Returns(1, 100, skewed=True), 0.93, 0.97),
        (Returns(2, 30), 0.94, 0.98),
        (Returns(4, 30), 0.94, 0.98),
        (Returns(4, 30, skewed=True), 0.94, 0.98),
        (Returns(4, 30, spread=0), 0.94, 1.0),
        (Returns(10, 30), 0.94, 0.98),
        # Four seeds are too few to show that their distribution is skewed, so coverage is lower.
        (Returns(4, 30, skewed_seeds=True), 0.86, 0.97),
    ],
)
def test_intervals_of_the_mean_cover_as_often_as_documented(
    of: Returns, least: float, most: float
) -> None:
    trials = 300
    margin = 2 * np.sqrt(0.95 * 0.05 / trials)
    assert least - margin <= coverage(of, mean_interval, trials) <= most + margin


def test_interval_of_the_mean_by_hand() -> None:
    # The means of the two seeds are 1 and 3, so the standard error of their mean is 1. The 97.5 %
    # quantile of Student's t distribution with one degree of freedom is 12.706.
    assert mean_interval(np.array([[1.0], [3.0]])) == pytest.approx((2 - 12.7062, 2 + 12.7062))
    # Each seed has two equal episodes, so the starts add no variance to the case above.
    twice = np.array([[1.0, 1.0], [3.0, 3.0]])
    assert mean_interval(twice) == pytest.approx((2 - 12.7062, 2 + 12.7062))
    # All usable bootstrap samples of two episodes have the same mean, so the interval is that of
    # Student's t.
    assert mean_interval(twice.T) == pytest.approx((2 - 12.7062, 2 + 12.7062))
    assert mean_interval(np.array([[1.0, 3.0]])) == pytest.approx((2 - 12.7062, 2 + 12.7062))
    # The seeds and the starts each contribute a standard error of 1; together they have sqrt(2).
    both = np.array([[0.0, 2.0], [2.0, 4.0]])
    assert mean_interval(both) == pytest.approx((2 - 12.7062 * 2**0.5, 2 + 12.7062 * 2**0.5))


@pytest.mark.parametrize("shape", [(1, 5), (3, 4), (1, 1), (4, 1)])
def test_equal_returns_have_an_interval_of_no_width(shape: tuple[int, int]) -> None:
    assert mean_interval(np.full(shape, 2.0)) == (2.0, 2.0)


@given(returns, st.integers(-3, 3))
def test_an_interval_of_the_mean_holds_it_and_shifts_and_scales(
    numbers: NDArray[Any], seed: int
) -> None:
    low, high = mean_interval(numbers, seed=abs(seed))
    assert low <= numbers.mean() + 1e-9
    assert numbers.mean() - 1e-9 <= high
    moved = mean_interval(3 * numbers + 5, seed=abs(seed))
    assert moved == pytest.approx((3 * low + 5, 3 * high + 5), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    "returns", [[37.0, 61.0, 61.5, 62.0, 157.0], [0.0, 0.01, 9.99, 10.0], [500.0] * 7 + [499.0, 9]]
)
def test_the_interval_of_a_few_episodes_is_students(returns: list[float]) -> None:
    expected = scipy.stats.t.interval(
        0.95, len(returns) - 1, np.mean(returns), scipy.stats.sem(returns)
    )
    assert mean_interval(np.array([returns])) == pytest.approx(expected, rel=2e-3)


def test_a_skewed_interval_is_longer_on_the_side_of_the_tail() -> None:
    numbers = np.random.default_rng(0).lognormal(size=(1, 30))
    low, high = mean_interval(numbers)
    assert high - numbers.mean() > 1.2 * (numbers.mean() - low)


def test_many_episodes_are_resampled_in_parts() -> None:
    numbers = np.random.default_rng(0).normal(size=(1, 5_000))
    low, high = mean_interval(numbers)
    half = 1.96 * numbers.std() / np.sqrt(numbers.size)
    assert high - low == pytest.approx(2 * half, rel=0.1)


@pytest.mark.parametrize("degrees", [1, 2, 3, 9, 12, 29, 99, 999, 10**6])
def test_the_quantile_of_students_t_is_scipys(degrees: int) -> None:
    assert student_quantile(degrees) == pytest.approx(scipy.stats.t.ppf(0.975, degrees), rel=1e-3)


def test_interval_grows_with_differences_between_seeds() -> None:
    alike = np.tile(np.arange(10.0), (4, 1))
    apart = alike + np.array([[0.0], [10], [20], [30]])
    for interval in (mean_interval, partial(bootstrap_interval, statistic=median)):
        low, high = interval(alike)
        wide_low, wide_high = interval(apart)
        assert wide_high - wide_low > 3 * (high - low)
    assert bootstrap_interval(np.full((1, 5), 2.0), median) == (2.0, 2.0)

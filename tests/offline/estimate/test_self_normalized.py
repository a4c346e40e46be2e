"""Tests of the intervals of off-policy estimates: by hand, against SciPy, and their coverage."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from mcaprl.offline.estimate.importance import ESTIMATORS, RatioEstimate, student_factor
from tests.support import two_state_task as task

columns = st.integers(2, 9).flatmap(
    lambda size: arrays(np.float64, size, elements=st.integers(-9, 9).map(float))
)


def resamplings(episodes: int, count: int, seed: int) -> NDArray[np.float64]:
    random = np.random.default_rng(seed)
    return random.multinomial(episodes, [1 / episodes] * episodes, count).astype(np.float64)


def test_a_ratio_by_hand() -> None:
    # The first arrays are a, the second are b. Both ratios a / b are 2, so the standard error is 0.
    same = RatioEstimate(np.array([0.5]), ((np.array([[2.0], [6.0]]), np.array([[1.0], [3.0]])),))
    # If the second episode is drawn twice, the ratio is 12 / 6 = 2, too.
    assert same.values(np.array([[1.0, 1.0], [0.0, 2.0]])) == pytest.approx([1.0, 1.0])
    assert same.errors(np.ones((1, 2))) == pytest.approx([0.0])
    assert same.interval(resamplings(2, 50, 0)) == pytest.approx((1.0, 1.0))
    # The ratio of the sums is 4 / 4 = 1. The episodes contribute (2 - 1) / 4 and (2 - 3) / 4, so
    # the standard error is sqrt(2 / 16).
    other = RatioEstimate(np.ones(1), ((np.array([[2.0], [2.0]]), np.array([[1.0], [3.0]])),))
    assert other.errors(np.ones((1, 2))) == pytest.approx([np.sqrt(1 / 8)])
    # If each episode is counted twice, there are four episodes. This halves the variance.
    assert other.errors(np.full((1, 2), 2.0)) == pytest.approx([np.sqrt(1 / 16)])


def test_weighted_pairs_are_summed() -> None:
    one = (np.array([[1.0, 2.0], [3.0, 2.0]]), np.array([[1.0, 0.0], [1.0, 4.0]]))
    # The ratios are 4 / 2 with factor 1 and 4 / 4 with factor 10: 12. Both pairs are equal: 24.
    assert RatioEstimate(np.array([1.0, 10.0]), (one, one)).values(np.ones((1, 2))) == [24.0]
    # Where b is 0 in all episodes, the ratio is 0.
    nothing = RatioEstimate(np.ones(1), ((np.ones((2, 1)), np.zeros((2, 1))),))
    assert nothing.values(np.ones((1, 2))) == [0.0]
    assert nothing.interval(resamplings(2, 20, 0)) == (0.0, 0.0)


@given(columns)
def test_the_error_of_a_mean_is_scipys(values: NDArray[np.float64]) -> None:
    mean = RatioEstimate.mean(values)
    once = np.ones((1, len(values)))
    assert mean.values(once) == pytest.approx([values.mean()])
    assert mean.errors(once) == pytest.approx([scipy.stats.sem(values, ddof=0)], abs=1e-9)


@given(columns, st.integers(0, 3))
def test_an_interval_shifts_and_scales_with_its_values(
    values: NDArray[np.float64], seed: int
) -> None:
    counts = resamplings(len(values), 60, seed)
    low, high = RatioEstimate.mean(values).interval(counts)
    assert low <= high
    moved = RatioEstimate.mean(3 * values + 5).interval(counts)
    assert moved == pytest.approx((3 * low + 5, 3 * high + 5), rel=1e-6, abs=1e-6)


def test_the_standard_error_is_the_spread_of_the_estimates() -> None:
    """Over 150 logs of 200 episodes, error and spread agree within four standard errors."""
    once, logs = np.ones((1, 200)), 150
    tables = [task.play(None, episodes=200, seed=seed) for seed in range(logs)]
    for name in ("WPDIS", "DR", "WDR"):
        found = [ESTIMATORS[name](table) for table in tables]
        spread = np.std([one.values(once)[0] for one in found])
        reported = np.sqrt(np.mean([one.errors(once)[0] ** 2 for one in found]))
        assert reported == pytest.approx(spread, rel=4 / np.sqrt(2 * logs))


def test_intervals_have_their_nominal_coverage() -> None:
    """Over 200 logs of 50 episodes, the coverage of 95 % intervals is 95 % within a tolerance.

    The tolerance is two percentage points plus two standard errors.
    """
    logs, episodes = 200, 50
    margin = 0.02 + 2 * np.sqrt(0.95 * 0.05 / logs)
    held = dict.fromkeys(ESTIMATORS, 0)
    for seed in range(logs):
        table = task.play(None, episodes=episodes, seed=seed)
        counts = resamplings(episodes, 250, seed)
        for name, estimator in ESTIMATORS.items():
            low, high = estimator(table).interval(counts)
            held[name] += low <= task.true_value() <= high
    for name, times in held.items():
        assert abs(times / logs - 0.95) <= margin, name


def test_the_interval_of_a_few_episodes_is_students() -> None:
    # All deviations from the mean are equal, so there are E - 1 degrees of freedom.
    values = np.array([0.0, 0, 0, 1, 1, 1])
    expected = scipy.stats.t.interval(0.95, 5, values.mean(), scipy.stats.sem(values))
    assert RatioEstimate.mean(values).interval(resamplings(6, 200, 0)) == pytest.approx(expected)


def test_intervals_of_a_few_episodes_have_their_nominal_coverage() -> None:
    random, trials = np.random.default_rng(0), 2_000
    counts, held = resamplings(5, 1, 0), 0
    for _ in range(trials):
        low, high = RatioEstimate.mean(random.normal(size=5)).interval(counts)
        held += low <= 0 <= high
    # Few degrees of freedom widen the interval, so that it is not too short for skewed returns.
    assert 0.94 <= held / trials <= 0.99


def test_degrees_of_freedom_by_hand() -> None:
    # For deviations d from the mean, the result is (sum of d^2)^2 / (sum of d^4) - 1, at least 1.
    # The deviations of 0 and 2 are equal: 4 / 2 - 1 = 1. The deviations of 0, 0, 0 and 4 are 1, 1,
    # 1 and 3: 144 / 84 - 1 is below the minimum of 1.
    assert RatioEstimate.mean(np.array([0.0, 2.0])).degrees_of_freedom() == 1.0
    assert RatioEstimate.mean(np.array([0.0, 0.0, 0.0, 4.0])).degrees_of_freedom() == 1.0
    alike = RatioEstimate.mean(np.array([-1.0, 1.0] * 10))
    assert alike.degrees_of_freedom() == pytest.approx(19.0)
    # Six deviations are 2, and the other two are 0: 6 - 1 degrees of freedom.
    some = RatioEstimate.mean(np.array([0.0, 0, 0, 2, 2, 4, 4, 4]))
    assert some.degrees_of_freedom() == pytest.approx(5.0)


def test_students_t_quantile_by_the_table() -> None:
    # 97.5 % quantiles: 12.706 of Student's t with one degree of freedom, 2.228 with ten degrees,
    # and 1.960 of the normal distribution.
    assert student_factor(1.0) == pytest.approx(12.706 / 1.960, rel=1e-3)
    assert student_factor(10.0) == pytest.approx(2.228 / 1.960, rel=1e-3)
    assert student_factor(1e9) == pytest.approx(1.0)

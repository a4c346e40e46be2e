"""Calibration of logged probabilities: results calculated by hand, and known policies."""

from __future__ import annotations

import math

import numpy as np
import pytest
from gymnasium import spaces

from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.lint import lint
from mcaprl.recorder.dataset.statistics import ProbabilityRange, calibration


def test_by_hand() -> None:
    found = calibration(np.array([0.5, 0.5, 0.25, 1.0]), spaces.Discrete(3))
    assert found is not None
    # The values of 1 / p are 2, 2, 4 and 1, and their mean is 2.25. The deviations are -0.25,
    # -0.25, 1.75 and -1.25, so the variance is 4.75 / 3. The squared standard error of the mean is
    # the variance divided by the number of values, 4.
    assert (found.available, found.actions) == (3, 2.25)
    assert found.error == pytest.approx(math.sqrt(4.75 / 3 / 4))
    assert found.ranges == (
        ProbabilityRange(1.25 / 3, 3, 2.0),
        ProbabilityRange(1.0, 1, 0.25),
    )
    assert str(found) == "2.25 +- 0.63 actions; the action space has 3"


@pytest.mark.parametrize("epsilon", [0.05, 0.3])
def test_an_epsilon_greedy_policy_has_one_likely_action(epsilon: float) -> None:
    random = np.random.default_rng(0)
    rare, steps = epsilon / 9, 50_000
    likely = random.random(steps) < 1 - epsilon + rare
    found = calibration(np.where(likely, 1 - epsilon + rare, rare), spaces.Discrete(9))
    assert found is not None
    assert found.possible
    assert found.actions == pytest.approx(9, abs=4 * found.error)
    few, one = found.ranges
    assert one.actions == pytest.approx(1, abs=0.02)
    assert few.actions == pytest.approx(8, abs=4 * found.error)


def test_a_deterministic_policy_implies_one_action() -> None:
    found = calibration(np.ones(10), spaces.Discrete(4))
    assert found is not None
    assert found.possible
    assert (found.actions, found.error) == (1.0, 0.0)


def test_probabilities_that_are_too_small_are_a_problem() -> None:
    steps = 400
    data = Dataset.from_arrays(
        observations=np.random.default_rng(0).normal(size=(steps, 1)).astype(np.float32),
        actions=np.arange(steps) % 2,
        rewards=np.arange(steps) / steps,
        terminated=np.arange(steps) % 50 == 49,
        truncated=np.zeros(steps, dtype=np.bool_),
        next_observations=np.zeros((steps, 1), dtype=np.float32),
        behavior_probs=np.full(steps, 0.25),
        action_space=spaces.Discrete(2),
    )
    problems = [finding for finding in lint(data) if "behavior_prob" in finding.what]
    assert [finding.severity for finding in problems] == ["problem"]
    assert "4.00 +- 0.00 actions; the action space has 2, so" in problems[0].what


@pytest.mark.parametrize("tiny", [1, 12, 400])
def test_a_probability_too_small_to_be_drawn_is_a_problem(tiny: int) -> None:
    """Report tiny probabilities, although huge values of 1 / p have a large standard error."""
    probs = np.full(400, 0.5)
    probs[:tiny] = 1e-38
    found = calibration(probs, spaces.Discrete(2))
    assert found is not None
    assert not found.possible
    assert str(found).endswith("so the logged probabilities are too small (down to 1e-38)")


def test_continuous_or_unknown_probabilities_have_no_calibration() -> None:
    assert calibration(np.array([0.5, math.nan]), spaces.Discrete(2)) is None
    for prob in (0.0, -0.5, 2.0, math.inf):
        assert calibration(np.array([0.5, prob]), spaces.Discrete(2)) is None
    assert calibration(np.array([0.5, 0.5]), spaces.Box(-1, 1, (1,))) is None

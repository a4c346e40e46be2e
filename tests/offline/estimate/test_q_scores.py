"""Tests of BVFT and SBV on MDPs whose Bellman errors are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.studies.q_scores import RESOLUTIONS, bvft, bvft_losses, sbv

PAYS = np.array([[1.0, 0.0], [0.5, 0.2]])
"""Mean reward of two actions in two states; each step ends the episode."""


def lottery(count: int = 4_000) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return states, actions and rewards; the reward is its mean plus 2 or minus 2."""
    random = np.random.default_rng(0)
    states, actions = random.integers(0, 2, (2, count))
    return states, actions, PAYS[states, actions] + random.choice([-2.0, 2.0], count)


def test_errors_of_two_candidates_by_hand() -> None:
    # The values of the first candidate differ between the transitions 0, 1 and 2, 3; those of the
    # second do not. Alone, the second has one group with the mean target 1, which is its value:
    # it would seem to be perfect. Together there are two groups with the mean targets 0 and 2.
    q = np.array([[0.1, 0.1, 2.1, 2.1], [1.0, 1.0, 1.0, 1.0]])
    targets = np.array([[-1.0, 1.0, 1.0, 3.0]] * 2)
    assert bvft_losses(q[1:], targets[1:], 0.5).tolist() == [0.0]
    assert bvft_losses(q, targets, 0.5).tolist() == pytest.approx([0.1, 1.0])
    # If a bin contains all values, both have one group.
    assert bvft_losses(q, targets, 10.0).tolist() == pytest.approx([1.01**0.5, 0.0])


def test_at_the_finest_resolution_the_error_is_the_temporal_difference() -> None:
    random = np.random.default_rng(1)
    q, targets = random.normal(size=(2, 3, 50))
    expected = np.sqrt(((targets - q) ** 2).mean(1))
    np.testing.assert_allclose(bvft_losses(q, targets, 1e-9), expected)


def test_the_tournament_selects_the_true_values_in_spite_of_noise() -> None:
    states, actions, rewards = lottery()
    true = PAYS[states, actions]
    q = np.stack([true + 1.0, true, np.full_like(true, PAYS.mean()), rewards.mean() - true])
    losses = bvft(q, np.stack([rewards] * 4), spread=float(rewards.std()))
    assert losses.argmin() == 1
    assert losses[0] == pytest.approx(1.0, abs=0.1)
    # The mean squared temporal difference of the true values is at least the variance of 4.
    assert losses[1] < 0.2 < 2 <= np.sqrt(((rewards - true) ** 2).mean())


def test_a_resolution_that_is_too_coarse_is_not_chosen() -> None:
    q = np.array([[0.0, 10.0], [5.0, 5.0]])
    targets = np.array([[0.0, 10.0]] * 2)
    # With the widest bins of 100, the two values of the first candidate are in one bin.
    assert bvft_losses(q, targets, 100.0).tolist() == [5.0, 0.0]
    assert bvft(q, targets, spread=100.0).tolist() == [0.0, 5.0]
    assert min(RESOLUTIONS) * 100 < 10


def test_regressed_targets_remove_the_noise_of_the_rewards() -> None:
    states, actions, rewards = lottery()
    true = PAYS[states, actions]
    q = np.stack([true + 1.0, true, np.full_like(true, PAYS.mean())])
    observations = np.eye(2, dtype=np.float32)[states]
    half = np.arange(len(states)) % 2 == 0
    found = sbv(q, np.stack([rewards] * 3), observations, actions, half, updates=300)
    # The errors are those of the mean rewards: 1, 0, and the standard deviation of PAYS.
    assert found.tolist() == pytest.approx([1.0, 0.0, float(PAYS.std())], abs=0.15)
    assert found.argmin() == 1


def test_each_half_is_compared_with_a_model_of_the_other() -> None:
    # The rewards of the two halves are 0 and 1, and a model of a half predicts that of the other.
    half = np.arange(400) % 2 == 0
    rewards = np.where(half, 0.0, 1.0)[None]
    observations = np.ones((400, 1), np.float32)
    actions = np.zeros(400, np.int64)
    assert sbv(rewards, rewards, observations, actions, half, updates=50)[0] == pytest.approx(1)

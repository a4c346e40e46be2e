"""Tests of the rule by which `auto` chooses, with numbers worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mcaprl.offline.selection.race import rate

HALF = {"a": np.full((1, 2), 0.5), "b": np.full((1, 2), 0.75)}


def test_the_estimate_is_the_mean_over_episodes_networks_and_models() -> None:
    values = {"a": np.array([[1.0, 3.0], [5.0, 7.0]]), "b": np.array([[2.0, 2.0]])}
    found = rate(values, HALF | {"a": np.full((2, 2), 0.5)}, imitate=False)
    assert (found["a"].value, found["a"].agreement, found["a"].score) == (4, 0.5, 4)
    assert (found["b"].value, found["b"].agreement, found["b"].score) == (2, 0.75, 2)
    assert found["b"].interval == (2, 2)
    assert list(found) == ["a", "b"]


def test_chances_of_two_episodes_by_hand() -> None:
    # There are four equally likely resamplings. In two of them, each episode occurs once, and a is
    # better than b by 1. If episode 0 occurs twice, a is worse by 2. If episode 1 occurs twice, a
    # is better by 4.
    values = {"a": np.array([[0.0, 4.0]]), "b": np.array([[2.0, 0.0]])}
    found = rate(values, HALF, imitate=False)
    assert found["a"].best_chance == pytest.approx(0.75, abs=0.05)
    assert found["a"].best_chance + found["b"].best_chance == 1
    assert found["a"].interval == (0, 4)


def test_a_log_of_a_deterministic_behavior_is_imitated() -> None:
    values = {"a": np.array([[0.0, 4.0]]), "b": np.array([[-9.0, -9.0]])}
    found = rate(values, HALF, imitate=True)
    assert list(found) == ["b", "a"]
    assert (found["b"].score, found["b"].value, found["b"].best_chance) == (0.75, -9, 1)


def test_a_difference_in_every_episode_is_certain() -> None:
    worse = np.random.default_rng(0).normal(0, 10, (1, 30))
    values = {"a": worse, "b": worse + 0.5}
    agreements = {name: np.ones((1, 30)) for name in values}
    found = rate(values, agreements, imitate=False)
    assert found["b"].value - found["a"].value == pytest.approx(0.5)
    assert found["b"].best_chance == 1

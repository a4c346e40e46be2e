"""The rule by which `auto` chooses, worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mcaprl.offline.selection.rule import Rating, choose, ranked, rate, survivors


def rating(value: float, over_default: float | None = None) -> Rating:
    return Rating(value, (value - 1, value + 1), 0.0, over_default)


def test_the_estimate_is_the_mean_over_episodes_networks_and_models() -> None:
    found = rate({"a": np.array([[1.0, 3.0], [5.0, 7.0]]), "b": np.array([[2.0, 2.0]])}, "b")
    assert found["a"].value == 4
    assert found["b"].value == 2
    assert found["b"].interval == (2, 2)


def test_chances_of_two_episodes_by_hand() -> None:
    # Of the four equally likely resamplings, two have one of each episode, so that a is better by
    # 1; the one with episode 0 twice makes it worse by 2, the one with episode 1 better by 4.
    found = rate({"a": np.array([[0.0, 4.0]]), "b": np.array([[2.0, 0.0]])}, "b")
    assert found["a"].over_default == pytest.approx(0.75, abs=0.05)
    assert found["a"].best_chance == found["a"].over_default
    assert found["a"].best_chance + found["b"].best_chance == 1
    assert found["b"].over_default == 0
    assert found["a"].interval == (0, 4)


def test_a_difference_in_every_episode_is_certain() -> None:
    random = np.random.default_rng(0)
    worse = random.normal(0, 10, (2, 30))
    found = rate({"default": worse, "better": worse + 0.5 * np.ones((2, 1))}, "default")
    assert found["better"].value - found["default"].value == pytest.approx(0.5)
    certain = rate({"default": worse[:1], "better": worse[:1] + 0.5}, "default")
    assert certain["better"].over_default == 1
    assert choose(certain, "default") == "better"


def test_the_default_is_chosen_unless_another_is_surely_better() -> None:
    close = {"default": rating(1, 0), "x": rating(2, 0.89), "y": rating(1.5, 0.95)}
    assert choose(close, "default") == "default"
    sure = {"default": rating(1, 0), "x": rating(2, 0.91)}
    assert choose(sure, "default") == "x"
    assert choose({"x": rating(2), "y": rating(3)}, "default") == "y"


def test_survivors_are_the_chosen_one_and_the_best_others() -> None:
    found = {
        "default": rating(1, 0),
        "x": rating(2, 0.5),
        "y": rating(1.5, 0.4),
        "z": rating(0, 0),
    }
    assert ranked(found) == ["x", "y", "default", "z"]
    assert survivors(found, "default", 2) == ["default", "x"]
    assert survivors(found, "default", 9) == ["default", "x", "y", "z"]

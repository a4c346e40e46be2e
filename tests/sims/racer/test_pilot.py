"""Tests of the pilot of the racer sim."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.support.sims import piloted


def test_it_drives_on_from_anywhere() -> None:
    ends = [piloted("racer", seed) for seed in range(100)]
    assert sum(reason == "time_limit" for _, reason, _ in ends) >= 98
    assert 150.0 < np.mean([total for total, _, _ in ends]) < 162.0


def test_continuous_actions_are_better() -> None:
    ends = [piloted("racer", seed, actions="continuous") for seed in range(100)]
    assert sum(reason == "time_limit" for _, reason, _ in ends) >= 99
    assert 161.0 < np.mean([total for total, _, _ in ends]) < 165.0


@pytest.mark.parametrize(
    "kwargs",
    [
        {"actions": 5},
        {"actions": 8},
        {"drift": True},
        {"track_seed": 0},
        {"track_seed": 1},
        {"actions": "continuous", "track_seed": 1},
    ],
)
def test_it_drives_by_other_actions_and_on_other_tracks(kwargs: dict[str, Any]) -> None:
    ends = [piloted("racer", seed, **kwargs) for seed in range(20)]
    assert sum(reason == "time_limit" for _, reason, _ in ends) >= 19


def test_it_races_by_the_classic_rules_for_10_000_steps() -> None:
    total, reason, _ = piloted("racer", 0, rules="classic")
    assert reason == "time_limit"
    assert total > 1_400.0

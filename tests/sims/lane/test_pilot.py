"""Tests of the pilot of the lane sim."""

from __future__ import annotations

import numpy as np
import pytest

from mcaprl.errors import UnknownNameError
from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.pilots import make_pilot
from mcaprl.sims.geometry.bicycle import moving
from mcaprl.sims.lane.pilot import HORIZON, choose, pursue, pursuit_value
from mcaprl.sims.lane.rules import ACTION_COMMANDS, DRIVING, drive, end_of, located
from tests.support.sims import piloted


def test_it_drives_on_from_anywhere() -> None:
    ends = [piloted("lane", seed, start="anywhere") for seed in range(100)]
    assert sum(reason == "time_limit" for _, reason, _ in ends) >= 98
    assert 145.0 < np.mean([total for total, _, _ in ends]) < 157.0


def test_it_laps_the_course_from_the_start_line() -> None:
    for seed in range(5):
        _, reason, infos = piloted("lane", seed, start="line")
        assert reason == "time_limit"
        assert infos[-1]["progress_m"] > 1026.0


def test_it_searches_where_pursuit_would_fail() -> None:
    """At 11.4 m/s, 8 m before a corner, it is too late to brake first and then turn."""
    car = located(moving(122.4, 1.0, 0.0, 11.4), 0.0, 122.4, 0.0)
    assert pursuit_value(car) < HORIZON
    assert choose(car) != pursue(car)
    for _ in range(HORIZON):
        car = drive(car, ACTION_COMMANDS[choose(car)])
        assert end_of(car) == DRIVING


def test_a_sim_without_a_pilot_says_so() -> None:
    with pytest.raises(UnknownNameError, match="environment with a pilot 'CartPole-v1'"):
        make_pilot(make_sim("CartPole-v1"))

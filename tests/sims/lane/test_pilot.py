"""Tests of the pilot of the lane sim."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mcaprl.errors import UnknownNameError
from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.evaluate import make_pilot
from mcaprl.sims.geometry import moving
from mcaprl.sims.lane.pilot import HORIZON, choose, pursue, pursuit_value, steer
from mcaprl.sims.lane.rules import ACTION_COMMANDS, DRIVING, drive, end_of, located, wheel_angle
from tests.support.sims import piloted


def test_it_drives_on_from_anywhere() -> None:
    ends = [piloted("lane", seed, start="anywhere") for seed in range(100)]
    assert sum(reason == "time_limit" for _, reason, _ in ends) >= 98
    assert 145.0 < np.mean([total for total, _, _ in ends]) < 157.0


def test_with_pedal_and_steering_it_drives_faster_and_smoothly() -> None:
    ends = [piloted("lane", seed, actions="continuous") for seed in range(100)]
    assert sum(reason == "time_limit" for _, reason, _ in ends) >= 99
    assert 200.0 < np.mean([total for total, _, _ in ends]) < 205.0


def test_it_commands_what_pursuit_wants() -> None:
    """On the path before a corner, the car brakes for it; after the corner, it accelerates."""
    straight = located(moving(60.0, 1.0, 0.0, 10.0), 0.0, 60.0, 0.0)
    assert steer(straight) == (1.0, 0.0)
    # The corner is 8 m ahead, hence 1 m is left to brake with 6 m/s^2 to 9 m/s.
    before = located(moving(122.0, 1.0, 0.0, 14.0), 0.0, 122.0, 0.0)
    assert steer(before).pedal == -1.0
    slower = located(moving(122.0, 1.0, 0.0, 10.5), 0.0, 122.0, 0.0)
    wanted_m_s = math.sqrt(9.0**2 + 2 * 6.0 * 1.0)
    assert steer(slower).pedal == pytest.approx((wanted_m_s - 10.5) / 0.25 / 8.0)
    right = located(moving(60.0, 0.0, 0.0, 10.0), 0.0, 60.0, 0.0)
    angle_rad = wheel_angle(steer(right).steering, 10.0)
    # The point to reach is 11 m ahead and 1 m to the left.
    ahead_m = math.sqrt(11.0**2 + 1.0)
    assert math.tan(angle_rad) == pytest.approx(2 * math.tan(math.asin(2.7 / ahead_m**2)))


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

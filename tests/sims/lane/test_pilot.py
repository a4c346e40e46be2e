"""Tests of the pilot of the lane sim."""

from __future__ import annotations

import numpy as np
import pytest

from mcaprl.errors import UnknownNameError
from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.pilots import make_pilot
from mcaprl.sims.geometry.bicycle import moving
from mcaprl.sims.lane.pilot import HORIZON, choose, pursue, pursuit_value
from mcaprl.sims.lane.rules import DRIVING, drive, end_of, located


def drive_through(start: str, seed: int) -> tuple[float, str, float]:
    """Let the pilot drive one episode; return its total reward, reason and progress in meters."""
    env = make_sim("lane", start=start)
    pilot = make_pilot(env)
    observation, info = env.reset(seed=seed)
    total, done = 0.0, False
    while not done:
        actions = pilot.act(observation[np.newaxis])
        observation, reward, terminated, truncated, info = env.step(actions[0])
        total, done = total + float(reward), terminated or truncated
    return total, info.get("reason", "time_limit"), info["progress_m"]


def test_it_drives_on_from_anywhere() -> None:
    ends = [drive_through("anywhere", seed) for seed in range(100)]
    assert sum(reason == "time_limit" for _, reason, _ in ends) >= 98
    assert 145.0 < np.mean([total for total, _, _ in ends]) < 157.0


def test_it_laps_the_course_from_the_start_line() -> None:
    for seed in range(5):
        _, reason, progress_m = drive_through("line", seed)
        assert reason == "time_limit"
        assert progress_m > 1026.0


def test_it_searches_where_pursuit_would_fail() -> None:
    """At 11.4 m/s, 8 m before a corner, it is too late to brake first and then turn."""
    car = located(moving(122.4, 1.0, 0.0, 11.4), 0.0, 122.4, 0.0)
    assert pursuit_value(car) < HORIZON
    assert choose(car) != pursue(car)
    for _ in range(HORIZON):
        car = drive(car, choose(car))
        assert end_of(car) == DRIVING


def test_its_actions_have_a_leading_dimension_of_one() -> None:
    env = make_sim("lane", observation="depth")
    observation, _ = env.reset(seed=0)
    pilot = make_pilot(env)
    actions = pilot.act(observation[np.newaxis])
    assert pilot.name == "pilot"
    assert actions.shape == (1,)
    assert actions.dtype == np.int64
    with pytest.raises(ValueError, match="not 2"):
        pilot.act(np.stack([observation, observation]))


def test_a_sim_without_a_pilot_says_so() -> None:
    with pytest.raises(UnknownNameError, match="environment with a pilot 'CartPole-v1'"):
        make_pilot(make_sim("CartPole-v1"))

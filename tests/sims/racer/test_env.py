"""Tests of the Gymnasium environment of the racer sim."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mcaprl.errors import UsageError
from tests.support.sims import unwrapped


def test_a_pose_is_kept() -> None:
    sim = unwrapped("racer")
    _, info = sim.reset(options={"pose": (5.0, 30.0, -math.pi / 2, 7.0)})
    place = sim.telemetry()
    assert (place["x_m"], place["y_m"]) == (5.0, 30.0)
    assert place["yaw_rad"] == pytest.approx(-math.pi / 2)
    assert place["speed_m_s"] == info["speed_m_s"] == 7.0
    assert place["lateral_offset_m"] == pytest.approx(0.0, abs=1e-6)
    sim.step(0)
    assert sim.telemetry()["y_m"] == pytest.approx(29.3)
    sim.reset(options={"pose": [5.0, 30.0, 0.3, -2.0]})
    assert sim.telemetry()["speed_m_s"] == -2.0


@pytest.mark.parametrize("seed", [-1, 1.5, "3", True])
def test_a_tracks_seed_is_a_whole_number(seed: Any) -> None:
    with pytest.raises(UsageError, match="track_seed must be None or an integer of at least 0"):
        unwrapped("racer", track_seed=seed)


def test_fewer_actions_are_some_of_the_nine() -> None:
    assert unwrapped("racer", actions=5).action_meanings == (
        "none",
        "forward",
        "left",
        "right",
        "back",
    )
    assert unwrapped("racer", actions=8).action_meanings == unwrapped("racer").action_meanings[1:]
    five, eight, nine = (unwrapped("racer", actions=count) for count in (5, 8, 9))
    for sim, action in ((five, 1), (eight, 0), (nine, 1)):
        sim.reset(options={"pose": (5.0, 30.0, -math.pi / 2)})
        sim.step(action)
        assert sim.telemetry()["speed_m_s"] == 2.0
    with pytest.raises(UsageError, match="actions are 0 to 4"):
        five.step(5)


def test_a_crash_terminates_and_costs_1() -> None:
    sim = unwrapped("racer")
    sim.reset(options={"pose": (4.0, 30.0, math.pi, 10.0)})
    sim.step(1)
    _, reward, terminated, truncated, info = sim.step(1)
    assert (reward, terminated, truncated, info["reason"]) == (-1.0, True, False, "crash")


def test_a_car_at_rest_is_truncated_after_100_steps() -> None:
    sim = unwrapped("racer", start="line")
    sim.reset(seed=0)
    results = [sim.step(0) for _ in range(100)]
    assert not any(terminated or truncated for _, _, terminated, truncated, _ in results[:-1])
    _, reward, terminated, truncated, info = results[-1]
    assert (reward, terminated, truncated, info["reason"]) == (0.0, False, True, "no_gate")


def test_gates_are_counted_and_rewarded() -> None:
    """On the straight after the start, gates are 6.6 m apart; the first one is 3.3 m away."""
    sim = unwrapped("racer")
    sim.reset(options={"pose": (5.0, 30.0, -math.pi / 2, 10.0)})
    rewards, counts = [], []
    for _ in range(12):
        _, reward, _, _, info = sim.step(0)
        rewards.append(reward)
        counts.append(info["gates_passed"])
    assert np.cumsum(rewards).tolist() == counts
    assert counts[-1] == 2
    assert info["progress_m"] == pytest.approx(12.0, abs=0.3)


def test_drift_bends_the_trajectory() -> None:
    ends = []
    for drift in (False, True):
        sim = unwrapped("racer", drift=drift)
        sim.reset(options={"pose": (5.0, 30.0, -math.pi / 2, 10.0)})
        for _ in range(2):
            sim.step(2)
        ends.append((sim.telemetry()["x_m"], sim.telemetry()["yaw_rad"]))
    assert ends[0][0] > ends[1][0]
    assert ends[0][1] == ends[1][1]

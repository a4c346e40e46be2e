"""Tests of the Gymnasium environment of the lane sim."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from mcaprl.sims import make_sim
from mcaprl.sims.drawing.depth import encode_depth
from mcaprl.sims.lane.course import COURSE
from tests.support.sims import unwrapped


def test_a_pose_is_kept() -> None:
    sim = unwrapped("lane")
    _, info = sim.reset(options={"pose": (130.0, -50.0, -math.pi / 2, 7.0)})
    expected = {
        "x_m": 130.0,
        "y_m": -50.0,
        "yaw_rad": -math.pi / 2,
        "speed_m_s": 7.0,
        "lateral_offset_m": 0.0,
        "heading_error_rad": 0.0,
        "progress_m": 0.0,
        "steering_rad": 0.0,
    }
    assert sim.telemetry().keys() == expected.keys()
    assert sim.telemetry() == pytest.approx(expected, abs=1e-12)
    assert info["speed_m_s"] == 7.0
    sim.reset(options={"pose": [130.0, -50.0, 0.0]})
    assert sim.telemetry()["speed_m_s"] == 0.0


def last_step(env: gym.Env[Any, Any], action: int) -> tuple[float, bool, bool, dict[str, Any]]:
    """Repeat one action until the episode ends."""
    while True:
        _, reward, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return float(reward), terminated, truncated, info


def test_leaving_the_lane_and_stalling_are_named_and_cost_5() -> None:
    env = make_sim("lane")
    env.reset(options={"pose": (50.0, 1.0, 0.0, 8.0)})
    assert last_step(env, 3)[:3] == (-5.0, True, False)
    env.reset(options={"pose": (50.0, 1.0, 0.0, 8.0)})
    assert last_step(env, 3)[3]["reason"] == "off_lane"
    env.reset(options={"pose": (50.0, 1.0, 0.0, 8.0)})
    assert last_step(env, 0)[3]["reason"] == "stall"


def test_progress_counts_along_the_path() -> None:
    sim = unwrapped("lane")
    sim.reset(options={"pose": (20.0, 1.0, 0.0, 8.0)})
    total = 0.0
    for _ in range(20):
        _, reward, _, _, info = sim.step(1)
        total += float(reward)
    assert info["progress_m"] == pytest.approx(sim.telemetry()["x_m"] - 20.0)
    assert total == pytest.approx(info["progress_m"] / 7.5)


@pytest.mark.parametrize(
    ("along_m", "turn"),
    [(10.0, -1), (129.9, -1), (130.1, -1), (511.0, -1), (513.0, 1), (1025.9, 1)],
)
def test_a_dashboard_has_speed_steering_and_the_next_turn(along_m: float, turn: int) -> None:
    # The course passes the shared street twice. The first passage ends with a right turn. The
    # second passage, 512 m later, ends with a left turn.
    sim = unwrapped("lane", observation="dashboard")
    sim.reset(seed=4)
    sim.fleet._cars[0, 5] = along_m + 3 * COURSE.length_m
    sim.fleet._cars[0, 3] = 15.0
    seen = sim.fleet.observation(0)
    assert seen["depth"].tobytes() == encode_depth(sim.depth_image_m()).tobytes()
    assert seen["motion"][2] == turn
    moved, *_ = sim.step(3)
    assert moved["motion"][1] == 1.0, "50 % to the left"
    assert moved["motion"][0] == pytest.approx(sim.car.speed_m_s / 30)


def test_the_last_commands_are_observed_beside_the_image() -> None:
    sim = unwrapped("lane", observation="depth-commands")
    seen, _ = sim.reset(options={"pose": (2.0, 1.0, 0.0, 5.0)})
    assert seen["depth"].tobytes() == encode_depth(sim.depth_image_m()).tobytes()
    assert seen["commands"].shape == (64,)
    assert not seen["commands"].any(), "no decision yet"
    # Commands of four actions: left, brake (which keeps the steering), slightly right, straight.
    expected = [1.0, 1.0], [-1.0, 1.0], [1.0, -0.5], [1.0, 0.0]
    for step, action in enumerate((3, 0, 4, 1), start=1):
        before = seen["commands"].copy()
        seen, *_ = sim.step(action)
        newest_first = np.ravel(expected[:step][::-1])
        np.testing.assert_array_equal(seen["commands"][: 2 * step], newest_first)
        assert not seen["commands"][2 * step :].any()
    np.testing.assert_array_equal(before, [1.0, -0.5, -1.0, 1.0, 1.0, 1.0, *[0.0] * 58])
    sim.reset(seed=0)
    assert not sim.fleet.observation(0)["commands"].any(), "another episode"


def test_commands_of_more_than_32_decisions_ago_are_not_observed() -> None:
    sim = unwrapped("lane", observation="depth-commands")
    sim.reset(seed=0)
    for action in (0, 2, *[3] * 31):
        seen, *_ = sim.step(action)
    np.testing.assert_array_equal(seen["commands"], [1.0, 1.0] * 31 + [1.0, -1.0])
    seen, *_ = sim.step(3)
    np.testing.assert_array_equal(seen["commands"], [1.0, 1.0] * 32)

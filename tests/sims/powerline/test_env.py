"""Tests of the Gymnasium environment of the powerline sim."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mcaprl.errors import UsageError
from mcaprl.sims.drawing.depth import encode_nearness
from mcaprl.sims.powerline.course import LENGTH_M, POINTS_M, point_on_line
from mcaprl.sims.powerline.env import PowerlineEnv
from tests.support.sims import unwrapped

NORTH, DOWN, NOTHING = 0, 2, 6


def last_step(sim: PowerlineEnv, action: int) -> tuple[float, str]:
    """Repeat one action until the episode ends; return the last reward and the reason."""
    while True:
        _, reward, terminated, _, info = sim.step(action)
        if terminated:
            return reward, info["reason"]


def test_starts_on_the_line_are_near_the_published_one() -> None:
    """The drone has flown from the first point for 5 s, less about 0.4 s of lag."""
    sim = unwrapped("powerline", start="line")
    for seed in range(20):
        sim.reset(seed=seed)
        flight = sim.flight
        flown = np.subtract(flight.drone.position_m, POINTS_M[0])
        np.testing.assert_allclose(flown, [4.6, -2.3, -4.6], atol=0.25)
        assert flight.command_m_s == (1.0, -0.5, -1.0)
        assert flight.drone.velocity_m_s == pytest.approx((1.0, -0.5, -1.0), abs=0.01)


def test_random_starts_are_where_the_card_says() -> None:
    sim = unwrapped("powerline")
    along, at_first = [], 0
    for seed in range(200):
        _, info = sim.reset(seed=seed)
        assert info["line_distance_m"] <= 1.3
        assert info["progress_m"] == 0.0
        assert info["speed_m_s"] <= 5.5
        command = np.array(sim.flight.command_m_s)
        np.testing.assert_array_equal(command, np.rint(2 * command) / 2)
        at_first += sim.flight.furthest_m < 8.5 and tuple(command) == (1.0, -0.5, -1.0)
        along.append(sim.flight.furthest_m)
    assert 75 <= at_first <= 125
    assert max(along) > 500.0
    assert max(along) <= LENGTH_M - 19.0


def test_a_pose_is_kept_and_reported_in_ros_axes() -> None:
    sim = unwrapped("powerline")
    point = point_on_line(150.0)
    pose = (point.x, point.y + 2.0, point.z - 1.0, 3.0, 0.0, 0.0)
    _, info = sim.reset(options={"pose": pose})
    telemetry = sim.telemetry()
    assert sim.flight.drone.position_m == pose[:3]
    assert (telemetry["x_m"], telemetry["y_m"], telemetry["z_m"]) == (pose[0], -pose[1], -pose[2])
    assert telemetry["speed_m_s"] == info["speed_m_s"] == 3.0
    # The drone is 2 m east of a line that leads north. This is to the right, which is negative. A
    # higher position is positive.
    assert telemetry["lateral_offset_m"] < -1.9
    assert telemetry["vertical_offset_m"] == pytest.approx(1.0, abs=0.15)
    assert telemetry["line_distance_m"] == pytest.approx(math.sqrt(5.0), abs=0.1)
    assert telemetry["tilt_rad"] == 0.0
    assert telemetry["wire_distance_m"] > 6.0
    assert telemetry["height_m"] > 25.0
    sim.reset(options={"pose": pose[:3]})
    assert sim.telemetry()["speed_m_s"] == 0.0


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"wind_m_s": -1.0}, "wind_m_s must be 0 to 8, not -1.0"),
        ({"wind_m_s": math.nan}, "wind_m_s must be 0 to 8, not nan"),
        ({"gust_m_s": 4.0}, "gust_m_s must be 0 to 3, not 4.0"),
        ({"gust_m_s": 1.0, "rules": "classic"}, "gust_m_s must be 0 to 0, not 1.0"),
    ],
)
def test_a_number_out_of_range_is_refused(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        unwrapped("powerline", **kwargs)


def test_ends_have_names_and_rewards() -> None:
    sim = unwrapped("powerline")
    middle, near_end = point_on_line(150.0), point_on_line(LENGTH_M - 4.0)
    sim.reset(options={"pose": tuple(middle)})
    assert last_step(sim, NORTH + 1) == (-5.0, "off_line")
    sim.reset(options={"pose": tuple(point_on_line(76.0))})
    assert last_step(sim, DOWN) == (-5.0, "collision")
    tangent = np.subtract(point_on_line(LENGTH_M - 3.0), near_end)
    sim.reset(options={"pose": (*near_end, *(2.0 * tangent))})
    reward, reason = last_step(sim, NOTHING)
    assert reason == "finished"
    assert 5.0 < reward <= 6.0


def test_progress_is_rewarded_once() -> None:
    """Flying back and forth is not rewarded again for the same progress."""
    sim = unwrapped("powerline", plant="point")
    point = point_on_line(150.0)
    sim.reset(options={"pose": tuple(point)})
    rewards = [sim.step(action)[1] for action in (0, 0, 3, 3, 3, 3, 0, 0, 6)]
    assert rewards[0] > 0.0
    assert rewards[5:8] == [0.0] * 3
    assert sim.telemetry()["progress_m"] < sim.flight.furthest_m - 150.0 + 1e-9


def test_the_motion_is_observed_beside_the_image() -> None:
    sim = unwrapped("powerline", observation="depth")
    sim.reset(seed=4)
    moved, *_ = sim.step(1)
    flight = sim.flight
    velocity = np.array(flight.drone.velocity_m_s)
    expected = [*(velocity / 5.0), *(np.array(flight.command_m_s) - velocity)]
    np.testing.assert_allclose(moved["motion"], expected, atol=1e-6)


def test_the_classic_image_has_the_published_code() -> None:
    """The code is 255 / max(1, d), rounded down, or 0 without a surface."""
    meters = np.array([0.3, 1.0, 2.0, 6.0, 300.0, np.inf])
    assert encode_nearness(meters).tolist() == [255, 255, 127, 42, 0, 0]
    sim = unwrapped("powerline", rules="classic", observation="depth")
    seen, _ = sim.reset(seed=0)
    assert seen.shape == (84, 84, 1)
    np.testing.assert_array_equal(seen[:, :, 0], encode_nearness(sim.depth_image_m()))


def test_wind_is_drawn_for_each_episode_and_gusts_for_each_step() -> None:
    sim = unwrapped("powerline", wind_m_s=5.0, gust_m_s=1.0)
    winds = []
    for seed in range(50):
        sim.reset(seed=seed)
        winds.append(sim.flight.wind_m_s)
    speeds = np.linalg.norm(np.array(winds), axis=1)
    assert speeds.max() <= 5.0
    assert 1.5 < speeds.mean() < 3.5
    assert np.all(np.array(winds)[:, 2] == 0.0)
    gusts = []
    for _ in range(3):
        sim.step(NOTHING)
        gusts.append(sim.flight.gust_m_s)
    assert len(set(gusts)) == 3


def test_a_hover_holds_its_place_in_wind() -> None:
    """In a steady wind of at most 5 m/s, the drone moves less than 1 m in 10 s."""
    sim = unwrapped("powerline", wind_m_s=5.0)
    start = point_on_line(300.0)
    for seed in range(5):
        sim.reset(seed=seed, options={"pose": tuple(start)})
        for _ in range(20):
            sim.step(NOTHING)
        drone = sim.flight.drone
        assert np.linalg.norm(np.subtract(drone.position_m, start)) < 1.0
        assert np.linalg.norm(drone.velocity_m_s) < 0.01

"""Tests of the highway-lane sim, whose physics and rewards are those of highway-env."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
import pytest
from highway_env.envs.lane_keeping_env import LaneKeepingEnv
from highway_env.envs.racetrack_env import RacetrackEnv

from mcaprl.errors import MissingExtraError, UsageError
from mcaprl.sims import make_sim, make_sims
from mcaprl.sims.highway.env import (
    ACTION_MEANINGS,
    LOOKAHEADS_M,
    OBSERVATION_NAMES,
    ROADS,
    STEERING_RAD,
    HighwayPilot,
)
from tests.support.sims import unwrapped

TRACK = "racetrack-v0"
ON_THE_TRACK = (60.0, 0.0, 0.0)
"""18 m into the straight of the racetrack's first lane."""


@pytest.mark.parametrize(
    ("road", "theirs", "range_rad"),
    [("lane-keeping-v0", LaneKeepingEnv, math.pi / 3), (TRACK, RacetrackEnv, math.pi / 4)],
)
def test_it_drives_as_highway_env_does(road: str, theirs: Any, range_rad: float) -> None:
    """The same seed and steering give bit-identical results, except for the sign of y."""
    ours, inner = unwrapped("highway-lane", road=road, start="line"), theirs()
    ours.reset(seed=4)
    inner.reset(seed=4)
    for action in [0, 3, 4, 0, 4, 2, 1, 0]:
        _, reward, terminated, _, _ = ours.step(action)
        share = -STEERING_RAD[action] / range_rad
        _, expected, _, _, _ = inner.step(np.array([share]))
        assert not terminated
        assert reward == expected
        assert (ours.car.x_m, -ours.car.y_m) == tuple(inner.vehicle.position)
        assert ours.car.yaw_rad == -inner.vehicle.heading
        assert ours.car.speed_m_s == inner.vehicle.speed
        others = [v.position for v in inner.road.vehicles if v is not inner.vehicle]
        assert [(car.x_m, -car.y_m) for car in ours.others] == [tuple(other) for other in others]


@pytest.mark.parametrize("action", range(len(ACTION_MEANINGS)))
def test_actions_turn_in_the_named_direction(action: int) -> None:
    sim = unwrapped("highway-lane", road=TRACK)
    sim.reset(seed=0, options={"pose": ON_THE_TRACK})
    sim.step(action)
    meaning = ACTION_MEANINGS[action]
    assert (sim.car.yaw_rad > 0) == ("left" in meaning)
    assert (sim.car.yaw_rad < 0) == ("right" in meaning)


def test_observation_by_hand() -> None:
    """The car is on a straight of the racetrack, 1 m and 0.1 rad to the left, at 8 m/s."""
    sim = unwrapped("highway-lane", road=TRACK)
    seen, info = sim.reset(seed=0, options={"pose": (50.0, 1.0, 0.1, 8.0)})
    values = dict(zip(OBSERVATION_NAMES, seen.tolist(), strict=True))
    assert values["offset"] == pytest.approx(1.0 / 2.5)
    assert values["heading_error"] == pytest.approx(0.1 / (math.pi / 2))
    assert values["speed"] == pytest.approx(0.8)
    assert values["lateral_speed"] == values["yaw_rate"] == 0.0
    for ahead in LOOKAHEADS_M:
        forward = (ahead * math.cos(0.1) - math.sin(0.1)) / ahead
        left = (-math.cos(0.1) - ahead * math.sin(0.1)) / ahead
        assert values[f"forward_{ahead:.0f}m"] == pytest.approx(forward, abs=1e-6)
        assert values[f"left_{ahead:.0f}m"] == pytest.approx(left, abs=1e-6)
    assert info["lateral_offset_m"] == pytest.approx(1.0)
    assert info["heading_error_rad"] == pytest.approx(0.1)


def test_another_car_is_seen_where_it_is() -> None:
    sim = unwrapped("highway-lane", road=TRACK)
    sim.reset(seed=0, options={"pose": ON_THE_TRACK})
    (other,) = sim.others
    # The other car is 8 m back and 1.5 m to the right, with the same heading.
    cos, sin = math.cos(other.yaw_rad), math.sin(other.yaw_rad)
    x_m, y_m = other.x_m - 8 * cos + 1.5 * sin, other.y_m - 8 * sin - 1.5 * cos
    seen, _ = sim.reset(seed=0, options={"pose": (x_m, y_m, other.yaw_rad)})
    assert seen[-2:] == pytest.approx([8 / 50, 1.5 / 50], abs=1e-6)
    assert unwrapped("highway-lane").reset(seed=0)[0][-2:].tolist() == [1.0, 0.0]


def test_progress_is_what_was_driven_and_grows_over_the_laps() -> None:
    sim = unwrapped("highway-lane", road=TRACK)
    pilot = HighwayPilot(sim)
    seen, _ = sim.reset(seed=0, options={"pose": ON_THE_TRACK})
    for step in range(250):
        seen, _, terminated, _, info = sim.step(pilot.act(seen[np.newaxis])[0])
        assert not terminated
        if step == 4:
            assert info["progress_m"] == pytest.approx(10.0, abs=0.2)
    # The car drives 50 s at 10 m/s, partly on the outer lane.
    assert 430.0 < info["progress_m"] < 520.0
    assert info["progress_m"] > sim.courses[0].length_m


def test_leaving_the_lane_ends() -> None:
    sim = unwrapped("highway-lane")
    sim.reset(seed=0)
    reasons = []
    for _ in range(100):
        _, _, terminated, truncated, info = sim.step(1)
        reasons.append(info.get("reason"))
        if terminated:
            break
    assert (reasons[-1], truncated) == ("off_lane", False)
    assert abs(info["lateral_offset_m"]) > 5.0
    assert set(reasons[:-1]) == {None}


def test_the_end_of_the_road_ends_an_episode() -> None:
    sim = unwrapped("highway-lane")
    x_m, y_m = sim.courses[0].point(sim.courses[0].length_m - 6.0)
    sim.reset(options={"pose": (x_m, y_m, 0.3)})
    _, _, terminated, _, info = sim.step(0)
    _, _, terminated, _, info = sim.step(0)
    assert (terminated, info["reason"]) == (True, "finished")


def test_a_collision_ends_an_episode() -> None:
    sim = unwrapped("highway-lane", road=TRACK)
    sim.reset(seed=0, options={"pose": ON_THE_TRACK})
    (other,) = sim.others
    x_m = other.x_m - 6.5 * math.cos(other.yaw_rad)
    y_m = other.y_m - 6.5 * math.sin(other.yaw_rad)
    sim.reset(seed=0, options={"pose": (x_m, y_m, other.yaw_rad, 15.0)})
    for _ in range(5):
        _, _, terminated, _, info = sim.step(0)
        if terminated:
            break
    assert (terminated, info["reason"]) == (True, "collision")


def test_highway_envs_own_limit_truncates() -> None:
    """A racetrack is truncated after 300 s."""
    sim = unwrapped("highway-lane", road=TRACK)
    pilot = HighwayPilot(sim)
    seen, _ = sim.reset(seed=0)
    sim._inner.time = 299.5
    for _ in range(3):
        seen, _, terminated, truncated, info = sim.step(pilot.act(seen[np.newaxis])[0])
    assert (terminated, truncated, info["reason"]) == (False, True, "time_limit")


@pytest.mark.parametrize("road", ROADS)
def test_starts_are_on_the_road_and_clear_of_others(road: str) -> None:
    sim = unwrapped("highway-lane", road=road)
    alongs = []
    for seed in range(30):
        _, info = sim.reset(seed=seed)
        assert abs(info["lateral_offset_m"]) <= 1.51
        # A start is up to 0.2 rad off. The tolerance adds half the turn between two samples of the
        # course in the tightest bend.
        assert abs(info["heading_error_rad"]) <= 0.25
        for other in sim.others:
            assert math.hypot(other.x_m - sim.car.x_m, other.y_m - sim.car.y_m) > 20.0
        alongs.append(sim.place.along_m)
    assert max(alongs) - min(alongs) > 0.6 * sim.courses[0].length_m


def test_a_pose_has_highway_envs_speed_unless_it_says_another() -> None:
    sim = unwrapped("highway-lane")
    x_m, y_m = sim.courses[0].point(100.0)
    assert sim.reset(options={"pose": (x_m, y_m, 0.0)})[1]["speed_m_s"] == 8.3
    assert sim.reset(options={"pose": (x_m, y_m, 0.0, 5.0)})[1]["speed_m_s"] == 5.0
    assert (sim.car.x_m, sim.car.y_m) == (x_m, y_m)


def test_a_pose_in_another_car_is_refused() -> None:
    sim = unwrapped("highway-lane", road=TRACK)
    sim.reset(seed=0)
    (other,) = sim.others
    with pytest.raises(UsageError, match="is occupied by another car"):
        sim.reset(seed=0, options={"pose": (other.x_m, other.y_m, 0.0)})


def test_without_highway_env_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "highway_env", None)
    with pytest.raises(MissingExtraError, match=r"highway_env is not .*'mcaprl\[sims\]'"):
        make_sim("highway-lane")


def test_it_keeps_no_states_of_earlier_episodes() -> None:
    """Each reset clears highway-env's list of states."""
    sim = unwrapped("highway-lane")
    for seed in range(3):
        sim.reset(seed=seed)
        sim.step(0)
    assert len(sim._inner.trajectory) == 1


def test_each_road_decides_at_its_own_rate() -> None:
    assert [unwrapped("highway-lane", road=road).step_duration_s for road in ROADS] == [
        0.1,
        0.2,
        0.2,
    ]


def test_many_are_stepped_one_after_the_other() -> None:
    """Environment i has the same results as a single environment with the i-th seed."""
    many, alone = make_sims("highway-lane", 2), unwrapped("highway-lane")
    seen, _ = many.reset(seed=7)
    for row, seed in enumerate((7, 8)):
        np.testing.assert_array_equal(seen[row], alone.reset(seed=seed)[0])
    seen, rewards, _, _, infos = many.step(np.array([4, 4]))
    expected, reward, _, _, info = alone.step(4)
    np.testing.assert_array_equal(seen[1], expected)
    assert (rewards[1], infos["progress_m"][1]) == (reward, info["progress_m"])


@pytest.mark.parametrize("road", ROADS)
def test_the_view_from_above_shows_the_whole_road(road: str) -> None:
    sim = unwrapped("highway-lane", road=road)
    points_m = np.concatenate([course.points_m for course in sim.courses])
    view = sim.view_settings
    off_m = np.abs(points_m - [view["world_x_m"], view["world_y_m"]]).max(axis=0)
    # The panel is twice as wide as it is high.
    assert off_m[0] <= view["world_m"]
    assert off_m[1] <= view["world_m"] / 2
    assert view["world_m"] < 1.3 * max(off_m[0], 2 * off_m[1])

"""Tests of the Gymnasium environment of the racer sim."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.sims import make_sim
from mcaprl.sims.racer.env import RacerEnv


def racer(**kwargs: Any) -> RacerEnv:
    """Return the sim without wrappers."""
    sim = make_sim("racer", **kwargs).unwrapped
    assert isinstance(sim, RacerEnv)
    return sim


def test_random_starts_are_where_the_card_says() -> None:
    sim = racer()
    for seed in range(200):
        _, info = sim.reset(seed=seed)
        # The path is a polyline, so offsets differ slightly from those of the spline.
        assert abs(info["lateral_offset_m"]) <= 1.2 + 0.05
        assert abs(info["heading_error_rad"]) <= 0.2 + 0.12
        assert 0.0 <= info["speed_m_s"] <= 6.0
        assert (info["progress_m"], info["gates_passed"]) == (0.0, 0)


def test_starts_on_the_line_are_near_it_and_not_all_the_same() -> None:
    sim = racer(start="line")
    places = []
    for seed in range(20):
        sim.reset(seed=seed)
        places.append(sim.telemetry())
    assert all(abs(place["x_m"] - 5.0) <= 0.3 for place in places)
    assert all(abs(place["y_m"] - 30.0) <= 0.02 for place in places)
    assert all(abs(place["yaw_rad"] + math.pi / 2) <= 0.05 for place in places)
    assert len({place["x_m"] for place in places}) == 20


def test_a_pose_is_kept() -> None:
    sim = racer()
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


@pytest.mark.parametrize("place", [(20.0, 30.0), (1.0, 30.0), (-50.0, 0.0)])
def test_a_pose_beside_the_track_or_in_a_wall_is_refused(place: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match="must be inside the walls at 4\\.15 m"):
        racer().reset(options={"pose": (*place, -math.pi / 2)})


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"rules": "clasic"}, "did you mean classic\\? known: classic, default"),
        ({"observation": "depth"}, "unknown observation 'depth': known: rays"),
        ({"start": "pole"}, "known: None, anywhere, line"),
        ({"actions": 7}, "unknown number of actions '7': known: 5, 8, 9"),
        ({"drift": "yes"}, "unknown drift 'yes': known: False, True"),
        ({"render_mode": "ansi"}, "known: None, human, rgb_array"),
    ],
)
def test_an_unknown_value_is_refused(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(UnknownNameError, match=words):
        RacerEnv(**kwargs)


@pytest.mark.parametrize("seed", [-1, 1.5, "3", True])
def test_a_tracks_seed_is_a_whole_number(seed: Any) -> None:
    with pytest.raises(UsageError, match="track_seed must be None or an integer of at least 0"):
        racer(track_seed=seed)


def test_fewer_actions_are_some_of_the_nine() -> None:
    assert racer(actions=5).action_meanings == ("none", "forward", "left", "right", "back")
    assert racer(actions=8).action_meanings == racer().action_meanings[1:]
    five, eight, nine = (racer(actions=count) for count in (5, 8, 9))
    for sim, action in ((five, 1), (eight, 0), (nine, 1)):
        sim.reset(options={"pose": (5.0, 30.0, -math.pi / 2)})
        sim.step(action)
        assert sim.telemetry()["speed_m_s"] == 2.0
    with pytest.raises(UsageError, match="actions are 0 to 4"):
        five.step(5)


def test_a_crash_terminates_and_costs_1() -> None:
    sim = racer()
    sim.reset(options={"pose": (4.0, 30.0, math.pi, 10.0)})
    sim.step(1)
    _, reward, terminated, truncated, info = sim.step(1)
    assert (reward, terminated, truncated, info["reason"]) == (-1.0, True, False, "crash")


def test_a_car_at_rest_is_truncated_after_100_steps() -> None:
    sim = racer(start="line")
    sim.reset(seed=0)
    results = [sim.step(0) for _ in range(100)]
    assert not any(terminated or truncated for _, _, terminated, truncated, _ in results[:-1])
    _, reward, terminated, truncated, info = results[-1]
    assert (reward, terminated, truncated, info["reason"]) == (0.0, False, True, "no_gate")


def test_gates_are_counted_and_rewarded() -> None:
    """On the straight after the start, gates are 6.6 m apart; the first one is 3.3 m away."""
    sim = racer()
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
        sim = racer(drift=drift)
        sim.reset(options={"pose": (5.0, 30.0, -math.pi / 2, 10.0)})
        for _ in range(2):
            sim.step(2)
        ends.append((sim.telemetry()["x_m"], sim.telemetry()["yaw_rad"]))
    assert ends[0][0] > ends[1][0]
    assert ends[0][1] == ends[1][1]


def test_the_limit_can_be_set_as_in_any_environment() -> None:
    env = make_sim("racer", max_episode_steps=3)
    env.reset(options={"pose": (5.0, 30.0, -math.pi / 2)})
    assert [env.step(0)[3] for _ in range(3)] == [False, False, True]

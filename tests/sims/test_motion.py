"""Tests of the frames within a step: at most 0.05 s apart, and without effect on the step."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from mcaprl.recorder.record.scene import MotionSource
from mcaprl.sims import make_sim
from mcaprl.sims.drawing.shapes import arc

CASES = [
    ("lane", {}, 4),
    ("lane", {"rules": "classic"}, 19),
    ("lane", {"actions": "continuous"}, 4),
    ("powerline", {"gust_m_s": 1.0}, 9),
    ("powerline", {"plant": "point"}, 9),
    ("powerline", {"actions": "increments"}, 9),
    ("powerline", {"rules": "classic"}, 99),
    ("powerline", {"rules": "classic", "plant": "quad"}, 99),
    ("racer", {}, 1),
    ("highway-lane", {}, 1),
    ("highway-lane", {"road": "racetrack-v0"}, 3),
]
every_case = pytest.mark.parametrize(("sim", "arguments", "count"), CASES)
EPISODES = 3


def steps(env: Any, *, watched: bool) -> list[Any]:
    """Return all results of random episodes; a watched environment is drawn at each step."""
    env.action_space.seed(0)
    results = []
    for seed in range(EPISODES):
        observation, _ = env.reset(seed=seed)
        results.append(observation)
        if watched:
            env.unwrapped.scene()
            assert not env.unwrapped.motion()
        ended = False
        while not ended:
            *result, _ = env.step(env.action_space.sample())
            ended = result[2] or result[3]
            results.append(result)
            if watched:
                env.unwrapped.motion()
    return results


@every_case
def test_watching_changes_no_step(sim: str, arguments: dict[str, Any], count: int) -> None:
    seen, unseen = (steps(make_sim(sim, **arguments), watched=watched) for watched in (True, False))
    np.testing.assert_equal(seen, unseen)


@every_case
def test_moments_are_close_and_in_order(sim: str, arguments: dict[str, Any], count: int) -> None:
    env: Any = make_sim(sim, **arguments)
    env.action_space.seed(1)
    inner: Any = env.unwrapped
    assert isinstance(env.unwrapped, MotionSource)
    env.reset(seed=1)
    inner.scene()
    before = inner.frames()
    for _ in range(3):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        left_s, between = zip(*inner.motion(), strict=True)
        assert len(left_s) == count
        apart_s = -np.diff([inner.step_duration_s, *left_s, 0.0])
        np.testing.assert_allclose(apart_s, inner.step_duration_s / (count + 1))
        assert apart_s.max() <= 0.05 + 1e-12
        # The car does not jump: it moves 0.5 m in 0.05 s at 10 m/s.
        way = [np.array(frames[0].position) for frames in (before, *between, inner.frames())]
        assert max(np.linalg.norm(b - a) for a, b in pairwise(way)) < 0.6
        before = inner.frames()
        if terminated or truncated:
            break


@pytest.mark.parametrize(
    ("sim", "arguments"), [case[:2] for case in CASES if case[0] in ("lane", "powerline")]
)
def test_repeated_steps_end_at_the_state_bit_for_bit(sim: str, arguments: dict[str, Any]) -> None:
    env: Any = make_sim(sim, **arguments)
    env.action_space.seed(2)
    inner = env.unwrapped
    for seed in range(EPISODES):
        env.reset(seed=seed)
        inner.scene()
        ended = False
        while not ended:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            assert inner._moments(*inner._last_step)[-1] == inner.frames()
            ended = terminated or truncated


def test_a_collision_within_a_decision_stops_the_drone() -> None:
    env: Any = make_sim("powerline", start="line")
    inner = env.unwrapped
    env.reset(seed=0)
    inner.scene()
    terminated = False
    while not terminated:
        # The drone flies down at up to 8 m/s, until it hits the ground or is too far from the line.
        _, _, terminated, _, _ = env.step(2)
    way = [frames[0].position for _, frames in inner.motion()] + [inner.frames()[0].position]
    stays = [a == b for a, b in pairwise(way)]
    assert stays == sorted(stays), "the drone moves, and then it stays"


def test_an_arc_by_hand() -> None:
    """The arc is a quarter of a circle of radius 1 to the left, from (0, 0) in direction x."""
    end = (1.0, 1.0, math.pi / 2)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(arc((0.0, 0.0, 0.0), end, 0.5), (half, 1.0 - half, math.pi / 4))
    np.testing.assert_allclose(arc((0.0, 0.0, 0.0), end, 1.0), end)
    np.testing.assert_allclose(arc((0.0, 0.0, 0.0), end, 0.0), (0.0, 0.0, 0.0), atol=1e-15)
    # Without a turn, the way is straight. Across +-pi, the shorter turn is used.
    np.testing.assert_allclose(arc((1.0, 2.0, 0.5), (3.0, 2.0, 0.5), 0.25), (1.5, 2.0, 0.5))
    assert abs(arc((0.0, 0.0, 3.1), (1.0, 0.0, -3.1), 0.5)[2]) == pytest.approx(math.pi)

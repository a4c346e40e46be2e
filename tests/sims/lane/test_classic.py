"""Tests of the published rules of the lane sim: numbers worked by hand, and known faults."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.evaluate import make_pilot
from mcaprl.sims.geometry import moving
from mcaprl.sims.lane.classic import (
    classic_decide,
    classic_distance,
    classic_end,
    classic_reward,
)
from mcaprl.sims.lane.course import COURSE
from mcaprl.sims.lane.env import LaneKeepingEnv
from mcaprl.sims.lane.rules import (
    ACTION_COMMANDS,
    BRAKE,
    COLLISION,
    DRIVING,
    LOW_REWARD,
    OFF_LANE,
    SLOW,
    located,
)

STRAIGHT, RIGHT, LEFT, SLIGHTLY_RIGHT, SLIGHTLY_LEFT = range(1, 6)


def lane(rules: str = "classic", **kwargs: Any) -> LaneKeepingEnv:
    sim = make_sim("lane", rules=rules, **kwargs).unwrapped
    assert isinstance(sim, LaneKeepingEnv)
    sim.reset(seed=0)
    return sim


@pytest.mark.parametrize(
    ("x_m", "y_m", "speed_m_s", "action", "hit", "reward", "text", "code"),
    [
        # At distance d and speed v, the reward is (e^-3d - .5) + ((v - 10) / 290 - .5). In the
        # middle, it is 0 at 10 m/s, and -10 / 290 at rest.
        (60.0, 1.0, 10.0, STRAIGHT, False, 0.0, DRIVING, DRIVING),
        (60.0, 1.0, 0.0, BRAKE, False, -0.034483, DRIVING, DRIVING),
        # By the published text, 5 m/s or less is too slow, unless the action is the brake.
        (60.0, 1.0, 0.0, STRAIGHT, False, -0.034483, SLOW, DRIVING),
        (60.0, 1.0, 5.0, LEFT, False, -0.017241, SLOW, DRIVING),
        (60.0, 1.0, 5.1, LEFT, False, -0.016897, DRIVING, DRIVING),
        # In the middle at the maximum speed of 30 m/s, the reward is 20 / 290.
        (60.0, 1.0, 30.0, STRAIGHT, False, 0.068966, DRIVING, DRIVING),
        # 0.5 m beside the line, at 10 m/s: e^-1.5 - 1.
        (60.0, 1.5, 10.0, STRAIGHT, False, -0.776870, DRIVING, DRIVING),
        # 1 m beside the line, at 20 m/s: e^-3 - 1 + 10 / 290.
        (130.0 + 1.0, -60.0, 20.0, RIGHT, False, -0.915730, DRIVING, DRIVING),
        # 3.4 m beside the line, at 20 m/s: e^-10.2 - 1 + 10 / 290, which is above -1. At 9 m/s, the
        # reward is below -1.
        (60.0, 4.4, 20.0, STRAIGHT, False, -0.965480, DRIVING, DRIVING),
        (60.0, 4.4, 9.0, STRAIGHT, False, -1.003411, LOW_REWARD, LOW_REWARD),
        # At rest, the reward reaches -1 at ln(29) / 3 = 1.1224 m, because e^-3d is 10 / 290 there.
        (60.0, 2.122, 0.0, BRAKE, False, -0.999955, DRIVING, DRIVING),
        (60.0, 2.123, 0.0, BRAKE, False, -1.000059, LOW_REWARD, LOW_REWARD),
        # Beyond 3.5 m, the reward is -3 and the episode ends, at any speed.
        (60.0, 4.51, 20.0, STRAIGHT, False, -3.0, OFF_LANE, OFF_LANE),
        (60.0, -60.0, 30.0, BRAKE, True, -3.0, OFF_LANE, OFF_LANE),
        # By the published code, a collision ends the episode only if the action is straight.
        (60.0, 1.5, 10.0, STRAIGHT, True, -0.776870, DRIVING, COLLISION),
        (60.0, 1.5, 10.0, LEFT, True, -0.776870, DRIVING, DRIVING),
        (60.0, 1.0, 4.0, BRAKE, True, -0.020690, DRIVING, DRIVING),
        # 200 m past the first corner, on the extension of the first leg: the line is infinite.
        (330.0, 1.0, 30.0, STRAIGHT, False, 0.068966, DRIVING, DRIVING),
        # 500 m south of the course, 0.1 m beside the extension of x = 0: e^-0.3 - 1.
        (-0.1, -500.0, 10.0, STRAIGHT, False, -0.259182, DRIVING, DRIVING),
    ],
)
def test_rewards_and_ends_by_hand(
    x_m: float,
    y_m: float,
    speed_m_s: float,
    action: int,
    hit: bool,
    reward: float,
    text: int,
    code: int,
) -> None:
    distance_m = classic_distance(x_m, y_m)
    assert classic_reward(distance_m, speed_m_s) == pytest.approx(reward, abs=2e-6)
    command = ACTION_COMMANDS[action]
    assert classic_end(distance_m, speed_m_s, command, hit, False) == text
    assert classic_end(distance_m, speed_m_s, command, hit, True) == code


@pytest.mark.parametrize(
    ("x_m", "y_m", "distance_m"),
    [
        (60.0, 1.0, 0.0),
        (60.0, 3.0, 2.0),
        (128.0, 60.0, 2.0),
        (400.0, 1.0, 0.0),
        (400.0, -2.0, 3.0),
        (-300.0, 126.0, 2.0),
        (65.0, -62.0, 63.0),
        (65.0, 64.0, 63.0),
        (1.0, 700.0, 1.0),
    ],
)
def test_the_distance_is_to_the_nearest_infinite_line(
    x_m: float, y_m: float, distance_m: float
) -> None:
    """The lines are y = 1, x = 130, y = -125, x = 0 and y = 128."""
    assert classic_distance(x_m, y_m) == pytest.approx(distance_m)


def test_a_decision_takes_one_second() -> None:
    """At full throttle, v(t) = 30 - 20 e^(-4 t / 30) from 10 m/s; Euler steps last 0.05 s."""
    car = located(moving(20.0, 1.0, 0.0, 10.0), 0.0, 20.0, 0.0)
    after, hit = classic_decide(car, ACTION_COMMANDS[STRAIGHT])
    assert not hit
    assert after.speed_m_s == pytest.approx(30.0 - 20.0 * (1.0 - 0.2 / 30.0) ** 20)
    assert lane().step_duration_s == 1.0


def test_it_starts_on_the_line_with_a_second_straight_ahead() -> None:
    car = lane().car
    assert car.speed_m_s == pytest.approx(30.0 - 30.0 * (1.0 - 0.2 / 30.0) ** 20)
    assert 2.0 < car.x_m < 4.0
    assert car.steering == 0.0
    assert lane(start="anywhere").car.along_m != car.along_m


@pytest.mark.parametrize("rules", ["classic", "classic-code"])
def test_ends_are_named(rules: str) -> None:
    sim = lane(rules)
    sim.reset(options={"pose": (60.0, 1.0, math.pi / 2, 10.0)})
    _, reward, terminated, _, info = sim.step(STRAIGHT)
    assert (reward, terminated, info["reason"]) == (-3.0, True, "off_lane")
    sim.reset(options={"pose": (60.0, 2.5, 0.0, 6.0)})
    _, reward, terminated, _, info = sim.step(BRAKE)
    assert reward < -1.0
    assert (terminated, info["reason"]) == (True, "low_reward")


def test_the_two_published_ends_differ() -> None:
    """Compare the ends of episodes in the published text and in the published code.

    An episode that starts from rest ends only by the text, because the car is too slow. An episode
    in which the car hits a rail ends only by the code.
    """
    slow, through_a_rail = {"pose": (60.0, 1.0, 0.0, 0.0)}, {"pose": (120.0, 1.0, 0.0, 20.0)}
    reasons = {}
    for rules in ("classic", "classic-code"):
        sim = lane(rules)
        for start in (slow, through_a_rail):
            sim.reset(options=start)
            info = sim.step(STRAIGHT)[4]
            reasons[rules, start["pose"][0]] = info.get("reason")
    assert reasons == {
        ("classic", 60.0): "slow",
        ("classic", 120.0): None,
        ("classic-code", 60.0): None,
        ("classic-code", 120.0): "collision",
    }


def test_fault_a_whole_lap_scores_far_below_leaving_at_once() -> None:
    """The pilot's lap has a low return, although the pilot decides four times per classic step."""
    sim = make_sim("lane", start="line").unwrapped
    assert isinstance(sim, LaneKeepingEnv)
    pilot = make_pilot(sim)
    observation, info = sim.reset(seed=0)
    score, step = 0.0, 0
    while info["progress_m"] < COURSE.length_m:
        observation, _, terminated, _, info = sim.step(pilot.act(observation[None])[0])
        assert not terminated
        step += 1
        if step % 4 == 0:
            car = sim.car
            score += classic_reward(classic_distance(car.x_m, car.y_m), car.speed_m_s)
    left = lane()
    left.reset(options={"pose": (60.0, 1.0, math.pi / 2, 10.0)})
    assert left.step(STRAIGHT)[1] == -3.0
    assert score < 5 * -3.0


def test_fault_a_high_speed_hardly_adds_to_the_reward() -> None:
    """A speed of 30 instead of 10 m/s adds 0.069 per second; an offset of 2.4 cm costs more."""
    gain = classic_reward(0.0, 30.0) - classic_reward(0.0, 10.0)
    assert gain == pytest.approx(20.0 / 290.0)
    assert classic_reward(0.0, 10.0) - classic_reward(0.024, 10.0) > gain
    sim = lane()
    sim.reset(options={"pose": (10.0, 1.0, 0.0, 0.0)})
    sim.step(BRAKE)
    rewards = [sim.step(STRAIGHT)[1] for _ in range(7)]
    assert max(rewards) < 0.07


def test_fault_a_hidden_lane_at_low_speed() -> None:
    """At an offset of 1.2 m, an episode ends at 1 m/s, but not at 10 m/s."""
    sim = lane()
    ends = {}
    for speed_m_s in (2.0, 20.0):
        sim.reset(options={"pose": (60.0, 2.2, 0.0, speed_m_s)})
        *_, terminated, _, info = sim.step(BRAKE)
        assert abs(info["lateral_offset_m"]) < 1.3
        ends[speed_m_s] = terminated
    assert ends == {2.0: True, 20.0: False}


def test_fault_leaving_along_the_extension_is_rewarded() -> None:
    """A car that drives straight on at the first corner, through a rail, is still rewarded."""
    sim = lane()
    sim.reset(options={"pose": (100.0, 1.0, 0.0, 20.0)})
    for _ in range(60):
        _, reward, terminated, _, info = sim.step(STRAIGHT)
        assert not terminated
        assert reward > 0.03
    assert sim.car.x_m > 1500.0
    assert abs(info["lateral_offset_m"]) > 1000.0


def test_fault_an_episode_at_rest_never_ends() -> None:
    sim = lane()
    sim.reset(options={"pose": (60.0, 1.0, 0.0, 10.0)})
    for _ in range(400):
        _, reward, terminated, _, _ = sim.step(BRAKE)
        assert not terminated
    assert reward == pytest.approx(-10.0 / 290.0)


def test_fault_by_the_code_walls_count_only_straight_ahead() -> None:
    """Driving through a rail ends the episode, but not if the car brakes."""
    sim = lane("classic-code")
    reasons = []
    for action in (STRAIGHT, BRAKE):
        sim.reset(options={"pose": (124.0, 1.0, 0.0, 15.0)})
        reasons.append(sim.step(action)[4].get("reason"))
        assert sim.car.x_m > 134.2
    assert reasons == ["collision", None]


def test_fault_in_a_second_nothing_can_be_corrected() -> None:
    """At 15 m/s, even the smallest steering angle makes a car in the middle leave the lane."""
    sim = lane()
    for action in (RIGHT, LEFT, SLIGHTLY_RIGHT, SLIGHTLY_LEFT):
        sim.reset(options={"pose": (60.0, 1.0, 0.0, 15.0)})
        assert sim.step(action)[4]["reason"] == "off_lane"

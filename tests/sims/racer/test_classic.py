"""Tests of the classic rules of the racer sim: rewards and ends by hand, and each known fault."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.evaluate import make_pilot
from mcaprl.sims.racer.course import Track
from mcaprl.sims.racer.env import RacerEnv
from mcaprl.sims.racer.rays import BLOCK_SIZE, LENGTH, RAY_NAMES, RAYS, measure
from mcaprl.sims.racer.rules import (
    ACTION_COMMANDS,
    CRASH,
    DRIVING,
    NO_GATE,
    TIME_LIMIT,
    drive,
    observe,
    outcome_of,
)
from tests.support.racer_tracks import car_in, corridor, outcome
from tests.support.sims import unwrapped

NONE, FORWARD, LEFT, RIGHT, BACK = range(5)


def classic(**kwargs: Any) -> RacerEnv:
    sim: RacerEnv = unwrapped("racer", rules="classic", **kwargs)
    return sim


def lengths_of(track: Track, x_px: float, y_px: float) -> dict[str, float]:
    """Return the classic ray lengths of a car that faces right."""
    block = np.zeros(BLOCK_SIZE)
    measure(track.walls_px, car_in(track, x_px, y_px), True, block)
    lengths = block[LENGTH : LENGTH + RAYS]
    return dict(zip(RAY_NAMES, lengths.tolist(), strict=True))


@pytest.mark.parametrize(
    ("car", "action", "expected"),
    [
        ((50.0, 150.0, 0, 0), NONE, (0, DRIVING)),
        ((50.0, 150.0, 0, 0), BACK, (0, DRIVING)),
        # The gate at 300 is passed from 281, 19 pixels away, but not from 279 or 280.
        ((275.0, 150.5, 0, 4), BACK, (1, DRIVING)),
        ((275.0, 150.5, 0, 2), BACK, (0, DRIVING)),
        ((275.0, 150.0, 0, 3), BACK, (0, DRIVING)),
        ((281.0, 150.5, 0, 0), NONE, (1, DRIVING)),
        # The car moves from 295 to 305, and the gate at 300 is not ahead at the end of the step.
        # Facing the gate from the other side counts.
        ((295.0, 150.5, 0, 10), NONE, (0, DRIVING)),
        ((310.0, 150.5, 180, 0), NONE, (1, DRIVING)),
        # The car is near the gate, but faces sideways.
        ((290.0, 150.5, 90, 0), NONE, (0, DRIVING)),
        # The gate at 600 is not the next one.
        ((590.0, 150.5, 0, 0), NONE, (0, DRIVING)),
        ((500.0, 108.0, 0, 0), NONE, (0, DRIVING)),
        ((500.0, 106.0, 0, 0), NONE, (-1, CRASH)),
        ((984.0, 150.0, 0, 0), FORWARD, (0, DRIVING)),
        ((984.0, 150.0, 0, 0), BACK, (-1, CRASH)),
        ((985.0, 115.0, -45, 0), NONE, (-2, CRASH)),
        ((281.0, 106.5, 0, 0), NONE, (0, CRASH)),
    ],
)
def test_rewards_and_ends_by_hand(car: Any, action: int, expected: tuple[float, int]) -> None:
    assert outcome(car_in(corridor(), *car), action, classic=True) == expected


@pytest.mark.parametrize(
    ("idle", "steps", "end"),
    [(98, 500, DRIVING), (99, 500, NO_GATE), (0, 999, DRIVING), (0, 9_999, TIME_LIMIT)],
)
def test_time_runs_out(idle: float, steps: float, end: int) -> None:
    before = car_in(corridor(), 50.0, 150.0)._replace(idle_steps=idle, steps=steps)
    assert outcome(before, NONE, classic=True) == (0, end)


def test_fault_forward_drives_backward() -> None:
    sim = classic()
    sim.reset(seed=0)
    observation, *_ = sim.step(FORWARD)
    assert sim.telemetry()["speed_m_s"] == -2.0
    assert observation[18] == pytest.approx(0.2)
    assert sim.telemetry()["y_m"] > 30.0
    sim.reset(seed=0)
    observation, *_ = sim.step(BACK)
    assert sim.telemetry()["y_m"] < 30.0
    assert observation[18] == pytest.approx(-0.2)


def test_fault_corner_rays_cross_the_nose_and_start_at_the_center() -> None:
    """The car's center is at (500.5, 130.5), and its front corners are at x = 515.5.

    Hits are rounded down to pixels: x = 515 is 14.5 pixels from the center. The walls at y = 200
    and y = 100 are 69.5 and 30.5 pixels from the center.
    """
    seen = lengths_of(corridor(), 500.5, 130.5)
    assert seen["left_corner_sideways"] == pytest.approx(math.hypot(14.5, 69.5))
    assert seen["right_corner_sideways"] == pytest.approx(math.hypot(14.5, 30.5))
    assert seen["left_corner_ahead"] == pytest.approx(math.hypot(499.5, 7.5))
    assert seen["right_corner_ahead"] == pytest.approx(math.hypot(499.5, 6.5))


def test_fault_hits_are_floored_to_pixels() -> None:
    """The car at 150 is midway between walls at 100.5 and 199.5, but observes 50 and 49."""
    seen = lengths_of(corridor(100.5, 199.5), 500.5, 150.0)
    assert seen["left_90"] == pytest.approx(math.hypot(50.0, 0.5))
    assert seen["right_90"] == pytest.approx(math.hypot(49.0, 0.5))


def test_fault_rays_are_squeezed_into_a_fifth_of_their_range() -> None:
    track = corridor()
    observation = np.zeros(19, dtype=np.float32)
    observe(track, car_in(track, 800.5, 150.5), True, observation)
    assert observation[6] == pytest.approx((1000 - math.hypot(50.5, 0.5)) / 1000)
    sim = classic()
    pilot = make_pilot(sim)
    observation, _ = sim.reset()
    seen = []
    for _ in range(200):
        observation, *_ = sim.step(pilot.act(observation[np.newaxis])[0])
        seen.append(observation[:18])
    assert np.mean(np.array(seen) > 0.8) > 0.8


def test_fault_a_joint_of_walls_costs_twice() -> None:
    track = corridor()
    before = car_in(track, 985.0, 115.0, -45)
    after = drive(track, before, ACTION_COMMANDS[NONE], True, False)
    assert outcome(before, NONE, classic=True)[0] == -2
    assert outcome_of(track, before, after, False)[0] == -1


def test_fault_a_gate_crossed_unseen_is_lost() -> None:
    """The car moves from x = 295 to 305 in one step, and the gate at 300 is not counted.

    The classic rules test only whether the gate is ahead at the end of a step.
    """
    track = corridor()
    car = car_in(track, 295.0, 150.5, 0, 10)
    over = drive(track, car, ACTION_COMMANDS[NONE], True, False)
    assert over.x_px == 305.0
    assert (over.gates, over.next_gate) == (0.0, 0.0)
    assert drive(track, car, ACTION_COMMANDS[NONE], False, False).gates == 1.0


def test_fault_every_episode_starts_equally() -> None:
    sim = classic()
    starts = {sim.reset(seed=seed)[0].tobytes() for seed in range(5)}
    assert len(starts) == 1
    car = sim.car
    assert (car.x_px, car.y_px, car.speed_px) == (50.0, 300.0, 0.0)
    assert car.heading_rad == pytest.approx(math.pi / 2)


def test_the_wrapped_sim_lasts_10_000_steps() -> None:
    env = make_sim("racer", rules="classic")
    assert env.spec is not None
    assert env.spec.max_episode_steps == 10_000

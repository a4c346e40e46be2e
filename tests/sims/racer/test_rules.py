"""Tests of the default equations of the racer sim with numbers worked by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaprl.sims.racer.block import step_cars
from mcaprl.sims.racer.course import car_at, is_beyond, make_track, placed
from mcaprl.sims.racer.rays import (
    BLOCK_SIZE,
    FAR_PX,
    LENGTH,
    RAY_NAMES,
    RAYS,
    SLOTS,
    cast,
    measure,
    ray_ends,
)
from mcaprl.sims.racer.rules import (
    ACTION_COMMANDS,
    ACTION_MEANINGS,
    CRASH,
    DRIVING,
    NO_GATE,
    OBSERVATION_NAMES,
    TIME_LIMIT,
    Command,
    drive,
    observe,
    outcome_of,
    walls_hit,
)
from tests.support.racer_tracks import car_in, corridor, outcome

NONE, FORWARD, LEFT, RIGHT, BACK = range(5)
FORWARD_LEFT, FORWARD_RIGHT = 7, 8


@pytest.mark.parametrize(
    ("car", "action", "expected"),
    [
        ((50.0, 150.0, 0, 0), NONE, (0, DRIVING)),
        ((50.0, 150.0, 0, 0), FORWARD, (0, DRIVING)),
        # The car crosses the gate at x = 300: it moves from 295 to 301, or from 290 to 300.
        ((295.0, 150.0, 0, 4), FORWARD, (1, DRIVING)),
        ((290.0, 150.0, 0, 8), FORWARD, (1, DRIVING)),
        # The car moves from x = 289 to 299, which is before the gate at 300. Only crossing a gate
        # counts, not facing a gate that is near.
        ((289.0, 150.0, 0, 8), FORWARD, (0, DRIVING)),
        ((285.0, 150.0, 0, 0), NONE, (0, DRIVING)),
        # The car crosses the gate at 600, which is not the next gate.
        ((595.0, 150.0, 0, 10), NONE, (0, DRIVING)),
        # The left side of the car is 7 pixels from its center, so it is at y = 101 in the first
        # case and at y = 99 in the second. The wall is at y = 100.
        ((500.0, 108.0, 0, 0), NONE, (0, DRIVING)),
        ((500.0, 106.0, 0, 0), NONE, (-1, CRASH)),
        # The nose of the car is 15 pixels ahead of its center: at x = 999, and at x = 1001 after
        # FORWARD. The wall is at x = 1000.
        ((984.0, 150.0, 0, 0), NONE, (0, DRIVING)),
        ((984.0, 150.0, 0, 0), FORWARD, (-1, CRASH)),
        ((984.0, 150.0, 0, 0), BACK, (0, DRIVING)),
        # The car hits two walls in the corner, which is one crash.
        ((985.0, 115.0, -45, 0), NONE, (-1, CRASH)),
        # The car passes a gate and crashes in one step.
        ((295.0, 106.0, 0, 10), NONE, (0, CRASH)),
    ],
)
def test_rewards_and_ends_by_hand(car: Any, action: int, expected: tuple[float, int]) -> None:
    assert outcome(car_in(corridor(), *car), action, classic=False) == expected


@pytest.mark.parametrize(
    ("idle", "steps", "x_px", "reward", "end"),
    [
        (98, 500, 50.0, 0, DRIVING),
        (99, 500, 50.0, 0, NO_GATE),
        (99, 500, 299.0, 1, DRIVING),
        (0, 998, 50.0, 0, DRIVING),
        (0, 999, 50.0, 0, TIME_LIMIT),
        (99, 999, 50.0, 0, NO_GATE),
    ],
)
def test_time_runs_out(idle: float, steps: float, x_px: float, reward: float, end: int) -> None:
    before = car_in(corridor(), x_px, 150.0, 0, 2)._replace(idle_steps=idle, steps=steps)
    assert outcome(before, NONE, classic=False) == (reward, end)


def test_a_crash_has_priority_over_the_time_limit() -> None:
    before = car_in(corridor(), 500.0, 106.0)._replace(idle_steps=99)
    assert outcome(before, NONE, classic=False) == (-1, CRASH)


def test_actions_by_hand() -> None:
    track = corridor()
    car = car_in(track, 500.0, 150.0, 0, 4)
    moves = {
        action: drive(track, car, command, False, False)
        for action, command in enumerate(ACTION_COMMANDS)
    }
    assert [moves[action].speed_px for action in range(9)] == [4, 6, 4, 4, 2, 2, 2, 6, 6]
    turns = [round(math.degrees(moves[action].heading_rad)) for action in range(9)]
    assert turns == [0, 0, -15, 15, 0, 15, -15, -15, 15]
    assert moves[FORWARD].x_px == 506.0
    assert moves[FORWARD_RIGHT].x_px == pytest.approx(500 + 6 * math.cos(math.radians(15)))
    assert moves[FORWARD_RIGHT].y_px == pytest.approx(150 + 6 * math.sin(math.radians(15)))
    assert moves[FORWARD_LEFT].offset_m > 0.0 > moves[FORWARD_RIGHT].offset_m
    assert len(ACTION_MEANINGS) == 9


def test_speed_is_limited_both_ways() -> None:
    track = corridor()
    car = car_in(track, 500.0, 150.0, 0, 9)
    assert drive(track, car, ACTION_COMMANDS[FORWARD], False, False).speed_px == 10.0
    assert (
        drive(track, car._replace(speed_px=-9.0), ACTION_COMMANDS[BACK], False, False).speed_px
        == -10.0
    )


def test_parts_of_a_command_scale_speed_change_and_turn() -> None:
    track = corridor()
    car = car_in(track, 500.0, 150.0, 0, 4)
    moved = drive(track, car, Command(-0.25, 0.4), False, False)
    assert moved.speed_px == 3.5
    # Left is positive in commands, and negative in the image, whose y points down.
    assert math.degrees(moved.heading_rad) == pytest.approx(-6.0)
    assert moved.y_px == pytest.approx(150.0 - 3.5 * math.sin(math.radians(6.0)))


def test_a_drifting_course_follows_by_100_over_speed_plus_1_degrees() -> None:
    """At 9 pixels per step, the course turns by 10 degrees; after two turns of 15 it lags by 10."""
    track = corridor()
    car = car_in(track, 500.0, 150.0, 0, 9)
    once = drive(track, car, ACTION_COMMANDS[RIGHT], False, True)
    twice = drive(track, once, ACTION_COMMANDS[RIGHT], False, True)
    assert math.degrees(once.heading_rad) == pytest.approx(15.0)
    assert math.degrees(once.course_rad) == pytest.approx(10.0)
    assert once.y_px == pytest.approx(150 + 9 * math.sin(math.radians(10)))
    assert math.degrees(twice.course_rad) == pytest.approx(20.0)
    assert math.degrees(
        drive(track, twice, ACTION_COMMANDS[NONE], False, True).course_rad
    ) == pytest.approx(30.0)
    slow = drive(track, car._replace(speed_px=2.0), ACTION_COMMANDS[RIGHT], False, True)
    assert slow.course_rad == slow.heading_rad


def test_rays_by_hand() -> None:
    track = corridor()
    block = np.zeros(BLOCK_SIZE)
    measure(track.walls_px, car_in(track, 500.0, 150.0), False, block)
    lengths = block[LENGTH : LENGTH + RAYS]
    ten, twenty = 50 / math.sin(math.radians(10)), 50 / math.sin(math.radians(20))
    expected = [500, 100, 100, 50 * 2**0.5, 50 * 2**0.5, 50, 50, 500, ten, ten]
    expected += [50 * 2**0.5, 50 * 2**0.5, twenty, twenty, 43, 43, 485, 485]
    np.testing.assert_allclose(lengths, expected)


def test_left_and_right_rays_differ() -> None:
    track = corridor()
    block = np.zeros(BLOCK_SIZE)
    measure(track.walls_px, car_in(track, 500.0, 130.0), False, block)
    lengths = block[LENGTH : LENGTH + RAYS]
    seen = dict(zip(RAY_NAMES, lengths.tolist(), strict=True))
    assert (seen["left_90"], seen["right_90"]) == pytest.approx((30.0, 70.0))
    assert seen["left_corner_sideways"] == pytest.approx(23.0)
    assert seen["right_corner_sideways"] == pytest.approx(63.0)
    assert seen["left_30"] == pytest.approx(60.0)
    assert seen["right_30"] == pytest.approx(140.0)


def test_observation_by_hand() -> None:
    track = corridor()
    observation = np.zeros(19, dtype=np.float32)
    observe(track, car_in(track, 500.0, 150.0, 0, -5), False, observation)
    assert observation[0] == pytest.approx(math.log(51) / math.log(101))
    assert observation[5] == pytest.approx(math.log(6) / math.log(101))
    assert observation[18] == -0.5
    assert OBSERVATION_NAMES[5] == "right_90"


def test_no_ray_passes_through_a_joint_of_walls() -> None:
    track = make_track()
    x_px, y_px = 50.0, 300.0
    away = track.walls_px[:, :2] - (x_px, y_px)
    reach = FAR_PX * away.T / np.hypot(*away.T)
    rays = np.vstack([np.full_like(reach, [[x_px], [y_px]]), reach, np.empty(len(away))])
    for first in range(0, len(away), SLOTS):
        block = np.zeros((5, SLOTS))
        part = rays[:, first : first + SLOTS]
        block[:, : part.shape[1]] = part
        cast(track.walls_px, block.ravel())
        assert (FAR_PX * block[4, : part.shape[1]] < 990.0).all()


@given(st.floats(0, 250), st.floats(-20, 20), st.floats(-3, 3))
def test_rays_end_on_walls(along_m: float, right_px: float, heading_rad: float) -> None:
    track = corridor()
    car = placed(track, 100 + 3 * along_m, 150 + right_px, heading_rad, 0.0, 0.0)
    ends = ray_ends(track.walls_px, car)[:, 1]
    beside = np.minimum(np.abs(ends[:, 0] - 0), np.abs(ends[:, 0] - 1000))
    above = np.minimum(np.abs(ends[:, 1] - 100), np.abs(ends[:, 1] - 200))
    np.testing.assert_allclose(np.minimum(beside, above), 0.0, atol=1e-6)


def test_the_next_gate_is_the_first_one_ahead() -> None:
    track = make_track()
    for index, gate in enumerate(track.gates_px):
        x_px, y_px = (gate[:2] + gate[2:]) / 2
        across = (gate[2:] - gate[:2]) / np.hypot(*(gate[2:] - gate[:2]))
        ahead = np.array([across[1], -across[0]])
        for step_px, following in ((-5.0, index), (5.0, (index + 1) % 37)):
            x, y = np.array([x_px, y_px]) + step_px * ahead
            heading_rad = math.atan2(ahead[1], ahead[0])
            car = placed(track, x, y, heading_rad, 0.0, 0.0)
            assert int(car.next_gate) == following
            assert is_beyond(x, y, gate) == (step_px > 0)
            assert abs(car.heading_error_rad) < 0.3


COMMANDS = st.sampled_from(ACTION_COMMANDS) | st.builds(Command, st.floats(-1, 1), st.floats(-1, 1))


@settings(max_examples=30)
@given(
    st.lists(st.tuples(st.floats(100, 900), COMMANDS), min_size=1, max_size=6),
    st.booleans(),
    st.booleans(),
)
def test_many_cars_drive_as_one_does(
    starts: list[tuple[float, Command]], classic: bool, drift: bool
) -> None:
    track = corridor()
    before = [car_in(track, x_px, 150.0, 20, 6) for x_px, _ in starts]
    cars, commands = np.array(before), [command for _, command in starts]
    rewards, ends = np.zeros(len(cars)), np.zeros(len(cars), dtype=np.int64)
    observations = np.zeros((len(cars), 19), dtype=np.float32)
    step_cars(track, cars, np.array(commands), rewards, ends, observations, classic, drift)
    for i, car in enumerate(before):
        alone = drive(track, car, commands[i], classic, drift)
        seen = np.zeros(19, dtype=np.float32)
        observe(track, alone, classic, seen)
        assert car_at(cars[i]) == alone
        assert (rewards[i], ends[i]) == outcome_of(track, car, alone, classic)
        assert seen.tobytes() == observations[i].tobytes()


@pytest.mark.parametrize("classic", [False, True])
def test_many_cars_end_as_one_does_anywhere_on_a_track(classic: bool) -> None:
    track, random = make_track(), np.random.default_rng(6)
    middles_m = track.path.points_m[random.integers(len(track.path.points_m), size=300)]
    x_px, y_px = middles_m[:, 0] / 0.1, 600.0 - middles_m[:, 1] / 0.1
    # Up to 45 pixels in x and y from the center line; the walls are 41.5 pixels from it.
    x_px, y_px = x_px + random.uniform(-45, 45, 300), y_px + random.uniform(-45, 45, 300)
    turns_rad = random.uniform(-math.pi, math.pi, 300)
    before = [placed(track, *pose, 4.0, 0.0) for pose in zip(x_px, y_px, turns_rad, strict=True)]
    cars, commands = np.array(before), random.choice(ACTION_COMMANDS, 300)
    rewards, ends = np.zeros(300), np.zeros(300, dtype=np.int64)
    step_cars(track, cars, commands, rewards, ends, np.zeros((300, 19), np.float32), classic, False)
    pairs = zip(before, commands, strict=True)
    after = [drive(track, car, Command(*command), classic, False) for car, command in pairs]
    outcomes = [outcome_of(track, *pair, classic) for pair in zip(before, after, strict=True)]
    assert list(zip(rewards.tolist(), ends.tolist(), strict=True)) == outcomes
    crashes = [walls_hit(track, car) > 0 for car in after]
    assert 50 < sum(crashes) < 250
    assert [end == CRASH for end in ends] == crashes


def test_walls_are_hit_by_any_edge() -> None:
    track = corridor()
    assert walls_hit(track, car_in(track, 500.0, 150.0)) == 0
    assert walls_hit(track, car_in(track, 14.0, 150.0)) == 1
    assert walls_hit(track, car_in(track, 500.0, 194.0)) == 1
    assert walls_hit(track, car_in(track, 985.0, 115.0, -45)) == 2

"""Tests of the equations of the lane sim with numbers worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.sims.geometry import moving, project
from mcaprl.sims.lane.block import step_cars
from mcaprl.sims.lane.course import COURSE
from mcaprl.sims.lane.fleet import start_at_random
from mcaprl.sims.lane.rules import (
    ACTION_COMMANDS,
    DRIVING,
    OBSERVATION_LIMIT,
    OFF_LANE,
    STALL,
    WHEELBASE_M,
    Car,
    Command,
    car_at,
    drive,
    driven,
    end_of,
    located,
    observe,
    reward_of,
    wheel_angle,
)

BRAKE, STRAIGHT, RIGHT, LEFT, SLIGHTLY_RIGHT, SLIGHTLY_LEFT = ACTION_COMMANDS


def placed(x_m: float, y_m: float, yaw_rad: float, speed_m_s: float, near_m: float) -> Car:
    """Return a car at a pose; search its place on the path near a distance along the path."""
    return located(moving(x_m, y_m, yaw_rad, speed_m_s), 0.0, near_m, 0.0)


SHARE = st.floats(0.0, 1.0, exclude_max=True)


@given(st.tuples(SHARE, SHARE, SHARE, SHARE), st.booleans())
def test_a_start_is_beside_the_nearest_path_point(shares: tuple[float, ...], on_line: bool) -> None:
    """Compare the start with searches of the path, which contains one street twice."""
    car = start_at_random(np.array(shares), on_line, False)
    nearest = project(COURSE, car.x_m, car.y_m, 0.0, COURSE.length_m)
    assert abs(car.offset_m) == pytest.approx(abs(nearest.offset_m), abs=1e-9)
    assert car == pytest.approx(placed(*car[:4], car.along_m), abs=1e-9)


def at_rest() -> Car:
    return placed(2.0, 1.0, 0.0, 0.0, 2.0)


def observed(car: Car) -> list[float]:
    observation = np.zeros(12, dtype=np.float32)
    observe(car, observation)
    return [round(float(number), 5) for number in observation]


@pytest.mark.parametrize(
    ("speed_km_h", "share"), [(0.0, 1.0), (10.0, 0.95), (20.0, 0.9), (25.0, 0.8875)]
)
def test_the_steering_angle_decreases_with_speed(speed_km_h: float, share: float) -> None:
    angle_rad = wheel_angle(0.5, speed_km_h / 3.6)
    assert math.degrees(angle_rad) == pytest.approx(20.0 * share)


def test_at_60_km_h_the_sideways_limit_is_reached_first() -> None:
    slip_rad = math.asin(9.0 * 1.35 / (60 / 3.6) ** 2)
    assert wheel_angle(0.5, 60 / 3.6) == pytest.approx(math.atan(2 * math.tan(slip_rad)))


@given(st.floats(-1, 1), st.floats(0, 30))
def test_no_speed_makes_more_than_9_m_s2_sideways(steering: float, speed_m_s: float) -> None:
    slip_rad = math.atan(0.5 * math.tan(wheel_angle(steering, speed_m_s)))
    lateral_m_s2 = speed_m_s**2 * math.sin(slip_rad) / (WHEELBASE_M / 2)
    assert abs(lateral_m_s2) <= 9.0 + 1e-9


@given(st.floats(-1, 1), st.floats(0, 30))
def test_a_car_turns_by_less_than_five_degrees_in_a_substep(steering: float, v_m_s: float) -> None:
    """`paths.turned` is accurate up to 12 degrees."""
    moved = driven(moving(0.0, 0.0, 0.0, v_m_s), steering, 1.0)
    assert abs(moved.yaw_rad) < math.radians(5.0)


def test_full_throttle_from_rest() -> None:
    speeds = [30.0 * (1.0 - (1.0 - 4.0 * 0.05 / 30.0) ** k) for k in range(6)]
    car = drive(at_rest(), STRAIGHT)
    assert car.speed_m_s == pytest.approx(speeds[5])
    assert car.x_m == pytest.approx(2.0 + 0.05 * sum(speeds[:5]))
    assert car.along_m == pytest.approx(car.x_m)
    assert (car.y_m, car.yaw_rad, car.offset_m, car.heading_error_rad) == (1.0, 0.0, 0.0, 0.0)


def test_braking_takes_2_m_s_in_a_quarter_second_and_stops_at_0() -> None:
    car = drive(placed(50.0, 1.0, 0.0, 3.0, 50.0), BRAKE)
    assert car.speed_m_s == pytest.approx(1.0)
    assert car.x_m == pytest.approx(50.0 + 0.05 * (3.0 + 2.6 + 2.2 + 1.8 + 1.4))
    assert drive(car, BRAKE).speed_m_s == 0.0


def test_a_light_pedal_brakes_or_accelerates_lightly_and_no_pedal_lets_the_car_roll() -> None:
    car = placed(50.0, 1.0, 0.0, 15.0, 50.0)
    assert drive(car, Command(-0.25, 0.0)).speed_m_s == pytest.approx(15.0 - 0.25 * 2.0)
    # At half the maximum speed, half of the throttle remains.
    slowly = drive(car, Command(0.5, 0.0), 1)
    assert slowly.speed_m_s == pytest.approx(15.0 + 0.05 * 0.5 * 4.0 * 0.5)
    assert drive(car, Command(0.0, 0.0)).speed_m_s == 15.0
    assert drive(placed(50.0, 1.0, 0.0, 0.01, 50.0), Command(-0.1, 0.0)).speed_m_s == 0.0


def test_a_command_steers_by_a_fraction_of_the_full_angle() -> None:
    car = drive(placed(50.0, 1.0, 0.0, 5.0, 50.0), Command(0.2, 0.8))
    assert car.steering == 0.8
    assert observed(car)[3] == pytest.approx(1.6)
    assert drive(car, Command(-0.2, -1.0)).steering == -1.0


def test_braking_keeps_the_last_steering() -> None:
    turning = drive(placed(50.0, 1.0, 0.0, 6.0, 50.0), LEFT)
    assert turning.steering == 0.5
    assert drive(turning, BRAKE).steering == 0.5
    assert drive(turning, BRAKE).yaw_rad > turning.yaw_rad


def test_left_and_right_are_not_mirrored() -> None:
    car = placed(50.0, 1.0, 0.0, 6.0, 50.0)
    y_m = [drive(car, action).y_m for action in (LEFT, SLIGHTLY_LEFT, STRAIGHT)]
    assert y_m[0] > y_m[1] > y_m[2] == 1.0
    for left, right in ((LEFT, RIGHT), (SLIGHTLY_LEFT, SLIGHTLY_RIGHT)):
        assert drive(car, left).y_m - 1.0 == pytest.approx(1.0 - drive(car, right).y_m)
        assert drive(car, left).offset_m > 0.0 > drive(car, right).offset_m


def test_reward_by_hand() -> None:
    before = at_rest()._replace(along_m=10.0)
    after = before._replace(along_m=13.75, offset_m=-1.75)
    assert reward_of(before, after) == pytest.approx(0.5 * (1.0 - 0.5 * 0.25))
    assert reward_of(after, before) == pytest.approx(-0.5)
    assert reward_of(before, after._replace(offset_m=3.6)) == -5.0
    assert reward_of(before, after._replace(slow_s=3.0)) == -5.0


def test_ends_of_episodes() -> None:
    car = at_rest()
    assert end_of(car) == DRIVING
    assert end_of(car._replace(offset_m=3.5)) == DRIVING
    assert end_of(car._replace(offset_m=-3.51)) == OFF_LANE
    assert end_of(car._replace(slow_s=2.75)) == DRIVING
    assert end_of(car._replace(slow_s=3.0)) == STALL


def test_twelve_decisions_at_rest_are_a_stall() -> None:
    car = at_rest()
    ends = []
    for _ in range(12):
        car = drive(car, BRAKE)
        ends.append(end_of(car))
    assert ends == [DRIVING] * 11 + [STALL]


def test_driving_on_resets_the_stall_timer() -> None:
    car = drive(drive(at_rest(), BRAKE), STRAIGHT)
    assert car.slow_s == 0.5
    assert drive(car, STRAIGHT).slow_s == 0.0


def test_observation_on_a_straight() -> None:
    car = placed(30.0, 2.75, 0.3, 15.0, 30.0)._replace(steering=-0.25)
    assert observed(car)[:4] == [0.5, round(0.3 / (math.pi / 2), 5), 0.5, -0.5]
    forward_m = 5.0 * math.cos(0.3) - 1.75 * math.sin(0.3)
    left_m = -5.0 * math.sin(0.3) - 1.75 * math.cos(0.3)
    assert observed(car)[4:6] == pytest.approx([forward_m / 5, left_m / 5], abs=1e-5)


def test_observation_before_the_first_corner() -> None:
    car = placed(125.0, 1.0, 0.0, 0.0, 125.0)
    assert observed(car)[4:] == [1.0, 0.0, 0.5, -0.5, 0.25, -0.75, 0.125, -0.875]


def test_the_shared_leg_is_observed_by_its_pass() -> None:
    first, second = (placed(125.0, 1.0, 0.0, 0.0, near_m) for near_m in (125.0, 637.0))
    assert (first.along_m, second.along_m) == (125.0, 637.0)
    assert observed(first)[7] == -0.5
    assert observed(second)[7] == 0.5


def test_observations_stay_inside_their_limits() -> None:
    far = at_rest()._replace(x_m=-500.0, y_m=900.0, offset_m=900.0)
    assert np.all(np.abs(observed(far)) <= OBSERVATION_LIMIT)


COMMANDS = st.sampled_from(ACTION_COMMANDS) | st.builds(Command, st.floats(-1, 1), st.floats(-1, 1))


@given(
    st.lists(st.tuples(st.floats(5, 120), COMMANDS), min_size=1, max_size=6),
    st.sampled_from([1, 12]),
)
def test_many_cars_drive_as_one_does(starts: list[tuple[float, Command]], copies: int) -> None:
    # The copies fill more than a block.
    starts = starts * copies
    cars = np.array([placed(x_m, 1.5, 0.1, 8.0, x_m) for x_m, _ in starts])
    commands = [command for _, command in starts]
    rewards, ends = np.zeros(len(cars)), np.zeros(len(cars), dtype=np.int64)
    observations = np.zeros((len(cars), 12), dtype=np.float32)
    alone = [drive(car_at(row), command) for row, command in zip(cars, commands, strict=True)]
    before = [car_at(row) for row in cars]
    step_cars(cars, np.array(commands), rewards, ends, observations)
    for i, car in enumerate(alone):
        assert car_at(cars[i]) == car
        assert rewards[i] == reward_of(before[i], car)
        assert ends[i] == end_of(car)

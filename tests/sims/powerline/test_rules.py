"""Tests of the default rules of the powerline sim with numbers worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaprl.sims.geometry import Vector
from mcaprl.sims.powerline.course import (
    ALONG_M,
    LENGTH_M,
    POINTS_M,
    TANGENTS,
    WIRES_M,
    ground_height,
    nearest_on_line,
    point_on_line,
    towers,
)
from mcaprl.sims.powerline.quadrotor import POINT, QUAD
from mcaprl.sims.powerline.rules import (
    COLLISION,
    DIRECTIONS,
    FINISHED,
    FLIGHT_SIZE,
    FLYING,
    OBSERVATION_LIMIT,
    OFF_LINE,
    Flight,
    begin,
    collides,
    commanded,
    decide_all,
    end_of,
    flight_at,
    next_gust,
    observe,
    reward_of,
    step_flights,
    store_flight,
)

ZERO = Vector(0.0, 0.0, 0.0)
UP, NOTHING = 5, 6


CHANGES = 0.5 * DIRECTIONS


def decide(plant: int, flight: Flight, action: int) -> tuple[Flight, int]:
    """Fly one drone for a decision; return the drone, and the outcome of the decision."""
    row, ends = np.zeros((1, FLIGHT_SIZE)), np.zeros(1, dtype=np.int64)
    store_flight(flight, row[0])
    decide_all(plant, row, CHANGES[[action]], True, ends)
    return flight_at(row[0]), int(ends[0])


def shifted(along_m: float, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Vector:
    """Return the position at an offset from a point of the line."""
    point = point_on_line(along_m)
    return Vector(point.x + x, point.y + y, point.z + z)


def hovering(position: Vector) -> Flight:
    return begin(position, ZERO, ZERO)


def observed(flight: Flight) -> list[float]:
    observation = np.zeros(18, dtype=np.float32)
    observe(flight, observation)
    return [round(float(number), 5) for number in observation]


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        (0, (1.5, -0.5, -1.0)),
        (1, (1.0, 0.0, -1.0)),
        (2, (1.0, -0.5, -0.5)),
        (3, (0.5, -0.5, -1.0)),
        (4, (1.0, -1.0, -1.0)),
        (5, (1.0, -0.5, -1.5)),
        (6, (1.0, -0.5, -1.0)),
    ],
)
def test_actions_change_the_command_by_half_a_meter_per_second(
    action: int, expected: tuple[float, float, float]
) -> None:
    change = Vector(*CHANGES[action].tolist())
    assert commanded(Vector(1.0, -0.5, -1.0), change, True) == expected


def test_a_command_beyond_8_m_s_is_ignored() -> None:
    fast = Vector(8.0, 0.0, 0.0)
    north, east, _, south = (Vector(*change) for change in CHANGES[:4].tolist())
    assert commanded(fast, north, True) == commanded(fast, east, True) == fast
    assert commanded(fast, south, True) == (7.5, 0.0, 0.0)


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ((0.5, -0.25, 0.0), (4.0, -2.0, 0.0)),
        ((0.0, 0.0, -1.0), (0.0, 0.0, -8.0)),
        # The norm of (1, -1, 1) is the square root of 3.
        ((1.0, -1.0, 1.0), (8 / math.sqrt(3), -8 / math.sqrt(3), 8 / math.sqrt(3))),
    ],
)
def test_a_velocity_is_commanded_in_units_of_8_m_s_and_shortened_to_8_m_s(
    command: tuple[float, float, float], expected: tuple[float, float, float]
) -> None:
    found = commanded(Vector(1.0, 2.0, 3.0), Vector(*command), False)
    assert found == pytest.approx(expected)


@pytest.mark.parametrize(
    ("position", "end"),
    [
        (shifted(150.0), FLYING),
        (shifted(150.0, z=-6.9), FLYING),
        (shifted(150.0, z=-7.1), OFF_LINE),
        (shifted(0.0, x=-6.0), FLYING),
        (shifted(0.0, x=-7.5), OFF_LINE),
        (Vector(*WIRES_M[4, 8].tolist()), COLLISION),
        (Vector(*(WIRES_M[4, 8] + [0.0, 0.0, -0.59]).tolist()), COLLISION),
        (Vector(*(WIRES_M[4, 0] + [0.0, 0.0, -0.5]).tolist()), COLLISION),
        (Vector(*(POINTS_M[1] + [0.0, 0.0, 6.2]).tolist()), COLLISION),
        (Vector(*(POINTS_M[1] + [0.0, 0.0, 4.5]).tolist()), FLYING),
        (shifted(LENGTH_M - 1.1), FLYING),
        (shifted(LENGTH_M - 0.9), FINISHED),
    ],
)
def test_ends_by_hand(position: Vector, end: int) -> None:
    assert end_of(position, nearest_on_line(position)) == end


def test_masts_arms_and_the_ground_cause_collisions() -> None:
    tower = towers()[2]
    assert collides(Vector(tower.x_m + 1.1, tower.y_m, tower.foot_z_m - 10.0))
    assert not collides(Vector(tower.x_m + 1.3, tower.y_m, tower.foot_z_m - 10.0))
    tip = np.array([tower.x_m, tower.y_m]) + 4.0 * np.array(tower.right)
    assert collides(Vector(float(tip[0]), float(tip[1]), tower.arm_z_m + 1.0))
    height_m = ground_height(100.0, 0.0)
    assert collides(Vector(100.0, 0.0, -height_m - 0.2))
    assert not collides(Vector(100.0, 0.0, -height_m - 0.4))


def moved(along_m: float, to_m: float, z: float = 0.0) -> tuple[Flight, Flight]:
    """Return two flights: before and after the drone moves along the line."""
    before = hovering(shifted(along_m))
    after = hovering(shifted(to_m, z=z))
    return before, after._replace(furthest_m=max(along_m, nearest_on_line(shifted(to_m)).along_m))


@pytest.mark.parametrize(
    ("along_m", "to_m", "z", "end", "expected"),
    [
        (100.0, 101.25, 0.0, FLYING, 0.5),
        (100.0, 102.5, 0.0, FLYING, 1.0),
        (100.0, 103.5, 0.0, FLYING, 0.6),
        (100.0, 105.0, 0.0, FLYING, 0.0),
        (100.0, 100.0, 0.0, FLYING, 0.0),
        (100.0, 98.0, 0.0, FLYING, 0.0),
        (100.0, 101.25, 0.0, OFF_LINE, -5.0),
        (100.0, 101.25, 0.0, COLLISION, -5.0),
        (LENGTH_M - 2.0, LENGTH_M - 0.75, 0.0, FINISHED, 5.5),
    ],
)
def test_rewards_by_hand(along_m: float, to_m: float, z: float, end: int, expected: float) -> None:
    before, after = moved(along_m, to_m, z)
    assert reward_of(before.furthest_m, after, end) == pytest.approx(expected, abs=1e-9)


def test_distance_costs_an_exponential() -> None:
    """At a height of 4 m above the inclined third leg, the distance is 4 m times the cosine."""
    before, after = moved(300.0, 302.5, z=-4.0)
    cosine = math.hypot(*TANGENTS[2, :2])
    assert reward_of(before.furthest_m, after, FLYING) == pytest.approx(math.exp(-cosine), abs=1e-6)


def test_observations_by_hand() -> None:
    """The drone is 20 m before the second corner, 0.7 m east of the line, at (1, 2, 0) m/s."""
    along_m = ALONG_M[2] - 20.0
    flight = begin(shifted(along_m), Vector(1.0, 2.0, 0.0), ZERO)
    flight = flight._replace(command_m_s=Vector(1.5, 2.0, -0.5), furthest_m=along_m + 5.0)
    numbers = observed(flight)
    assert numbers[:9] == pytest.approx([0, 0, 0, 0.2, 0.4, 0, 0.5, 0, -0.5], abs=1e-6)
    assert numbers[9:12] == pytest.approx(TANGENTS[1], abs=1e-5)
    assert numbers[12:15] == pytest.approx(TANGENTS[2], abs=1e-5)
    assert numbers[15:] == pytest.approx([1 / 3, math.exp(-2), 0.5], abs=1e-5)


def test_the_offset_points_from_the_line_to_the_drone() -> None:
    assert observed(hovering(shifted(0.0, x=-3.5)))[:3] == [-0.5, 0.0, 0.0]


def test_after_the_last_corner_the_next_leg_is_the_last() -> None:
    numbers = observed(hovering(shifted(LENGTH_M - 70.0)))
    assert numbers[9:12] == numbers[12:15]
    assert numbers[15] == 1.0


def test_observations_stay_inside_their_limits() -> None:
    wild = begin(Vector(900.0, -900.0, 900.0), Vector(50.0, -50.0, 50.0), ZERO)
    wild = wild._replace(command_m_s=Vector(-50.0, 50.0, 0.0), furthest_m=1e4)
    assert np.all(np.abs(observed(wild)) <= OBSERVATION_LIMIT)


@pytest.mark.parametrize("plant", [QUAD, POINT])
def test_an_action_moves_the_drone_in_its_direction(plant: int) -> None:
    start = hovering(shifted(150.0))
    for action, axis, sign in ((0, 0, 1), (1, 1, 1), (2, 2, 1), (3, 0, -1), (4, 1, -1), (5, 2, -1)):
        after, end = decide(plant, start, action)
        moved_m = np.subtract(after.drone.position_m, start.drone.position_m)
        assert end == FLYING
        assert np.argmax(np.abs(moved_m)) == axis
        assert np.sign(moved_m[axis]) == sign


def test_no_change_keeps_the_command() -> None:
    start = begin(shifted(150.0), Vector(3.0, 0.0, 0.0), ZERO)
    after, _ = decide(POINT, start, NOTHING)
    assert after.drone.velocity_m_s == (3.0, 0.0, 0.0)
    assert after.drone.position_m.x == pytest.approx(start.drone.position_m.x + 1.5)


def test_a_flight_ends_within_its_decision() -> None:
    """From 6.5 m above the line, at 8 m/s upward, the limit of 7 m is exceeded within 0.1 s."""
    start = begin(shifted(150.0, z=-6.5), Vector(0.0, 0.0, -8.0), ZERO)
    after, end = decide(POINT, start, UP)
    assert end == OFF_LINE
    assert after.drone.position_m.z == pytest.approx(start.drone.position_m.z - 0.8)


def test_gusts_are_stationary_and_decorrelate() -> None:
    """The standard deviation is always 1.5 m/s. Successive gusts have a correlation of e^(-1/4)."""
    noise = np.random.default_rng(0).standard_normal((20000, 3))
    gusts = [ZERO]
    for row in noise:
        gusts.append(next_gust(gusts[-1], 1.5, row))
    series = np.array(gusts[100:])
    np.testing.assert_allclose(series.std(axis=0), 1.5, rtol=0.05)
    correlation = np.corrcoef(series[:-1, 0], series[1:, 0])[0, 1]
    assert correlation == pytest.approx(math.exp(-0.25), abs=0.02)


def test_wind_moves_a_quadrotor_but_no_point() -> None:
    flight = hovering(shifted(150.0))._replace(wind_m_s=Vector(0.0, 6.0, 0.0))
    assert decide(QUAD, flight, NOTHING)[0].drone.velocity_m_s.y > 0.2
    assert decide(POINT, flight, NOTHING)[0].drone.velocity_m_s == ZERO


@settings(max_examples=20)
@given(
    st.lists(st.tuples(st.floats(5, 600), st.integers(0, 6)), min_size=1, max_size=20),
    st.floats(0, 2),
)
def test_many_drones_fly_as_one_does(starts: list[tuple[float, int]], gust_m_s: float) -> None:
    flights = [begin(shifted(a, y=0.5), Vector(1.0, 0.5, 0.0), ZERO) for a, _ in starts]
    rows = np.zeros((len(flights), FLIGHT_SIZE))
    for row, flight in zip(rows, flights, strict=True):
        store_flight(flight, row)
        assert flight_at(row) == flight
    actions = np.array([action for _, action in starts])
    noise = np.random.default_rng(1).standard_normal((len(rows), 3))
    rewards, ends = np.zeros(len(rows)), np.zeros(len(rows), dtype=np.int64)
    observations = np.zeros((len(rows), 18), dtype=np.float32)
    step_flights(QUAD, rows, CHANGES[actions], True, gust_m_s, noise, rewards, ends, observations)
    for i, flight in enumerate(flights):
        before = flight._replace(gust_m_s=next_gust(flight.gust_m_s, gust_m_s, noise[i]))
        after, end = decide(QUAD, before, actions[i])
        assert flight_at(rows[i]) == after
        assert ends[i] == end
        assert rewards[i] == reward_of(before.furthest_m, after, end)
        assert [round(float(number), 5) for number in observations[i]] == observed(after)

"""Tests of the drones of the powerline sim against closed forms and laws of motion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaprl.sims.geometry import Vector, dot, minus, norm, plus, rotate, times
from mcaprl.sims.powerline.quadrotor import (
    DRAG_PER_S,
    DRONE_SIZE,
    GRAVITY_M_S2,
    MASS_KG,
    MAX_ROTOR_THRUST_N,
    POINT,
    POINT_LAG_S,
    QUAD,
    ROTOR_LAG_S,
    TIME_STEP_S,
    VELOCITY_GAIN_PER_S,
    Drone,
    Rotors,
    advance,
    angular_momentum,
    cruising,
    drone_at,
    fly,
    move,
    rotor_commands,
    store,
    wanted_acceleration,
)

ZERO = Vector(0.0, 0.0, 0.0)
NO_THRUST = Rotors(0.0, 0.0, 0.0, 0.0)
BASIS = np.eye(3).tolist()


def resting() -> Drone:
    return cruising(ZERO, ZERO)


def speed_along(axis: int, command_m_s: float, after_s: float, wind: Vector = ZERO) -> float:
    """Fly from a hover at a command along one axis; return the velocities along it."""
    command = Vector(*[command_m_s * part for part in BASIS[axis]])
    return fly(QUAD, resting(), command, wind, after_s).velocity_m_s[axis]


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("command_m_s", [-8.0, -2.0, -0.5, 0.5, 2.0, 5.0, 8.0])
def test_it_settles_at_the_commanded_velocity(axis: int, command_m_s: float) -> None:
    """From 4 s on, the velocity is within 2 % of the command."""
    for after_s in (4.0, 6.0, 10.0, 20.0):
        assert speed_along(axis, command_m_s, after_s) == pytest.approx(command_m_s, rel=0.02)


@given(st.tuples(*[st.floats(-4.5, 4.5)] * 3), st.tuples(*[st.floats(-4.0, 4.0)] * 2))
@settings(max_examples=40)
def test_any_command_is_reached_in_any_wind(
    command: tuple[float, float, float], wind: tuple[float, float]
) -> None:
    """After 10 s, the error is below 2 % of the sum of command and wind."""
    after = fly(QUAD, resting(), Vector(*command), Vector(*wind, 0.0), 10.0)
    error = np.array(after.velocity_m_s) - command
    assert np.linalg.norm(error) <= 0.02 * (np.linalg.norm(command) + np.linalg.norm(wind)) + 1e-9


def linear_step(after_s: float) -> float:
    """Solve the linearized loop in closed form: velocity after a unit step.

    States: velocity v, tilt f, its rate w, angular acceleration u, reference r, integral i, with
    v' = g f - d v, f' = w, w' = u, u' = (kr (ka (f_wanted - f) - w) - u) / T, r' = (k + d)(1 - r),
    i' = ki (r - v) and g f_wanted = k (1 - v) + d + i.
    """
    k, d, ka, kr, ki = VELOCITY_GAIN_PER_S, DRAG_PER_S, 12.0, 30.0, 1.5
    g, lag = GRAVITY_M_S2, ROTOR_LAG_S
    asked = kr * ka / (g * lag)
    system = np.array(
        [
            [-d, g, 0, 0, 0, 0],
            [0, 0, 1, 0, 0, 0],
            [0, 0, 0, 1, 0, 0],
            [-asked * k, -kr * ka / lag, -kr / lag, -1 / lag, 0, asked],
            [0, 0, 0, 0, -(k + d), 0],
            [-ki, 0, 0, 0, ki, 0],
        ]
    )
    rest = np.linalg.solve(system, -np.array([0, 0, 0, asked * (k + d), k + d, 0]))
    rates, modes = np.linalg.eig(system)
    shares = np.linalg.solve(modes, -rest.astype(complex))
    return float(np.real(rest + modes @ (shares * np.exp(rates * after_s)))[0])


@pytest.mark.parametrize("axis", [0, 1])
def test_a_small_step_follows_the_closed_form(axis: int) -> None:
    for after_s in (0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 1.5, 2.0, 4.0):
        response = speed_along(axis, 0.1, after_s) / 0.1
        assert response == pytest.approx(linear_step(after_s), abs=0.01)


def test_a_step_by_numbers() -> None:
    """After a command of 2 m/s, the speed is 1 m/s at about 0.33 s; overshoot is at most 1 %."""
    speeds = [speed_along(0, 2.0, 0.1 * k) for k in range(60)]
    assert 0.9 < speeds[3] < 1.2
    assert max(speeds) < 2.02
    assert np.all(np.diff(speeds[:15]) > -1e-3)


@pytest.mark.parametrize("wind_m_s", [2.0, 6.0])
def test_hovering_in_wind_leans_into_it_as_forces_say(wind_m_s: float) -> None:
    """At rest, thrust cancels gravity and drag: tan(tilt) = d w / g."""
    hovering = fly(QUAD, resting(), ZERO, Vector(0.0, wind_m_s, 0.0), 20.0)
    assert norm(hovering.velocity_m_s) < 1e-3
    lift = rotate(hovering.attitude, Vector(0.0, 0.0, -1.0))
    tilt_rad = math.atan2(math.hypot(lift.x, lift.y), -lift.z)
    assert tilt_rad == pytest.approx(math.atan(DRAG_PER_S * wind_m_s / GRAVITY_M_S2), rel=1e-3)
    assert lift.y < 0.0
    weight_n = MASS_KG * GRAVITY_M_S2
    assert sum(hovering.thrusts_n) == pytest.approx(weight_n / math.cos(tilt_rad), rel=1e-4)


def test_without_wind_a_hover_is_an_equilibrium() -> None:
    after = fly(QUAD, resting(), ZERO, ZERO, 5.0)
    np.testing.assert_allclose(np.array(after.position_m), 0.0, atol=1e-12)
    np.testing.assert_allclose(after.thrusts_n, MASS_KG * GRAVITY_M_S2 / 4, rtol=1e-12)


def test_falling_without_thrust_ends_at_the_speed_where_drag_holds() -> None:
    """The speed is v(t) = g / d (1 - e^-dt), up to the first-order error of the Euler method."""
    drone = resting()._replace(thrusts_n=NO_THRUST)
    for _ in range(1000):
        drone = move(drone, NO_THRUST, ZERO)
    expected = GRAVITY_M_S2 / DRAG_PER_S * (1 - math.exp(-DRAG_PER_S * 2.0))
    assert drone.velocity_m_s.z == pytest.approx(expected, rel=1e-3)
    assert drone.velocity_m_s.x == drone.velocity_m_s.y == 0.0


def test_a_free_spin_keeps_its_momentum_and_energy() -> None:
    """Without torque, world angular momentum and energy are constant within 1 % over 2 s."""
    spin = Vector(3.0, -1.0, 2.0)
    drone = resting()._replace(thrusts_n=NO_THRUST, rates_rad_s=spin)
    before = rotate(drone.attitude, angular_momentum(drone.rates_rad_s))
    energy = dot(spin, angular_momentum(spin))
    for _ in range(1000):
        drone = move(drone, NO_THRUST, ZERO)
    after = rotate(drone.attitude, angular_momentum(drone.rates_rad_s))
    assert np.linalg.norm(np.subtract(after, before)) < 0.01 * norm(before)
    rates = drone.rates_rad_s
    assert dot(rates, angular_momentum(rates)) == pytest.approx(energy, rel=0.01)
    assert np.linalg.norm(drone.attitude) == pytest.approx(1.0, abs=1e-12)


def energy_j(drone: Drone) -> float:
    """Return the sum of translational, rotational and potential energy."""
    rates = drone.rates_rad_s
    moving = 0.5 * MASS_KG * dot(drone.velocity_m_s, drone.velocity_m_s)
    turning = 0.5 * dot(rates, angular_momentum(rates))
    return moving + turning - MASS_KG * GRAVITY_M_S2 * drone.position_m.z


def test_energy_is_the_work_of_rotors_and_drag() -> None:
    """Compare the gain of energy with the work, in a sideways climb in wind.

    The difference is at most 1 % of the work of the rotors' thrust.
    """
    wind, command = Vector(3.0, -2.0, 0.0), Vector(2.0, 3.0, -2.0)
    drone = resting()
    before_j, lift_j, drag_j, turn_j = energy_j(drone), 0.0, 0.0, 0.0
    for _ in range(1500):
        after = advance(drone, command, wind)
        mean = times(0.5, plus(drone.velocity_m_s, after.velocity_m_s))
        lift_n = rotate(after.attitude, Vector(0.0, 0.0, -sum(after.thrusts_n)))
        drag_n = times(MASS_KG * DRAG_PER_S, minus(wind, mean))
        lift_j += TIME_STEP_S * dot(lift_n, mean)
        drag_j += TIME_STEP_S * dot(drag_n, mean)
        spun = minus(angular_momentum(after.rates_rad_s), angular_momentum(drone.rates_rad_s))
        turn_j += dot(spun, times(0.5, plus(drone.rates_rad_s, after.rates_rad_s)))
        drone = after
    assert lift_j > 50.0
    assert energy_j(drone) - before_j == pytest.approx(lift_j + drag_j + turn_j, abs=0.01 * lift_j)


@pytest.mark.parametrize(
    ("rotors", "sign"),
    [
        (Rotors(2.0, 3.0, 3.0, 2.0), (1, 0, 0)),
        (Rotors(3.0, 2.0, 3.0, 2.0), (0, 1, 0)),
        (Rotors(3.0, 3.0, 2.0, 2.0), (0, 0, 1)),
    ],
)
def test_rotors_turn_the_body_the_right_way(rotors: Rotors, sign: tuple[int, int, int]) -> None:
    """Check the signs of the rotation.

    More thrust of the left rotors rolls the drone to the right. More thrust of the front rotors
    pitches it up. More thrust of the first pair of rotors yaws it to the right.
    """
    drone = move(resting()._replace(thrusts_n=rotors), rotors, ZERO)
    assert tuple(np.sign(np.round(drone.rates_rad_s, 12)).astype(int)) == sign


@given(st.tuples(*[st.floats(-6.0, 6.0)] * 3))
def test_rotors_keep_their_limits(wanted: tuple[float, float, float]) -> None:
    for thrust_n in rotor_commands(resting(), Vector(*wanted)):
        assert 0.0 <= thrust_n <= MAX_ROTOR_THRUST_N


def test_the_wanted_acceleration_by_hand() -> None:
    """Add gain times velocity error, drag times command, and the integral.

    Forward: 2.5 (2 - 1) + .25 x 2 + .3 = 3.3. Right: 2.5 x 4 + .25 x 4 = 11, limited to 6.
    Down: 2.5 (0 - .1) + .5 = .25.
    """
    drone = resting()._replace(
        velocity_m_s=Vector(1.0, 0.0, 0.1), integral_m_s2=Vector(0.3, 0.0, 0.5)
    )
    wanted = wanted_acceleration(drone, Vector(2.0, 4.0, 0.0))
    assert wanted == pytest.approx((3.3, 6.0, 0.25))


def test_the_point_follows_its_closed_form() -> None:
    """From rest with c = 2 m/s, v = 2 (1 - 1/e) and x = 2 T / e after one lag T."""
    after = fly(POINT, resting(), Vector(0.0, 2.0, 0.0), Vector(9.0, 9.0, 9.0), POINT_LAG_S)
    assert after.velocity_m_s == pytest.approx((0.0, 2 * (1 - math.exp(-1)), 0.0))
    assert after.position_m == pytest.approx((0.0, 2 * POINT_LAG_S / math.e, 0.0))


@given(st.floats(0.002, 3.0), st.floats(0.002, 3.0))
def test_two_flights_of_a_point_are_one(first_s: float, second_s: float) -> None:
    command = Vector(1.0, -2.0, 0.5)
    parts = fly(POINT, fly(POINT, resting(), command, ZERO, first_s), command, ZERO, second_s)
    whole = fly(POINT, resting(), command, ZERO, first_s + second_s)
    assert parts.position_m == pytest.approx(whole.position_m, abs=1e-9)
    assert parts.velocity_m_s == pytest.approx(whole.velocity_m_s, abs=1e-9)


def test_two_flights_of_a_quadrotor_are_one_to_the_bit() -> None:
    command, wind = Vector(3.0, -2.0, 1.0), Vector(1.0, 2.0, 0.0)
    parts = resting()
    for _ in range(10):
        parts = fly(QUAD, parts, command, wind, 0.1)
    assert parts == fly(QUAD, resting(), command, wind, 1.0)
    assert round(0.1 / TIME_STEP_S) == 50


def test_a_drone_survives_its_row() -> None:
    row = np.arange(float(DRONE_SIZE))
    drone, copy = drone_at(row), np.empty(DRONE_SIZE)
    store(drone, copy)
    np.testing.assert_array_equal(copy, row)

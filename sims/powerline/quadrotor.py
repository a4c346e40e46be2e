"""Two drones that follow a commanded velocity: a quadrotor with controllers, and a point mass.

World axes are NED: x north, y east, z down. Body axes are x forward, y right, z down. Both drones
always face north.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled, inlined
from mcaprl.sims.geometry import (
    Quaternion,
    Vector,
    cross,
    dot,
    inverse,
    minus,
    norm,
    plus,
    product,
    rotate,
    times,
    unit,
)

PLANTS = ("quad", "point")
QUAD, POINT = 0, 1

GRAVITY_M_S2 = 9.81
TIME_STEP_S = 0.002  # Time step of the quadrotor's equations and controllers, which run at 500 Hz
POINT_LAG_S = 0.5

MASS_KG = 1.0
INERTIA_KG_M2 = (0.01, 0.01, 0.018)
ROTOR_OFFSET_M = 0.15
"""Distance of each rotor from the center along x and along y; the arms form an X."""
TORQUE_PER_THRUST_M = 0.016
MAX_ROTOR_THRUST_N = 5.5
ROTOR_LAG_S = 0.02
ROTOR_SHARE = 1.0 - math.exp(-TIME_STEP_S / ROTOR_LAG_S)
"""Fraction of the thrust error that is corrected in one time step."""
DRAG_PER_S = 0.25  # Coefficient of the drag per mass, which is linear in the airspeed

VELOCITY_GAIN_PER_S = 2.5
INTEGRAL_GAIN_PER_S2 = 1.5
REFERENCE_GAIN_PER_S = VELOCITY_GAIN_PER_S + DRAG_PER_S
"""Rate at which the reference velocity approaches the command: the drone's rate in still air."""
MAX_INTEGRAL_M_S2 = 2.0
MAX_ACCELERATION_M_S2 = 6.0
ATTITUDE_GAIN_PER_S = 12.0
RATE_GAIN_PER_S = 30.0


class Rotors(NamedTuple):
    """One value per rotor; the first two rotors rotate opposite to the last two."""

    front_right: float
    rear_left: float
    front_left: float
    rear_right: float


class Drone(NamedTuple):
    """State of a drone and its controllers; a point mass uses only the first two fields."""

    position_m: Vector
    velocity_m_s: Vector
    attitude: Quaternion  # Rotation from the body's axes to the world's
    rates_rad_s: Vector  # Angular velocity about the body's axes
    thrusts_n: Rotors
    reference_m_s: Vector  # Velocity that the drone would have without wind
    integral_m_s2: Vector  # Integral of the velocity controller, which compensates for the wind


DRONE_SIZE = 23  # Number of floats in the array row of a `Drone`


@compiled
def drone_at(row: NDArray[np.float64]) -> Drone:
    """Read a drone from a row of 23 floats."""
    return Drone(
        Vector(row[0], row[1], row[2]),
        Vector(row[3], row[4], row[5]),
        Quaternion(row[6], row[7], row[8], row[9]),
        Vector(row[10], row[11], row[12]),
        Rotors(row[13], row[14], row[15], row[16]),
        Vector(row[17], row[18], row[19]),
        Vector(row[20], row[21], row[22]),
    )


@compiled
def store(drone: Drone, row: NDArray[np.float64]) -> None:
    """Write a drone into a row of 23 floats."""
    row[0:3] = drone.position_m
    row[3:6] = drone.velocity_m_s
    row[6:10] = drone.attitude
    row[10:13] = drone.rates_rad_s
    row[13:17] = drone.thrusts_n
    row[17:20] = drone.reference_m_s
    row[20:23] = drone.integral_m_s2


@compiled
def cruising(position_m: Vector, velocity_m_s: Vector) -> Drone:
    """Return a level drone in steady flight at a velocity in still air."""
    hover_n = 0.25 * MASS_KG * GRAVITY_M_S2
    still = Vector(0.0, 0.0, 0.0)
    return Drone(
        position_m,
        velocity_m_s,
        Quaternion(1.0, 0.0, 0.0, 0.0),
        still,
        Rotors(hover_n, hover_n, hover_n, hover_n),
        velocity_m_s,
        still,
    )


@compiled
def fly(
    plant: int, drone: Drone, command_m_s: Vector, wind_m_s: Vector, duration_s: float
) -> Drone:
    """Return the drone after flying at a commanded velocity."""
    if plant == POINT:
        return lag(drone, command_m_s, duration_s)
    for _ in range(round(duration_s / TIME_STEP_S)):
        drone = advance(drone, command_m_s, wind_m_s)
    return drone


@compiled
def lag(drone: Drone, command_m_s: Vector, duration_s: float) -> Drone:
    """Advance a point mass by the exact solution of v' = (c - v) / T.

    The velocity is v, the command c, the position x, and the lag T. The solution is
    v(t) = c + (v - c) e and x(t) = x + c t + (v - c) T (1 - e), with e = exp(-t / T).
    """
    left = math.exp(-duration_s / POINT_LAG_S)
    error = minus(drone.velocity_m_s, command_m_s)
    moved = plus(times(duration_s, command_m_s), times(POINT_LAG_S * (1.0 - left), error))
    return Drone(plus(drone.position_m, moved), plus(command_m_s, times(left, error)), *drone[2:])


@inlined
def advance(drone: Drone, command_m_s: Vector, wind_m_s: Vector) -> Drone:
    """Advance a quadrotor and its controllers by 2 ms."""
    wanted = wanted_acceleration(drone, command_m_s)
    rotors = rotor_commands(drone, wanted)
    reference = drone.reference_m_s
    reference_rate = times(REFERENCE_GAIN_PER_S, minus(command_m_s, reference))
    moved = move(drone, rotors, wind_m_s)
    return Drone(
        *moved[:5],
        plus(reference, times(TIME_STEP_S, reference_rate)),
        Vector(
            _integrated(drone.integral_m_s2.x, reference.x - drone.velocity_m_s.x, wanted.x),
            _integrated(drone.integral_m_s2.y, reference.y - drone.velocity_m_s.y, wanted.y),
            _integrated(drone.integral_m_s2.z, reference.z - drone.velocity_m_s.z, wanted.z),
        ),
    )


@inlined
def wanted_acceleration(drone: Drone, command_m_s: Vector) -> Vector:
    """Return the acceleration with which the velocity controller approaches the command.

    On each axis, the acceleration is the sum of three terms: k (c - v) with the gain k, the command
    c and the velocity v; the acceleration that compensates drag at the commanded velocity; and the
    integral of the deviation from a reference velocity. Wind causes such a deviation; a change of
    the command does not. The result is limited to 6 m/s^2.
    """
    c, v, i = command_m_s, drone.velocity_m_s, drone.integral_m_s2
    return Vector(_asked(c.x, v.x, i.x), _asked(c.y, v.y, i.y), _asked(c.z, v.z, i.z))


@inlined
def _asked(command_m_s: float, velocity_m_s: float, integral_m_s2: float) -> float:
    wanted = VELOCITY_GAIN_PER_S * (command_m_s - velocity_m_s) + DRAG_PER_S * command_m_s
    return min(max(wanted + integral_m_s2, -MAX_ACCELERATION_M_S2), MAX_ACCELERATION_M_S2)


@inlined
def _integrated(integral_m_s2: float, error_m_s: float, wanted_m_s2: float) -> float:
    """Integrate the velocity error of an axis unless the acceleration is at its limit."""
    if abs(wanted_m_s2) >= MAX_ACCELERATION_M_S2:
        return integral_m_s2
    grown = integral_m_s2 + TIME_STEP_S * INTEGRAL_GAIN_PER_S2 * error_m_s
    return min(max(grown, -MAX_INTEGRAL_M_S2), MAX_INTEGRAL_M_S2)


@inlined
def rotor_commands(drone: Drone, wanted_m_s2: Vector) -> Rotors:
    """Return the commanded thrusts of the rotors, newtons, for a desired acceleration.

    The desired attitude is the shortest rotation from upright that points the body's z axis along
    g - a, with gravity g and the desired acceleration a. The attitude error determines the
    commanded angular velocity. The error of the angular velocity determines the torques. Mellinger
    and Kumar describe this cascade in "Minimum snap trajectory generation and control for
    quadrotors", ICRA 2011.
    """
    down = minus(Vector(0.0, 0.0, GRAVITY_M_S2), wanted_m_s2)
    size = norm(down)
    upright_to_wanted = unit(Quaternion(size + down.z, -down.y, down.x, 0.0))
    error = product(inverse(drone.attitude), upright_to_wanted)
    gain = 2.0 * ATTITUDE_GAIN_PER_S if error.w >= 0.0 else -2.0 * ATTITUDE_GAIN_PER_S
    missing = minus(times(gain, Vector(error.x, error.y, error.z)), drone.rates_rad_s)
    spin = angular_momentum(drone.rates_rad_s)
    turn = times(RATE_GAIN_PER_S, angular_momentum(missing))
    torque = plus(turn, cross(drone.rates_rad_s, spin))
    body_down = rotate(drone.attitude, Vector(0.0, 0.0, 1.0))
    return _mixed(MASS_KG * max(0.0, dot(down, body_down)), torque)


@inlined
def angular_momentum(rates_rad_s: Vector) -> Vector:
    """Return the angular momentum in the body's axes."""
    about_x, about_y, about_z = INERTIA_KG_M2
    return Vector(about_x * rates_rad_s.x, about_y * rates_rad_s.y, about_z * rates_rad_s.z)


@inlined
def _mixed(thrust_n: float, torque_n_m: Vector) -> Rotors:
    """Distribute a thrust and torques among the rotors; clip each thrust to its limits."""
    each = 0.25 * thrust_n
    roll = 0.25 * torque_n_m.x / ROTOR_OFFSET_M
    pitch = 0.25 * torque_n_m.y / ROTOR_OFFSET_M
    yaw = 0.25 * torque_n_m.z / TORQUE_PER_THRUST_M
    return Rotors(
        _limited(each - roll + pitch + yaw),
        _limited(each + roll - pitch + yaw),
        _limited(each + roll + pitch - yaw),
        _limited(each - roll - pitch - yaw),
    )


@inlined
def _limited(thrust_n: float) -> float:
    return min(max(thrust_n, 0.0), MAX_ROTOR_THRUST_N)


@inlined
def move(drone: Drone, rotors: Rotors, wind_m_s: Vector) -> Drone:
    """Advance a rigid body by 2 ms with the semi-implicit Euler method.

    The equations are m v' = m g + R f + m d (w - v), J omega' = torque - omega x J omega and
    q' = q (0, omega) / 2. Here, m is the mass, v the velocity, g gravity, R the rotation from body
    to world axes, f the total thrust in body axes, d the drag coefficient, w the wind, J the
    inertia, omega the angular velocity, and q the attitude. Each thrust follows its command with a
    lag of 20 ms. The new omega is used to integrate the attitude, and the new v to integrate the
    position.
    """
    share, old = ROTOR_SHARE, drone.thrusts_n
    thrusts = Rotors(
        old.front_right + share * (rotors.front_right - old.front_right),
        old.rear_left + share * (rotors.rear_left - old.rear_left),
        old.front_left + share * (rotors.front_left - old.front_left),
        old.rear_right + share * (rotors.rear_right - old.rear_right),
    )
    first, second, third, fourth = thrusts
    lift = Vector(0.0, 0.0, -(first + second + third + fourth) / MASS_KG)
    drag = times(DRAG_PER_S, minus(wind_m_s, drone.velocity_m_s))
    push = plus(rotate(drone.attitude, lift), plus(drag, Vector(0.0, 0.0, GRAVITY_M_S2)))
    velocity = plus(drone.velocity_m_s, times(TIME_STEP_S, push))
    rates = _turned(drone.rates_rad_s, thrusts)
    half = times(0.5 * TIME_STEP_S, rates)
    attitude = product(drone.attitude, Quaternion(1.0, half.x, half.y, half.z))
    return Drone(
        plus(drone.position_m, times(TIME_STEP_S, velocity)),
        velocity,
        unit(attitude),
        rates,
        thrusts,
        *drone[5:],
    )


@inlined
def _turned(rates_rad_s: Vector, thrusts: Rotors) -> Vector:
    """Return the angular velocity after the thrusts act on the body for 2 ms."""
    right, left = thrusts.front_right + thrusts.rear_right, thrusts.front_left + thrusts.rear_left
    front, rear = thrusts.front_right + thrusts.front_left, thrusts.rear_right + thrusts.rear_left
    one_way = thrusts.front_right + thrusts.rear_left
    other_way = thrusts.front_left + thrusts.rear_right
    torque = Vector(
        ROTOR_OFFSET_M * (left - right),
        ROTOR_OFFSET_M * (front - rear),
        TORQUE_PER_THRUST_M * (one_way - other_way),
    )
    net = minus(torque, cross(rates_rad_s, angular_momentum(rates_rad_s)))
    about_x, about_y, about_z = INERTIA_KG_M2
    return plus(
        rates_rad_s, times(TIME_STEP_S, Vector(net.x / about_x, net.y / about_y, net.z / about_z))
    )

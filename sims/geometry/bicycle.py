"""Kinematic bicycle model: a car whose wheels never slip."""

from __future__ import annotations

import math
from typing import NamedTuple

from mcaprl.compiled import inlined
from mcaprl.sims.geometry.paths import Heading, heading_of, sine, turned


class Motion(NamedTuple):
    """Pose and speed of the middle of the wheelbase."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float
    heading: Heading
    """Direction of the yaw; each step rotates the direction instead of recomputing it."""


@inlined
def moving(x_m: float, y_m: float, yaw_rad: float, speed_m_s: float) -> Motion:
    """Return the motion of a car; compute the heading from the yaw."""
    return Motion(x_m, y_m, yaw_rad, speed_m_s, heading_of(yaw_rad))


@inlined
def roll(
    motion: Motion,
    slip_sine: float,
    acceleration_m_s2: float,
    wheelbase_m: float,
    duration_s: float,
) -> Motion:
    """Advance a bicycle by one explicit Euler step, which must turn it by at most 12 degrees."""
    moved, turn_rad = roll_pose(motion, slip_sine, acceleration_m_s2, wheelbase_m, duration_s)
    heading = turned(moved.heading, turn_rad)
    return Motion(moved.x_m, moved.y_m, moved.yaw_rad, moved.speed_m_s, heading)


@inlined
def roll_pose(
    motion: Motion,
    slip_sine: float,
    acceleration_m_s2: float,
    wheelbase_m: float,
    duration_s: float,
) -> tuple[Motion, float]:
    """Return the motion after the step of `roll`, with the old heading, and the turn in radians.

    Let beta be the slip angle, l half the wheelbase and v the speed. Then x' = v cos(yaw + beta),
    y' = v sin(yaw + beta), yaw' = v sin(beta) / l, and v' = acceleration. Polack, Altche,
    d'Andrea-Novel and de La Fortelle, "The kinematic bicycle model: a consistent model for planning
    feasible trajectories for autonomous vehicles?", IEEE IV 2017, eq. 1. cos(yaw + beta) and
    sin(yaw + beta) are expanded into products, because the argument `slip_sine` is sin(beta).
    """
    cos, sin = motion.heading
    slip_cosine = math.sqrt(1.0 - slip_sine * slip_sine)
    distance_m = motion.speed_m_s * duration_s
    turn_rad = distance_m * slip_sine * (2.0 / wheelbase_m)
    moved = Motion(
        motion.x_m + distance_m * (cos * slip_cosine - sin * slip_sine),
        motion.y_m + distance_m * (sin * slip_cosine + cos * slip_sine),
        motion.yaw_rad + turn_rad,
        motion.speed_m_s + acceleration_m_s2 * duration_s,
        motion.heading,
    )
    return moved, turn_rad


@inlined
def slip_of(
    steering_rad: float, speed_m_s: float, most_lateral_m_s2: float, wheelbase_m: float
) -> float:
    """Return sin(beta) for a steering angle, limited by a maximum lateral acceleration.

    tan(beta) = tan(steering) / 2, so sin(beta) = sin(steering) / sqrt(4 - 3 sin^2(steering)). Let l
    be half the wheelbase and v the speed. The radius of the turn is l / sin(beta), so the lateral
    acceleration is v^2 sin(beta) / l. It limits sin(beta) to l / v^2 times the maximum.

    Args:
        steering_rad: Steering angle, from -45 to 45 degrees.
        speed_m_s: Speed v; 0 for a slip without a limit.
        most_lateral_m_s2: Maximum lateral acceleration.
        wheelbase_m: Distance between the axles.
    """
    steering_sine = sine(steering_rad)
    root = math.sqrt(4.0 - 3.0 * steering_sine * steering_sine)
    limit, square = 0.5 * wheelbase_m * most_lateral_m_s2, speed_m_s * speed_m_s
    # The fractions are compared by products, so that there is only one division, which takes as
    # long as many products.
    is_limited = abs(steering_sine) * square > limit * root
    size = limit if is_limited else abs(steering_sine)
    slip_size = size / (square if is_limited else root)
    return -slip_size if steering_sine < 0.0 else slip_size


@inlined
def steering_of(slip_sine: float) -> float:
    """Return the steering angle in radians for sin(beta): the inverse of `slip_of` at speed 0."""
    return math.atan2(2.0 * slip_sine, math.sqrt(1.0 - slip_sine * slip_sine))

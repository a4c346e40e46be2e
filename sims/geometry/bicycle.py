"""The kinematic bicycle: a car whose wheels never slip."""

from __future__ import annotations

import math
from typing import NamedTuple

from mcaprl.sims.geometry.compiled import inlined
from mcaprl.sims.geometry.paths import Heading, heading_of, sine, turned


class Motion(NamedTuple):
    """Pose and speed of the middle of the wheelbase."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float
    heading: Heading
    """Of the yaw, turned with it step by step; `moving` computes it anew."""


@inlined
def moving(x_m: float, y_m: float, yaw_rad: float, speed_m_s: float) -> Motion:
    """Make a motion."""
    return Motion(x_m, y_m, yaw_rad, speed_m_s, heading_of(yaw_rad))


@inlined
def roll(
    motion: Motion,
    slip_sine: float,
    acceleration_m_s2: float,
    wheelbase_m: float,
    duration_s: float,
) -> Motion:
    """Advance a bicycle by one explicit Euler step, in which it turns by at most 90 degrees.

    With slip angle beta, half the wheelbase l and speed v: x' = v cos(yaw + beta),
    y' = v sin(yaw + beta), yaw' = v sin(beta) / l, v' = acceleration. Polack, Altche,
    d'Andrea-Novel and de La Fortelle, "The kinematic bicycle model: a consistent model for planning
    feasible trajectories for autonomous vehicles?", IEEE IV 2017, eq. 1. The sums of angles are
    written out as products, since beta is known by its sine alone.
    """
    cos, sin = motion.heading
    slip_cosine = math.sqrt(1.0 - slip_sine * slip_sine)
    distance_m = motion.speed_m_s * duration_s
    turn_rad = distance_m * slip_sine / (0.5 * wheelbase_m)
    return Motion(
        motion.x_m + distance_m * (cos * slip_cosine - sin * slip_sine),
        motion.y_m + distance_m * (sin * slip_cosine + cos * slip_sine),
        motion.yaw_rad + turn_rad,
        motion.speed_m_s + acceleration_m_s2 * duration_s,
        turned(motion.heading, turn_rad),
    )


@inlined
def slip_of(steering_rad: float) -> float:
    """Give sin(beta) for an angle of the front wheels of at most 45 degrees.

    tan(beta) = tan(steering) / 2, so sin(beta) = sin(steering) / sqrt(4 - 3 sin^2(steering)).
    """
    steering_sine = sine(steering_rad)
    return steering_sine / math.sqrt(4.0 - 3.0 * steering_sine * steering_sine)


@inlined
def steering_of(slip_sine: float) -> float:
    """Give the front wheels' angle, radians, for sin(beta): what `slip_of` turns back."""
    return math.atan2(2.0 * slip_sine, math.sqrt(1.0 - slip_sine * slip_sine))


@inlined
def slip_for_lateral(lateral_m_s2: float, speed_m_s: float, wheelbase_m: float) -> float:
    """Give sin(beta) of the turn that makes a sideways acceleration at a speed.

    The car turns on a radius of l / sin(beta), so v^2 sin(beta) / l = lateral; at low speed no turn
    reaches it and the answer is 1.
    """
    least = 0.5 * wheelbase_m * lateral_m_s2
    return least / max(speed_m_s * speed_m_s, least)

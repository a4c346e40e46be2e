"""The kinematic bicycle: a car whose wheels never slip."""

from __future__ import annotations

import math
from typing import NamedTuple

from mcaprl.sims.compiled import compiled


class Motion(NamedTuple):
    """Pose and speed of the middle of the wheelbase."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float


@compiled
def roll(
    motion: Motion,
    slip_sine: float,
    acceleration_m_s2: float,
    wheelbase_m: float,
    duration_s: float,
) -> Motion:
    """Advance a bicycle by one explicit Euler step.

    With slip angle beta, half the wheelbase l and speed v: x' = v cos(yaw + beta),
    y' = v sin(yaw + beta), yaw' = v sin(beta) / l, v' = acceleration. Polack, Altche,
    d'Andrea-Novel and de La Fortelle, "The kinematic bicycle model: a consistent model for planning
    feasible trajectories for autonomous vehicles?", IEEE IV 2017, eq. 1. The sums of angles are
    written out as products, since beta is known by its sine alone.
    """
    cos, sin = math.cos(motion.yaw_rad), math.sin(motion.yaw_rad)
    slip_cosine = math.sqrt(1.0 - slip_sine * slip_sine)
    distance_m = motion.speed_m_s * duration_s
    return Motion(
        motion.x_m + distance_m * (cos * slip_cosine - sin * slip_sine),
        motion.y_m + distance_m * (sin * slip_cosine + cos * slip_sine),
        motion.yaw_rad + distance_m * slip_sine / (0.5 * wheelbase_m),
        motion.speed_m_s + acceleration_m_s2 * duration_s,
    )


@compiled
def slip_of(steering_rad: float) -> float:
    """Give sin(beta) for an angle of the front wheels: tan(beta) = tan(steering) / 2."""
    tangent = 0.5 * math.tan(steering_rad)
    return tangent / math.sqrt(1.0 + tangent * tangent)


@compiled
def steering_of(slip_sine: float) -> float:
    """Give the front wheels' angle, radians, for sin(beta): what `slip_of` turns back."""
    return math.atan2(2.0 * slip_sine, math.sqrt(1.0 - slip_sine * slip_sine))


@compiled
def slip_for_lateral(lateral_m_s2: float, speed_m_s: float, wheelbase_m: float) -> float:
    """Give sin(beta) of the turn that makes a sideways acceleration at a speed.

    The car turns on a radius of l / sin(beta), so v^2 sin(beta) / l = lateral; at low speed no turn
    reaches it and the answer is 1.
    """
    sine = 0.5 * wheelbase_m * lateral_m_s2
    square = speed_m_s * speed_m_s
    return 1.0 if sine >= square else sine / square

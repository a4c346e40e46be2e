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
    steering_rad: float,
    acceleration_m_s2: float,
    wheelbase_m: float,
    duration_s: float,
) -> Motion:
    """Advance a bicycle by one explicit Euler step.

    With slip angle beta = atan(tan(steering) / 2), half the wheelbase l and speed v:
    x' = v cos(yaw + beta), y' = v sin(yaw + beta), yaw' = v sin(beta) / l, v' = acceleration.
    Polack, Altche, d'Andrea-Novel and de La Fortelle, "The kinematic bicycle model: a consistent
    model for planning feasible trajectories for autonomous vehicles?", IEEE IV 2017, eq. 1.
    """
    slip_rad = math.atan(0.5 * math.tan(steering_rad))
    distance_m = motion.speed_m_s * duration_s
    return Motion(
        motion.x_m + distance_m * math.cos(motion.yaw_rad + slip_rad),
        motion.y_m + distance_m * math.sin(motion.yaw_rad + slip_rad),
        motion.yaw_rad + distance_m * math.sin(slip_rad) / (0.5 * wheelbase_m),
        motion.speed_m_s + acceleration_m_s2 * duration_s,
    )


@compiled
def steering_for_lateral(lateral_m_s2: float, speed_m_s: float, wheelbase_m: float) -> float:
    """Give the steering angle, radians, that makes a sideways acceleration at a speed.

    The car turns on a radius of l / sin(beta), so v^2 sin(beta) / l = lateral; at low speed no
    angle reaches it and the answer is pi / 2.
    """
    sine = 0.5 * wheelbase_m * lateral_m_s2
    square = speed_m_s * speed_m_s
    if sine >= square:
        return 0.5 * math.pi
    return math.atan(2.0 * math.tan(math.asin(sine / square)))

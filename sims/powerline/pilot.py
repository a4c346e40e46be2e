"""The scripted flyer of the powerline sim: aim at a point ahead, slow down before corners."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.geometry.compiled import compiled
from mcaprl.sims.geometry.vectors import Vector, minus, norm, times
from mcaprl.sims.powerline.env import PowerlineEnv
from mcaprl.sims.powerline.rules import ACTION_MEANINGS, DIRECTIONS, Flight
from mcaprl.sims.powerline.world import ALONG_M, LEGS, TANGENTS, nearest_on_line, point_on_line
from mcaprl.sims.vehicle.arguments import check_one

AIM_M = 6.0
"""The point aimed at lies this far ahead on the line."""
OFFSET_GAIN_PER_S = 0.5
MAX_SPEED_M_S = 5.0
HALF_TURN_RAD = 0.46
TURN_SPEED_M_S = 2.0
"""A corner of 2 x 0.46 rad is taken at 2 m/s; sharper ones more slowly."""
BRAKE_M_S2 = 0.3
CORNER_EARLY_M = 6.0
NO_CHANGE = len(ACTION_MEANINGS) - 1


@compiled
def corner_speed(leg: int) -> float:
    """Give the speed, m/s, for the corner at a leg's end: less, the sharper it is."""
    if leg + 1 >= LEGS:
        return MAX_SPEED_M_S
    cosine = 0.0
    for k in range(3):
        cosine += TANGENTS[leg, k] * TANGENTS[leg + 1, k]
    half_rad = 0.5 * math.acos(min(1.0, cosine))
    sharpness = (1.0 - math.cos(half_rad)) / (1.0 - math.cos(HALF_TURN_RAD))
    return min(MAX_SPEED_M_S, TURN_SPEED_M_S / math.sqrt(sharpness))


@compiled
def wanted_velocity(position_m: Vector) -> Vector:
    """Give the velocity that a drone at a position should have, m/s."""
    place = nearest_on_line(position_m)
    slowing_m = max(0.0, ALONG_M[place.leg + 1] - place.along_m - CORNER_EARLY_M)
    corner_m_s = corner_speed(place.leg)
    speed_m_s = min(MAX_SPEED_M_S, math.sqrt(corner_m_s**2 + 2.0 * BRAKE_M_S2 * slowing_m))
    ahead = minus(point_on_line(place.along_m + AIM_M), position_m)
    toward = times(speed_m_s / max(norm(ahead), 1e-9), ahead)
    return minus(toward, times(OFFSET_GAIN_PER_S, minus(position_m, place.point_m)))


@compiled
def choose(flight: Flight, step_m_s: float, from_measured: bool) -> int:
    """Choose the action that mends the largest part of the command's error, if it is worth a step.

    Args:
        flight: now.
        step_m_s: that an action makes.
        from_measured: whether actions change the measured velocity, not the last command.
    """
    base = flight.drone.velocity_m_s if from_measured else flight.command_m_s
    missing = minus(wanted_velocity(flight.drone.position_m), base)
    best, most_m_s = NO_CHANGE, 0.5 * step_m_s
    for action in range(NO_CHANGE):
        gain_m_s = 0.0
        for k in range(3):
            gain_m_s += DIRECTIONS[action, k] * missing[k]
        if gain_m_s > most_m_s:
            best, most_m_s = action, gain_m_s
    return best


class PowerlinePilot:
    """Flies the drone of one environment, whose state it reads."""

    name: ClassVar[str] = "pilot"

    def __init__(self, sim: PowerlineEnv) -> None:
        """Take over `sim`."""
        self._sim = sim

    def act(
        self, observations: NDArray[np.generic] | dict[str, NDArray[np.generic]]
    ) -> NDArray[np.int64]:
        """Give the action, shape (1,), for the drone as it is now.

        Raises:
            ValueError: there are observations of more than one environment.
        """
        check_one(observations)
        sim = self._sim
        action = choose(sim.flight, sim.fleet.velocity_step_m_s, sim.fleet.classic)
        return np.array([action], dtype=np.int64)

"""Pilot of the powerline sim: aims at a point ahead and slows down before corners."""

from __future__ import annotations

import math

from mcaprl.compiled import compiled
from mcaprl.sims.geometry import Vector, minus, norm, times
from mcaprl.sims.powerline.course import ALONG_M, LEGS, TANGENTS, nearest_on_line, point_on_line
from mcaprl.sims.powerline.env import PowerlineEnv
from mcaprl.sims.powerline.rules import ACTION_MEANINGS, DIRECTIONS, MAX_COMMAND_M_S, Flight
from mcaprl.sims.vehicle.env import ScriptedPilot

AIM_M = 6.0  # Distance along the line to the target point
OFFSET_GAIN_PER_S = 0.5
MAX_SPEED_M_S = 5.0
HALF_TURN_RAD = 0.46
TURN_SPEED_M_S = 2.0
"""Speed in a corner that turns the line by 2 x 0.46 rad; sharper corners are flown more slowly."""
BRAKE_M_S2 = 0.3
CORNER_EARLY_M = 6.0
NO_CHANGE = len(ACTION_MEANINGS) - 1


@compiled
def corner_speed(leg: int) -> float:
    """Return the speed, m/s, for the corner at a leg's end; sharper corners need a lower speed."""
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
    """Return the desired velocity, m/s, of a drone at a position."""
    place = nearest_on_line(position_m)
    slowing_m = max(0.0, ALONG_M[place.leg + 1] - place.along_m - CORNER_EARLY_M)
    corner_m_s = corner_speed(place.leg)
    speed_m_s = min(MAX_SPEED_M_S, math.sqrt(corner_m_s**2 + 2.0 * BRAKE_M_S2 * slowing_m))
    ahead = minus(point_on_line(place.along_m + AIM_M), position_m)
    toward = times(speed_m_s / max(norm(ahead), 1e-9), ahead)
    return minus(toward, times(OFFSET_GAIN_PER_S, minus(position_m, place.point_m)))


@compiled
def steer(flight: Flight, is_change: bool) -> Vector:
    """Return the command for the wanted velocity; see `commanded`."""
    wanted = wanted_velocity(flight.drone.position_m)
    if not is_change:
        return times(1.0 / MAX_COMMAND_M_S, wanted)
    missing = minus(wanted, flight.command_m_s)
    return Vector(
        min(max(missing.x, -1.0), 1.0),
        min(max(missing.y, -1.0), 1.0),
        min(max(missing.z, -1.0), 1.0),
    )


@compiled
def choose(flight: Flight, step_m_s: float, from_measured: bool) -> int:
    """Choose the action that most reduces the command's error, or none if the error is small."""
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


class PowerlinePilot(ScriptedPilot[PowerlineEnv]):
    """Scripted pilot of the powerline sim's drone."""

    def choose(self) -> int | Vector:
        """Choose the action for the current state of the drone."""
        fleet = self.sim.fleet
        if fleet.controls.commands is None:
            return steer(self.sim.flight, fleet.are_changes)
        return choose(self.sim.flight, fleet.velocity_step_m_s, fleet.classic)

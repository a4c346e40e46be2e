"""Pilot of the racer sim: steers toward free space and slows down near walls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.racer.course import Car, Track
from mcaprl.sims.racer.env import RacerEnv
from mcaprl.sims.racer.rays import BLOCK_SIZE, CENTER_RAYS, CENTER_RAYS_RAD, LENGTH, measure
from mcaprl.sims.racer.rules import (
    ACTION_COMMANDS,
    MAX_SPEED_PX,
    SPEED_CHANGE_PX,
    TURN_RAD,
    Command,
)
from mcaprl.sims.vehicle.env import ScriptedPilot

ROOM_EXPONENT, CONTINUOUS_ROOM_EXPONENT = 1.17, 1.3
"""Exponents of a ray's length in the weight of the ray, for discrete and continuous actions."""
TURN_BEYOND_RAD = math.radians(7.5)  # Minimum aim angle for a turn: half of the turn of one action
STOP_PX, SPEED_PER_PX, SLOWEST_PX = 38.5, 0.296, 2.0
"""Target speed, pixels per step: 0.296 (d - 38.5), at least 2, for a free distance d ahead."""


@compiled
def aim(track: Track, car: Car, room_exponent: float) -> tuple[float, float]:
    """Return the wanted turn, radians, right positive, and the wanted change of speed, pixels."""
    # The mean direction of the rays up to 90 degrees to each side, weighted by length, is the turn;
    # the ray straight ahead determines the speed.
    block = np.empty(BLOCK_SIZE)
    measure(track.walls_px, car, False, block)
    lengths_px = block[LENGTH:]
    weights, moments = 0.0, 0.0
    for i in range(CENTER_RAYS):
        if abs(CENTER_RAYS_RAD[i]) <= 0.5 * math.pi:
            weight = lengths_px[i] ** room_exponent
            weights += weight
            moments += weight * CENTER_RAYS_RAD[i]
    wanted_px = min(max((lengths_px[0] - STOP_PX) * SPEED_PER_PX, SLOWEST_PX), MAX_SPEED_PX)
    return moments / weights, wanted_px - car.speed_px


@compiled
def steer(track: Track, car: Car) -> Command:
    """Return the command that turns to the wanted direction and reaches the wanted speed."""
    aim_rad, lacking_px = aim(track, car, CONTINUOUS_ROOM_EXPONENT)
    acceleration, turn = lacking_px / SPEED_CHANGE_PX, -aim_rad / TURN_RAD
    return Command(min(max(acceleration, -1.0), 1.0), min(max(turn, -1.0), 1.0))


@compiled
def choose(track: Track, car: Car, allowed: NDArray[np.int64], classic: bool) -> int:
    """Choose the allowed action that fits the wanted turn, and if possible the change of speed."""
    aim_rad, lacking_px = aim(track, car, ROOM_EXPONENT)
    turn = 0.0 if abs(aim_rad) <= TURN_BEYOND_RAD else math.copysign(1.0, -aim_rad)
    acceleration = 0.0
    if abs(lacking_px) > 0.5 * SPEED_CHANGE_PX:
        acceleration = math.copysign(1.0, -lacking_px if classic else lacking_px)
    best, least = allowed[0], math.inf
    for action in allowed:
        command = ACTION_COMMANDS[action]
        misses = 2.0 * abs(command.turn - turn) + abs(command.acceleration - acceleration)
        if misses < least:
            best, least = action, misses
    return int(best)


class RacerPilot(ScriptedPilot[RacerEnv]):
    """Scripted driver of the racer sim's car."""

    def choose(self) -> int | Command:
        """Choose the action for the current state of the car."""
        fleet = self.sim.fleet
        if fleet.controls.commands is None:
            return steer(fleet.track, self.sim.car)
        chosen = choose(fleet.track, self.sim.car, fleet.action_set, fleet.classic)
        return int(np.flatnonzero(fleet.action_set == chosen)[0])

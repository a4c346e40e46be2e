"""The scripted driver of the racer sim: steer to where there is room, slow down where not."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.geometry.compiled import compiled
from mcaprl.sims.racer.car import Racer
from mcaprl.sims.racer.env import RacerEnv
from mcaprl.sims.racer.rays import CENTRE_RAYS, CENTRE_RAYS_RAD, RAYS, measure
from mcaprl.sims.racer.rules import MAX_SPEED_PX, SPEED_CHANGE_PX, THROTTLE, TURN
from mcaprl.sims.racer.track import Track
from mcaprl.sims.vehicle.arguments import check_one

ROOM_EXPONENT = 1.17
"""How much more a long ray counts than a short one."""
TURN_BEYOND_RAD = math.radians(7.5)
"""Half of what one action turns."""
STOP_PX, SPEED_PER_PX, SLOWEST_PX = 38.5, 0.296, 2.0
"""The speed is in proportion to the free way ahead, less 38.5 pixels, and never below 2."""


@compiled
def choose(track: Track, car: Racer, allowed: NDArray[np.int64], classic: bool) -> int:
    """Choose one of the allowed actions by the rays that look ahead, up to 90 degrees.

    Their mean direction, weighted by the lengths, says where to turn; the one straight ahead says
    how fast to drive. Turning comes first where an action cannot do both.
    """
    lengths_px = np.empty(RAYS)
    measure(track.walls_px, car, False, lengths_px)
    weights, moments = 0.0, 0.0
    for i in range(CENTRE_RAYS):
        if abs(CENTRE_RAYS_RAD[i]) <= 0.5 * math.pi:
            weight = lengths_px[i] ** ROOM_EXPONENT
            weights += weight
            moments += weight * CENTRE_RAYS_RAD[i]
    aim_rad = moments / weights
    turn = 0 if abs(aim_rad) <= TURN_BEYOND_RAD else int(math.copysign(1.0, aim_rad))
    wanted_px = min(max((lengths_px[0] - STOP_PX) * SPEED_PER_PX, SLOWEST_PX), MAX_SPEED_PX)
    lacking_px = wanted_px - car.speed_px
    throttle = 0
    if abs(lacking_px) > 0.5 * SPEED_CHANGE_PX:
        throttle = int(math.copysign(1.0, -lacking_px if classic else lacking_px))
    best, least = allowed[0], math.inf
    for action in allowed:
        misses = 2 * abs(TURN[action] - turn) + abs(THROTTLE[action] - throttle)
        if misses < least:
            best, least = action, misses
    return int(best)


class RacerPilot:
    """Drives the car of one environment, whose state it reads."""

    name: ClassVar[str] = "pilot"

    def __init__(self, sim: RacerEnv) -> None:
        """Take the wheel of `sim`."""
        self._sim = sim

    def act(self, observations: NDArray[np.generic]) -> NDArray[np.int64]:
        """Give the action, shape (1,), for the car as it is now.

        Raises:
            ValueError: there are observations of more than one environment.
        """
        check_one(observations)
        fleet = self._sim.fleet
        chosen = choose(fleet.track, self._sim.car, fleet.action_set, fleet.classic)
        return np.flatnonzero(fleet.action_set == chosen)

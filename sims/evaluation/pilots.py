"""Scripted drivers: what a sim's own knowledge can do, and the 1 on the scale of scores."""

from __future__ import annotations

import importlib
from typing import Any, Final, Protocol, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UnknownNameError

PILOTS: Final[dict[str, tuple[str, str]]] = {
    "mcaprl/LaneKeeping-v0": ("mcaprl.sims.lane.pilot", "LanePilot"),
    "mcaprl/Racer-v0": ("mcaprl.sims.racer.pilot", "RacerPilot"),
    "mcaprl/Powerline-v0": ("mcaprl.sims.powerline.pilot", "PowerlinePilot"),
    "mcaprl/HighwayLane-v0": ("mcaprl.sims.highway.pilot", "HighwayPilot"),
}
"""Module and class of each sim's pilot, by the sim's id."""


class Pilot(Protocol):
    """A scripted policy that drives one environment and reads its state."""

    @property
    def name(self) -> str:
        """What to call it in logs and tables."""

    def act(self, observations: NDArray[np.generic]) -> NDArray[np.int64]:
        """Give actions, shape (1,), for observations with a leading dimension of 1."""


def make_pilot(env: gym.Env[Any, Any]) -> Pilot:
    """Make the pilot of the sim inside `env`, wrapped or not.

    Raises:
        UnknownNameError: the environment has no pilot.
    """
    sim = env.unwrapped
    env_id = sim.spec.id if sim.spec else type(sim).__name__
    if env_id not in PILOTS:
        raise UnknownNameError("environment with a pilot", env_id, PILOTS)
    module, pilot = PILOTS[env_id]
    return cast(Pilot, getattr(importlib.import_module(module), pilot)(sim))

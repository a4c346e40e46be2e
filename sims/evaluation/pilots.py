"""Scripted policies of the sims; their normalized score is 1 by definition."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym

from mcaprl.errors import UnknownNameError
from mcaprl.sims import SIMS
from mcaprl.sims.evaluation.rollout import Policy


def make_pilot(env: gym.Env[Any, Any]) -> Policy:
    """Create the pilot of the sim in `env`, which may be wrapped.

    Raises:
        UnknownNameError: The environment has no pilot.
    """
    sim = env.unwrapped
    env_id = sim.spec.id if sim.spec else type(sim).__name__
    spec = SIMS.find(env_id)
    if spec is None or spec.pilot is None:
        raise UnknownNameError("environment with a pilot", env_id, SIMS)
    return cast(Policy, spec.make_pilot(sim))

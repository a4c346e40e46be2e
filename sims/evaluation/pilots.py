"""Scripted policies of the sims; their normalized score is 1 by definition."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from mcaprl.base_policy import BasePolicy, as_policy
from mcaprl.errors import UnknownNameError
from mcaprl.sims import SIMS
from mcaprl.sims.spec import SimSpec


def make_pilot(env: gym.Env[Any, Any]) -> BasePolicy:
    """Create the pilot of the sim in `env`, which may be wrapped.

    Raises:
        UnknownNameError: The environment has no pilot.
    """
    spec = _spec_of(env)
    if spec is None:
        raise UnknownNameError("environment with a pilot", _id_of(env), SIMS)
    return as_policy(spec.make_pilot(env.unwrapped))


def has_pilot(env: gym.Env[Any, Any]) -> bool:
    """Return whether the sim in `env`, which may be wrapped, has a pilot."""
    return _spec_of(env) is not None


def _spec_of(env: gym.Env[Any, Any]) -> SimSpec | None:
    """Return the sim in `env` if it has a pilot."""
    spec = SIMS.find(_id_of(env))
    return spec if spec is not None and spec.pilot is not None else None


def _id_of(env: gym.Env[Any, Any]) -> str:
    sim = env.unwrapped
    return sim.spec.id if sim.spec else type(sim).__name__

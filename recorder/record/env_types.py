"""Checks that an object is an environment that can be recorded, with advice for other packages."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode

from mcaprl.errors import UsageError

_ADVICE_FOR_BATCH = (
    "; this one steps several environments, but is not a gymnasium.vector.VectorEnv: use the vector"
    " wrapper of its package, and RecordVecMcap"
)


def check_single(env: Any) -> None:
    """Check that an object is a single environment of Gymnasium.

    Raises:
        UsageError: It is a vector environment, or an environment of another package.
    """
    if isinstance(env, gym.vector.VectorEnv):
        raise UsageError("RecordMcap wraps single environments; RecordVecMcap wraps vector ones")
    if not isinstance(env, gym.Env):
        raise _refused("RecordMcap", "an environment", env)
    if _is_batch(env):
        raise UsageError(f"RecordMcap wraps single environments{_ADVICE_FOR_BATCH}")


def check_vector(env: Any) -> None:
    """Check that an object is a vector environment of Gymnasium.

    Raises:
        UsageError: It is a single environment, or an environment of another package.
    """
    if isinstance(env, gym.vector.VectorEnv):
        return
    if not isinstance(env, gym.Env):
        raise _refused("RecordVecMcap", "a vector environment", env)
    advice = _ADVICE_FOR_BATCH if _is_batch(env) else ""
    raise UsageError(
        f"RecordVecMcap wraps vector environments; RecordMcap wraps single ones{advice}"
    )


def autoreset_mode(env: gym.vector.VectorEnv[Any, Any, Any]) -> AutoresetMode:
    """Return the autoreset mode that a vector environment declares.

    Raises:
        UsageError: It declares none.
    """
    declared = env.metadata.get("autoreset_mode")
    try:
        return AutoresetMode(declared)
    except ValueError:
        known = ", ".join(mode.value for mode in AutoresetMode)
        raise UsageError(
            f"metadata['autoreset_mode'] of {env} is {declared!r}, expected one of {known}:"
            " set it to the way in which the environment resets itself"
        ) from None


def _is_batch(env: gym.Env[Any, Any]) -> bool:
    """Return whether an environment steps several environments, as those of some simulators."""
    count = getattr(env.unwrapped, "num_envs", 1)
    return isinstance(count, int) and count > 1


def _refused(wrapper: str, expected: str, env: Any) -> UsageError:
    kind = f"{type(env).__module__}.{type(env).__qualname__}"
    return UsageError(f"{wrapper} needs {expected} of Gymnasium, not {kind}: {_advice(env)}")


def _advice(env: Any) -> str:
    """Return what to do with an object that is not an environment of Gymnasium."""
    names = {f"{one.__module__.split('.')[0]}.{one.__name__}" for one in type(env).__mro__}
    if "stable_baselines3.VecEnv" in names:
        return (
            "record with RecordVecMcap(gymnasium.make_vec(ID, N), ...), or wrap each environment in"
            " RecordMcap, with its own file, before Stable-Baselines3's VecEnv"
        )
    if hasattr(env, "possible_agents"):
        return (
            "PettingZoo's environments have several agents: wrap the one to record as a"
            " gymnasium.Env of a single agent"
        )
    if "gym.Env" in names:
        return "convert the old gym.Env with gymnasium.make('GymV26Environment-v0', env=...)"
    if hasattr(env, "observation_spec"):
        return "convert the dm_env environment with shimmy's DmControlCompatibilityV0"
    return "wrap it in a class derived from gymnasium.Env"

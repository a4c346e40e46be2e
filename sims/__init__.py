"""Sims that record well and learn fast: plain Gymnasium environments, registered on import.

    >>> import mcaprl.sims
    >>> sorted(mcaprl.sims.SIMS)
    ['highway-lane', 'lane', 'powerline', 'racer']

Importing this package loads no engine: numba and pygame wait until a sim is made or drawn.
"""

from __future__ import annotations

from typing import Any, Final

import gymnasium as gym

from mcaprl.errors import UnknownNameError, UsageError, import_extra

SIMS: Final[dict[str, str]] = {
    "lane": "mcaprl/LaneKeeping-v0",
    "racer": "mcaprl/Racer-v0",
    "powerline": "mcaprl/Powerline-v0",
    "highway-lane": "mcaprl/HighwayLane-v0",
}
"""Short name of each sim, and the id that Gymnasium knows it by."""
ENGINES: Final[dict[str, str]] = dict.fromkeys(SIMS.values(), "numba") | {
    SIMS["highway-lane"]: "highway_env"
}
"""What a sim needs of the extra `sims`, by the sim's id."""

gym.register(
    id=SIMS["lane"],
    entry_point="mcaprl.sims.lane:LaneKeepingEnv",
    max_episode_steps=400,
)
gym.register(
    id=SIMS["racer"],
    entry_point="mcaprl.sims.racer:RacerEnv",
    # The classic rules' limit; the default ones end sooner by themselves.
    max_episode_steps=10_000,
)
gym.register(
    id=SIMS["powerline"],
    entry_point="mcaprl.sims.powerline:PowerlineEnv",
    max_episode_steps=400,
)
gym.register(
    id=SIMS["highway-lane"],
    entry_point="mcaprl.sims.highway_lane:HighwayLaneEnv",
    max_episode_steps=700,
)


def make_sim(name: str, **kwargs: Any) -> gym.Env[Any, Any]:
    """Make an environment from a sim's short name or from any Gymnasium id.

    Args:
        name: one of `SIMS`, or an id such as `CartPole-v1` or `module:Name-v0`.
        **kwargs: for the environment's constructor, such as `observation`, `rules`, `render_mode`.

    Raises:
        UnknownNameError: there is no such sim, or the sim does not know the value of an argument.
        MissingExtraError: the packages that the sim needs are not installed.
        UsageError: the environment takes no such argument, or cannot be made.
    """
    env_id = SIMS.get(name, name)
    if env_id in ENGINES:
        import_extra(ENGINES[env_id], "sims")
    try:
        return gym.make(env_id, **kwargs)
    except gym.error.UnregisteredEnv as error:
        known = [*SIMS, "any Gymnasium id"]
        raise UnknownNameError("sim", name, known, gym.registry) from error
    except (TypeError, ValueError, gym.error.Error, ModuleNotFoundError) as error:
        given = ", ".join(f"{key}={value!r}" for key, value in kwargs.items()) or "no arguments"
        reason = str(error).split(" was raised from the environment creator")[0]
        raise UsageError(f"cannot make sim '{name}' with {given}: {reason}") from error


__all__ = ["SIMS", "make_sim"]

"""Sims that record well and learn fast: plain Gymnasium environments, registered on import.

    >>> import mcaprl.sims
    >>> sorted(mcaprl.sims.SIMS)
    ['highway-lane', 'lane', 'powerline', 'racer']

Importing this package loads no engine: numba and pygame wait until a sim is made or drawn.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, Final

import gymnasium as gym

from mcaprl.errors import UnknownNameError, UsageError, import_extra
from mcaprl.lazy import lazy_attributes

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

# The checker that Gymnasium would wrap around these takes time in each step; the tests run it.
gym.register(
    id=SIMS["lane"],
    entry_point="mcaprl.sims.lane.env:LaneKeepingEnv",
    vector_entry_point="mcaprl.sims.lane.env:BatchedLaneKeepingEnv",
    max_episode_steps=400,
    disable_env_checker=True,
)
gym.register(
    id=SIMS["racer"],
    entry_point="mcaprl.sims.racer.env:RacerEnv",
    vector_entry_point="mcaprl.sims.racer.env:BatchedRacerEnv",
    # The classic rules' limit; the default ones end sooner by themselves.
    max_episode_steps=10_000,
    disable_env_checker=True,
)
gym.register(
    id=SIMS["powerline"],
    entry_point="mcaprl.sims.powerline.env:PowerlineEnv",
    vector_entry_point="mcaprl.sims.powerline.env:BatchedPowerlineEnv",
    max_episode_steps=400,
    disable_env_checker=True,
)
gym.register(
    id=SIMS["highway-lane"],
    entry_point="mcaprl.sims.highway.env:HighwayLaneEnv",
    max_episode_steps=700,
    disable_env_checker=True,
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
    with _errors_of(name, kwargs):
        return gym.make(SIMS.get(name, name), **kwargs)


def make_sims(
    name: str, num_envs: int, *, autoreset_mode: str = "NextStep", **kwargs: Any
) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make many environments that are stepped together, in this process.

    Our own sims advance all their vehicles in one array step; other environments are stepped one
    after the other.

    Args:
        name: as of `make_sim`.
        num_envs: how many.
        autoreset_mode: `NextStep`, `SameStep` or `Disabled`; see
            `gymnasium.vector.AutoresetMode`.
        **kwargs: as of `make_sim`.

    Raises:
        UnknownNameError, MissingExtraError, UsageError: as of `make_sim`.
    """
    env_id, modes = SIMS.get(name, name), [mode.value for mode in gym.vector.AutoresetMode]
    if autoreset_mode not in modes:
        raise UnknownNameError("autoreset_mode", autoreset_mode, modes)
    with _errors_of(name, kwargs):
        if env_id in SIMS.values() and gym.registry[env_id].vector_entry_point:
            return gym.make_vec(env_id, num_envs, autoreset_mode=autoreset_mode, **kwargs)
        options = {"autoreset_mode": autoreset_mode}
        return gym.make_vec(env_id, num_envs, "sync", vector_kwargs=options, **kwargs)


@contextlib.contextmanager
def _errors_of(name: str, kwargs: dict[str, Any]) -> Iterator[None]:
    """Tell in a user's terms why a sim cannot be made."""
    env_id = SIMS.get(name, name)
    if env_id in ENGINES:
        import_extra(ENGINES[env_id], "sims")
    try:
        yield
    except gym.error.UnregisteredEnv as error:
        known = [*SIMS, "any Gymnasium id"]
        raise UnknownNameError("sim", name, known, gym.registry) from error
    except (TypeError, ValueError, gym.error.Error, ModuleNotFoundError) as error:
        given = ", ".join(f"{key}={value!r}" for key, value in kwargs.items()) or "no arguments"
        reason = str(error).split(" was raised from the environment creator")[0]
        raise UsageError(f"cannot make sim '{name}' with {given}: {reason}") from error


__all__ = [
    "SIMS",
    "EpsilonGreedy",
    "LaneKeepingEnv",
    "Policy",
    "PolicyScore",
    "encode_depth",
    "episode_seed",
    "evaluate",
    "make_pilot",
    "make_sim",
    "make_sims",
    "normalize",
    "rollout",
]

# Imported on first use.
__getattr__ = lazy_attributes(
    __name__,
    {
        "mcaprl.sims.drawing.depth": ("encode_depth",),
        "mcaprl.sims.evaluation.evaluate": ("PolicyScore", "evaluate", "normalize"),
        "mcaprl.sims.evaluation.pilots": ("make_pilot",),
        "mcaprl.sims.evaluation.rollout": ("EpsilonGreedy", "Policy", "episode_seed", "rollout"),
        "mcaprl.sims.lane.env": ("LaneKeepingEnv",),
    },
)

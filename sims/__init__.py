"""Plain Gymnasium environments of vehicles, registered on import.

    >>> import mcaprl.sims
    >>> sorted(mcaprl.sims.SIMS)
    ['highway-lane', 'lane', 'powerline', 'racer']

Importing this package does not import numba or pygame; making or rendering a sim does.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym

from mcaprl.errors import McaprlError, UnknownNameError, UsageError, import_extra
from mcaprl.lazy import lazy_attributes
from mcaprl.sims import highway, lane, powerline, racer
from mcaprl.sims.spec import SimCatalog, SimSpec
from mcaprl.system import has_display

if TYPE_CHECKING:
    from mcaprl.base_policy import BasePolicy as Policy
    from mcaprl.sims.drawing.camera import lens
    from mcaprl.sims.drawing.depth import DepthCamera, encode_depth
    from mcaprl.sims.evaluation.evaluate import (
        PolicyScore,
        Scale,
        evaluate,
        improvement_probability,
        interquartile_mean,
        make_pilot,
        normalize,
    )
    from mcaprl.sims.evaluation.rollout import EpsilonGreedy, NoisyPolicy, episode_seed, rollout
    from mcaprl.sims.lane.camera import CarCamera
    from mcaprl.sims.lane.env import LaneKeepingEnv
    from mcaprl.sims.vehicle.device import DeviceSims

SIMS: Final = SimCatalog((lane.SPEC, racer.SPEC, powerline.SPEC, highway.SPEC))
"""Gymnasium id of each sim by short name, including sims of installed packages."""

# Attribute of an environment with the name of the module that registers it. Recorders log the name.
_ENV_MODULE: Final = "env_module"


def make_sim(name: str, /, **kwargs: Any) -> gym.Env[Any, Any]:
    """Make an environment from a sim's short name or from any Gymnasium id.

    Args:
        name: Key of `SIMS`, or an id such as `CartPole-v1` or `module:Name-v0`.
        **kwargs: Arguments of the environment, such as `observation`, `rules`, `render_mode`.

    Raises:
        UnknownNameError: There is no such sim, or an argument has a value that the sim does not
            accept.
        MissingExtraError: The packages that the sim needs are not installed.
        UsageError: The environment does not accept an argument, or creating it fails.
    """
    env_id, spec = _resolve(name)
    if kwargs.get("render_mode") == "rgb_array" and not has_display():
        # SDL prints an error while it looks for a display, which images do not need.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    with _clear_errors(name, spec, kwargs):
        env = gym.make(env_id, **kwargs)
    _set_module([env], env_id)
    return env


def make_sims(
    name: str,
    num_envs: int,
    *,
    autoreset_mode: str = "NextStep",
    wrappers: Sequence[Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]] = (),
    **kwargs: Any,
) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make environments that are stepped together in this process.

    Sims with a vector environment advance all their vehicles in one array step; other environments
    are stepped one after the other.

    Args:
        name: As in `make_sim`.
        num_envs: Number of environments.
        autoreset_mode: `NextStep`, `SameStep` or `Disabled`; see
            `gymnasium.vector.AutoresetMode`.
        wrappers: Wrappers of each environment, the innermost first. With wrappers, environments are
            stepped one after the other.
        **kwargs: As in `make_sim`.

    Raises:
        UnknownNameError, MissingExtraError, UsageError: As in `make_sim`.
    """
    modes = [mode.value for mode in gym.vector.AutoresetMode]
    if autoreset_mode not in modes:
        raise UnknownNameError("autoreset_mode", autoreset_mode, modes)
    env_id, spec = _resolve(name)
    with _clear_errors(name, spec, kwargs):
        if spec is not None and spec.vector_entry_point and not wrappers:
            return gym.make_vec(env_id, num_envs, autoreset_mode=autoreset_mode, **kwargs)
        options = {"autoreset_mode": autoreset_mode}
        wraps: Any = list(wrappers)
        envs = gym.make_vec(
            env_id, num_envs, "sync", vector_kwargs=options, wrappers=wraps, **kwargs
        )
    _set_module(getattr(envs.unwrapped, "envs", ()), env_id)
    return envs


def make_device_sims(
    name: str,
    num_envs: int,
    *,
    device: str,
    seed: int = 0,
    max_episode_steps: int | None = None,
    **kwargs: Any,
) -> DeviceSims:
    """Make vehicles whose states and observations stay on one device between steps.

    The sims `lane` and `racer` support this, with their default rules, and with vectors as
    observations. On a GPU, this needs the extra `gpu`.

    Args:
        name: `lane` or `racer`, or the short name or id of another sim that supports it.
        num_envs: Number of vehicles.
        device: `cpu` or `cuda`.
        seed: Seed of the starting states.
        max_episode_steps: Steps after which an episode is truncated; default: as in `make_sim`.
        **kwargs: `start`, and for the racer `drift` and `track_seed`; see the sims.

    Raises:
        UnknownNameError, MissingExtraError: As in `make_sim`.
        UsageError: The sim does not support this, an argument is invalid, or there is no GPU.
    """
    spec = _resolve(name)[1]
    if spec is None or spec.device_entry_point is None:
        specs = [SIMS.find(env_id, loads=False) for env_id in SIMS.values()]
        able = " and ".join(one.name for one in specs if one and one.device_entry_point)
        raise UsageError(f"sim '{name}' cannot stay on a device; {able} can")
    actions = kwargs.get("actions", gym.spec(_resolve(name)[0]).kwargs.get("actions", "discrete"))
    if isinstance(actions, str):
        if actions != "discrete":
            raise UsageError(
                f"device sims have discrete actions only: sim '{name}' has actions '{actions}'"
            )
        kwargs.pop("actions", None)
    module, _, attribute = spec.device_entry_point.partition(":")
    steps = max_episode_steps or spec.max_episode_steps or sys.maxsize
    options = {"num_envs": num_envs, "device": device, "seed": seed, "max_episode_steps": steps}
    with _clear_errors(name, spec, kwargs):
        sims: DeviceSims = getattr(importlib.import_module(module), attribute)(**options, **kwargs)
    return sims


def _set_module(envs: Iterable[gym.Env[Any, Any]], env_id: str) -> None:
    """Store the module part of `env_id` in the environments, so that recorders can log it."""
    module = env_id.rpartition(":")[0]
    for env in envs:
        if module and not hasattr(env.unwrapped, _ENV_MODULE):
            setattr(env.unwrapped, _ENV_MODULE, module)


def _resolve(name: str) -> tuple[str, SimSpec | None]:
    """Return the Gymnasium id of a name, and its `SimSpec`; the spec is None if it is not a sim."""
    env_id = SIMS.get(name, name)
    is_known_to_gymnasium = env_id in gym.registry or ":" in env_id
    return env_id, SIMS.find(env_id, loads=not is_known_to_gymnasium)


@contextlib.contextmanager
def _clear_errors(name: str, spec: SimSpec | None, kwargs: dict[str, Any]) -> Iterator[None]:
    """Context manager that converts errors during `gym.make` to errors of this package."""
    if spec is not None and spec.engine:
        import_extra(spec.engine, "sims")
    try:
        yield
    except gym.error.UnregisteredEnv as error:
        known = [*SIMS, "any Gymnasium id"]
        raise UnknownNameError("sim", name, known, gym.registry) from error
    except (McaprlError, OSError):
        raise
    # An environment may raise any exception, for example for an argument with a wrong type.
    except Exception as error:
        given = ", ".join(f"{key}={value!r}" for key, value in kwargs.items()) or "no arguments"
        reason = str(error).split(" was raised from the environment creator")[0]
        unknown = re.search(r"unexpected keyword argument '(\w+)'", reason)
        if unknown and unknown[1] in kwargs:
            raise UsageError(f"sim '{name}' has no argument {unknown[1]}: omit it") from error
        if not isinstance(error, TypeError | ValueError | gym.error.Error | ModuleNotFoundError):
            reason = f"{type(error).__name__}: {reason}"
        raise UsageError(f"cannot make sim '{name}' with {given}: {reason}") from error


__all__ = [
    "SIMS",
    "CarCamera",
    "DepthCamera",
    "DeviceSims",
    "EpsilonGreedy",
    "LaneKeepingEnv",
    "NoisyPolicy",
    "Policy",
    "PolicyScore",
    "Scale",
    "SimSpec",
    "encode_depth",
    "episode_seed",
    "evaluate",
    "improvement_probability",
    "interquartile_mean",
    "lens",
    "make_device_sims",
    "make_pilot",
    "make_sim",
    "make_sims",
    "normalize",
    "rollout",
]

# These names are imported on first use.
__getattr__ = lazy_attributes(
    __name__,
    {
        "mcaprl.sims.drawing.camera": ("lens",),
        "mcaprl.sims.drawing.depth": ("DepthCamera", "encode_depth"),
        "mcaprl.base_policy": ("BasePolicy as Policy",),
        "mcaprl.sims.evaluation.evaluate": (
            "PolicyScore",
            "Scale",
            "evaluate",
            "improvement_probability",
            "interquartile_mean",
            "make_pilot",
            "normalize",
        ),
        "mcaprl.sims.evaluation.rollout": (
            "EpsilonGreedy",
            "NoisyPolicy",
            "episode_seed",
            "rollout",
        ),
        "mcaprl.sims.lane.camera": ("CarCamera",),
        "mcaprl.sims.lane.env": ("LaneKeepingEnv",),
        "mcaprl.sims.vehicle.device": ("DeviceSims",),
    },
)

"""Environments from the options of commands or the metadata of logs."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym

from mcaprl.api.policies import SCRIPTED, load_policies
from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.format.metadata import as_json, same_env
from mcaprl.sims import SIMS, make_sim
from mcaprl.texts import shortened

_MAX_SHOWN = 200


def all_options(
    observation: str | None,
    rules: str | None,
    actions: str | int | None,
    others: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """Return the arguments of a sim, except arguments that are None.

    >>> all_options("depth", None, None, {"road": "racetrack-v0"})
    {'observation': 'depth', 'road': 'racetrack-v0'}
    """
    named = {"observation": observation, "rules": rules, "actions": actions}
    given = {name: value for name, value in named.items() if value is not None}
    for name in given.keys() & (others or {}).keys():
        raise UsageError(f"the argument {name} is given twice: pass it once")
    return given | dict(others or {})


def name_of(sim: str | gym.Env[Any, Any]) -> str:
    """Return the name of a sim, or the id or class of an environment."""
    if isinstance(sim, str):
        return sim
    if not isinstance(sim, gym.Env):
        raise UsageError(f"{sim!r} is not a single environment: pass a gymnasium.Env, or a name")
    return sim.spec.id if sim.spec else type(sim.unwrapped).__name__


def check_names(*given: object) -> None:
    """Check that sims and policies are given by names, which other processes can use."""
    objects = [each for each in given if not isinstance(each, str)]
    if objects:
        raise UsageError(
            f"several processes need names of sims and policies, not {objects[0]!r}: pass a name"
            " or a path, or use one process"
        )


def trained_options(
    names: Iterable[str], sim: str | gym.Env[Any, Any], options: dict[str, Any], *, trust_env: bool
) -> dict[str, Any]:
    """Return the arguments of an environment in which policies act."""
    # If none are given, they are those of the policies' training in the same environment. Without
    # `trust_env`, arguments in files are passed to the sims of `SIMS` only; a warning names them.
    if not isinstance(sim, str):
        if options:
            raise UsageError(
                f"{', '.join(options)}: arguments are for a sim that is given by its name"
            )
        return {}
    paths = [Path(name) for name in names if name not in SCRIPTED and Path(name).exists()]
    if options or not paths:
        return options
    found: dict[str, dict[str, Any]] = {}
    for path in paths:
        policy = load_policies(path)[0]
        if policy.env_id and same_env(policy.env_id, SIMS.get(sim, sim)):
            found[str(path)] = _special(policy.env_kwargs, sim, imports=True)
    first = next(iter(found.values()), {})
    if any(other != first for other in found.values()):
        _warn(found, sim, "the policies were trained with different arguments: pass them")
        return {}
    if first and not trust_env and _needs_trust(sim):
        _warn(found, sim, "to use the arguments of the run, pass `trust_env=True` or the arguments")
        return {}
    return first


def _warn(found: Mapping[str, dict[str, Any]], sim: str, advice: str) -> None:
    name, arguments = next((name, one) for name, one in found.items() if one)
    warnings.warn(
        f"{name} was trained with {_shown(arguments)}, but {sim} is used with its defaults;"
        f" {advice}, as `sim_options={shortened(repr(arguments), _MAX_SHOWN)}`",
        stacklevel=3,
    )


def sim_of(
    dataset: Dataset,
    path: Path,
    sim: str | None = None,
    *,
    trust_env: bool = False,
    sim_options: Mapping[str, Any] | None = None,
    render_mode: str | None = None,
) -> gym.Env[Any, Any]:
    """Make the environment in which a log was recorded."""
    # `sim` and `sim_options` replace what the log says. `trust_env` imports the module that the
    # logged id names, and passes logged arguments to environments other than the sims of `SIMS`.
    name, given = sim or dataset.env_id, dict(sim_options or {})
    if not name:
        raise UsageError(f"{path} has no environment id: pass `sim=NAME`")
    module, _, registered = name.rpartition(":")
    # A module that this program has imported is no choice of the log.
    is_imported = module in sys.modules and registered in gym.registry
    if sim is None and module and not (trust_env or is_imported):
        raise UsageError(
            f"{path} names the environment {name}, so the module {module} would be imported: if you"
            f" trust the log, pass `trust_env=True` or `sim={name!r}`"
        )
    missing = [argument for argument in dataset.unstored_kwargs if argument not in given]
    if missing:
        raise UsageError(
            f"{path} was recorded with arguments of {name} that are not stored, because they are"
            f" not JSON: {', '.join(missing)}; pass them with `sim_options=`"
        )
    logged = {key: value for key, value in dataset.env_kwargs.items() if key not in given}
    logged = _special(logged, name, imports=trust_env or sim is not None)
    if logged and not trust_env and _needs_trust(name):
        raise UsageError(
            f"{path} names arguments of {name}: {_shown(logged)}; if you trust the log, pass"
            " `trust_env=True`"
        )
    others = {} if render_mode is None else {"render_mode": render_mode}
    try:
        return make_sim(name, **{**logged, **given, **others})
    except UnknownNameError as error:
        if sim is not None or error.kind != "sim":
            raise
        raise UsageError(
            f"{path} was recorded in {name}, which is not registered: pass"
            f" `sim='MODULE:{registered}'` with the module that registers it"
        ) from error


def _needs_trust(name: str) -> bool:
    """Return whether arguments from a file may be passed to this environment only with trust."""
    return SIMS.find(SIMS.get(name, name), loads=":" not in name) is None


def _special(arguments: Mapping[str, Any], name: str, *, imports: bool) -> dict[str, Any]:
    """Return the arguments that differ from the defaults of an environment's registration."""
    env_id = SIMS.get(name, name)
    module, _, registered = env_id.rpartition(":")
    if registered not in gym.registry and module and imports:
        # `make_sim` reports an id that cannot be used. `gym.spec` would not import the module.
        with suppress(Exception):
            import_module(module)
    spec = gym.registry.get(registered)
    found = dict(arguments)
    for key, default in (spec.kwargs if spec else {}).items():
        with suppress(ValueError):
            if key in found and as_json(default) == found[key]:
                del found[key]
    return found


def _shown(arguments: Mapping[str, Any]) -> str:
    texts = (f"{key}={value!r}" for key, value in arguments.items())
    return shortened(", ".join(texts), _MAX_SHOWN)


def check_episode(dataset: Dataset, episode: int | None, path: Path) -> None:
    """Check that a log has an episode with this index, or that the index is None."""
    last = len(dataset.episodes) - 1
    if episode is not None and not 0 <= episode <= last:
        raise UsageError(f"`episode={episode}`: {path} has episodes 0 to {last}")

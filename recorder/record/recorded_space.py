"""What of an environment can be recorded, and the space of the observations in its log.

A log stores a Tuple as a Dict with the keys `0`, `1`, ..., and may omit parts of a Dict or Tuple.
The agent still receives the observation of the environment.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from mcaprl.errors import SpaceError, UnknownNameError, UsageError
from mcaprl.recorder.format.spaces import (
    Leaf,
    check_key,
    is_below,
    leaves_of,
    nest,
    observation_leaves,
)

_ADVICE_FOR_BATCH = (
    "; this one steps several environments, but is not a gymnasium.vector.VectorEnv: use the vector"
    " wrapper of its package, and RecordVecMcap"
)


def check_single(env: Any) -> None:
    """Check that an object is a single environment of Gymnasium."""
    if isinstance(env, gym.vector.VectorEnv):
        raise UsageError("RecordMcap wraps single environments; RecordVecMcap wraps vector ones")
    if not isinstance(env, gym.Env):
        raise _refused("RecordMcap", "an environment", env)
    if _is_batch(env):
        raise UsageError(f"RecordMcap wraps single environments{_ADVICE_FOR_BATCH}")


def check_vector(env: Any) -> None:
    """Check that an object is a vector environment of Gymnasium."""
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


class RecordedSpace(NamedTuple):
    """The part of an observation space that a log stores.

    Attributes:
        space: Observation space of the log.
        leaves: Leaves of this space.
        paths: Path of each leaf in an observation of the environment. Keys of a Dict are strings,
            indexes of a Tuple are integers.
    """

    space: spaces.Space[Any]
    leaves: tuple[Leaf, ...]
    paths: tuple[tuple[str | int, ...], ...]

    def of(self, observation: Any) -> Any:
        """Return an observation of the environment, or a batch of them, in the form of the log."""
        return nest(self.leaves, [value_at(observation, path) for path in self.paths])


def recorded_space(space: spaces.Space[Any], keys: Sequence[str] | None = None) -> RecordedSpace:
    """Return the form in which a log stores the observations of an environment."""
    parts = dict(_parts(space, ()))
    paths = list(parts)
    if keys is not None:
        paths = _selected(paths, keys, space)
    changes = len(paths) < len(parts) or any(isinstance(key, int) for path in paths for key in path)
    logged = space
    if changes:
        logged = _dict_of([(tuple(map(str, path)), parts[path]) for path in paths])
    try:
        return RecordedSpace(logged, observation_leaves(logged), tuple(paths))
    except SpaceError as error:
        cure = "convert it with a TransformObservation wrapper"
        if any(paths):
            cure = f"{_keys_cure(parts)}, or {cure}"
        raise SpaceError(f"{error}; {cure}") from error


def recorded_like(space: spaces.Space[Any], logged: spaces.Space[Any]) -> RecordedSpace:
    """Return the form in which a log with the space `logged` stores an environment's observations.

    Raises:
        SpaceError: A log cannot store a part that `logged` has.
        UnknownNameError: The environment lacks a part.
        UsageError: Only `logged` has keys.
    """
    keys = None
    if isinstance(logged, spaces.Dict):
        keys = ["/".join(leaf.path) for leaf in leaves_of(logged)]
    return recorded_space(space, keys)


def _parts(
    space: spaces.Space[Any], path: tuple[str | int, ...]
) -> Iterator[tuple[tuple[str | int, ...], spaces.Space[Any]]]:
    """Yield the path and the space of each part that is neither a Dict nor a Tuple."""
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            check_key(key, "observation", path)
            yield from _parts(part, (*path, key))
    elif isinstance(space, spaces.Tuple):
        for index, part in enumerate(space.spaces):
            yield from _parts(part, (*path, index))
    else:
        yield path, space


def _selected(
    paths: Sequence[tuple[str | int, ...]], keys: Sequence[str], space: spaces.Space[Any]
) -> list[tuple[str | int, ...]]:
    """Return the paths that the keys select."""
    if isinstance(keys, str):
        keys = [keys]
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        raise UsageError(
            f"keys select parts of a Dict or Tuple, but the observation space is {space}: omit keys"
        )
    if not keys:
        raise UsageError("keys is empty, so no observation would be recorded: pass some keys")
    names = {path: "/".join(map(str, path)) for path in paths}
    for key in keys:
        if not any(is_below(name, key) for name in names.values()):
            raise UnknownNameError("key of the observation", str(key), names.values())
    return [path for path, name in names.items() if any(is_below(name, key) for key in keys)]


def _dict_of(parts: Sequence[tuple[tuple[str, ...], spaces.Space[Any]]]) -> spaces.Dict:
    """Return the Dict space with these paths, in order."""
    groups: dict[str, list[tuple[tuple[str, ...], spaces.Space[Any]]]] = {}
    for (key, *rest), part in parts:
        groups.setdefault(key, []).append((tuple(rest), part))
    return spaces.Dict(
        [(key, _dict_of(inner) if inner[0][0] else inner[0][1]) for key, inner in groups.items()]
    )


def _keys_cure(parts: dict[tuple[str | int, ...], spaces.Space[Any]]) -> str:
    """Return an advice to leave out the parts that a log cannot store."""
    good = []
    for path, part in parts.items():
        try:
            leaves_of(part)
        except SpaceError:
            continue
        good.append("/".join(map(str, path)))
    if not good:
        return "no part of the observation can be recorded"
    return f"leave it out with `keys={good}`"


def value_at(observation: Any, path: Sequence[str | int]) -> Any:
    """Return the part of an observation at a path of keys and indexes."""
    for key in path:
        observation = observation[key]
    return observation

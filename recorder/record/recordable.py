"""What of an environment can be recorded: values as arrays, infos, and the space of observations.

A log stores a Tuple as a Dict with the keys `0`, `1`, ..., and may omit parts of a Dict or Tuple.
Texts in an observation, such as the missions of MiniGrid, become infos. The agent still receives
the observation of the environment.

Simulators on a GPU return tensors of PyTorch or arrays of JAX, CuPy or Warp. Their packages are not
imported here.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mcaprl.errors import SpaceError, UnknownNameError, UsageError
from mcaprl.recorder.format.log_writer import InfoTopics, flat_infos, info_array
from mcaprl.recorder.format.spaces import (
    Leaf,
    check_key,
    is_below,
    leaves_of,
    nest,
    observation_leaves,
)

_FINAL_NAMES = ("final_obs", "final_observation")
"""Names of the last observations in the infos of vector environments, the current name first."""


def as_array(value: Any) -> NDArray[Any]:
    """Convert a value to a NumPy array; the data is copied only if it is not in main memory."""
    if type(value) is np.ndarray:
        return value
    if hasattr(value, "detach") and hasattr(value, "cpu"):
        return _of_tensor(value.detach().cpu())
    if hasattr(value, "__dlpack__") and not hasattr(value, "__array__"):
        return np.from_dlpack(value)
    try:
        return np.asarray(value)
    except (TypeError, RuntimeError):
        # NumPy does not convert lists of tensors that are on a GPU or have gradients.
        if isinstance(value, list | tuple):
            return np.asarray([as_array(each) for each in value])
        # CuPy refuses implicit copies from the GPU.
        if not hasattr(value, "get"):
            raise
        return np.asarray(value.get())


def as_arrays(values: Any) -> Any:
    """Convert the arrays in nested dicts to NumPy arrays, and keep all other values."""
    if isinstance(values, Mapping):
        return {key: as_arrays(part) for key, part in values.items()}
    return as_array(values) if is_other_array(values) else values


def is_other_array(value: Any) -> bool:
    """Return whether a value is an array of another package than NumPy."""
    has_data = hasattr(value, "__array__") or hasattr(value, "__dlpack__")
    return has_data and not isinstance(value, np.ndarray | np.generic)


def one_each(what: str, values: NDArray[Any], count: int) -> NDArray[Any]:
    """Return one value for each of `count` environments, (N,)."""
    if values.shape == (count,):
        return values
    if values.size != count:
        cure = "; combine several rewards with a wrapper" if what == "reward" else ""
        raise SpaceError(
            f"each environment must have one {what}, but those of {count} environments have shape"
            f" {values.shape}{cure}"
        )
    return values.reshape(count)


def final_observation(
    infos: Mapping[str, Any], number: int, count: int, space: spaces.Space[Any]
) -> Any:
    """Return the last observation of one environment reset in the same step; None without one."""
    for name in _FINAL_NAMES:
        mask = infos.get(f"_{name}")
        if infos.get(name) is not None and (mask is None or bool(mask[number])):
            return _row(infos[name], number, count, space)
    return None


def _row(values: Any, number: int, count: int, space: spaces.Space[Any]) -> Any:
    if isinstance(space, spaces.Dict) and isinstance(values, Mapping):
        return {
            key: _row(values[key], number, count, part)
            for key, part in space.spaces.items()
            if key in values
        }
    if isinstance(space, spaces.Tuple) and _is_batched(values, number, space):
        parts = zip(values, space.spaces, strict=True)
        return tuple(_row(part, number, count, of) for part, of in parts)
    try:
        found = len(values)
        row = values[number]
    except (TypeError, KeyError, IndexError):
        found = 0
    if found != count:
        raise SpaceError(
            f"infos['{_FINAL_NAMES[0]}'] is {values!r:.60}: it must have one item for each of the"
            f" {count} environments"
        )
    return row


def _is_batched(values: Any, number: int, space: spaces.Tuple[Any]) -> bool:
    """Return whether values are the batched parts of a Tuple, and not one tuple per environment."""
    if not isinstance(values, list | tuple) or len(values) != len(space.spaces):
        return False
    return number >= len(values) or not isinstance(values[number], list | tuple)


def _of_tensor(tensor: Any) -> NDArray[Any]:
    try:
        return np.asarray(tensor)
    except TypeError:
        # NumPy lacks some of PyTorch's float types, such as bfloat16.
        return np.asarray(tensor.float())


class EpisodeInfos:
    """Collector of the infos of one episode, which are written at its end."""

    def __init__(self, topics: InfoTopics, names: bool | Sequence[str]) -> None:
        """Begin without infos."""
        self._topics = topics
        one = [names] if isinstance(names, str) else names
        self._names = None if isinstance(one, bool) else tuple(one)
        self._values: dict[str, tuple[list[int], list[Any]]] = {}
        self._twice: set[str] = set()

    def begin(self, info: Mapping[str, Any]) -> None:
        """Drop the infos of earlier episodes, and store the info that `reset` returned."""
        self._values.clear()
        self.add(0, info)

    def add(self, step: int, info: Mapping[str, Any]) -> None:
        """Store the info that came with observation `step` of the episode."""
        for name, value in flat_infos(info):
            if self._names is None or any(
                name == one or name.startswith(f"{one}.") for one in self._names
            ):
                steps, values = self._values.setdefault(name, ([], []))
                if steps and steps[-1] == step:
                    self._twice.add(name)
                steps.append(step)
                values.append(_copied(value))

    def end(self, length: int, start_ns: int, step_ns: int) -> None:
        """Write the infos of an episode of `length` transitions, without those of later steps."""
        found, refused = {}, self._topics.refused
        for name, (steps, values) in self._values.items():
            count = sum(step <= length for step in steps)
            if not count:
                continue
            array = info_array(values[:count])
            if name in self._twice:
                refused[name] = "two entries of the info have this name"
            elif array is None:
                refused[name] = (
                    "a log stores flags, texts, integers, float32, float64, and arrays of one"
                    " shape, but not a mixture of these"
                )
            else:
                found[name] = ([start_ns + step * step_ns for step in steps[:count]], array)
        self._values.clear()
        self._topics.write(found)

    def warn(self) -> None:
        """Warn once about each info that the log cannot store; call this after `end`."""
        for name, why in self._topics.refused.items():
            if name not in self._topics.warned:
                self._topics.warned.add(name)
                warnings.warn(f"the info '{name}' is not recorded: {why}", stacklevel=5)


def _copied(value: Any) -> Any:
    """Copy arrays and lists, because the environment may change them later."""
    if is_other_array(value):
        value = as_array(value)
        return value.copy() if value.ndim else value[()]
    if isinstance(value, np.ndarray):
        return value.copy()
    return [_copied(each) for each in value] if isinstance(value, list | tuple) else value


def info_of(infos: Any, number: int, count: int) -> dict[str, Any]:
    """Return the info of one of `count` environments from the infos of a vector environment."""
    # Gymnasium stores one array per info, whose mask `_name` selects the environments with it. A
    # value of another length belongs to each environment. Some return a sequence of dicts.
    if not isinstance(infos, Mapping):
        one = infos[number] if len(infos) == count else None
        return dict(one) if isinstance(one, Mapping) else {}
    found: dict[str, Any] = {}
    for name, value in infos.items():
        mask = infos.get(f"_{name}")
        is_own = name in ("final_obs", "final_observation", "final_info") or name.startswith("_")
        if is_own or (mask is not None and not mask[number]):
            continue
        if isinstance(value, Mapping):
            inner = info_of(value, number, count)
            if inner:
                found[name] = inner
        elif isinstance(value, np.ndarray | list | tuple):
            found[name] = value[number] if np.shape(value)[:1] == (count,) else value
    return found


def final_info(infos: dict[str, Any]) -> Any:
    """Return the infos of the episodes that ended in same-step mode."""
    found = infos.get("final_info")
    return {} if found is None else found


def info_reason(infos: Any, number: int) -> Any:
    """Return the reason in the infos of one environment; None if there is none."""
    if not isinstance(infos, Mapping):
        # Some vector environments return one dict for each environment.
        one = infos[number] if isinstance(infos, np.ndarray | list | tuple) else None
        return one.get("reason") if isinstance(one, Mapping) else None
    found = infos.get("reason")
    return found[number] if isinstance(found, np.ndarray | list | tuple) else None


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
    """Check that an object is a vector environment of Gymnasium whose steps are those of all."""
    if isinstance(env, gym.vector.VectorEnv):
        rows = getattr(env.unwrapped, "batch_size", env.num_envs)
        if isinstance(rows, int) and rows != env.num_envs:
            raise UsageError(
                f"RecordVecMcap records the steps of all environments, and {env} returns those of"
                f" {rows} of its {env.num_envs} at a time: make it with batch_size={env.num_envs}"
            )
        return
    if not isinstance(env, gym.Env):
        raise _refused("RecordVecMcap", "a vector environment", env)
    advice = _ADVICE_FOR_BATCH if _is_batch(env) else ""
    raise UsageError(
        f"RecordVecMcap wraps vector environments; RecordMcap wraps single ones{advice}"
    )


def autoreset_mode(env: gym.vector.VectorEnv[Any, Any, Any]) -> AutoresetMode:
    """Return the autoreset mode that a vector environment declares."""
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
    """The part of an observation space that a log stores."""

    space: spaces.Space[Any]  # Observation space of the log
    leaves: tuple[Leaf, ...]
    # Path of each leaf in an observation of the environment. Keys of a Dict are strings, indexes of
    # a Tuple are integers.
    paths: tuple[tuple[str | int, ...], ...]
    texts: dict[str, tuple[str | int, ...]]  # Path of each text by the name of its info

    def of(self, observation: Any) -> Any:
        """Return an observation of the environment, or a batch of them, in the form of the log."""
        return nest(self.leaves, [value_at(observation, path) for path in self.paths])

    def infos(self, wanted: bool | Sequence[str]) -> bool | Sequence[str]:
        """Return the names of the infos to record, with those of the texts."""
        if wanted is True or not self.texts:
            return wanted
        return [*([wanted] if isinstance(wanted, str) else wanted or []), *self.texts]

    def info(self, info: Any, observation: Any, number: int | None = None) -> Any:
        """Return an info with the texts of an observation, of environment `number` of a batch."""
        if not self.texts:
            return info
        found = {name: value_at(observation, path) for name, path in self.texts.items()}
        if number is not None:
            found = {name: texts[number] for name, texts in found.items()}
        return {**info, **{name: str(text) for name, text in found.items()}}


def recorded_space(space: spaces.Space[Any], keys: Sequence[str] | None = None) -> RecordedSpace:
    """Return the form in which a log stores the observations of an environment."""
    parts = dict(_parts(space, ()))
    paths = list(parts)
    if keys is not None:
        paths = _selected(paths, keys, space)
    texts = {
        f"observation.{'.'.join(map(str, path))}": path for path in paths if _is_text(parts[path])
    }
    if len(texts) < len(paths):
        paths = [path for path in paths if not _is_text(parts[path])]
    changes = len(paths) < len(parts) or any(isinstance(key, int) for path in paths for key in path)
    logged = space
    if changes:
        logged = _dict_of([(tuple(map(str, path)), parts[path]) for path in paths])
    try:
        return RecordedSpace(logged, observation_leaves(logged), tuple(paths), texts)
    except SpaceError as error:
        cure = "convert it with a TransformObservation wrapper"
        if any(paths):
            cure = f"{_keys_cure(parts)}, or {cure}"
        raise SpaceError(f"{error}; {cure}") from error


def recorded_like(space: spaces.Space[Any], logged: spaces.Space[Any]) -> RecordedSpace:
    """Return the form in which a log with the space `logged` stores observations."""
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


def _is_text(space: spaces.Space[Any]) -> bool:
    """Return whether values of a space are texts, also if it is not one of Gymnasium's."""
    return space.dtype is not None and np.dtype(space.dtype).kind == "U"


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

"""Conversion of transition arrays to episode columns; spaces that are not given are inferred.

All functions name the array and the first wrong row in their errors.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import SpaceError
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.behavior import LOG_DENSITY, PROBABILITY, BehaviorField, behavior_field
from mcaprl.recorder.format.messages import EpisodeSummary, add_up
from mcaprl.recorder.format.metadata import NO_TIMES, LogMetadata, installed_versions
from mcaprl.recorder.format.spaces import (
    MAX_ACTIONS,
    Leaf,
    action_leaf,
    observation_leaves,
    outside,
)
from mcaprl.texts import shortened

_MAX_SHOWN = 40


def numbers(name: str, values: Any) -> NDArray[Any]:
    """Return flags, integers or floats as an array."""
    if isinstance(values, np.ma.MaskedArray) and np.ma.getmaskarray(values).any():
        raise SpaceError(f"{name} has no value in row {_first(np.ma.getmaskarray(values))}")
    try:
        array = np.asarray(values)
    # PyTorch raises these errors for tensors on a GPU or with a gradient.
    except (TypeError, ValueError, RuntimeError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise SpaceError(f"{name} cannot be converted to an array: {reason}") from error
    if array.dtype.kind in "biuf":
        return array
    what = f"{name} has dtype {array.dtype}, but they must be numbers"
    if array.dtype.kind == "O":
        is_number = [isinstance(value, int | float | np.number | np.bool_) for value in array.flat]
        wrong = ~np.array(is_number, bool).reshape(array.shape)
        if not wrong.any():
            raise SpaceError(f"{what}: convert the array of objects with astype")
        raise SpaceError(f"{what}: {_row(array, wrong)}")
    raise SpaceError(f"{what}: {_row(array, np.ones(array.shape, bool))}")


def flags(name: str, values: Any, *, first_row: int = 0) -> NDArray[np.bool_]:
    """Return 0 and 1, or False and True, as flags."""
    array = numbers(name, values)
    wrong = (array != 0) & (array != 1)
    if wrong.any():
        raise SpaceError(f"{name} are not flags: {_row(array, wrong, first_row)}, expected 0 or 1")
    return array.astype(np.bool_)


def rewards_of(name: str, values: Any) -> NDArray[np.float64]:
    """Return rewards as float64."""
    return exactly(name, numbers(name, values), np.dtype(np.float64))


def behavior_of(
    field: BehaviorField,
    probs: Any,
    log_probs: Any,
    *,
    place: str = "",
    is_table: bool = False,
    first_row: int = 0,
) -> NDArray[np.float32] | None:
    """Return probabilities or log densities of actions in the meaning of `field`; NaN is unknown.

    Args:
        field: Meaning of the result.
        probs: Probabilities; None if there are none. Earlier versions stored those of all actions.
        log_probs: Logarithms of probabilities or densities; None if there are none.
        place: Text before the names of the arrays, for errors.
        is_table: Whether errors name the columns of a table, instead of arrays.
        first_row: Row of the first value, for errors.
    """
    for given, values in ((PROBABILITY, probs), (LOG_DENSITY, log_probs)):
        if values is None:
            continue
        name = f"{place}{given.name if is_table else given.plural}"
        array = numbers(name, values)
        wrong, expected = given.is_impossible(array), given.expected
        if given == LOG_DENSITY and field == PROBABILITY:
            wrong |= field.is_impossible(np.exp(array.astype(np.float64)))
            expected = f"the logarithm of {field.expected}"
        if wrong.any():
            raise SpaceError(f"{name}: {_row(array, wrong, first_row)}, expected {expected}")
    return field.column(probs, log_probs)


def behavior_of_arrays(
    field: BehaviorField, probs: Any, log_probs: Any
) -> NDArray[np.float32] | None:
    """Return the behavior column of a caller's arrays; None if there are none."""
    if probs is not None:
        field.probs(np.empty(0, np.float32))
        if log_probs is not None:
            raise SpaceError("pass behavior_probs or behavior_log_probs, not both")
    found = behavior_of(field, probs, log_probs)
    return None if found is None else found.copy()


def check_finite(name: str, values: NDArray[Any], *, first_row: int = 0) -> None:
    """Check that no value is NaN or infinite."""
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        wrong = ~np.isfinite(values)
        raise SpaceError(f"{name}: {_row(values, wrong, first_row)}, which is not finite")


def check_inside(
    name: str, values: NDArray[Any], space: spaces.Space[Any], *, first_row: int = 0
) -> None:
    """Check that values are in a Discrete, MultiDiscrete or MultiBinary space."""
    if isinstance(space, spaces.Box):
        return
    wrong = outside(space, values)
    if wrong.any():
        raise SpaceError(f"{name}: {_row(values, wrong, first_row)}, which is outside of {space}")


def is_beyond_float32(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the finite numbers that are too large for float32."""
    found: NDArray[np.bool_] = np.isfinite(values) & (np.abs(values) > np.finfo(np.float32).max)
    return found


def exactly(where: str, array: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Copy an array to another dtype without changing any value."""
    if array.dtype == dtype:
        return array.copy()
    with np.errstate(all="ignore"):
        cast = array.astype(dtype)
        # NumPy rounds integers when it compares them with floats, so they are also cast back.
        same = (cast == array) & (cast.astype(array.dtype) == array)
    if dtype.kind == "f" and array.dtype.kind == "f":
        same |= np.isnan(cast) & np.isnan(array)
    if not same.all():
        raise SpaceError(
            f"{where} is {array.dtype} and cannot be converted exactly to {dtype}:"
            f" {_row(array, ~same)}"
        )
    return cast


def _first(wrong: NDArray[np.bool_]) -> int:
    """Return the index of the first row with a true value."""
    return int(wrong.reshape(len(wrong), -1).any(axis=1).argmax()) if wrong.ndim else 0


def _row(array: NDArray[Any], wrong: NDArray[np.bool_], first_row: int = 0) -> str:
    """Describe the first wrong value."""
    if not array.size:
        return "there are no values"
    value = array[np.unravel_index(int(wrong.argmax()), array.shape)] if array.ndim else array[()]
    shown = repr(value.item()) if isinstance(value, np.generic) else repr(value)
    return f"row {_first(wrong) + first_row} is {shortened(shown, _MAX_SHOWN)}"


_END_FLAGS = ("terminated", "truncated")
_SCALARS: Mapping[str, Callable[[str, Any], NDArray[Any]]] = {
    "rewards": rewards_of,
    "terminated": flags,
    "truncated": flags,
}


def description_of(
    env_id: str,
    observations: Any,
    actions: Any,
    observation_space: spaces.Space[Any] | None,
    action_space: spaces.Space[Any] | None,
) -> LogMetadata:
    """Return the metadata for `Dataset.from_arrays`; infer the spaces that are None."""
    registered: tuple[spaces.Space[Any] | None, spaces.Space[Any] | None] = (None, None)
    if observation_space is None or action_space is None:
        registered = _registered_spaces(env_id, observations)
    return LogMetadata(
        observation_space=observation_space or registered[0] or _space_of(observations),
        action_space=action_space or registered[1] or action_space_of(numbers("actions", actions)),
        env_id=env_id,
        versions=installed_versions(),
        times=NO_TIMES,
    )


def columns_of_arrays(
    description: LogMetadata, observations: Any, next_observations: Any, given: Mapping[str, Any]
) -> Transitions:
    """Convert arrays to columns without times.

    `given` maps the `STEP_COLUMNS` to arrays; `behavior` is valid, or None.
    """
    steps = len(np.atleast_1d(numbers("rewards", given["rewards"])))
    if steps == 0:
        raise SpaceError("no transitions: the arrays are empty")
    leaves = observation_leaves(description.observation_space)
    here = [_leaf_array("observations", observations, leaf, steps) for leaf in leaves]
    there = [_leaf_array("next_observations", next_observations, leaf, steps) for leaf in leaves]
    action, behavior = action_leaf(description.action_space), given["behavior"]
    columns: dict[str, Any] = {
        "actions": _leaf_array("actions", given["actions"], action, steps),
        "behavior": np.full(steps, np.nan, np.float32) if behavior is None else behavior,
    }
    for name, convert in _SCALARS.items():
        columns[name] = convert(name, given[name])
    named = {"behavior": behavior_field(description.action_space).plural}
    for name in (*_SCALARS, "behavior"):
        if columns[name].shape != (steps,):
            where = named.get(name, name)
            raise SpaceError(f"{where} has shape {columns[name].shape}, expected {(steps,)}")
    lasts = last_steps(columns["terminated"] | columns["truncated"], here, there)
    after = lasts + 1
    frames = tuple(
        np.insert(observation, after, following[lasts], axis=0)
        for observation, following in zip(here, there, strict=True)
    )
    summaries: list[EpisodeSummary] = []
    for start, stop in zip([0, *after[:-1].tolist()], after.tolist(), strict=True):
        terminated, truncated = (bool(columns[name][stop - 1]) for name in _END_FLAGS)
        summary = EpisodeSummary(
            episode=len(summaries),
            length=stop - start,
            total_reward=add_up(columns["rewards"][start:stop]),
            terminated=terminated,
            truncated=truncated,
            start_time_ns=0,
            end_time_ns=0,
            reason="terminated" if terminated else "truncated" if truncated else "",
        )
        summaries.append(summary)
    times = np.empty(steps + len(summaries), np.int64)
    transitions = Transitions(
        frames=frames, log_time_ns=times, episodes=tuple(summaries), infos={}, **columns
    )
    return with_fresh_times(transitions, 0, description.step_duration_ns)


def _registered_spaces(
    env_id: str, observations: Any
) -> tuple[spaces.Space[Any], spaces.Space[Any]] | tuple[None, None]:
    """Return the environment's observation space and action space.

    Returns:
        (None, None) if the environment is not registered or cannot be created, or if its
        observation shapes differ from the shapes in `observations`.
    """
    if env_id not in gym.registry:
        return None, None
    try:
        with closing(gym.make(env_id)) as env:
            leaves = observation_leaves(env.observation_space)
            fits = all(leaf.of(observations).shape[1:] == leaf.shape for leaf in leaves)
            return (env.observation_space, env.action_space) if fits else (None, None)
    # A dependency of the environment may not be installed, or an observation key may be missing.
    except Exception:
        return None, None


def with_fresh_times(columns: Transitions, start_ns: int, step_ns: int) -> Transitions:
    """Replace the log_times by times that start at `start_ns` and increase by `step_ns`."""
    times = start_ns + np.arange(len(columns.log_time_ns)) * step_ns
    first, lengths = columns.first_frames.tolist(), columns.lengths.tolist()
    episodes = tuple(
        episode._replace(start_time_ns=int(times[start]), end_time_ns=int(times[start + length]))
        for episode, start, length in zip(columns.episodes, first, lengths, strict=True)
    )
    return dataclasses.replace(columns, log_time_ns=times, episodes=episodes)


def _space_of(observations: Any) -> spaces.Space[Any]:
    if isinstance(observations, Mapping):
        return spaces.Dict([(key, _space_of(part)) for key, part in observations.items()])
    return box_of(np.asarray(observations))


def action_space_of(actions: NDArray[Any]) -> spaces.Space[Any]:
    """Infer a Discrete space from integers (N,), or an unbounded Box from other arrays."""
    if actions.ndim == 1 and actions.dtype.kind in "iu" and actions.size:
        least, most = int(actions.min()), int(actions.max())
        if least < 0:
            row = int(actions.argmin())
            raise SpaceError(f"action {least} in row {row} is negative; pass action_space")
        if most >= MAX_ACTIONS:
            row = int(actions.argmax())
            raise SpaceError(
                f"action {most} in row {row} is too large: at most {MAX_ACTIONS} discrete actions"
                " can be used; pass action_space if it is not discrete"
            )
        return spaces.Discrete(most + 1)
    return box_of(actions)


def box_of(array: NDArray[Any]) -> spaces.Box:
    """Return a Box for the rows of an array (N, *shape).

    For integers, the bounds are the limits of the dtype. For floats, the bounds are infinite.
    """
    kind = array.dtype.kind
    if kind in "iu":
        low, high = int(np.iinfo(array.dtype).min), int(np.iinfo(array.dtype).max)
        return spaces.Box(low, high, array.shape[1:], array.dtype.type)
    if kind != "f":
        raise SpaceError(f"no Box can hold an array of {array.dtype}; pass the space")
    return spaces.Box(-np.inf, np.inf, array.shape[1:], array.dtype.type)


def _leaf_array(role: str, values: Any, leaf: Leaf, steps: int) -> NDArray[Any]:
    where = role + "".join(f"['{key}']" for key in leaf.path)
    try:
        found = leaf.of(values)
    except (KeyError, IndexError, TypeError) as error:
        raise SpaceError(f"{where} is missing") from error
    array = numbers(where, found)
    if array.shape != (steps, *leaf.shape):
        raise SpaceError(f"{where} has shape {array.shape}, expected {(steps, *leaf.shape)}")
    return exactly(where, array, leaf.dtype)


def last_steps(
    ends: NDArray[np.bool_], here: Sequence[NDArray[Any]], there: Sequence[NDArray[Any]]
) -> NDArray[np.int64]:
    """Return the index of each episode's last transition.

    `ends` (N,) marks the transitions with an end flag. `here` and `there` contain the observations
    and the next observations of the N transitions, one array for each leaf.
    """
    last = ends.copy()
    last[-1] = True
    for observation, following in zip(here, there, strict=True):
        differ = _bytes_of(observation)[1:] != _bytes_of(following)[:-1]
        last[:-1] |= differ.any(axis=1)
    return np.flatnonzero(last)


def _bytes_of(array: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the bytes of each row. Bytes of equal NaN values compare as equal, unlike floats."""
    rows = np.ascontiguousarray(array).reshape(len(array), math.prod(array.shape[1:]))
    return rows.view(np.uint8)

"""Conversion of transition arrays to episode columns; spaces that are not given are inferred."""

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
from mcaprl.recorder.dataset.values import exactly, flags, numbers, rewards_of
from mcaprl.recorder.format.behavior import behavior_field
from mcaprl.recorder.format.messages import EpisodeSummary, add_up
from mcaprl.recorder.format.metadata import NO_TIMES, LogMetadata, installed_versions
from mcaprl.recorder.format.spaces import (
    MAX_ACTIONS,
    Leaf,
    action_leaf,
    observation_leaves,
)

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

"""Demonstrations in robomimic's HDF5 form: a group `data/demo_<i>` for each episode."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError
from mcaprl.recorder.dataset.arrays import description_of
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats import hdf5_nodes as nodes
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.dataset.formats.flat import (
    joined_trees,
    named_leaves,
    rows_of_tree,
    unread_note,
)
from mcaprl.recorder.dataset.values import flags

_KNOWN = ("data", "mask")
"""Groups of a file; `mask` contains names of demonstrations only."""
_DEMO = ("obs", "next_obs", "actions", "rewards", "dones")


def read_demos(file: Any, path: Path) -> Dataset:
    """Read all demonstrations, in the order of their numbers.

    A demonstration is terminated if `dones` is set at its last step; otherwise it is truncated.
    If a truncated demonstration has no `next_obs`, its last step is left out, because the next
    observation of this step is unknown.
    """
    data = nodes.group_in(file, "data")
    names = sorted((name for name in nodes.names_in(data) if name.startswith("demo_")), key=_number)
    if not names:
        raise LogError(f"{path}: the group data has no demo_0, demo_1, ...: unknown form of HDF5")
    notes: dict[str, None] = {}
    unread = {
        name: None
        for name in nodes.names_in(file)
        if name not in _KNOWN and nodes.has_rows(file, name)
    }
    episodes = []
    for name in names:
        group = nodes.group_in(data, name)
        episodes.append(_demo(group, f"{path}: {name}", notes))
        others = (key for key in nodes.names_in(group) if key not in _DEMO)
        unread |= {f"demo_<i>/{key}": None for key in others if nodes.has_rows(group, key)}
    if notes:
        warnings.warn(f"{path}: {', and '.join(notes)}", stacklevel=4)
    if unread:
        warnings.warn(f"{path}: {unread_note(list(unread))}", stacklevel=4)
    try:
        actions = np.concatenate([episode.actions for episode in episodes])
        metadata = description_of("", episodes[0].observations, actions, None, None)
    except (SpaceError, ValueError) as error:
        raise SpaceError(f"{path}: {error}") from error
    return dataset_of(episodes, metadata, path)


def _demo(group: Any, where: str, notes: dict[str, None]) -> EpisodeArrays:
    if not nodes.has(group, "obs"):
        raise LogError(f"{where} has no observations: extract them with robomimic's scripts")
    observations = nodes.tree_in(group, "obs")
    actions, rewards = nodes.array_in(group, "actions"), nodes.array_in(group, "rewards")
    dones = None
    if nodes.has(group, "dones"):
        dones = flags(f"{where}: dones", nodes.array_in(group, "dones"))
    columns = [actions, rewards, *([] if dones is None else [dones])]
    if rewards.ndim != 1 or any(np.shape(values)[:1] != rewards.shape for values in columns):
        shapes = [values.shape for values in columns]
        raise LogError(f"{where}: actions, rewards and dones have shapes {shapes}")
    count = len(rewards)
    for name, part in named_leaves("obs", observations):
        if part.shape[:1] != (count,):
            raise LogError(f"{where}: {name} has shape {part.shape}, but there are {count} rewards")
    is_done = dones is not None and count > 0 and bool(dones[-1])
    if dones is not None and dones[:-1].any():
        notes["dones before the last step of a demonstration are ignored"] = None
    if nodes.has(group, "next_obs"):
        following = nodes.tree_in(group, "next_obs")
        _check_follows(observations, following, where)
        frames = joined_trees([observations, rows_of_tree(following, slice(count - 1, count))])
    elif is_done:
        notes["without next_obs, the last observation is also used as next observation"] = None
        frames = rows_of_tree(observations, np.minimum(np.arange(count + 1), count - 1))
    else:
        notes["without next_obs, the last step of a demonstration is left out"] = None
        frames, count = observations, count - 1
    return EpisodeArrays(
        observations=frames,
        actions=actions[:count],
        rewards=rewards[:count],
        terminated=is_done,
        truncated=not is_done,
    )


def _check_follows(here: Any, there: Any, where: str) -> None:
    """Check that each next observation is the observation of the following step."""
    if isinstance(here, dict):
        for key, part in here.items():
            _check_follows(part, there.get(key), f"{where}/{key}")
        return
    if there is None or not np.array_equal(_bytes(here[1:]), _bytes(there[:-1])):
        raise LogError(f"{where}: next_obs is not the observation of the following step")


def _bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the bytes of an array, because NaN is equal to NaN as bytes, but not as floats."""
    return np.frombuffer(array.tobytes(), np.uint8)


def _number(name: str) -> tuple[int, str]:
    digits = name.removeprefix("demo_")
    return (int(digits) if digits.isdecimal() else 0, name)

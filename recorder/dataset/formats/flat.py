"""Datasets from flat arrays of transitions with the names that other tools use."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError
from mcaprl.recorder.dataset.arrays import description_of
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of, episode_slices
from mcaprl.recorder.dataset.formats.infos import masked
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.texts import counted

NAMES = {
    "observations": ("observations",),
    "actions": ("actions",),
    "rewards": ("rewards",),
    "terminated": ("terminals", "terminations", "terminated"),
    "truncated": ("timeouts", "truncations", "truncated"),
    "next_observations": ("next_observations",),
    "behavior_probs": ("behavior_probs",),
}
"""Names that a file may use for each array of `Dataset.from_arrays`.

A file must not contain two of the names of the same array.
"""
_REQUIRED = ("observations", "actions", "rewards", "terminated")
_COLUMNS = ("rewards", "terminated", "truncated", "behavior_probs")


def flat_dataset(
    found: Mapping[str, Any], where: object, infos: Mapping[str, NDArray[Any]] | None = None
) -> Dataset:
    """Return a dataset of flat arrays.

    If there are no next observations, the observation of a terminal transition is repeated as its
    next observation. The last transition before a timeout is left out, because its next observation
    is unknown.

    Args:
        found: Arrays of N rows by the names in `NAMES`. The observations may be nested dicts.
        where: Name of the source, for errors and warnings.
        infos: Arrays by dotted name. An array of N rows is read as an info of the N observations;
            the final observations have no infos. Other arrays are ignored.

    Raises:
        LogError: An array is missing.
        SpaceError: The arrays have different lengths, or a log cannot store their dtype.
    """
    arrays = _named(found, where)
    missing = [" or ".join(NAMES[name]) for name in _REQUIRED if name not in arrays]
    if missing:
        raise LogError(f"{where} has no {', '.join(missing)}; it has {', '.join(sorted(found))}")
    for name in _COLUMNS:
        if name in arrays:
            arrays[name] = _one_column(arrays[name])
    arrays.setdefault("truncated", np.zeros(len(arrays["rewards"]), bool))
    count = len(arrays["rewards"])
    rows = {name: values for name, values in (infos or {}).items() if _is_info(values, count)}
    try:
        if "next_observations" in arrays:
            data = Dataset.from_arrays(**arrays)
            return _with_infos(data, rows, where) if rows else data
        return _without_next(arrays, rows, where)
    except SpaceError as error:
        raise SpaceError(f"{where}: {error}") from error


def rows_of_tree(tree: Any, rows: Any) -> Any:
    """Index an array, or each array in nested dicts, with `rows`."""
    if isinstance(tree, Mapping):
        return {key: rows_of_tree(part, rows) for key, part in tree.items()}
    return tree[rows]


def joined_trees(trees: list[Any]) -> Any:
    """Concatenate arrays, or nested dicts of arrays."""
    if isinstance(trees[0], Mapping):
        return {key: joined_trees([tree[key] for tree in trees]) for key in trees[0]}
    return np.concatenate(trees)


def _named(found: Mapping[str, Any], where: object) -> dict[str, Any]:
    arrays = {}
    for name, others in NAMES.items():
        present = [other for other in others if other in found]
        if len(present) > 1:
            raise LogError(f"{where} has both {' and '.join(present)}: remove one of them")
        if present:
            arrays[name] = found[present[0]]
    return arrays


def _one_column(values: Any) -> NDArray[Any]:
    """Convert an array (N, 1) to (N,); return other arrays unchanged."""
    array = np.asarray(values)
    return array[:, 0] if array.ndim == 2 and array.shape[1] == 1 else array


def _is_info(values: NDArray[Any], count: int) -> bool:
    return values.ndim > 0 and len(values) == count and values.dtype.kind in "biufU"


def _info_rows(infos: Mapping[str, NDArray[Any]], first: int, last: int, count: int) -> Any:
    """Return the rows [first, last) of each info; append masked rows up to `count` rows."""
    is_missing = np.arange(count) >= last - first
    return {
        name: masked(np.resize(values[first:last], (count, *values.shape[1:])), is_missing)
        for name, values in infos.items()
    }


def _with_infos(data: Dataset, infos: Mapping[str, NDArray[Any]], where: object) -> Dataset:
    episodes = [
        EpisodeArrays(
            observations=rows_of_tree(data.frames, frames),
            actions=data.actions[steps],
            rewards=data.rewards[steps],
            terminated=bool(data.terminated[steps.stop - 1]),
            truncated=bool(data.truncated[steps.stop - 1]),
            behavior_probs=data.behavior_probs[steps],
            infos=_info_rows(infos, steps.start, steps.stop, frames.stop - frames.start),
        )
        for steps, frames in episode_slices(data)
    ]
    return dataset_of(episodes, LogMetadata.from_strings(data.metadata), where)


def _without_next(
    arrays: Mapping[str, Any], infos: Mapping[str, NDArray[Any]], where: object
) -> Dataset:
    observations, actions = arrays["observations"], np.asarray(arrays["actions"])
    rewards, probs = arrays["rewards"], arrays.get("behavior_probs")
    terminated, truncated = (arrays[name].astype(bool) for name in ("terminated", "truncated"))
    for name in ("actions", *_COLUMNS):
        if name in arrays and len(arrays[name]) != len(rewards):
            raise SpaceError(f"there are {len(arrays[name])} {name}, but {len(rewards)} rewards")
    ends = terminated | truncated
    ends[-1:] = True
    stops = (np.flatnonzero(ends) + 1).tolist()
    episodes, dropped = [], 0
    for start, stop in zip([0, *stops[:-1]], stops, strict=True):
        is_terminal = bool(terminated[stop - 1])
        last = stop if is_terminal else stop - 1
        dropped += stop - last
        steps, frames = slice(start, last), np.arange(start, last + 1)
        episode = EpisodeArrays(
            observations=rows_of_tree(observations, np.minimum(frames, stop - 1)),
            actions=actions[steps],
            rewards=rewards[steps],
            terminated=is_terminal,
            truncated=bool(truncated[stop - 1]),
            behavior_probs=None if probs is None else probs[steps],
            infos=_info_rows(infos, start, min(last + 1, stop), last - start + 1),
        )
        episodes.append(episode)
    _warn(where, int(terminated.sum()), dropped)
    return dataset_of(episodes, description_of("", observations, actions, None, None), where)


def _warn(where: object, terminal: int, dropped: int) -> None:
    found = []
    if terminal:
        episodes = counted(terminal, "terminated episode")
        found.append(f"the last observation of {episodes} is repeated as next observation")
    if dropped:
        episodes = counted(dropped, "episode")
        found.append(f"the last steps of {episodes} without a terminal step are left out")
    if found:
        warnings.warn(f"{where} has no next_observations: {', and '.join(found)}", stacklevel=5)

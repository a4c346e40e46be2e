"""Conversion of transitions to Arrow blocks of Ray Data, and of blocks to transitions.

A block has one row for each transition, with the columns of `Dataset.to_arrow`: `episode`, `step`,
`log_time_ns`, `reward`, `terminated`, `truncated`, `behavior_prob`, `action`, `observation` and
`next_observation`, or `observation_<key>` for the parts of a Dict. Vectors and images are tensors.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow
from numpy.typing import NDArray
from ray.data.extensions import ArrowTensorArray

from mcaprl.errors import SpaceError
from mcaprl.recorder.dataset.arrays import columns_of_arrays
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.tables import observation_names, step_columns
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.metadata import NO_TIMES, LogMetadata
from mcaprl.recorder.format.spaces import Leaf, action_leaf, leaves_of, nest

Columns = dict[str, NDArray[Any]]
_SCALARS = {
    "episode": np.int64,
    "step": np.int64,
    "log_time_ns": np.int64,
    "reward": np.float64,
    "terminated": np.bool_,
    "truncated": np.bool_,
    "behavior_prob": np.float32,
}
_OPTIONAL = ("log_time_ns", "behavior_prob")
_NOT_WHOLE = (
    "{}: episode {} is not whole in its block, or two episodes have this number; bring the rows of"
    ' an episode together with rows.repartition(N, keys=["episode"])'
)


def empty_columns(description: LogMetadata) -> Columns:
    """Return all columns of a block without rows, to know their dtypes and shapes."""
    action = action_leaf(description.action_space)
    columns: Columns = {name: np.empty(0, dtype) for name, dtype in _SCALARS.items()}
    columns["action"] = np.empty((0, *action.shape), action.dtype)
    for name, leaf in _leaves(description):
        for column in (name, f"next_{name}"):
            columns[column] = np.empty((0, *leaf.shape), leaf.dtype)
    return columns


def row_bytes(columns: Columns) -> int:
    """Return the size of a row with these columns."""
    return sum(int(np.prod(one.shape[1:])) * one.dtype.itemsize for one in columns.values())


def block_of(columns: Columns, metadata: dict[str, str]) -> pyarrow.Table:
    """Return a block whose schema has this metadata."""
    arrays = [_array(values) for values in columns.values()]
    fields = [pyarrow.field(name, array.type) for name, array in zip(columns, arrays, strict=True)]
    schema = pyarrow.schema(fields, metadata=metadata)
    return pyarrow.Table.from_arrays(arrays, schema=schema)


def columns_of(data: Dataset, episodes: NDArray[np.int64], names: Sequence[str]) -> Columns:
    """Return columns of a dataset by name.

    Args:
        data: Transitions; observations that are not in `names` may be missing.
        episodes: (E,) numbers of the episodes for the column `episode`.
        names: Names of the columns.
    """
    columns = data._transitions
    found = step_columns(columns) | {"action": columns.actions}
    found["episode"] = np.repeat(episodes, columns.lengths)
    frames = columns.frame_of_step()
    leaves = leaves_of(data.observation_space)
    for name, leaf in zip(observation_names(leaves), columns.frames, strict=True):
        for column, offset in ((name, 0), (f"next_{name}", 1)):
            if column in names:
                found[column] = np.asarray(leaf[frames + offset])
    return {name: found[name] for name in names}


def keys_of(description: LogMetadata, names: Sequence[str]) -> tuple[str, ...] | None:
    """Return the keys of the observations in the columns `names`; None for all observations."""
    wanted = {name.removeprefix("next_") for name in names}
    leaves = _leaves(description)
    if all(name in wanted for name, _ in leaves):
        return None
    return tuple("/".join(leaf.path) for name, leaf in leaves if name in wanted)


def dataset_of(columns: Columns, description: LogMetadata, where: str) -> Dataset:
    """Return the episodes of a block, sorted by number and step."""
    missing = empty_columns(description).keys() - columns.keys() - {*_OPTIONAL}
    if missing:
        raise SpaceError(f"{where}: the rows have no column {', '.join(sorted(missing))}")
    order = np.lexsort((columns["step"], columns["episode"]))
    columns = {name: values[order] for name, values in columns.items()}
    lengths = _lengths(columns, where)
    leaves = leaves_of(description.observation_space)
    names = observation_names(leaves)
    transitions: Transitions = columns_of_arrays(
        description,
        nest(leaves, [columns[name] for name in names]),
        nest(leaves, [columns[f"next_{name}"] for name in names]),
        {
            "actions": columns["action"],
            "rewards": columns["reward"],
            "terminated": columns["terminated"],
            "truncated": columns["truncated"],
            "behavior_probs": columns.get("behavior_prob"),
        },
    )
    if not np.array_equal(transitions.lengths, lengths):
        raise SpaceError(
            f"{where}: a next observation differs from the observation of the next step, so a log"
            " cannot hold both: change both columns in the same way"
        )
    return Dataset(transitions, dataclasses.replace(description, times=NO_TIMES))


def _lengths(columns: Columns, where: str) -> NDArray[np.int64]:
    """Return the length of each episode of sorted columns; check that the episodes are whole."""
    lengths = np.unique(columns["episode"], return_counts=True)[1]
    lasts = np.cumsum(lengths) - 1
    steps = np.arange(len(columns["step"])) - np.repeat(lasts + 1 - lengths, lengths)
    ends = columns["terminated"] | columns["truncated"]
    expected = np.zeros(len(ends), bool)
    expected[lasts] = True
    wrong = np.flatnonzero((steps != columns["step"]) | (ends != expected))
    if len(wrong):
        raise SpaceError(_NOT_WHOLE.format(where, columns["episode"][wrong[0]]))
    return lengths.astype(np.int64)


def _leaves(description: LogMetadata) -> list[tuple[str, Leaf]]:
    leaves = leaves_of(description.observation_space)
    return list(zip(observation_names(leaves), leaves, strict=True))


def _array(values: NDArray[Any]) -> Any:
    if values.ndim == 1:
        return pyarrow.array(values)
    return ArrowTensorArray.from_numpy(np.ascontiguousarray(values))

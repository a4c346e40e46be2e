"""Conversion of datasets to PyArrow tables. Requires the extra `tables`.

A vector becomes one column per element, `observation.<name>` or `observation.<index>`. An array of
more than MAX_COLUMNS elements, such as an image, becomes one column of flat lists.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import import_extra
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import Leaf

MAX_COLUMNS = 64


def transition_table(columns: Transitions, leaves: Sequence[Leaf], description: LogMetadata) -> Any:
    """Return a table with one row per transition, which contains both of its observations."""
    pyarrow = import_extra("pyarrow", "tables")
    step_frames = columns.frame_of_step()
    lengths = columns.lengths
    names = ["episode", "step", "log_time_ns", "reward", "terminated", "truncated", "behavior_prob"]
    arrays = [
        np.repeat(np.arange(len(lengths)), lengths),
        np.arange(len(columns.rewards)) - np.repeat(columns.first_steps, lengths),
        columns.log_time_ns[step_frames],
        columns.rewards,
        columns.terminated,
        columns.truncated,
        columns.behavior_probs,
    ]
    converted = [pyarrow.array(array) for array in arrays]
    parts: list[tuple[str, NDArray[Any], tuple[str, ...]]] = [("action", columns.actions, ())]
    for leaf, frames in zip(leaves, columns.frames, strict=True):
        named = description.observation_names if leaf.path == () else ()
        name = leaf.name if leaf.name.startswith("observation") else f"observation_{leaf.name}"
        parts.append((name, frames[step_frames], named))
        parts.append((f"next_{name}", frames[step_frames + 1], named))
    for name, values, element_names in parts:
        for column_name, column in _columns(pyarrow, name, values, element_names):
            names.append(column_name)
            converted.append(column)
    return pyarrow.Table.from_arrays(converted, names=names)


def episode_table(columns: Transitions) -> Any:
    """Return a table with one episode summary per row, numbered in the dataset's order."""
    pyarrow = import_extra("pyarrow", "tables")
    rows = [episode._asdict() | {"episode": k} for k, episode in enumerate(columns.episodes)]
    return pyarrow.Table.from_pylist(rows)


def _columns(
    pyarrow: Any, name: str, values: NDArray[Any], element_names: Sequence[str]
) -> Iterator[tuple[str, Any]]:
    if values.ndim == 1:
        yield name, pyarrow.array(values)
        return
    flat = np.ascontiguousarray(values.reshape(len(values), math.prod(values.shape[1:])))
    if flat.shape[1] > MAX_COLUMNS:
        yield (
            name,
            pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(flat.ravel()), flat.shape[1]),
        )
        return
    labels = element_names if len(element_names) == flat.shape[1] else range(flat.shape[1])
    for index, label in enumerate(labels):
        yield f"{name}.{label}", pyarrow.array(np.ascontiguousarray(flat[:, index]))

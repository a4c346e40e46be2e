"""Conversion of datasets to PyArrow tables. Requires the extra `tables`.

A tensor is a column whose rows are vectors or arrays. With `tensors="columns"`, a tensor becomes
one column per element, such as `observation.<name>`, or `action.<index>` without names; a row of
more than MAX_COLUMNS elements, such as an image, becomes a flat list. With `tensors="lists"`, each
tensor becomes one column of flat fixed-size lists in C order, and the metadata of the column's
field has the shape of a row, as a JSON list in `shape`. The metadata of the table's schema has the
spaces: see `described`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import SpaceError, import_extra
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.behavior import behavior_field
from mcaprl.recorder.format.infos import Masked
from mcaprl.recorder.format.metadata import METADATA_NAME, LogMetadata
from mcaprl.recorder.format.spaces import Leaf

Tensors = Literal["columns", "lists"]
MAX_COLUMNS = 64
# Arrow chunks smaller than this are copied into one: many small chunks make a table slow.
_MIN_SHARED_BYTES = 1 << 14


def transition_table(
    columns: Transitions,
    leaves: Sequence[Leaf],
    description: LogMetadata,
    *,
    tensors: Tensors = "columns",
) -> Any:
    """Return a table with one row per transition, with its observation and next observation.

    The column `info.<name>` contains the info that came with the next observation. It is null if
    the environment returned no info.

    With `tensors="lists"`, columns share their memory with the dataset where Arrow stores the
    values in the same way. This is always the case for actions, rewards and probabilities.
    Observations share their memory if they take 16 KiB or more per episode on average; their
    columns then have one chunk per episode. Flags, images on disk and times are copied.
    """
    arrow = import_extra("pyarrow", "tables")
    import_extra("pyarrow.compute", "tables")
    found = [
        (name, arrow.array(array)) for name, array in step_columns(columns, description).items()
    ]
    if tensors == "lists":
        found += _tensor_lists(arrow, columns, leaves)
    else:
        found += _tensor_columns(arrow, columns, leaves, description)
    shapes = _shapes(columns, leaves) if tensors == "lists" else {}
    fields = [field_of(arrow, name, array, shapes.get(name, ())) for name, array in found]
    for info in info_columns(arrow, columns.infos, columns.frame_of_step() + 1, "info"):
        found.append((info[0].name, info[1]))
        fields.append(info[0])
    schema = arrow.schema(fields, metadata=described(description))
    return arrow.Table.from_arrays([array for _, array in found], schema=schema)


def episode_table(columns: Transitions) -> Any:
    """Return a table with one episode summary per row, numbered in the dataset's order."""
    arrow = import_extra("pyarrow", "tables")
    types = {
        "episode": arrow.int64(),
        "length": arrow.int64(),
        "total_reward": arrow.float64(),
        "terminated": arrow.bool_(),
        "truncated": arrow.bool_(),
        "start_time_ns": arrow.int64(),
        "end_time_ns": arrow.int64(),
        "reason": arrow.string(),
        "policy": arrow.string(),
        "epsilon": arrow.float64(),
        "seed": arrow.uint64(),
        "options": arrow.string(),
    }
    rows = [episode._asdict() | {"episode": k} for k, episode in enumerate(columns.episodes)]
    return arrow.Table.from_pylist(rows, schema=arrow.schema(list(types.items())))


def described(description: LogMetadata) -> dict[str, str]:
    """Return a schema's metadata: the log's metadata as a JSON object under `METADATA_NAME`."""
    return {METADATA_NAME: json.dumps(description.to_strings())}


def observation_names(leaves: Sequence[Leaf]) -> list[str]:
    """Return the column name of each observation leaf."""
    names: list[str] = []
    for leaf in leaves:
        name = leaf.name if leaf.name.startswith("observation") else f"observation_{leaf.name}"
        number, base = 2, name
        while name in names:
            name, number = f"{base}_{number}", number + 1
        names.append(name)
    return names


def field_of(arrow: Any, name: str, array: Any, shape: Sequence[int]) -> Any:
    """Return a non-nullable field; its metadata contains the row shape if `shape` is not empty."""
    metadata = {"shape": json.dumps(list(shape))} if shape else None
    return arrow.field(name, array.type, nullable=False, metadata=metadata)


def fixed_lists(arrow: Any, values: NDArray[Any]) -> Any:
    """Return rows (N, *shape) as an Arrow array of numbers or flat lists; copy only if needed."""
    flat = arrow.array(np.ascontiguousarray(values).reshape(-1))
    if values.ndim == 1:
        return flat
    # Parquet files of lists whose elements may be null are larger and slower.
    element = arrow.field("element", flat.type, nullable=False)
    kind = arrow.list_(element, math.prod(values.shape[1:]))
    return arrow.FixedSizeListArray.from_arrays(flat, type=kind)


def info_problem(name: str, info: Masked) -> str:
    """Return the reason why a table cannot store an info; empty if a table can store it."""
    if info.dtype.kind not in "biufU" or not math.prod(info.shape[1:]):
        kind = f"{info.dtype} of shape {info.shape[1:]}"
        return f"the info '{name}' has {kind}; a table can only store numbers, flags and text"
    if info.dtype.kind == "U":
        try:
            "".join(np.ma.getdata(info).ravel()).encode()
        except UnicodeEncodeError:
            return f"the info '{name}' has a text that is not UTF-8"
    return ""


def info_columns(
    arrow: Any, infos: Mapping[str, Masked], rows: NDArray[np.int64], prefix: str
) -> Iterator[tuple[Any, Any]]:
    """Yield a field named `PREFIX.<name>` and the values at `rows` for each info.

    The metadata of a field has the NumPy dtype and the shape of a row.
    """
    for name, info in infos.items():
        values, mask = np.ma.getdata(info)[rows], np.ma.getmaskarray(info)[rows]
        is_missing = mask.any(axis=tuple(range(1, mask.ndim)))
        if problem := info_problem(name, info):
            raise SpaceError(problem)
        metadata = {"dtype": values.dtype.str, "shape": json.dumps(values.shape[1:])}
        if values.ndim > 1:
            # Many versions of PyArrow cannot read nulls among lists of a fixed size from Parquet.
            sizes = np.where(is_missing, 0, math.prod(values.shape[1:]))
            offsets = np.concatenate([[0], np.cumsum(sizes)])
            nulls = np.append(is_missing, False)
            flat = arrow.array(np.ascontiguousarray(values[~is_missing]).reshape(-1))
            array = arrow.LargeListArray.from_arrays(arrow.array(offsets, mask=nulls), flat)
        else:
            array = arrow.array(np.ascontiguousarray(values))
            if is_missing.any():
                array = arrow.compute.if_else(arrow.array(~is_missing), array, None)
        yield arrow.field(f"{prefix}.{name}", array.type, metadata=metadata), array


def _shapes(columns: Transitions, leaves: Sequence[Leaf]) -> dict[str, tuple[int, ...]]:
    """Return the row shape of each action and observation column, by column name."""
    shapes = {"action": columns.actions.shape[1:]}
    for name, leaf in zip(observation_names(leaves), leaves, strict=True):
        shapes |= {name: leaf.shape, f"next_{name}": leaf.shape}
    return shapes


def step_columns(columns: Transitions, description: LogMetadata) -> dict[str, NDArray[Any]]:
    """Return the numeric and boolean columns (N,) of a table of transitions, by name."""
    lengths = columns.lengths
    return {
        "episode": np.repeat(np.arange(len(lengths)), lengths),
        "step": np.arange(len(columns.rewards)) - np.repeat(columns.first_steps, lengths),
        "log_time_ns": columns.log_time_ns[columns.frame_of_step()],
        "reward": columns.rewards,
        "terminated": columns.terminated,
        "truncated": columns.truncated,
        behavior_field(description.action_space).name: columns.behavior,
    }


def _tensor_lists(
    arrow: Any, columns: Transitions, leaves: Sequence[Leaf]
) -> Iterator[tuple[str, Any]]:
    yield "action", fixed_lists(arrow, columns.actions)
    step_frames = columns.frame_of_step()
    starts, lengths = columns.first_frames.tolist(), columns.lengths.tolist()
    for name, frames in zip(observation_names(leaves), columns.frames, strict=True):
        values = np.asarray(frames)
        shared = values.nbytes >= _MIN_SHARED_BYTES * max(len(lengths), 1)
        whole = fixed_lists(arrow, values) if shared else None
        for column, offset in ((name, 0), (f"next_{name}", 1)):
            if whole is None:
                yield column, fixed_lists(arrow, values[step_frames + offset])
                continue
            chunks = [
                whole.slice(start + offset, length)
                for start, length in zip(starts, lengths, strict=True)
            ]
            yield column, arrow.chunked_array(chunks, whole.type)


def _tensor_columns(
    arrow: Any, columns: Transitions, leaves: Sequence[Leaf], description: LogMetadata
) -> Iterator[tuple[str, Any]]:
    yield from _columns(arrow, "action", columns.actions, description.action_part_names)
    step_frames = columns.frame_of_step()
    for name, leaf, frames in zip(observation_names(leaves), leaves, columns.frames, strict=True):
        named = description.observation_names if leaf.path == () else ()
        for column, offset in ((name, 0), (f"next_{name}", 1)):
            yield from _columns(arrow, column, frames[step_frames + offset], named)


def _columns(
    arrow: Any, name: str, values: NDArray[Any], element_names: Sequence[str]
) -> Iterator[tuple[str, Any]]:
    count = math.prod(values.shape[1:])
    if values.ndim == 1 or count > MAX_COLUMNS:
        yield name, fixed_lists(arrow, values)
        return
    flat = values.reshape(len(values), count)
    labels = element_names if len(element_names) == count else range(count)
    for index, label in enumerate(labels):
        yield f"{name}.{label}", arrow.array(np.ascontiguousarray(flat[:, index]))

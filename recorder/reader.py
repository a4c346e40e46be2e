"""Reads logs of format version 1 into a Dataset: file -> chunks -> columns -> transitions."""

from __future__ import annotations

import glob
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, NoEpisodesError, NoStepsError, SpaceError
from mcaprl.recorder.columns import Columns, Topic
from mcaprl.recorder.dataset import Dataset
from mcaprl.recorder.episodes import (
    COUNTERS,
    episode_lengths,
    step_order,
    summaries,
    told_episodes,
)
from mcaprl.recorder.foreign import inferred_metadata, observation_fields
from mcaprl.recorder.images import read_images
from mcaprl.recorder.log_writer import EPISODE_TOPIC, STEP_TOPIC
from mcaprl.recorder.mcap_reader import McapReader
from mcaprl.recorder.metadata import METADATA_NAME, LogMetadata
from mcaprl.recorder.schema import is_intact, stored_dtype
from mcaprl.recorder.spaces import Leaf, action_leaf, observation_leaves
from mcaprl.recorder.transitions import Transitions

REQUIRED_FIELDS = ("reward", "action", "terminated", "truncated", *COUNTERS)


def open_logs(data: str | Path | Sequence[str | Path]) -> Dataset:
    """Read logs into memory.

    All chunks read are checked against their CRCs. A log that was cut off, or is still being
    written, gives its finished episodes and a warning; one of several that has none yet is left
    out, with a warning.

    Args:
        data: a file, a folder of `.mcap` files, a glob, or a sequence of these. Logs of one call
            must have the same spaces; their episodes follow each other in the order of the files.

    Raises:
        LogError: a file is missing, no MCAP, damaged, or has no finished episode.
        SpaceError: the logs' spaces differ.
    """
    paths, parts = find_logs(data), []
    for path in paths:
        try:
            parts.append(read_log(path))
        except NoEpisodesError as error:
            if len(paths) == 1:
                raise
            warnings.warn(f"{error}: left out", stacklevel=2)
    if not parts:
        raise NoEpisodesError(f"{len(paths)} logs have no finished episode, {paths[0]} first")
    return Dataset.concatenate(parts)


def find_logs(data: str | Path | Sequence[str | Path]) -> list[Path]:
    """The files that `data` means: see `open_logs`; sorted within a folder or glob.

    Raises:
        LogError: there are none.
    """
    if not isinstance(data, str | Path):
        every = [path for part in data for path in find_logs(part)]
        # A file that is meant twice counts once.
        return list({path.resolve(): path for path in every}.values())
    path = Path(data)
    if path.is_dir():
        found = sorted(path.glob("*.mcap"))
        if not found:
            raise LogError(f"{path} has no .mcap files")
        return found
    if path.exists():
        return [path]
    found = sorted(Path(name) for name in glob.glob(str(data)))
    if not found:
        raise LogError(f"{data}: no such file, folder or match")
    return found


def read_log(path: Path) -> Dataset:
    """Read one file. Raises as `open_logs` does."""
    reader = McapReader(path)
    steps = _steps_of(reader)
    metadata = described(reader)
    wanted = [*REQUIRED_FIELDS, *(name for name in ("behavior_prob",) if name in steps.fields)]
    wanted += _vector_fields(metadata) if metadata else observation_fields(steps.fields)
    _check_fields(path, steps, wanted)
    order = step_order(steps)
    columns = steps.read(wanted, order)
    columns["log_time"] = steps.times if order is None else steps.times[order]
    lengths = episode_lengths(columns, str(path))
    if not len(lengths):
        raise NoEpisodesError(f"{path} has no finished episode")
    frames = int(lengths.sum()) + len(lengths)
    if frames < len(steps) or not reader.complete:
        warnings.warn(
            f"{path} was cut off or is still being written: {len(lengths)} finished episodes are"
            f" read, {len(steps) - frames} records behind them are not",
            stacklevel=3,
        )
    columns = {name: column[:frames] for name, column in columns.items()}
    metadata = metadata or inferred_metadata(reader, columns)
    transitions = _transitions(reader, metadata, columns, lengths)
    return Dataset(transitions, metadata, sources=(path,))


def describe(reader: McapReader) -> LogMetadata:
    """The metadata of a log.

    Raises:
        NoStepsError: the file has no steps.
        LogError: its metadata is missing, of a later version, or damaged.
    """
    _steps_of(reader)
    return described(reader) or LogMetadata.from_strings({})


def described(reader: McapReader) -> LogMetadata | None:
    """The metadata of a log; None if it has none, for it is not one of ours.

    Raises:
        LogError: it is of a later version, or damaged.
    """
    record = reader.metadata.get(METADATA_NAME)
    copies = [
        # The channel's copy stands in the summary, too, under its CRC.
        channel.metadata
        for channel in reader.channels_of(STEP_TOPIC)
        if "format_version" in channel.metadata
    ]
    copies += [record] if record is not None else []
    if not copies:
        return None
    if any(copy != copies[0] for copy in copies):
        raise CorruptLogError(
            f"{reader.path}: the metadata record and the metadata of {STEP_TOPIC} differ"
        )
    try:
        return LogMetadata.from_strings(copies[0])
    except (LogError, SpaceError) as error:
        raise LogError(f"{reader.path}: {error}") from error


def _steps_of(reader: McapReader) -> Topic:
    channels = reader.channels_of(STEP_TOPIC)
    if not channels:
        topics = ", ".join(sorted(channel.topic for channel in reader.channels.values())) or "none"
        raise NoStepsError(
            f"{reader.path} has no topic {STEP_TOPIC}, so no transitions (topics: {topics})"
        )
    for schema in map(reader.schema_of, channels):
        if not is_intact(schema.name, schema.data):
            raise CorruptLogError(f"{reader.path}: the schema of {STEP_TOPIC} is damaged")
    return Topic(reader, STEP_TOPIC)


def _vector_fields(metadata: LogMetadata) -> list[str]:
    leaves = observation_leaves(metadata.observation_space)
    return [leaf.name for leaf in leaves if leaf.encoding is None]


def _check_fields(path: Path, steps: Topic, wanted: Sequence[str]) -> None:
    if not len(steps):
        raise NoEpisodesError(f"{path} has no finished episode")
    missing = [name for name in wanted if name not in steps.fields]
    if missing:
        raise LogError(f"{path}: {STEP_TOPIC} has no field {', '.join(missing)}")
    odd = [name for name in wanted if steps.fields[name].kind == "O"]
    if odd:
        raise LogError(f"{path}: {', '.join(odd)} of {STEP_TOPIC} is neither number nor array")


def _transitions(
    reader: McapReader, metadata: LogMetadata, columns: Columns, lengths: NDArray[np.int64]
) -> Transitions:
    actual = ~columns["final"].astype(bool)
    times = columns["log_time"]
    action = action_leaf(metadata.action_space)
    unknown = np.full(len(times), np.nan, np.float32)
    frames = tuple(
        read_images(reader.path, Topic(reader, leaf.topic), leaf, times)
        if leaf.encoding
        else _as_leaf(reader.path, columns, leaf)
        for leaf in observation_leaves(metadata.observation_space)
    )
    episodes = told_episodes(Topic(reader, EPISODE_TOPIC))
    return Transitions(
        frames=frames,
        log_time_ns=times,
        actions=_as_leaf(reader.path, columns, action)[actual],
        rewards=columns["reward"][actual].astype(np.float64, copy=False),
        terminated=columns["terminated"][actual].astype(bool),
        truncated=columns["truncated"][actual].astype(bool),
        behavior_probs=columns.get("behavior_prob", unknown)[actual].astype(np.float32, copy=False),
        episodes=summaries(reader.path, columns, lengths, episodes),
    )


def _as_leaf(path: Path, columns: Columns, leaf: Leaf) -> NDArray[Any]:
    """A field's column with the shape and dtype of its leaf.

    Raises:
        CorruptLogError: it does not fit the leaf without loss.
    """
    column = columns[leaf.name]
    if column[0].size == leaf.size:
        shaped = column.reshape(len(column), *leaf.shape)
        if column.dtype == stored_dtype(leaf.dtype):
            return shaped.astype(leaf.dtype, copy=False)
        with np.errstate(all="ignore"):
            cast = shaped.astype(leaf.dtype)
        is_float = cast.dtype.kind == shaped.dtype.kind == "f"
        if np.array_equal(cast, shaped, equal_nan=is_float):
            return cast
    raise CorruptLogError(
        f"{path}: {STEP_TOPIC} does not fit the spaces in the metadata: {leaf.name} is"
        f" {column.dtype} {column.shape[1:]}, its space {leaf.dtype} {leaf.shape}"
    )

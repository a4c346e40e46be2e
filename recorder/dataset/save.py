"""Writes a dataset as one log, in whole chunks."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, OutputExistsError
from mcaprl.files import replacing
from mcaprl.recorder.dataset.arrays import with_fresh_times
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.log_writer import LogWriter
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.format.writing import refuse_if_taken


def save_log(
    path: str | Path,
    columns: Transitions,
    metadata: LogMetadata,
    *,
    compression: str = "zstd",
    overwrite: bool = False,
) -> None:
    """Write columns as a log.

    Times are kept where they rise from the first frame to the last, else counted from now on.
    Episodes are numbered anew.

    Raises:
        OutputExistsError: there is a file, and `overwrite` is not set.
        LogError: it cannot be written, or there are no episodes.
    """
    if not columns.episodes:
        raise LogError(f"nothing to write to {path}: the dataset has no episodes")
    # Arrays that never were in a log have times from 0 on.
    if columns.log_time_ns[0] == 0 or (np.diff(columns.log_time_ns) <= 0).any():
        columns = with_fresh_times(columns, time.time_ns(), metadata.step_duration_ns)
    path = Path(path)
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists: choose another path, or pass overwrite=True")
    refuse_if_taken(path)
    # The log that is replaced may be the one that is being saved.
    with replacing(path, LogError) as unfinished:
        log = LogWriter(unfinished, metadata, compression=compression, overwrite=True)
        try:
            _write_images(log, columns)
            log.write_episodes([e._replace(episode=k) for k, e in enumerate(columns.episodes)])
            _write_steps(log, columns)
            log.close()
        finally:
            log.mcap.abandon()


def _write_images(log: LogWriter, columns: Transitions) -> None:
    leaves = observation_leaves(log.metadata.observation_space)
    for leaf, frames in zip(leaves, columns.frames, strict=True):
        if leaf.encoding is None:
            continue
        rows = log.add_image_topic(leaf.topic, leaf.shape, leaf.encoding)
        for start in range(0, len(frames), len(rows)):
            part = slice(start, min(start + len(rows), len(frames)))
            chunk = rows[: part.stop - start]
            chunk["log_time"] = columns.log_time_ns[part]
            chunk["payload"]["data"] = frames[part].reshape(len(chunk), -1)
            log.write_images(chunk)


def _write_steps(log: LogWriter, columns: Transitions) -> None:
    """Fill the rows of a chunk by fields: frames in order, and transitions where they belong."""
    fields = _frame_columns(log, columns)
    frames = len(columns.log_time_ns)
    rows = log.step_rows()
    for start in range(0, frames, len(rows)):
        part = slice(start, min(start + len(rows), frames))
        chunk = rows[: part.stop - start]
        chunk["log_time"] = columns.log_time_ns[part]
        for name, column in fields.items():
            chunk["payload"][name] = column[part]
        log.write_steps(chunk)


def _frame_columns(log: LogWriter, columns: Transitions) -> dict[str, NDArray[Any]]:
    """The fields of `/rl/step`, one value per frame."""
    count = len(columns.log_time_ns)
    step_frames = columns.frame_of_step()
    finals = columns.first_frames + columns.lengths
    fields: dict[str, NDArray[Any]] = {}
    for name, values, missing in (
        ("reward", columns.rewards, 0),
        ("action", _flat(columns.actions), 0),
        ("behavior_prob", columns.behavior_probs, np.nan),
        ("terminated", columns.terminated, False),
        ("truncated", columns.truncated, False),
    ):
        fields[name] = np.full((count, *values.shape[1:]), missing, values.dtype)
        fields[name][step_frames] = values
    fields["final"] = np.zeros(count, np.bool_)
    fields["final"][finals] = True
    frames_per_episode = columns.lengths + 1
    fields["episode"] = np.repeat(np.arange(len(columns.episodes)), frames_per_episode)
    fields["step"] = np.arange(count) - np.repeat(columns.first_frames, frames_per_episode)
    leaves = observation_leaves(log.metadata.observation_space)
    for leaf, frames in zip(leaves, columns.frames, strict=True):
        if leaf.encoding is None:
            fields[leaf.name] = _flat(np.asarray(frames))
    return fields


def _flat(values: NDArray[Any]) -> NDArray[Any]:
    """Each value as a vector, as a message's field has it; scalars stay scalars."""
    return values if values.ndim == 1 else values.reshape(len(values), -1)

"""Order, lengths and summaries of a log's episodes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.messages import EpisodeSummary, add_up_each
from mcaprl.recorder.format.reading import Columns, Topic
from mcaprl.recorder.format.schema import STEP_TOPIC

COUNTERS = ("episode", "step", "final")
"""Fields of `/rl/step` that locate a record: episode, step and final-record flag."""
# If a log has at most this many episodes, their summaries are read at once.
_FEW_EPISODES = 256
# Number of rows of a column that fit into the processor's cache.
_BLOCK_ROWS = 2**15


def time_order(topic: Topic) -> NDArray[np.int64] | None:
    """Return the row indexes that sort a topic by log_time; None if it is already sorted."""
    times = topic.times
    for start in range(0, len(times), _BLOCK_ROWS):
        block = times[start : start + _BLOCK_ROWS + 1]
        if (block[1:] < block[:-1]).any():
            return np.argsort(times, kind="stable")
    return None


def step_order(steps: Topic) -> NDArray[np.int64] | None:
    """Return row indexes that sort `/rl/step` records into whole episodes; None if already sorted.

    Records are sorted by log_time. If this does not yield whole episodes, for example because two
    robots recorded at the same time, records are sorted by channel and then by log_time.
    """
    order = time_order(steps)
    if steps.channels < 2:
        return order
    try:
        episode_lengths(steps.read(COUNTERS, order), steps.name)
    except CorruptLogError:
        order = np.lexsort((steps.times, steps.channel_ids))
        episode_lengths(steps.read(COUNTERS, order), steps.name)
    return order


def episode_lengths(columns: Columns, where: object) -> NDArray[np.int64]:
    """Return the number of transitions of each finished episode."""
    final = columns["final"].astype(bool)
    finals = np.flatnonzero(final)
    if not len(finals):
        return np.empty(0, np.int64)
    read = int(finals[-1]) + 1
    row = _first_wrong(columns, final[:read])
    if row is not None:
        episode, step = columns["episode"][row], columns["step"][row]
        raise CorruptLogError(
            f"{where}: record {row} of {STEP_TOPIC} (episode {episode}, step {step}) is out of"
            " order: records are missing or duplicated, or an episode continues after its end"
        )
    lengths = finals.copy()
    lengths[1:] -= finals[:-1] + 1
    return lengths


def _first_wrong(columns: Columns, final: NDArray[np.bool_]) -> int | None:
    """Return the first row that does not fit the row before or after it; None if all fit."""
    steps, episodes = columns["step"], columns["episode"]
    if steps[0] != 0:
        return 0
    for start in range(0, len(final) - 1, _BLOCK_ROWS):
        # Pairs of successive rows.
        before = slice(start, min(start + _BLOCK_ROWS, len(final) - 1))
        after = slice(before.start + 1, before.stop + 1)
        # After a final record, a new episode begins. After any other record, `step` increases by 1.
        continues = (steps[after] - steps[before] == 1) & (episodes[after] == episodes[before])
        wrong = np.flatnonzero(~np.where(final[before], steps[after] == 0, continues)) + 1
        if "terminated" in columns:
            # The end flags are set on the last transition, which precedes the final record.
            has_ended = (columns["terminated"][before] | columns["truncated"][before]).astype(bool)
            wrong = np.concatenate([wrong, np.flatnonzero(has_ended & ~final[after])])
        if len(wrong):
            return start + int(wrong.min())
    return None


class EpisodeTopic:
    """The summaries on `/rl/episode`; empty if the topic has another message type."""

    def __init__(self, topic: Topic) -> None:
        """Store the topic without reading messages."""
        self._topic = topic

    @cached_property
    def lengths(self) -> NDArray[np.int64]:
        """(E,) number of transitions of each episode.

        If messages are out of order, the array is empty.
        """
        if not self._is_ours or not (np.diff(self._columns["end_time_ns"]) > 0).all():
            return np.empty(0, np.int64)
        return self._columns["length"].astype(np.int64)

    def summaries(self, ends: NDArray[np.int64]) -> list[EpisodeSummary]:
        """Read the summaries of the episodes that end at the log_times `ends`.

        If these are half of the episodes or more, read all summaries instead.
        """
        if not self._is_ours:
            return []
        fields, rows = EpisodeSummary._fields, None
        if len(ends) < len(self._topic) // 2:
            # `np.isin` takes longer than everything else here if there are few episodes.
            recorded, ends = self._columns["end_time_ns"], np.sort(ends)
            rows = np.flatnonzero(ends[np.searchsorted(ends[:-1], recorded)] == recorded)
        if len(self._topic) > _FEW_EPISODES:
            columns = self._topic.read(self._fields, rows)
        else:
            chosen = slice(None) if rows is None else rows
            columns = {name: column[chosen] for name, column in self._columns.items()}
        for name in ("terminated", "truncated"):
            columns[name] = columns[name].astype(bool)
        values = {name: columns[name].tolist() for name in fields if name in columns}
        if "seed" in values:
            values["seed"] = list(map(messages.seed_of, values["seed"]))
        defaults, count = EpisodeSummary._field_defaults, len(values["length"])
        every = [values[name] if name in values else [defaults[name]] * count for name in fields]
        return list(map(EpisodeSummary._make, zip(*every, strict=True)))

    @property
    def _is_ours(self) -> bool:
        required = set(EpisodeSummary._fields) - set(EpisodeSummary._field_defaults)
        return required <= set(self._topic.fields)

    @cached_property
    def _fields(self) -> list[str]:
        """Names of the fields of a summary that the messages have."""
        return [name for name in EpisodeSummary._fields if name in self._topic.fields]

    @cached_property
    def _columns(self) -> Columns:
        """Lengths and end times of all episodes; if there are few episodes, all fields."""
        is_small = len(self._topic) <= _FEW_EPISODES
        return self._topic.read(self._fields if is_small else ("length", "end_time_ns"))


def summaries(
    path: object, columns: Columns, lengths: NDArray[np.int64], recorded: list[EpisodeSummary]
) -> tuple[EpisodeSummary, ...]:
    """Return one summary per episode; compute the summaries that are not in `recorded`.

    `lengths` (E,) contains the number of transitions of each episode, and `recorded` contains the
    summaries from `/rl/episode`.
    """
    # Identify episodes by end time, because indexes restart at 0 in appended recordings.
    by_end = {summary.end_time_ns: summary for summary in recorded}
    finals = np.cumsum(lengths + 1) - 1
    ends = columns["log_time"][finals].tolist()
    is_missing = np.array([end not in by_end for end in ends], bool)
    computed = summaries_of_records(columns, finals[is_missing], lengths[is_missing])
    found = []
    for end, length in zip(ends, lengths.tolist(), strict=True):
        summary = by_end[end] if end in by_end else next(computed)
        if summary.length != length:
            raise CorruptLogError(
                f"{path}: episode {summary.episode} has {summary.length} steps according to"
                f" /rl/episode, but {length} on {STEP_TOPIC}"
            )
        found.append(summary)
    return tuple(found)


def summaries_of_records(
    columns: Columns, finals: NDArray[np.int64], lengths: NDArray[np.int64]
) -> Iterator[EpisodeSummary]:
    """Compute the summaries of the episodes whose final records are in the rows `finals` (E,).

    Fields that the records do not contain keep their defaults.
    """
    firsts = finals - lengths
    lasts = np.maximum(finals - 1, firsts)
    rewards = columns["reward"].astype(np.float64, copy=False)
    # The values are in the same order as the fields of `EpisodeSummary`.
    values = (
        columns["episode"][finals].tolist(),
        lengths.tolist(),
        add_up_each(rewards, firsts.tolist(), finals.tolist()),
        columns["terminated"][lasts].astype(bool).tolist(),
        columns["truncated"][lasts].astype(bool).tolist(),
        columns["log_time"][firsts].tolist(),
        columns["log_time"][finals].tolist(),
    )
    return itertools.starmap(EpisodeSummary, zip(*values, strict=True))

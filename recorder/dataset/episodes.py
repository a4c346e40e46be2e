"""Episodes of a log: where they end, in what order, and what `/rl/episode` tells of them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.format.episode_summary import EpisodeSummary, add_up_each
from mcaprl.recorder.format.reading import Columns, Topic
from mcaprl.recorder.format.topics import STEP_TOPIC

COUNTERS = ("episode", "step", "final")
"""The fields that say which episode a record belongs to, where in it, and whether it is the end."""
# So many rows of a column stay in a processor's cache while they are looked at.
_BLOCK_ROWS = 2**15


def time_order(topic: Topic) -> NDArray[np.int64] | None:
    """The order of log_time; None if that is the order they are in."""
    times = topic.times
    for start in range(0, len(times), _BLOCK_ROWS):
        block = times[start : start + _BLOCK_ROWS + 1]
        if (block[1:] < block[:-1]).any():
            return np.argsort(times, kind="stable")
    return None


def step_order(steps: Topic) -> NDArray[np.int64] | None:
    """The order in which the records of `/rl/step` are whole episodes; None if they are in it.

    That is the order of log_time. Where two robots wrote at once, each on a channel of its own, it
    is one channel after the other.

    Raises:
        CorruptLogError: they are no whole episodes in any order.
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


def episode_lengths(columns: Columns, where: str) -> NDArray[np.int64]:
    """Transitions of each finished episode.

    Raises:
        CorruptLogError: records are missing, doubled or out of order.
    """
    final = columns["final"].astype(bool)
    finals = np.flatnonzero(final)
    if not len(finals):
        return np.empty(0, np.int64)
    read = int(finals[-1]) + 1
    steps, episodes = columns["step"][:read], columns["episode"][:read]
    # Behind a final record an episode begins; any other is followed by the next of its episode.
    begins = np.concatenate([[0], finals[:-1] + 1])
    breaks = np.concatenate([_breaks(steps, 1), _breaks(episodes, 0)])
    wrong = [begins[steps[begins] != 0], breaks[~final[breaks]] + 1]
    if "terminated" in columns:
        # An end is the last transition's, which stands before the final record.
        ends = np.flatnonzero(columns["terminated"][: read - 1] | columns["truncated"][: read - 1])
        wrong.append(ends[~final[ends + 1]])
    rows = np.concatenate(wrong)
    if len(rows):
        row = int(rows.min())
        raise CorruptLogError(
            f"{where}: record {row} of {STEP_TOPIC} (episode {episodes[row]}, step {steps[row]}) is"
            " out of order: records are missing or doubled, or an episode goes on after its end"
        )
    return np.diff(finals, prepend=-1) - 1


def _breaks(column: NDArray[Any], by: int) -> NDArray[np.int64]:
    """The rows that the next one is not higher than by so much."""
    found = []
    for start in range(0, len(column) - 1, _BLOCK_ROWS):
        block = column[start : start + _BLOCK_ROWS + 1]
        found.append(start + np.flatnonzero(block[1:] - block[:-1] != by))
    return np.concatenate(found) if found else np.empty(0, np.int64)


class Told:
    """What `/rl/episode` tells of episodes: nothing, if it is of another type than ours."""

    def __init__(self, topic: Topic) -> None:
        """Point at it; nothing is read."""
        self._topic = topic

    @cached_property
    def lengths(self) -> NDArray[np.int64]:
        """(E,) transitions of each; none if they are told of out of order."""
        if not self._is_ours or not (np.diff(self._columns["end_time_ns"]) > 0).all():
            return np.empty(0, np.int64)
        return self._columns["length"].astype(np.int64)

    def summaries(self, ends: NDArray[np.int64]) -> list[EpisodeSummary]:
        """Of those with these last log_times, and maybe others."""
        if not self._is_ours:
            return []
        fields, rows = EpisodeSummary._fields, None
        if len(ends) < len(self._topic) // 2:
            rows = np.flatnonzero(np.isin(self._columns["end_time_ns"], ends))
        columns = self._topic.read([name for name in fields if name in self._topic.fields], rows)
        for name in ("terminated", "truncated"):
            columns[name] = columns[name].astype(bool)
        values = {name: columns[name].tolist() for name in fields if name in columns}
        if "seed" in values:
            values["seed"] = [None if seed < 0 else seed for seed in values["seed"]]
        defaults, told = EpisodeSummary._field_defaults, len(values["length"])
        every = [values[name] if name in values else [defaults[name]] * told for name in fields]
        return list(map(EpisodeSummary._make, zip(*every, strict=True)))

    @property
    def _is_ours(self) -> bool:
        required = set(EpisodeSummary._fields) - set(EpisodeSummary._field_defaults)
        return required <= set(self._topic.fields)

    @cached_property
    def _columns(self) -> Columns:
        return self._topic.read(("length", "end_time_ns"))


def summaries(
    path: object, columns: Columns, lengths: NDArray[np.int64], told: list[EpisodeSummary]
) -> tuple[EpisodeSummary, ...]:
    """One for each episode; one that was not told of is summed up from its records.

    Raises:
        CorruptLogError: what is told does not agree with the records.
    """
    # By the time of their last record: appended recordings count from 0 again.
    by_end = {summary.end_time_ns: summary for summary in told}
    finals = np.cumsum(lengths + 1) - 1
    ends = columns["log_time"][finals].tolist()
    untold = np.array([end not in by_end for end in ends], bool)
    summed_up = of_records(columns, finals[untold], lengths[untold])
    found = []
    for end, length in zip(ends, lengths.tolist(), strict=True):
        summary = by_end[end] if end in by_end else next(summed_up)
        if summary.length != length:
            raise CorruptLogError(
                f"{path}: /rl/episode gives episode {summary.episode} {summary.length} steps,"
                f" {STEP_TOPIC} has {length}"
            )
        found.append(summary)
    return tuple(found)


def of_records(
    columns: Columns, finals: NDArray[np.int64], lengths: NDArray[np.int64]
) -> Iterator[EpisodeSummary]:
    """Summaries of the episodes that end with these records, as far as records tell."""
    firsts = finals - lengths
    lasts = np.maximum(finals - 1, firsts)
    rewards = columns["reward"].astype(np.float64, copy=False)
    # In the order of the summary's fields.
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

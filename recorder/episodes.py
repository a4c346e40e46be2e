"""Episodes of a log: where they end, in what order, and what `/rl/episode` tells of them."""

from __future__ import annotations

from dataclasses import MISSING, fields

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns import Columns, Topic
from mcaprl.recorder.log_writer import STEP_TOPIC, EpisodeSummary
from mcaprl.recorder.rows import add_up

COUNTERS = ("episode", "step", "final")
"""The fields that say which episode a record belongs to, where in it, and whether it is the end."""


def time_order(topic: Topic) -> NDArray[np.int64] | None:
    """The order of log_time; None if that is the order they are in."""
    if (topic.times[1:] >= topic.times[:-1]).all():
        return None
    return np.argsort(topic.times, kind="stable")


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
    in_order = np.empty(read, bool)
    in_order[0] = steps[0] == 0
    # Behind a final record an episode begins; any other is followed by the next of its episode.
    ended = final[: read - 1]
    in_order[1:] = np.where(
        ended, steps[1:] == 0, (steps[1:] == steps[:-1] + 1) & (episodes[1:] == episodes[:-1])
    )
    if "terminated" in columns:
        # An end is the last transition's, which stands before the final record.
        ends = (columns["terminated"][:read] | columns["truncated"][:read]).astype(bool)
        in_order[:-1] &= ~ends[:-1] | final[1:read]
    if not in_order.all():
        row = int(np.argmin(in_order))
        raise CorruptLogError(
            f"{where}: record {row} of {STEP_TOPIC} (episode {episodes[row]}, step {steps[row]}) is"
            " out of order: records are missing or doubled, or an episode goes on after its end"
        )
    return np.diff(finals, prepend=-1) - 1


def told_lengths(topic: Topic) -> NDArray[np.int64]:
    """(E,) transitions of each episode by `/rl/episode`; none if it tells them out of order."""
    names = ("length", "end_time_ns")
    if not set(names) <= set(topic.fields):
        return np.empty(0, np.int64)
    columns = topic.read(names)
    in_order = (np.diff(columns["end_time_ns"]) > 0).all()
    return columns["length"].astype(np.int64) if in_order else np.empty(0, np.int64)


def told_episodes(topic: Topic, ends: NDArray[np.int64]) -> list[EpisodeSummary]:
    """What `/rl/episode` tells of the episodes with these last log_times.

    Nothing if it is of another type.
    """
    known = fields(EpisodeSummary)
    if any(field.default is MISSING and field.name not in topic.fields for field in known):
        return []
    names = [field.name for field in known if field.name in topic.fields]
    rows = None
    if len(ends) < len(topic) // 2:
        rows = np.flatnonzero(np.isin(topic.read(["end_time_ns"])["end_time_ns"], ends))
    columns = topic.read(names, rows)
    columns["terminated"] = columns["terminated"].astype(bool)
    columns["truncated"] = columns["truncated"].astype(bool)
    values = {name: columns[name].tolist() for name in names}
    if "seed" in values:
        values["seed"] = [None if seed < 0 else seed for seed in values["seed"]]
    rows_ = zip(*values.values(), strict=True)
    return [EpisodeSummary(**dict(zip(names, row, strict=True))) for row in rows_]


def summaries(
    path: object, columns: Columns, lengths: NDArray[np.int64], told: list[EpisodeSummary]
) -> tuple[EpisodeSummary, ...]:
    """One for each episode; one that was not told of is summed up from its records.

    Raises:
        CorruptLogError: what is told does not agree with the records.
    """
    # By the time of their last record: appended recordings count from 0 again.
    by_end = {summary.end_time_ns: summary for summary in told}
    found = []
    finals = np.cumsum(lengths + 1) - 1
    ends = columns["log_time"][finals].tolist()
    for end, final, length in zip(ends, finals.tolist(), lengths.tolist(), strict=True):
        summary = by_end.get(end)
        if summary is None:
            summary = _summary_of_records(columns, final, length)
        elif summary.length != length:
            raise CorruptLogError(
                f"{path}: /rl/episode gives episode {summary.episode} {summary.length} steps,"
                f" {STEP_TOPIC} has {length}"
            )
        found.append(summary)
    return tuple(found)


def _summary_of_records(columns: Columns, final: int, length: int) -> EpisodeSummary:
    first = final - length
    last = max(final - 1, first)
    return EpisodeSummary(
        episode=int(columns["episode"][final]),
        length=length,
        total_reward=add_up(columns["reward"][first:final]),
        terminated=bool(columns["terminated"][last]),
        truncated=bool(columns["truncated"][last]),
        start_time_ns=int(columns["log_time"][first]),
        end_time_ns=int(columns["log_time"][final]),
    )

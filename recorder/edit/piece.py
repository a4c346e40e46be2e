"""Copies of selected episodes of a log, and of the part between two steps or times.

If the part begins or ends within an episode, this episode is shortened: its steps are numbered
from 0, and its last copied record becomes its final record.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from mcaprl.errors import LogError, NoEpisodesError, UsageError
from mcaprl.files import replacing, replacing_folder
from mcaprl.recorder.dataset.log_reader import LogReader, Selection
from mcaprl.recorder.edit.source import Edited, FinishedLog
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.messages import INTERRUPTED, EpisodeSummary, add_up
from mcaprl.recorder.format.schema import EPISODE_TOPIC, STEP_TOPIC, Part, Shorten, message_dtype
from mcaprl.recorder.format.selected_copy import Source, copy_selected
from mcaprl.recorder.mapping.expression import Column, Expression
from mcaprl.texts import counted

_NS_PER_S = 10**9
_LAST_TIME = np.iinfo(np.int64).max
Bounds = tuple[float | None, float | None]
"""Start (included) and stop (excluded) of the part; None for no bound."""


@dataclass(frozen=True)
class _Piece:
    """Part of one episode.

    Attributes:
        episode: Index of the episode.
        start: Step of the first record.
        stop: Step of the last record; the part has the transitions from `start` to `stop` - 1.
        length: Number of transitions of the whole episode.
    """

    episode: int
    start: int
    stop: int
    length: int

    @property
    def is_whole(self) -> bool:
        return self.start == 0 and self.stop == self.length

    def part(self, log: FinishedLog) -> Part:
        first = int(log.firsts[self.episode])
        start_ns, end_ns = (int(log.times[first + step]) for step in (self.start, self.stop))
        count = self.stop - self.start
        return Part(start_ns, end_ns, self.start, count, is_cut=self.stop < self.length)


def slice_log(
    path: str | Path,
    out: str | Path,
    *,
    steps: Bounds | None = None,
    time: Bounds | None = None,
    overwrite: bool = False,
) -> Edited:
    """Copy the part of a log between two steps or times; see `mcaprl.slice`."""
    if (steps is None) == (time is None):
        raise UsageError("give either steps or time, as in 100:200")
    for bound in (*(steps or ()), *(time or ())):
        if bound is not None and not math.isfinite(bound):
            raise UsageError(f"a bound is {bound}, expected a number")
    log = FinishedLog(path)
    window = _window_of_steps(log, steps) if steps is not None else _window_of_time(log, time)
    pieces = _pieces(log, *window)
    if log.has_steps:
        if not pieces:
            raise NoEpisodesError(f"{path} has no whole transition in this part")
        window = _without_single_records(log, pieces, *window)
    cut = [piece for piece in pieces if not piece.is_whole]
    spans = np.array([window], np.int64)
    source = Source(
        log.reader,
        {id_: id_ for id_ in log.reader.channels},
        spans,
        also=log.states(spans),
    )
    summaries = _shorten(log, cut, source) if cut else []
    with replacing(Path(out), LogError, overwrite=overwrite) as unfinished:
        copied = copy_selected([source], unfinished, log.top_level, summaries)
    transitions = sum(piece.stop - piece.start for piece in pieces)
    return Edited(
        Path(out), len(pieces), transitions, copied.messages, copied.whole, copied.rewritten
    )


def _window_of_steps(log: FinishedLog, steps: Bounds) -> tuple[int, int]:
    """Return the first and last log_time of a part.

    The bounds in `steps` count the transitions of all episodes.
    """
    log.need_steps()
    count = int(log.lengths.sum())
    if any(bound is not None and bound != int(bound) for bound in steps):
        raise UsageError(f"steps are {steps[0]} and {steps[1]}, expected integers")
    start = 0 if steps[0] is None else int(steps[0])
    stop = count if steps[1] is None else min(int(steps[1]), count)
    if not 0 <= start < stop:
        raise UsageError(f"{log.path} has the steps 0 to {count - 1}: none of them is in this part")
    ends = np.cumsum(log.lengths)
    first, last = (int(np.searchsorted(ends, step, side="right")) for step in (start, stop - 1))
    # Add the number of earlier episodes, because each has one more record than transitions.
    low = int(log.times[start + first]) if start else 0
    if stop == count:
        return low, _LAST_TIME
    if stop == ends[last]:
        return low, int(log.times[log.firsts[last + 1]]) - 1
    return low, int(log.times[stop + last])


def _window_of_time(log: FinishedLog, time: Bounds | None) -> tuple[int, int]:
    """Return the first and last log_time of a part.

    The bounds in `time` are seconds since the first message.
    """
    assert time is not None
    begin_ns, end_ns = log.span_of_messages()
    start, stop = time
    low = 0 if start is None else begin_ns + _ns(start)
    high = _LAST_TIME if stop is None else min(begin_ns + _ns(stop) - 1, _LAST_TIME)
    if not (low <= min(high, end_ns) and high >= begin_ns):
        seconds = (end_ns - begin_ns) / _NS_PER_S
        raise UsageError(f"{log.path} lasts {seconds:.9g} s: no message is in this part")
    return max(low, 0), high


def _ns(seconds: float) -> int:
    """Convert seconds to nanoseconds; limit them to the times that a log can have."""
    most_s = _LAST_TIME / _NS_PER_S
    return round(max(-most_s, min(seconds, most_s)) * _NS_PER_S)


def _pieces(log: FinishedLog, low: int, high: int) -> list[_Piece]:
    """Return the part of each episode between two log_times, if it has at least one transition."""
    if not log.has_steps:
        return []
    first = int(np.searchsorted(log.times, low))
    last = int(np.searchsorted(log.times, high, side="right")) - 1
    found = []
    for episode, (start, length) in enumerate(zip(log.firsts, log.lengths, strict=True)):
        begin, end = max(first - int(start), 0), min(last - int(start), int(length))
        if begin < end:
            found.append(_Piece(episode, begin, end, int(length)))
    return found


def _without_single_records(
    log: FinishedLog, pieces: list[_Piece], low: int, high: int
) -> tuple[int, int]:
    """Narrow the time range to exclude records that do not belong to any copied transition."""
    firsts, first, last = log.firsts, pieces[0], pieces[-1]
    before, after = firsts[first.episode] + first.start - 1, firsts[last.episode] + last.stop + 1
    if before >= 0:
        low = max(low, int(log.times[before]) + 1)
    if after < len(log.times):
        high = min(high, int(log.times[after]) - 1)
    return low, high


def _shorten(log: FinishedLog, pieces: list[_Piece], source: Source) -> list[EpisodeSummary]:
    """Make `source` change the records of shortened episodes; return their new summaries."""
    dtypes = {one.id: _step_dtype(log, one) for one in log.reader.channels_of(STEP_TOPIC)}
    change = Shorten([piece.part(log) for piece in pieces], dtypes)
    source.change, source.changed = change, dict.fromkeys(dtypes, change.spans)
    listed = log.reader.channel_of(EPISODE_TOPIC)
    if listed is None:
        return []
    if log.reader.schema_of(listed).data.decode(errors="replace") != messages.EPISODE_TEXT:
        raise LogError(
            f"{log.path}: {EPISODE_TOPIC} has messages of another version, so episodes cannot be"
            " shortened; choose a part of whole episodes"
        )
    source.without = {listed.id: log.spans[[one.episode for one in pieces], 1]}
    return _new_summaries(log.path, pieces)


def _step_dtype(log: FinishedLog, channel: Channel) -> np.dtype[Any]:
    text = log.reader.schema_of(channel).data.decode(errors="replace")
    dtype = message_dtype(text)
    if dtype is None or channel.message_encoding != "cdr":
        raise LogError(
            f"{log.path}: {STEP_TOPIC} has messages of another program, so episodes cannot be"
            " shortened; choose a part of whole episodes"
        )
    return dtype


def _new_summaries(path: Path, pieces: list[_Piece]) -> list[EpisodeSummary]:
    """Return a new summary for each shortened episode."""
    numbers: NDArray[np.int64] = np.array([piece.episode for piece in pieces])
    whole = LogReader(path, Selection(columns=())).read(numbers)
    found = []
    for piece, episode in zip(pieces, whole.episodes, strict=True):
        rows = slice(piece.start, piece.stop)
        summary: EpisodeSummary = episode.summary._replace(
            length=piece.stop - piece.start,
            total_reward=add_up(episode.rewards[rows].astype(np.float64)),
            start_time_ns=int(episode.log_time_ns[piece.start]),
            end_time_ns=int(episode.log_time_ns[piece.stop]),
        )
        if piece.stop < piece.length:
            summary = summary._replace(terminated=False, truncated=True, reason=INTERRUPTED)
        if piece.start > 0:
            # The seed and the options of the reset do not reproduce the first state of the part.
            summary = summary._replace(seed=None, options="")
        found.append(summary)
    return found


# Expressions compare numbers as float64, which cannot represent all integers above this limit.
_LARGEST_EXACT = 2**53


def filter_log(
    expression: str, path: str | Path, out: str | Path, *, overwrite: bool = False
) -> Edited:
    """Copy the episodes for which an expression is true; see `mcaprl.filter`."""
    condition = Expression(expression)
    if condition.uses_next:
        raise UsageError(f"'{expression}': next(...) has no meaning for episodes")
    log = FinishedLog(path)
    table = episode_columns(log.summaries(), condition.names)
    holds = condition.evaluate(table, np.arange(len(log.lengths)))
    if not condition.is_condition(table):
        raise UsageError(f"'{expression}' is not a condition: compare it, as in 'length > 10'")
    # A condition on a missing value (NaN) is false.
    chosen = np.flatnonzero(np.nan_to_num(holds.astype(np.float64)))
    if not len(chosen):
        raise NoEpisodesError(
            f"{path}: '{expression}' is true for no episode ({len(log.lengths)} in the log)"
        )
    with replacing(Path(out), LogError, overwrite=overwrite) as unfinished:
        return _copy_episodes(log, chosen, unfinished, Path(out))


def split_log(
    path: str | Path,
    out: str | Path,
    *,
    episodes: int | None = None,
    ratio: Sequence[float] | None = None,
    seed: int | None = None,
    overwrite: bool = False,
) -> list[Edited]:
    """Copy the episodes of a log to several logs in a folder; see `mcaprl.split`."""
    log, out = FinishedLog(path), Path(out)
    log.need_steps()
    parts = _parts(len(log.lengths), episodes, ratio)
    order = np.arange(len(log.lengths))
    if seed is not None:
        np.random.default_rng(seed).shuffle(order)
    found = []
    with replacing_folder(out, overwrite=overwrite) as folder:
        for number, (start, stop) in enumerate(parts):
            name = f"{Path(str(log.path)).stem}-{number:05d}.mcap"
            chosen = np.sort(order[start:stop])
            found.append(_copy_episodes(log, chosen, folder / name, out / name))
    return found


def episode_columns(
    summaries: Sequence[EpisodeSummary], names: frozenset[str]
) -> dict[str, Column]:
    """Return the columns that a filter can use, by name, with one row per episode."""
    seeds = [summary.seed for summary in summaries]
    largest = max((seed for seed in seeds if seed is not None), default=0)
    if "seed" in names and largest > _LARGEST_EXACT:
        raise UsageError(f"seed {largest} is too large to compare; select by `episode` instead")
    starts, ends = (
        np.array([getattr(summary, name) for summary in summaries], np.int64)
        for name in ("start_time_ns", "end_time_ns")
    )
    return {
        "episode": np.arange(len(summaries)),
        "length": np.array([summary.length for summary in summaries], np.int64),
        "total_reward": np.array([summary.total_reward for summary in summaries], np.float64),
        "terminated": np.array([summary.terminated for summary in summaries], np.bool_),
        "truncated": np.array([summary.truncated for summary in summaries], np.bool_),
        "reason": np.array([summary.reason for summary in summaries], object),
        "policy": np.array([summary.policy for summary in summaries], object),
        "epsilon": np.array([summary.epsilon for summary in summaries], np.float64),
        "seed": np.array([np.nan if seed is None else seed for seed in seeds], np.float64),
        "options": np.array([summary.options for summary in summaries], object),
        "start_s": (starts - starts[0]) / _NS_PER_S,
        "duration_s": (ends - starts) / _NS_PER_S,
    }


def _copy_episodes(log: FinishedLog, chosen: NDArray[np.int64], target: Path, out: Path) -> Edited:
    spans = log.spans_of(chosen)
    ids = {id_: id_ for id_ in log.reader.channels}
    source = Source(log.reader, ids, spans, also=log.states(spans))
    copied = copy_selected([source], target, log.top_level)
    steps = int(log.lengths[chosen].sum())
    return Edited(out, len(chosen), steps, copied.messages, copied.whole, copied.rewritten)


def _parts(
    count: int, episodes: int | None, ratio: Sequence[float] | None
) -> list[tuple[int, int]]:
    """Divide `count` episodes into parts, and return the start and stop index of each part."""
    if (episodes is None) == (ratio is None):
        raise UsageError("give either the episodes of each part or the ratio of the parts")
    if episodes is not None:
        if episodes < 1:
            raise UsageError(f"episodes is {episodes}, expected 1 or more")
        return [(start, min(start + episodes, count)) for start in range(0, count, episodes)]
    assert ratio is not None
    shares = np.array(ratio, np.float64)
    if not (len(shares) > 1 and np.isfinite(shares).all() and (shares > 0).all()):
        raise UsageError("the ratio needs two or more positive numbers, such as 8:1:1")
    bounds = np.rint(np.cumsum(shares) / shares.sum() * count).astype(np.int64)
    starts = np.concatenate([[0], bounds[:-1]])
    if (starts == bounds).any():
        raise UsageError(
            f"{counted(count, 'episode')} cannot be divided into {len(shares)} parts of this ratio"
        )
    return list(zip(starts.tolist(), bounds.tolist(), strict=True))

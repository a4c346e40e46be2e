"""Copies of selected episodes of a log, and of the part between two steps or times.

If the part begins or ends within an episode, this episode is shortened: its steps are numbered
from 0, and its last copied record becomes its final record.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Metadata
from numpy.typing import NDArray

from mcaprl.errors import (
    CorruptLogError,
    LogError,
    NoEpisodesError,
    NoStepsError,
    UnknownNameError,
    UsageError,
)
from mcaprl.files import replacing, replacing_folder
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.labels import Labels, carry_labels, labels_of, labels_to_carry
from mcaprl.recorder.dataset.log_reader import LogReader, Selection, described
from mcaprl.recorder.dataset.log_video import LogVideo, is_video_leaf
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.messages import INTERRUPTED, EpisodeSummary, add_up
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.schema import (
    EPISODE_TOPIC,
    PHASE_TOPIC,
    STEP_TOPIC,
    Part,
    Shorten,
    message_dtype,
)
from mcaprl.recorder.format.selected_copy import Source, Times, copy_selected, times_of
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.format.writing import finished_state
from mcaprl.recorder.mapping.expression import Column, Expression
from mcaprl.recorder.record.display import CAMERA_INFO, MAP, SCENE, SCENE_STATIC, TF, TF_STATIC
from mcaprl.storage.remote import as_path
from mcaprl.texts import counted

# On these topics, a message is valid until the next message of the same topic.
_STATES = (SCENE, SCENE_STATIC, MAP, TF, TF_STATIC, CAMERA_INFO, PHASE_TOPIC)


@dataclass(frozen=True)
class Edited:
    """Log that was made of parts of other logs.

    Attributes:
        out: Path of the log.
        episodes: Number of episodes.
        steps: Number of transitions.
        messages: Number of messages.
        whole_chunks: Number of chunks that were copied without decompressing them.
        rewritten_chunks: Number of chunks that were decompressed and written again.
    """

    out: Path
    episodes: int
    steps: int
    messages: int
    whole_chunks: int
    rewritten_chunks: int


class FinishedLog:
    """A finished log of whole episodes, or a finished MCAP file without `/rl/step`."""

    def __init__(self, path: str | Path) -> None:
        """Open the file; a remote file is first downloaded completely."""
        self.path = as_path(path, whole=True)
        self.reader = McapReader(self.path)
        try:
            top_level = finished_state(self.reader).top_level
        except CorruptLogError as error:
            what = str(error).removeprefix(f"{self.path}: ")
            raise self._unusable(what) from error
        # Metadata records, schemas, channels and attachments, in this order.
        self.top_level = [
            *(record for record in top_level if isinstance(record, Metadata)),
            *(record for record in top_level if not isinstance(record, Metadata | Attachment)),
            *(record for record in top_level if isinstance(record, Attachment)),
        ]
        self._log = LogReader(self.path) if self.reader.channels_of(STEP_TOPIC) else None

    @property
    def has_steps(self) -> bool:
        """Whether the file has the topic `/rl/step`."""
        return self._log is not None

    @cached_property
    def lengths(self) -> NDArray[np.int64]:
        """(E,) number of transitions of each episode. Without `/rl/step`, the array is empty."""
        if self._log is None:
            return np.empty(0, np.int64)
        with warnings.catch_warnings():
            # Suppress the warning about an unfinished last episode: `times` raises an error for it.
            warnings.simplefilter("ignore")
            return self._log.lengths

    @cached_property
    def times(self) -> Times:
        """(F,) log_time of each record of `/rl/step`, nanoseconds."""
        if self._log is None:
            return np.empty(0, np.int64)
        lengths, found = self.lengths, self._log.record_times()
        channels = self.reader.channels_of(STEP_TOPIC)
        records = sum(len(part) for one in channels for part in self.reader.message_ranges(one))
        if len(found) != records:
            raise self._unusable(f"it has {records - len(found)} records of an unfinished episode")
        if (np.diff(found) <= 0).any():
            raise LogError(
                f"{self.path}: the log_times of {STEP_TOPIC} do not increase throughout the"
                f" {len(lengths)} episodes; copy the log with mcaprl.open(...).save(...) first"
            )
        return found

    @property
    def firsts(self) -> NDArray[np.int64]:
        """(E,) index of the first record of each episode."""
        return np.cumsum(self.lengths + 1) - (self.lengths + 1)

    @property
    def spans(self) -> Times:
        """(E, 2) log_times of the first and last record of each episode, increasing."""
        firsts = self.firsts
        return np.stack([self.times[firsts], self.times[firsts + self.lengths]], axis=1)

    def need_steps(self) -> None:
        """Raise NoStepsError if the file has no `/rl/step`."""
        if self._log is None:
            raise NoStepsError(f"{self.path} has no topic {STEP_TOPIC} and thus no episodes")

    def summaries(self) -> list[EpisodeSummary]:
        """Return the summary of each episode."""
        self.need_steps()
        return LogReader(self.path, Selection(columns=())).episode_summaries()

    def span_of_messages(self) -> tuple[int, int]:
        """Return the smallest and largest log_time of all messages; (0, 0) if there are none."""
        chunks = [chunk for chunk in self.reader.chunks if chunk.message_index_length]
        starts = [chunk.message_start_time for chunk in chunks]
        ends = [chunk.message_end_time for chunk in chunks]
        return min(starts, default=0), max(ends, default=0)

    def spans_of(self, episodes: NDArray[np.int64]) -> Times:
        """Return the time ranges (S, 2) of the episodes' messages, merged if adjacent."""
        # An episode has all messages until the next one; the first has those before it, too.
        starts = self.spans[:, 0].copy()
        starts[0] = 0
        stops = np.append(starts[1:] - 1, _LAST_TIME)
        begins = np.flatnonzero(np.diff(episodes, prepend=-2) != 1)
        ends = np.append(begins[1:] - 1, len(episodes) - 1)
        return np.stack([starts[episodes[begins]], stops[episodes[ends]]], axis=1)

    def states(self, spans: Times) -> dict[int, Times]:
        """Return, by channel, the times of messages still valid at each range's start."""
        # These are the last messages before a range of display topics that are not repeated at each
        # step, such as the static scene, and of latched (transient local) topics.
        found = {}
        for channel in self.reader.channels.values():
            if channel.topic in _STATES or _is_latched(channel.metadata):
                times = np.sort(times_of(self.reader, channel))
                latest = np.searchsorted(times, spans[:, 0], side="right") - 1
                before = times[latest[latest >= 0]]
                if len(before):
                    found[channel.id] = np.unique(before)
        return found

    def _unusable(self, what: str) -> LogError:
        return LogError(
            f"{self.path} cannot be copied: {what}; run `mcaprl recover {self.path} OUT` and use"
            " OUT"
        )


def _is_latched(metadata: dict[str, str]) -> bool:
    """Return whether ROS delivers the last message of a channel to later subscribers."""
    qos = metadata.get("offered_qos_profiles", "")
    return (
        metadata.get("latching") == "1"
        or "transient_local" in qos
        or any(line.strip(" -") == "durability: 1" for line in qos.splitlines())
    )


_NS_PER_S = 10**9
_LAST_TIME = np.iinfo(np.int64).max
Bounds = tuple[float | None, float | None]
"""Start (included) and stop (excluded) of the part; None for no bound."""


@dataclass(frozen=True)
class _Piece:
    """Part of one episode."""

    episode: int
    start: int  # Step of the first record
    stop: int  # Step of the last record; the part has the transitions from `start` to `stop` - 1
    length: int  # Number of transitions of the whole episode

    @property
    def is_whole(self) -> bool:
        return self.start == 0 and self.stop == self.length

    def part(self, log: FinishedLog) -> Part:
        first = int(log.firsts[self.episode])
        start_ns, end_ns = (int(log.times[first + step]) for step in (self.start, self.stop))
        count = self.stop - self.start
        return Part(start_ns, end_ns, self.start, count, is_cut=self.stop < self.length)


def _check_videos(log: FinishedLog, pieces: Iterable[_Piece]) -> None:
    """Check that parts of episodes begin with a keyframe, where images are frames of a video."""
    metadata = described(log.reader)
    for leaf in observation_leaves(metadata.observation_space) if metadata else ():
        if leaf.encoding is not None and is_video_leaf(log.reader, leaf):
            video = LogVideo(log.reader, leaf)
            for piece in pieces:
                if piece.start and not video.is_start(piece.part(log).start_ns):
                    raise UsageError(
                        f"{log.path}: the images of {leaf.topic} are a video without a keyframe at"
                        f" step {piece.start} of episode {piece.episode}: begin at another step"
                    )


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
    _check_videos(log, cut)
    spans = np.array([window], np.int64)
    source = Source(
        log.reader, {id_: id_ for id_ in log.reader.channels}, spans, also=log.states(spans)
    )
    summaries = _shorten(log, cut, source) if cut else []
    with replacing(Path(out), LogError, overwrite=overwrite) as unfinished:
        copied = copy_selected([source], unfinished, log.top_level, summaries)
    transitions = sum(piece.stop - piece.start for piece in pieces)
    return Edited(
        Path(out), len(pieces), transitions, copied.messages, copied.whole, copied.rewritten
    )


def _window_of_steps(log: FinishedLog, steps: Bounds) -> tuple[int, int]:
    """Return the first and last log_time of a part, by transitions of all episodes."""
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
    """Return the first and last log_time of a part, by seconds since the first message."""
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
    log = FinishedLog(path)
    labels = labels_to_carry(log.path)
    chosen = _chosen(expression, log.summaries(), lambda: labels, str(path))
    with replacing(Path(out), LogError, overwrite=overwrite) as unfinished:
        found = _copy_episodes(log, chosen, unfinished, Path(out))
    carry_labels(labels, chosen, Path(out))
    return found


def _chosen(
    expression: str,
    summaries: Sequence[EpisodeSummary],
    labels: Callable[[], Labels | None],
    name: str,
) -> NDArray[np.int64]:
    """Return the indexes of the episodes for which an expression is true."""
    condition, count = Expression(expression), len(summaries)
    table = _table(condition, summaries, labels)
    holds = condition.evaluate(table, np.arange(count))
    if not condition.is_condition(table):
        raise UsageError(f"'{expression}' is not a condition: compare it, as in 'length > 10'")
    # A condition on a missing value (NaN) is false.
    chosen = np.flatnonzero(np.nan_to_num(holds.astype(np.float64)))
    if not len(chosen):
        raise NoEpisodesError(f"{name}: '{expression}' is true for no episode ({count} in the log)")
    return chosen


def _table(
    expression: Expression, summaries: Sequence[EpisodeSummary], labels: Callable[[], Labels | None]
) -> dict[str, Column]:
    """Return the columns of episodes that an expression can use."""
    if expression.uses_next:
        raise UsageError(f"'{expression.text}': next(...) has no meaning for episodes")
    table = episode_columns(summaries, expression.names)
    if expression.labels or expression.names & {"success", "note"}:
        table |= (labels() or Labels("")).columns(len(summaries))
    return table


def episode_values(expression: str, dataset: Dataset) -> NDArray[np.float64]:
    """Return the (E,) values of an expression that has the columns of `mcaprl.filter`."""
    parsed = Expression(expression)

    def labels() -> Labels | None:
        if dataset.origin.grow is not None:
            raise UsageError(f"'{expression}': a log that is being written has no labels")
        return labels_of(dataset)

    table = _table(parsed, [episode.summary for episode in dataset.episodes], labels)
    return parsed.evaluate(table, np.arange(len(dataset.episodes))).astype(np.float64)


def selected(dataset: Dataset, only: str | None = None, mask: Sequence[str] = ()) -> Dataset:
    """Return the episodes for which an expression is true, without the intervals in `mask`."""
    if only is None and not mask:
        return dataset
    if dataset.origin.grow is not None:
        name = "mask" if mask else "only"
        raise UsageError(f"`{name}=` and `follow=`: a log that is being written has no labels")
    labels, lengths = cache(lambda: labels_of(dataset)), dataset.episode_lengths
    dropped = np.zeros(len(dataset), np.bool_)
    if mask:
        firsts = (np.cumsum(lengths) - lengths).tolist()
        steps = (labels() or Labels("")).steps(firsts, len(dataset))
        for name in mask:
            if name not in steps:
                raise UnknownNameError("name of intervals", name, steps)
            dropped |= steps[name]
    if only is not None:
        summaries = [episode.summary for episode in dataset.episodes]
        chosen = _chosen(only, summaries, labels, "the data")
        dropped |= np.repeat(~np.isin(np.arange(len(lengths)), chosen), lengths)
    found = dataset.without(dropped)
    selection = {"only": only, "mask": list(mask), "data": dataset.content}
    selection["episodes"] = found.wholes.tolist()
    kept = partial(_kept_labels, labels, lengths, dropped), found.episode_lengths
    found.origin = replace(found.origin, selection=selection, labels=kept)
    return found


def _kept_labels(
    labels: Callable[[], Labels | None], lengths: NDArray[np.int64], dropped: NDArray[np.bool_]
) -> Labels:
    """Return the labels of the parts that are left of episodes without some of their steps."""
    firsts = (np.cumsum(lengths + 1) - lengths - 1).tolist()
    parts = []
    for first, flags in zip(firsts, np.split(dropped, np.cumsum(lengths)[:-1]), strict=True):
        inside = np.pad(~flags, 1)
        edges = np.flatnonzero(inside[1:] != inside[:-1]).reshape(-1, 2)
        parts += [(first + start, stop - start) for start, stop in edges.tolist()]
    new = [start for start, _ in parts], [length for _, length in parts]
    found = labels() or Labels("")
    return found.divided((firsts, lengths.tolist()), new, int((lengths + 1).sum()))


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
    labels = labels_to_carry(log.path)
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
            carry_labels(labels, chosen, folder / name)
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


def relabeled(dataset: Dataset, reward: str) -> Dataset:
    """Return the same transitions with the reward that an expression has; see `mcaprl.relabel`."""
    columns, rows = _step_columns(dataset), dataset.frame_of_step
    count = len(rows) + len(dataset.episodes)
    following = np.minimum(np.arange(count) + 1, count - 1)
    expression = Expression(reward)
    if expression.names - columns.keys() and (labels := labels_of(dataset)) is not None:
        lengths = dataset.episode_lengths
        firsts = np.cumsum(lengths + 1) - lengths - 1
        columns = labels.rows_of(firsts.tolist(), lengths.tolist(), count) | columns
    found = expression.evaluate(columns, following)[rows].astype(np.float64)
    if not (finite := np.isfinite(found)).all():
        step = int(finite.argmin())
        raise UsageError(
            f"the reward '{reward}' is {found[step]} in transition {step}, and not finite in"
            f" {np.count_nonzero(~finite)} of {len(found)} transitions"
        )
    return dataset.with_rewards(found)


def _step_columns(dataset: Dataset) -> dict[str, NDArray[Any]]:
    """Return what an expression can use, by observation."""
    # Later names do not replace earlier ones.
    rows, count = dataset.frame_of_step, len(dataset.frame_of_step) + len(dataset.episodes)
    columns: dict[str, NDArray[Any]] = {}

    def add(name: str, values: NDArray[Any]) -> None:
        if name.isidentifier():
            columns.setdefault(name, values)

    def of_steps(values: NDArray[Any]) -> NDArray[Any]:
        # The last observation of an episode has no action; nothing reads this row.
        full = np.zeros((count, *values.shape[1:]), values.dtype)
        full[rows] = values
        return full

    actions = dataset.actions.reshape(len(rows), -1)
    add("action", of_steps(actions[:, 0] if actions.shape[1] == 1 else actions))
    add("reward", of_steps(dataset.rewards))
    add("terminated", of_steps(dataset.terminated))
    add("truncated", of_steps(dataset.truncated))
    leaves = observation_leaves(dataset.observation_space)
    for leaf in leaves:
        if leaf.encoding is None:
            values = np.asarray(leaf.of(dataset.frames)).reshape(count, -1)
            add(leaf.path[-1] if leaf.path else "observation", values)
            names = dataset.observation_names if len(leaves) == 1 else ()
            for index, name in enumerate(names):
                add(name, values[:, index])
    for name, info in dataset.infos.items():
        if info.ndim == 1 and info.dtype.kind in "biuf":
            add(name, np.ma.filled(info.astype(np.float64), np.nan))
    return columns

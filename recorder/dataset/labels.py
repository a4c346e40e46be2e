"""Labels of a log's episodes and steps, in a file beside the log, which is not changed.

`LOG.labels.json` names the log's data by the hash of its chunks, so that it is never read for
another log. It is replaced as a whole. Labels of a recording of a bag also name the episodes that
the mapping found, by the hash of their times.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError
from mcaprl.files import as_type, locked_file, parse_json, read_file, read_json, write_json
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.log_reader import LogReader
from mcaprl.texts import counted

_VERSION: Final = 1
_MAX_TEXT = 10_000
_NS_PER_S = 1e9
_KEYS = ("episode", "success", "note", "interval", "start", "stop")
_SUCCESS = {"": None, "true": True, "1": True, "false": False, "0": False}
Span = tuple[float | None, float | None]
"""Start (included) and stop (excluded); None for the start or end of the episode."""


@dataclass(frozen=True)
class Labeled:
    """Episodes of a log, or of a recording of a bag by a mapping, to which labels belong.

    Attributes:
        path: Log; or file or folder of the recording. The labels are beside it.
        lock: File that is locked while labels are saved.
        checksum: Hash of the log or recording.
        lengths: (E,) number of transitions of each episode.
        record_times: Function that returns the (N + E,) times of all observations, nanoseconds.
        episodes: Hash of the times of the episodes of a mapping; empty for a log.
    """

    path: Path
    lock: Path
    checksum: str
    lengths: NDArray[np.int64]
    record_times: Callable[[], NDArray[np.int64]]
    episodes: str = ""

    @classmethod
    def log(cls, path: Path, reader: LogReader | None = None) -> Labeled:
        """Return the episodes of a log."""
        reader = reader or LogReader(path)
        return cls(path, path, reader.checksum, reader.lengths, reader.record_times)


@dataclass(frozen=True)
class Interval:
    """Steps of an episode that have a name.

    Attributes:
        name: Name, such as `intervention`.
        episode: Index of the episode in the log, from 0.
        start: First step, from 0.
        stop: Step after the last one.
    """

    name: str
    episode: int
    start: int
    stop: int


@dataclass(frozen=True)
class Labels:
    """Labels of a log.

    Attributes:
        log: Hash of the log's chunks, or of the recording.
        success: Whether each labeled episode succeeded, by the episode's index as text.
        notes: Note of each episode that has one, by the episode's index as text.
        intervals: Named intervals, by episode and start.
        version: Version of the file.
        mapped: Hash of the episodes of a mapping; empty for a log.
    """

    log: str
    success: dict[str, bool] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    intervals: list[Interval] = field(default_factory=list)
    version: int = _VERSION
    mapped: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return what `label --json` prints and what the file contains."""
        return asdict(self)

    def rows(self) -> list[list[str]]:
        """Return episode, success, note and intervals of each labeled episode, as texts."""
        named = {str(one.episode) for one in self.intervals}
        return [
            [
                key,
                {True: "success", False: "failure", None: ""}[self.success.get(key)],
                self.notes.get(key, ""),
                ", ".join(
                    f"{one.name} {one.start}:{one.stop}"
                    for one in self.intervals
                    if str(one.episode) == key
                ),
            ]
            for key in sorted({*self.success, *self.notes, *named}, key=int)
        ]

    def columns(self, episodes: int) -> dict[str, NDArray[Any]]:
        """Return (E,) columns of expressions on episodes.

        They are `success` (1, 0, or NaN without a label), `note` (empty without one), and whether
        the episode has such an interval by `labels.NAME`.
        """
        keys = [str(episode) for episode in range(episodes)]
        found: dict[str, NDArray[Any]] = {
            "success": np.array([self.success.get(key, np.nan) for key in keys], np.float64),
            "note": np.array([self.notes.get(key, "") for key in keys], object),
        }
        flags: dict[str, NDArray[Any]] = {}
        for one in self.intervals:
            flags.setdefault(word_of(one.name), np.zeros(episodes, np.bool_))[one.episode] = True
        return found | _prefixed({**flags, **found})

    def rows_of(
        self, firsts: Sequence[int], lengths: Sequence[int], count: int
    ) -> dict[str, NDArray[Any]]:
        """Return (count,) columns of expressions on steps, by `NAME` and `labels.NAME`.

        They are `success` (1, 0, or NaN without a label), `note` (empty without one), and whether
        a step is in an interval by the interval's name, with `_` for blanks and hyphens.

        Args:
            firsts: (E,) row of the first observation of each episode.
            lengths: (E,) number of transitions of each episode.
            count: Number of rows.
        """
        found: dict[str, NDArray[Any]] = {}
        for name, rows in self.steps(firsts, count).items():
            found[word_of(name)] = rows | found.get(word_of(name), False)
        found |= {"success": np.full(count, np.nan), "note": np.full(count, "", object)}
        episodes = self.columns(len(firsts))
        for name in ("success", "note"):
            for first, length, value in zip(firsts, lengths, episodes[name], strict=True):
                found[name][first : first + length + 1] = value
        return found | _prefixed(found)

    def divided(
        self,
        old: tuple[Sequence[int], Sequence[int]],
        new: tuple[Sequence[int], Sequence[int]],
        count: int,
    ) -> Labels:
        """Return the labels of other episodes of the same rows.

        They have the result and the note that all of their rows have, and the intervals in them.

        Args:
            old: First rows and lengths of the labeled episodes; see `rows_of`.
            new: Those of the other episodes.
            count: Number of rows.
        """
        columns, flags = self.rows_of(*old, count), self.steps(old[0], count)
        found = Labels(self.log)
        for episode, (first, length) in enumerate(zip(*new, strict=True)):
            success = np.unique(columns["success"][first : first + length + 1])
            if len(success) == 1 and not np.isnan(success[0]):
                found.success[str(episode)] = bool(success[0])
            notes = {*columns["note"][first : first + length + 1]}
            if len(notes) == 1 and notes != {""}:
                found.notes[str(episode)] = notes.pop()
            for name, column in flags.items():
                inside = np.pad(column[first : first + length], 1)
                edges = np.flatnonzero(inside[1:] != inside[:-1]).reshape(-1, 2).tolist()
                found.intervals.extend(Interval(name, episode, *edge) for edge in edges)
        return found

    def steps(self, firsts: Sequence[int], count: int) -> dict[str, NDArray[np.bool_]]:
        """Return which of the rows are in intervals, by name; see `rows_of`."""
        found: dict[str, NDArray[np.bool_]] = {}
        for one in self.intervals:
            rows = found.setdefault(one.name, np.zeros(count, np.bool_))
            rows[firsts[one.episode] + one.start : firsts[one.episode] + one.stop] = True
        return found

    def texts(self, dataset: Dataset) -> list[tuple[int, str]]:
        """Return log_time and text of each change of the labels along a log.

        A text has result and note of the episode and the names of the step's intervals, such as
        `success: clean lap, intervention`; it is empty without labels.
        """
        found: list[tuple[int, str]] = []
        for episode in dataset.episodes:
            key = str(episode.index)
            result = {True: "success", False: "failure", None: ""}[self.success.get(key)]
            whole = ": ".join(filter(None, (result, self.notes.get(key))))
            parts = [one for one in self.intervals if one.episode == episode.index]
            for step in sorted({0, *(at for one in parts for at in (one.start, one.stop))}):
                names = [one.name for one in parts if one.start <= step < one.stop]
                text = ", ".join(filter(None, (whole, *dict.fromkeys(names))))
                if text != (found[-1][1] if found else None):
                    found.append((int(episode.log_time_ns[step]), text))
        return found

    def taken(self, log: str, chosen: NDArray[np.int64]) -> Labels:
        """Return the labels of the chosen episodes, as labels of a log that has only these."""
        new = {str(old): index for index, old in enumerate(chosen.tolist())}

        def moved(given: Mapping[str, Any]) -> dict[str, Any]:
            return {str(new[key]): value for key, value in given.items() if key in new}

        kept = [one for one in self.intervals if str(one.episode) in new]
        intervals = [replace(one, episode=new[str(one.episode)]) for one in kept]
        return Labels(log, moved(self.success), moved(self.notes), intervals)

    def without(self, episode: int | None, interval: str | None) -> Labels:
        """Return the labels without those of an episode, of a name, or of a name in an episode."""

        def stays(one: Interval) -> bool:
            return episode not in (None, one.episode) or interval not in (None, one.name)

        kept = [one for one in self.intervals if stays(one)]
        if interval is not None:
            return replace(self, intervals=kept)

        def others(given: Mapping[str, Any]) -> dict[str, Any]:
            return {key: one for key, one in given.items() if episode not in (None, int(key))}

        return replace(self, success=others(self.success), notes=others(self.notes), intervals=kept)


def word_of(name: str) -> str:
    """Return the name of intervals in expressions.

    >>> word_of("bad-data"), word_of("hand over")
    ('bad_data', 'hand_over')
    """
    return "_".join(name.replace("-", " ").split())


def _prefixed(columns: Mapping[str, Any]) -> dict[str, Any]:
    return {f"labels.{name}": column for name, column in columns.items()}


def labels_path(log: Path) -> Path:
    """Return the path of a log's labels."""
    return log.with_name(f"{log.name}.labels.json")


def read_labels(log: Path | Labeled) -> Labels:
    """Return the labels of a log; empty if it has none.

    Raises:
        LogError: The file of labels is damaged, or belongs to other data.
    """
    labeled = log if isinstance(log, Labeled) else Labeled.log(log)
    log, path = labeled.path, labels_path(labeled.path)
    try:
        found: Labels = read_json(path, LogError, Labels)
    except FileNotFoundError:
        return Labels(labeled.checksum, mapped=labeled.episodes)
    if found.version != _VERSION:
        raise LogError(f"{path} has version {found.version}, expected {_VERSION}")
    if found.log != labeled.checksum:
        raise LogError(
            f"{path} has the labels of other data than {log}, which was replaced or continued:"
            " move the file of labels away"
        )
    if found.mapped != labeled.episodes:
        which = counted(len(labeled.lengths), "episode")
        which += " that the mapping finds in" if labeled.episodes else " of"
        how = "the mapping by which they were labeled" if found.mapped else "no mapping"
        raise LogError(
            f"{path} has the labels of other episodes than the {which} {log}: use {how}, or move"
            " the file of labels away"
        )
    lengths = labeled.lengths.tolist()
    spans = [(str(one.episode), one.start, one.stop) for one in found.intervals]
    known = {str(episode): length for episode, length in enumerate(lengths)}
    for key, start, stop in [*((key, 0, 1) for key in {**found.success, **found.notes}), *spans]:
        if key not in known or not 0 <= start < stop <= max(known[key], 1):
            raise LogError(f"{path}: {log} has no episode {key} with steps {start}:{stop}")
    return found


def change_labels(log: Path | Labeled, changes: Sequence[Mapping[str, Any]]) -> Labels:
    """Apply changes, which have the arguments of `mcaprl.label`, to a log's labels, and save them.

    Nothing is saved if one of the changes is refused.
    """
    with locked_file(log.lock if isinstance(log, Labeled) else log):
        labeled = log if isinstance(log, Labeled) else Labeled.log(log)
        labels = read_labels(labeled)
        for change in changes:
            labels = _changed(labels, labeled, **change)
        if changes:
            write_json(labels_path(labeled.path), labels.to_json(), LogError)
    return labels


@dataclass(frozen=True)
class _Change:
    """Change that a page sends; see `mcaprl.label`."""

    episode: int
    success: bool | None = None
    note: str | None = None
    interval: str | None = None
    steps: tuple[int, int] | None = None
    remove: bool = False


def label_by_json(log: Path, text: bytes) -> dict[str, Any]:
    """Apply a change that is a JSON object with arguments of `mcaprl.label`; return the labels.

    Raises:
        UsageError: It is not such an object, or the change is refused.
    """
    try:
        change: _Change = as_type(_Change, parse_json(text))
    except ValueError as error:
        raise UsageError(f"the label cannot be read: {error}") from error
    return change_labels(log, [asdict(change)]).to_json()


def labels_to_carry(source: Path) -> Labels | None:
    """Return the labels of a log of which others will be made; None if it has no file of labels."""
    return read_labels(source) if labels_path(source).exists() else None


def carry_labels(labels: Labels | None, chosen: NDArray[np.int64], target: Path) -> None:
    """Write the labels of the chosen episodes beside a log that was made of them."""
    if labels is not None:
        taken = labels.taken(LogReader(target).checksum, chosen)
        write_json(labels_path(target), taken.to_json(), LogError)


def labels_of(dataset: Dataset) -> Labels | None:
    """Return the labels of the logs that a dataset was read from; None if there are none.

    Raises:
        UsageError: The dataset has not exactly the episodes of its logs.
    """
    if dataset.origin.labels is not None:
        labels, lengths = dataset.origin.labels
        _check_whole(dataset, lengths)
        return cast(Labels, labels())
    if not any(labels_path(source).is_file() for source in dataset.sources):
        return None
    parts = [Labeled.log(source) for source in dataset.sources]
    _check_whole(dataset, np.concatenate([part.lengths for part in parts]))
    return joined_labels(parts)


def joined_labels(parts: Sequence[Labeled]) -> Labels:
    """Return the labels of several logs or recordings, whose episodes follow each other."""
    joined, first = Labels(""), 0
    for part in parts:
        # Put the episodes at the place that they have in all data.
        places = np.concatenate([np.full(first, -1, np.int64), np.arange(len(part.lengths))])
        moved = read_labels(part).taken("", places)
        joined.success.update(moved.success)
        joined.notes.update(moved.notes)
        joined.intervals.extend(moved.intervals)
        first += len(part.lengths)
    return joined


def _check_whole(dataset: Dataset, lengths: NDArray[np.int64]) -> None:
    if not np.array_equal(lengths, dataset.episode_lengths):
        raise UsageError("the labels of logs are known for all of their episodes only")


def changes_in(path: Path) -> Iterator[dict[str, Any]]:
    """Return the changes that a CSV or JSON file lists; see `mcaprl.label`."""
    try:
        text = read_file(path).decode("utf-8-sig")
        rows = (
            parse_json(text) if path.suffix == ".json" else list(csv.DictReader(io.StringIO(text)))
        )
    except (OSError, ValueError, csv.Error) as error:
        raise UsageError(f"{path} cannot be read: {error}") from error
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise UsageError(f"{path} must be a list of objects with {', '.join(_KEYS)}")
    for number, row in enumerate(rows, 1):
        where = f"{path}: row {number}"
        if unknown := [str(key) for key in row if key not in _KEYS]:
            raise UsageError(f"{where} has '{unknown[0]}', expected {', '.join(_KEYS)}")
        cells = {key: "" if row.get(key) is None else str(row[key]).strip() for key in _KEYS}
        if cells["success"].lower() not in _SUCCESS:
            raise UsageError(f"{where}: success is '{cells['success']}', expected true or false")
        try:
            bounds = [int(cells[key]) if cells[key] else None for key in ("start", "stop")]
            episode = int(cells["episode"])
        except ValueError as error:
            raise UsageError(f"{where}: episode, start and stop are whole numbers") from error
        yield {
            "episode": episode,
            "success": _SUCCESS[cells["success"].lower()],
            "note": cells["note"] or None,
            "interval": cells["interval"] or None,
            "steps": tuple(bounds) if cells["interval"] else None,
        }


def _changed(
    labels: Labels,
    reader: Labeled,
    episode: int | None = None,
    success: bool | None = None,
    note: str | None = None,
    interval: str | None = None,
    steps: Span | None = None,
    time: Span | None = None,
    remove: bool = False,
) -> Labels:
    lengths = reader.lengths
    if episode is not None and not 0 <= episode < len(lengths):
        raise UsageError(f"episode is {episode}; {reader.path} has {len(lengths)} episodes")
    if remove:
        if (success, note, steps, time) != (None, None, None, None):
            raise UsageError("remove= takes only `episode=` and `interval=`")
        return labels.without(episode, interval)
    if episode is None:
        raise UsageError("a label needs `episode=`, its index in the log")
    if interval is None and (steps, time) != (None, None):
        raise UsageError("`steps=` and `time=` need the name of the interval: `interval=`")
    if any(text is not None and not 0 < len(text) <= _MAX_TEXT for text in (note, interval)):
        raise UsageError(f"a note or name has 1 to {_MAX_TEXT} characters")
    key, changed = str(episode), labels
    if success is not None:
        changed = replace(changed, success={**changed.success, key: success})
    if note is not None:
        changed = replace(changed, notes={**changed.notes, key: note})
    if interval is not None:
        start, stop = _steps_in(reader, episode, steps, time)
        added = {*changed.intervals, Interval(interval, episode, start, stop)}
        ordered = sorted(added, key=lambda one: (one.episode, one.start, one.stop, one.name))
        changed = replace(changed, intervals=ordered)
    return changed


def _steps_in(
    reader: Labeled, episode: int, steps: Span | None, time: Span | None
) -> tuple[int, int]:
    """Return the range of steps that a range of steps, or of seconds in the episode, selects."""
    if steps is not None and time is not None:
        raise UsageError("`steps=` and `time=` exclude each other")
    length = int(reader.lengths[episode])
    low, high = steps or time or (None, None)
    if time is not None:
        frame = int((reader.lengths[:episode] + 1).sum())
        times = reader.record_times()[frame : frame + length]
        seconds = (times - times[:1]) / _NS_PER_S
        low, high = (
            None if at is None else int(np.searchsorted(seconds, at)) for at in (low, high)
        )
    start, stop = int(low or 0), length if high is None else int(high)
    if not 0 <= start < stop <= length:
        raise UsageError(
            f"the interval {start}:{stop} is not within the {length} steps of episode {episode}"
        )
    return start, stop

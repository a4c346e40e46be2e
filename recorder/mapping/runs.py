"""Recordings and runs, within which values may be used together, and their episodes.

- A *recording* is a file, or the files that a `metadata.yaml` lists as the parts of a split bag.
- A *run* is the part of a recording between two resets of its clock, as in a simulation that
  restarts. Values, commands and transforms never pass from one run to another.

Within a run, `steps` decides where steps exist.

A clock is reset where the times of all streams go back at the same place of the recording. A stream
with few messages may have none around a reset; its messages belong to runs by their places. Smaller
steps back are jitter, and the messages are sorted by time. Single messages whose time is far from
those of the messages around them are outliers, and are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.mapping.align import NS_PER_S, time_order

_Times = NDArray[np.int64]

_PERIODS = 3
"""Number of typical intervals between messages by which a clock goes back at least in a reset."""
_OUTLIERS = 3
"""Largest number of successive messages that are outliers."""
_MANY = 10
"""A stream in which more than one of this number of messages goes back has no single clock."""
_SWITCHES = 8
"""Largest number of switches between two blocks of messages that were written out of order."""
_JITTER = 20
"""A stream has jitter, not resets, if more than one of this number of messages goes back."""


class Recorded(Protocol):
    """Messages in the order of recording: those of a topic, or of a coordinate frame."""

    @property
    def times_ns(self) -> _Times:
        """(M,) times of the messages."""

    @property
    def places(self) -> NDArray[np.int64]:
        """(M, 2) places of the messages; see `Bag.places`."""


class Messages(NamedTuple):
    """Messages of a stream in one run, in the order of time.

    Attributes:
        times_ns: (M,) times, not descending.
        rows: (M,) positions of the messages in the stream.
    """

    times_ns: _Times
    rows: NDArray[np.int64]


class Run(NamedTuple):
    """Messages of a recording between two resets of its clock.

    Attributes:
        recording: Index of the recording.
        files: Index of the recording's first file, and of the file after its last one.
        streams: Messages by the name of the stream; a stream without messages is empty.
    """

    recording: int
    files: tuple[int, int]
    streams: dict[str, Messages]


class Runs(NamedTuple):
    """Runs of a bag, in the order of recording.

    Attributes:
        runs: The runs.
        outliers: Number of messages by the name of their stream that were left out, because their
            times are far from those of the messages around them.
        mixed: Names of streams of which a part was recorded with a clock that went back, while
            those of the other streams did not; its messages were sorted by time.
    """

    runs: list[Run]
    outliers: dict[str, int]
    mixed: list[str]


def runs_of(
    streams: Mapping[str, Recorded],
    gap_s: float,
    paths: Sequence[Path],
    recordings: Sequence[int],
) -> Runs:
    """Divide the messages of all streams into runs.

    Args:
        streams: Messages by the name of the stream.
        gap_s: Largest jitter in seconds.
        paths: Files of the bag.
        recordings: Index of the recording of each file, not descending.
    """
    found = Runs([], {}, [])
    for number in sorted(set(recordings)):
        files = (recordings.index(number), len(recordings) - recordings[::-1].index(number))
        parts = {}
        for name, stream in streams.items():
            bounds = np.searchsorted(stream.places[:, 0], files)
            parts[name] = _Part.of(stream, slice(*bounds.tolist()), int(gap_s * NS_PER_S))
        cuts, mixed = _Resets(parts, int(gap_s * NS_PER_S), paths[files[0]]).find()
        found.mixed.extend(name for name in mixed if name not in found.mixed)
        for name, part in parts.items():
            if part.dropped:
                found.outliers[name] = found.outliers.get(name, 0) + part.dropped
        bounds_of = {name: [0, *cuts[name], len(part.rows)] for name, part in parts.items()}
        for k in range(len(next(iter(cuts.values()))) + 1):
            messages = {
                name: part.messages(*bounds_of[name][k : k + 2]) for name, part in parts.items()
            }
            found.runs.append(Run(number, files, messages))
    return found


class _Part:
    """Messages of one stream in one recording, in the order of recording, without outliers."""

    def __init__(self, times_ns: _Times, rows: _Times, places: NDArray[np.int64]) -> None:
        self.times_ns, self.rows, self.places = times_ns, rows, places
        self.dropped = 0

    @classmethod
    def of(cls, stream: Recorded, part: slice, gap_ns: int) -> _Part:
        rows = np.arange(part.start, part.stop)
        found = cls(stream.times_ns[part], rows, stream.places[part])
        outliers = _outliers(found.times_ns, gap_ns)
        if len(outliers) * _MANY <= len(rows):
            found.drop(outliers)
        return found

    def drop(self, rows: Iterable[int]) -> None:
        """Leave out messages."""
        keep = np.ones(len(self.rows), bool)
        keep[list(rows)] = False
        self.dropped += int((~keep).sum())
        self.times_ns, self.rows = self.times_ns[keep], self.rows[keep]
        self.places = self.places[keep]

    def messages(self, start: int, stop: int) -> Messages:
        """Return some messages in the order of time."""
        times_ns, rows = self.times_ns[start:stop], self.rows[start:stop]
        if (np.diff(times_ns) >= 0).all():
            return Messages(times_ns, rows)
        order = time_order(times_ns)
        return Messages(times_ns[order], rows[order])

    def at(self, place: NDArray[np.int64]) -> int:
        """Return the index of the first message at or after a place."""
        first, last = np.searchsorted(self.places[:, 0], [place[0], place[0] + 1]).tolist()
        return int(first + np.searchsorted(self.places[first:last, 1], place[1]))

    def elapsed_ns(self, first: int, stop: int) -> int:
        """Return the time that passes between two messages, without the steps back."""
        steps = np.diff(self.times_ns[first:stop])
        return int(steps[steps > 0].sum())


def _outliers(times_ns: _Times, gap_ns: int) -> set[int]:
    """Return the messages that are more than `gap_ns` from both messages around them.

    Up to `_OUTLIERS` successive messages may be outliers, if the messages around all of them are at
    most `gap_ns` apart.
    """
    found: set[int] = set()
    for row in (np.flatnonzero(np.diff(times_ns) < -gap_ns) + 1).tolist():
        for count in range(1, _OUTLIERS + 1):
            # The messages from `row` on are too early, or those before `row` are too late.
            for first in (row, row - count):
                if _is_away(times_ns, first, first + count, gap_ns):
                    found.update(range(first, first + count))
    return found


def _is_away(times_ns: _Times, first: int, stop: int, gap_ns: int) -> bool:
    """Return whether some messages, but not those around them, are far away in time."""
    if first < 1 or stop >= len(times_ns):
        return False
    low, high = sorted((int(times_ns[first - 1]), int(times_ns[stop])))
    away = times_ns[first:stop]
    is_far = (away < low - gap_ns).all() or (away > high + gap_ns).all()
    return bool(is_far) and high - low <= gap_ns


def _jumps(times_ns: _Times, gap_ns: int) -> list[int]:
    """Return the messages at which the clock may have been reset.

    The clock goes back there by more than `gap_ns`, or by several intervals between messages. In
    the second case, at least `_PERIODS` messages before and after it are not in the order of time.
    """
    steps = np.diff(times_ns)
    back = np.flatnonzero(steps < 0) + 1
    if not len(back):
        return []
    forward = steps[steps > 0]
    period_ns = float(np.median(forward)) if len(forward) else 0.0
    found = []
    for row in back.tolist():
        by_ns = times_ns[row - 1] - times_ns[row]
        before = times_ns[max(row - _PERIODS, 0) : row]
        after = times_ns[row : row + _PERIODS]
        is_run = len(before) == len(after) == _PERIODS and before.min() > after.max()
        if by_ns > gap_ns or (is_run and by_ns > _PERIODS * period_ns):
            found.append(row)
    if len(found) * _JITTER > len(times_ns):
        found = [row for row in found if times_ns[row - 1] - times_ns[row] > gap_ns]
    return found


class _Resets:
    """Search for the resets of a recording's clock."""

    def __init__(self, parts: dict[str, _Part], gap_ns: int, path: Path) -> None:
        self._parts, self._gap_ns, self._path = parts, gap_ns, path
        self._cuts: dict[str, list[int]] = {name: [] for name in parts}
        self._mixed: list[str] = []

    def find(self) -> tuple[dict[str, list[int]], list[str]]:
        """Return the first message of each run but the first by stream, and the mixed streams."""
        jumps = self._jumps()
        for name, rows in jumps.items():
            count = len(self._parts[name].rows)
            if len(rows) > _OUTLIERS and len(rows) * _MANY > count:
                raise UsageError(
                    f"{self._path}: the clock of {name} goes back {len(rows)} times in {count}"
                    " messages, as if publishers had different clocks: use another `time`"
                )
        while any(jumps.values()):
            first = min(
                (name for name, rows in jumps.items() if rows),
                key=lambda name: tuple(self._parts[name].places[jumps[name][0]].tolist()),
            )
            place = self._parts[first].places[jumps[first][0]]
            members = {
                name: rows[0]
                for name, rows in jumps.items()
                if rows and self._is_at(name, rows[0], place)
            }
            others = [name for name in self._parts if name not in members]
            other = next((o for o in others if self._goes_on(o, first, members[first])), None)
            if other is None:
                self._check_others(others, first, members[first], jumps)
                for name, part in self._parts.items():
                    self._cuts[name].append(members.get(name, part.at(place)))
            elif self._drop(members):
                jumps = self._jumps()
                continue
            else:
                for name, row in members.items():
                    self._sort(name, row, other)
            for name in members:
                jumps[name].pop(0)
        return self._cuts, self._mixed

    def _jumps(self) -> dict[str, list[int]]:
        """Return the candidates of each stream after the last reset."""
        return {
            name: [row for row in _jumps(part.times_ns, self._gap_ns) if row > self._start(name)]
            for name, part in self._parts.items()
        }

    def _start(self, name: str) -> int:
        """Return the first message of a stream after the last reset."""
        return self._cuts[name][-1] if self._cuts[name] else 0

    def _is_at(self, name: str, row: int, place: NDArray[np.int64]) -> bool:
        """Return whether the clock of a stream is reset at a place, up to late messages."""
        part = self._parts[name]
        late = part.at(place)
        by_ns = int(part.times_ns[row - 1] - part.times_ns[row])
        return late >= row or part.elapsed_ns(late, row) <= min(by_ns, self._gap_ns)

    def _goes_on(self, name: str, other: str, jump: int) -> bool:
        """Return whether the clock of a stream goes on where that of another stream goes back.

        A stream with few messages does not show whether its clock goes on: more time passes between
        its messages before and after the place, by the clock of the other stream.
        """
        part, back = self._parts[name], self._parts[other]
        after = part.at(back.places[jump])
        if after <= self._start(name) or after >= len(part.rows):
            return False
        if part.times_ns[after] < part.times_ns[after - 1]:
            return False
        first, stop = back.at(part.places[after - 1]), back.at(part.places[after])
        passed = back.elapsed_ns(max(first - 1, 0), jump) + back.elapsed_ns(jump, stop + 1)
        return passed <= self._gap_ns

    def _check_others(
        self, names: Sequence[str], first: str, jump: int, jumps: Mapping[str, Sequence[int]]
    ) -> None:
        """Check that a stream with messages on one side of a reset only belongs to this side."""
        back = self._parts[first]
        for name in names:
            part, start = self._parts[name], self._start(name)
            at = part.at(back.places[jump])
            if len(part.rows) - start <= _OUTLIERS or start < at < len(part.rows):
                continue
            is_apart = back.at(part.places[start]) >= len(back.rows)
            if is_apart or jumps[name]:
                raise UsageError(
                    f"{self._path}: the clocks of {first} and {name} go back at different places:"
                    " use another `time`, or split the bag there"
                )

    def _drop(self, members: Mapping[str, int]) -> bool:
        """Leave out a few messages at the begin or end of streams, if they cause the jumps."""
        is_done = False
        for name, row in members.items():
            part = self._parts[name]
            before, after = range(self._start(name), row), range(row, len(part.rows))
            few, many = sorted((before, after), key=len)
            if len(few) <= _OUTLIERS and len(many) > len(few):
                part.drop(few)
                is_done = True
        return is_done

    def _sort(self, name: str, row: int, other: str) -> None:
        """Note that messages are sorted by time, because the clock of another stream goes on."""
        part, start = self._parts[name], self._start(name)
        is_after = np.arange(start, len(part.rows)) >= row
        switches = np.count_nonzero(np.diff(is_after[time_order(part.times_ns[start:])]))
        if switches <= _SWITCHES:
            return
        if part.times_ns[row - 1] - part.times_ns[row] > self._gap_ns:
            at_s = part.times_ns[row - 1] / NS_PER_S
            raise UsageError(
                f"{self._path}: the clock of {name} goes back at {at_s:.3f} s, that of {other} does"
                " not: use another `time` for one of them, or split the bag there"
            )
        if name not in self._mixed:
            self._mixed.append(name)


Flags = NDArray[np.bool_]

GAP, NO_ACTION, TIME_LIMIT, RESTARTED = "gap", "no_action", "time_limit", "restarted"
END_OF_DATA = "end_of_data"


class Marks(NamedTuple):
    """Flags (N,) of the steps that determine the episodes.

    Attributes:
        usable: Whether all observations are present.
        acted: Whether there is an action.
        gap_before: Whether there is a gap between the step and the one before it.
        begin: Condition whose rising edge begins an episode; None if every step may begin one.
        terminated: Whether the step is a terminal state.
        truncated: Whether the step truncates an episode.
        gap_after: Whether there is a gap after the last step.
    """

    usable: Flags
    acted: Flags
    gap_before: Flags
    begin: Flags | None
    terminated: Flags
    truncated: Flags
    gap_after: bool = False


class Segment(NamedTuple):
    """Steps of one episode.

    Attributes:
        first: Step with the first observation.
        last: Step with the final observation.
        terminated: Whether the final observation is a terminal state.
        truncated: Whether the episode was truncated.
        reason: Reason of the end; empty if a condition of the mapping ended the episode.
    """

    first: int
    last: int
    terminated: bool
    truncated: bool
    reason: str

    @property
    def length(self) -> int:
        """Number of transitions."""
        return self.last - self.first


def segments(marks: Marks, max_steps: int | None) -> list[Segment]:
    """Divide steps into episodes.

    An episode begins at a usable step that has an action and is neither terminal nor truncating.
    If `begin` is given, this step must be a rising edge of it. The episode ends at whichever comes
    first: a terminal or truncating step, the last step before a gap or an unusable step, a step
    without an action, `max_steps` transitions, or the last step before the next rising edge of
    `begin`. The next episode begins after the final observation.
    """
    count = len(marks.usable)
    begins = marks.usable if marks.begin is None else marks.usable & _edges(marks.begin)
    # An episode ends at a step of `ends`, or one step before a step at which `cuts` is true.
    ends = np.flatnonzero(marks.terminated | marks.truncated | ~marks.acted)
    cuts = marks.gap_before | ~marks.usable
    if marks.begin is not None:
        cuts |= begins
    cut_at = np.append(np.flatnonzero(cuts), count)
    starts = np.flatnonzero(begins & marks.acted & ~marks.terminated & ~marks.truncated)
    found: list[Segment] = []
    at = 0
    while (k := int(np.searchsorted(starts, at))) < len(starts):
        first = int(starts[k])
        cut = int(cut_at[np.searchsorted(cut_at, first, side="right")])
        e = int(np.searchsorted(ends, first, side="right"))
        end = int(ends[e]) if e < len(ends) else count
        limit = first + max_steps if max_steps is not None else count
        last = min(cut - 1, end, limit)
        found.append(_segment(marks, first, last, cut, limit))
        at = last + 1
    return found


def _segment(marks: Marks, first: int, last: int, cut: int, limit: int) -> Segment:
    terminated, truncated = (bool(flags[last]) for flags in (marks.terminated, marks.truncated))
    if last > first and (terminated or truncated):
        return Segment(first, last, terminated, truncated, "")
    if last == limit:
        return Segment(first, last, False, True, TIME_LIMIT)
    if not marks.acted[last]:
        return Segment(first, last, False, True, NO_ACTION)
    if cut == len(marks.usable):
        reason = GAP if marks.gap_after else END_OF_DATA
        return Segment(first, last, False, True, reason)
    is_gap = marks.gap_before[cut] or not marks.usable[cut]
    return Segment(first, last, False, True, GAP if is_gap else RESTARTED)


def _edges(condition: Flags) -> Flags:
    """Return a mask of the steps at which a condition becomes true."""
    found: Flags = condition.copy()
    found[1:] &= ~condition[:-1]
    return found

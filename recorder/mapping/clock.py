"""Times of the steps of a run.

A *stretch* is a part of a run without a gap. Steps exist only within stretches: from the first
message on, up to the first step at or after the last message, which is the last step that has a new
message. No value is interpolated, or taken from a later message, across a gap.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.mapping.align import NS_PER_S, time_order
from mcaprl.recorder.mapping.runs import Messages, Recorded

_Times = NDArray[np.int64]

_SIDES: tuple[Literal["left", "right"], ...] = ("left", "right")
_STEPS_PER_MESSAGE, _FEW_STEPS = 1000, 10_000
"""Largest number of steps at a fixed rate for each message, and beside those."""


class Ticks(NamedTuple):
    """Times of the N steps of a run.

    Attributes:
        times_ns: (N,) times.
        gap_before: (N,) whether there is a gap between the step and the one before it.
        gap_after: Whether there is a gap after the last step.
    """

    times_ns: _Times
    gap_before: NDArray[np.bool_]
    gap_after: bool

    @classmethod
    def of(cls, times: Sequence[_Times], parts: Sequence[Stretch], gap_s: float) -> Ticks:
        """Return the steps of all stretches; `times` has those of each stretch."""
        times_ns = np.concatenate([np.empty(0, np.int64), *times])
        gap_before = np.diff(times_ns, prepend=times_ns[:1]) > gap_s * NS_PER_S
        starts = np.cumsum([0, *map(len, times)])[:-1]
        gap_before[starts[starts < len(times_ns)]] = True
        is_gap = bool(parts) and parts[-1].stop_ns - 1 - parts[-1].last_ns > gap_s * NS_PER_S
        return cls(times_ns, gap_before, is_gap)

    @property
    def ends_ns(self) -> _Times:
        """(N,) end of each step: the next step's time.

        The last step before a gap has the median duration.
        """
        durations, is_inner = np.diff(self.times_ns), ~self.gap_before[1:]
        typical = int(np.median(durations[is_inner])) if is_inner.any() else int(NS_PER_S)
        until = np.append(np.where(is_inner, durations, typical), typical)
        found: _Times = self.times_ns + until[: len(self.times_ns)]
        return found


class Stretch(NamedTuple):
    """Part of a run without a gap.

    Attributes:
        first_ns: Time of the first message, from which on there are steps.
        last_ns: Time of the last message. The last step is the first one at or after it, which is
            the last one that has a new message.
        stop_ns: Time of the next stretch, or of the end of the run, before which all steps are.
    """

    first_ns: int
    last_ns: int
    stop_ns: int


def stretches(
    required: Sequence[_Times], observed: Sequence[_Times], used: Sequence[_Times], gap_s: float
) -> list[Stretch]:
    """Return the stretches of a run.

    A gap is an interval longer than `gap_s` without a message of a required stream, also at the
    begin and the end of the run, or, if no stream is required, without any message.

    Args:
        required: (M,) times of each stream that a step needs, not descending.
        observed: (M,) times of each stream that is observed, not descending.
        used: (M,) times of all streams, not descending.
        gap_s: Longest interval that is not a gap.
    """
    used = [each for each in used if len(each)]
    if not used or not all(len(each) for each in required):
        return []
    first, stop = min(int(each[0]) for each in used), max(int(each[-1]) for each in used) + 1
    gaps: list[tuple[int, int]] = []
    for times_ns in required or [np.sort(np.concatenate(used))]:
        if times_ns[0] - first > gap_s * NS_PER_S:
            gaps.append((first - 1, int(times_ns[0])))
        after = np.flatnonzero(np.diff(times_ns) > gap_s * NS_PER_S)
        gaps += zip(times_ns[after].tolist(), times_ns[after + 1].tolist(), strict=True)
        if stop - times_ns[-1] > gap_s * NS_PER_S + 1:
            gaps.append((int(times_ns[-1]), stop))
    found, start = list[Stretch](), first
    for low, high in sorted(gaps):
        if start <= low:
            found.append(Stretch(start, low, high))
        elif found:
            found[-1] = found[-1]._replace(stop_ns=max(found[-1].stop_ns, high))
        start = max(start, high)
    if start < stop:
        last = max((int(each[-1]) for each in observed if len(each)), default=stop)
        found.append(Stretch(start, last if required else stop - 1, stop))
    return found


def distinct(streams: dict[str, Messages], clock: str, recorded: Mapping[str, Recorded]) -> None:
    """Make the times of a clock's messages distinct, in place.

    Of messages with equal times, as those of a simulation whose clock is slow, each one but the
    first gets a time that is one nanosecond later than that of the one before it. Messages of other
    streams with the same time get the time of the last clock message that was recorded before them.
    """
    ticks = streams[clock]
    is_same = np.diff(ticks.times_ns, prepend=ticks.times_ns[:1] - 1) == 0
    if not is_same.any():
        return
    count = np.arange(len(is_same))
    nth = count - np.maximum.accumulate(np.where(is_same, 0, count))
    tick_places = recorded[clock].places[ticks.rows]
    for name, messages in streams.items():
        if name == clock:
            times_ns = np.maximum.accumulate(ticks.times_ns + nth - count) + count
        else:
            places = np.concatenate([tick_places, recorded[name].places[messages.rows]])
            every_ns = np.concatenate([ticks.times_ns, messages.times_ns])
            order = np.lexsort((places[:, 1], places[:, 0], every_ns))
            passed = np.empty(len(order), np.int64)
            passed[order] = np.cumsum(order < len(is_same))
            low, high = (
                np.searchsorted(ticks.times_ns, messages.times_ns, side) for side in _SIDES
            )
            later = passed[len(is_same) :] - low - 1
            times_ns = messages.times_ns + np.where(high > low, np.maximum(later, 0), 0)
        by_time = time_order(times_ns)
        streams[name] = Messages(times_ns[by_time], messages.rows[by_time])


def ticks_of_topic(times_ns: _Times, parts: Sequence[Stretch], gap_s: float) -> Ticks:
    """Return one step for each message of a clock with the times (M,)."""
    found = []
    for part in parts:
        first, last, stop = np.searchsorted(times_ns, part)
        found.append(times_ns[first : min(last + 1, stop)])
    return Ticks.of(found, parts, gap_s)


def ticks_at_rate(rate_hz: float, parts: Sequence[Stretch], messages: int, gap_s: float) -> Ticks:
    """Return steps at a fixed rate, beginning at the first message of each stretch."""
    period_ns = NS_PER_S / rate_hz
    # If a duration is a whole number of periods, rounding must not add or remove a step.
    until = [math.ceil((last - first) / period_ns - 1e-6) for first, last, _ in parts]
    within = [math.floor((stop - 1 - first) / period_ns + 1e-6) for first, _, stop in parts]
    counts = [min(pair) + 1 for pair in zip(until, within, strict=True)]
    most = _STEPS_PER_MESSAGE * messages + _FEW_STEPS
    if sum(counts) > most:
        raise UsageError(
            f"{sum(counts)} steps are too many for {messages} messages: use a rate at which there"
            f" are at most {most}"
        )
    found = []
    for k, (part, count) in enumerate(zip(parts, counts, strict=True)):
        times_ns = part.first_ns + np.rint(np.arange(count) * period_ns).astype(np.int64)
        found.append(times_ns[times_ns < parts[k + 1].first_ns] if k + 1 < len(parts) else times_ns)
    return Ticks.of(found, parts, gap_s)

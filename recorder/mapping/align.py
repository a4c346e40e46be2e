"""Alignment of messages with the times of the steps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

NONE = -1
"""Value in `Matches.rows` of a step without a message."""
NS_PER_S = 1e9


class Matches(NamedTuple):
    """The messages that match N steps.

    Attributes:
        rows: (N,) index of the message in the sorted messages; `NONE` for a step without a message.
        age_s: (N,) time of the step minus time of the message, seconds; NaN for a step without a
            message.
    """

    rows: NDArray[np.int64]
    age_s: NDArray[np.float64]


def time_order(times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indexes that sort messages by time; equal times keep their order."""
    return np.argsort(times_ns, kind="stable")


def last(
    times_ns: NDArray[np.int64], steps_ns: NDArray[np.int64], tolerance_s: float | None
) -> Matches:
    """Match each step with the last message up to its time.

    Args:
        times_ns: (M,) times of the messages, not descending.
        steps_ns: (N,) times of the steps.
        tolerance_s: Maximum age of a matching message in seconds; None for no limit.
    """
    rows = np.searchsorted(times_ns, steps_ns, side="right") - 1
    return _within(times_ns, steps_ns, rows, tolerance_s)


def nearest(
    times_ns: NDArray[np.int64],
    steps_ns: NDArray[np.int64],
    tolerance_s: float | None,
    gap_s: float = math.inf,
) -> Matches:
    """Match each step with the message nearest in time.

    Of two equally near messages, the earlier one matches. A message that comes more than `gap_s`
    after the step never matches, because it belongs to the data after a gap.
    """
    if not len(times_ns):
        return _within(times_ns, steps_ns, np.full(len(steps_ns), NONE), tolerance_s)
    after = np.searchsorted(times_ns, steps_ns, side="right")
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(times_ns) - 1)
    wait_ns = times_ns[after] - steps_ns
    is_after = np.abs(wait_ns) < np.abs(steps_ns - times_ns[before])
    rows = np.where(is_after & (wait_ns <= gap_s * NS_PER_S), after, before)
    # All messages may come after the step, and more than `gap_s` after it.
    rows[times_ns[rows] - steps_ns > gap_s * NS_PER_S] = NONE
    return _within(times_ns, steps_ns, rows, tolerance_s)


def during(
    times_ns: NDArray[np.int64],
    steps_ns: NDArray[np.int64],
    ends_ns: NDArray[np.int64],
    tolerance_s: float | None,
) -> Matches:
    """Match each step with the last message before the end of the step.

    `ends_ns` contains the (N,) ends of the steps.
    """
    rows = np.searchsorted(times_ns, ends_ns, side="left") - 1
    return _within(times_ns, steps_ns, rows, tolerance_s)


def interpolated(
    times_ns: NDArray[np.int64],
    values: NDArray[np.float64],
    steps_ns: NDArray[np.int64],
    tolerance_s: float | None,
    gap_s: float = math.inf,
) -> tuple[NDArray[np.float64], Matches]:
    """Interpolate values (M,) or (M, K) linearly at the times of the steps.

    A step has no value before the first and after the last message, and between two messages that
    are more than `gap_s` apart.

    Returns:
        Values (N,) or (N, K), which are NaN where missing, and the matches. `rows` of the matches
        are the messages before the steps. `age_s` is the age of one of the two messages
        between which a value is interpolated: the message that is nearer in time.
    """
    low = np.searchsorted(times_ns, steps_ns, side="right") - 1
    exact = (low >= 0) & (times_ns[np.maximum(low, 0)] == steps_ns) if len(times_ns) else low >= 0
    high = np.where(exact, low, low + 1)
    has_both = (low >= 0) & (high < len(times_ns))
    low, high = np.where(has_both, low, 0), np.where(has_both, high, 0)
    found = np.full((len(steps_ns), *values.shape[1:]), np.nan)
    if len(times_ns):
        before_s, after_s = steps_ns - times_ns[low], times_ns[high] - steps_ns
        has_both &= times_ns[high] - times_ns[low] <= gap_s * NS_PER_S
        span = np.maximum(times_ns[high] - times_ns[low], 1)
        share = (before_s / span).reshape(-1, *[1] * (values.ndim - 1))
        found = values[low] + share * (values[high] - values[low])
        age_s = np.where(before_s <= after_s, before_s, -after_s) / NS_PER_S
        is_late = np.zeros(len(age_s), bool)
        if tolerance_s is not None:
            is_late = np.maximum(before_s, after_s) / NS_PER_S > tolerance_s
        has_both &= ~is_late
        found[~has_both] = np.nan
    else:
        age_s = np.full(len(steps_ns), np.nan)
    rows = np.where(has_both, low, NONE)
    return found, Matches(rows, np.where(has_both, age_s, np.nan))


def _within(
    times_ns: NDArray[np.int64],
    steps_ns: NDArray[np.int64],
    rows: NDArray[np.int64],
    tolerance_s: float | None,
) -> Matches:
    has_one = rows >= 0
    age_s = np.full(len(steps_ns), np.nan)
    if len(times_ns):
        age_s = np.where(has_one, (steps_ns - times_ns[np.maximum(rows, 0)]) / NS_PER_S, np.nan)
    if tolerance_s is not None:
        has_one = has_one & (np.abs(age_s) <= tolerance_s)
    return Matches(np.where(has_one, rows, NONE), np.where(has_one, age_s, np.nan))

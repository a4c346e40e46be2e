"""Alignment of messages with the times of the steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

NONE = -1
"""Position of the message of a step that has none."""
_NS_PER_S = 1e9


class Matches(NamedTuple):
    """The message of each step.

    Attributes:
        rows: (N,) position of the message; `NONE` where there is none.
        age_s: (N,) time from the message to the step, seconds; negative after the step, and NaN
            without a message.
    """

    rows: NDArray[np.int64]
    age_s: NDArray[np.float64]


def time_order(times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the positions of messages by time; equal times keep their order."""
    return np.argsort(times_ns, kind="stable")


def last(
    times_ns: NDArray[np.int64], steps_ns: NDArray[np.int64], tolerance_s: float | None
) -> Matches:
    """Return the last message up to each step's time.

    Args:
        times_ns: (M,) times of the messages, not descending.
        steps_ns: (N,) times of the steps.
        tolerance_s: Age beyond which a message does not count; None for any age.
    """
    rows = np.searchsorted(times_ns, steps_ns, side="right") - 1
    return _within(times_ns, steps_ns, rows, tolerance_s)


def nearest(
    times_ns: NDArray[np.int64], steps_ns: NDArray[np.int64], tolerance_s: float | None
) -> Matches:
    """Return the message nearest to each step's time; of two equally near ones, the earlier."""
    if not len(times_ns):
        return _within(times_ns, steps_ns, np.full(len(steps_ns), NONE), tolerance_s)
    after = np.searchsorted(times_ns, steps_ns, side="right")
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(times_ns) - 1)
    is_after = np.abs(times_ns[after] - steps_ns) < np.abs(steps_ns - times_ns[before])
    return _within(times_ns, steps_ns, np.where(is_after, after, before), tolerance_s)


def during(
    times_ns: NDArray[np.int64],
    steps_ns: NDArray[np.int64],
    ends_ns: NDArray[np.int64],
    tolerance_s: float | None,
) -> Matches:
    """Return the last message before each step's end, `ends_ns` (N,)."""
    rows = np.searchsorted(times_ns, ends_ns, side="left") - 1
    return _within(times_ns, steps_ns, rows, tolerance_s)


def interpolated(
    times_ns: NDArray[np.int64],
    values: NDArray[np.float64],
    steps_ns: NDArray[np.int64],
    tolerance_s: float | None,
) -> tuple[NDArray[np.float64], Matches]:
    """Interpolate values (M,) or (M, K) linearly at the times of the steps.

    A step before the first or after the last message has no value.

    Returns:
        Values (N,) or (N, K), NaN where missing; and the matches with the earlier messages, whose
        age is the time to the nearer one.
    """
    low = np.searchsorted(times_ns, steps_ns, side="right") - 1
    exact = (low >= 0) & (times_ns[np.maximum(low, 0)] == steps_ns) if len(times_ns) else low >= 0
    high = np.where(exact, low, low + 1)
    has_both = (low >= 0) & (high < len(times_ns))
    low, high = np.where(has_both, low, 0), np.where(has_both, high, 0)
    found = np.full((len(steps_ns), *values.shape[1:]), np.nan)
    if len(times_ns):
        before_s, after_s = steps_ns - times_ns[low], times_ns[high] - steps_ns
        span = np.maximum(times_ns[high] - times_ns[low], 1)
        share = (before_s / span).reshape(-1, *[1] * (values.ndim - 1))
        found = values[low] + share * (values[high] - values[low])
        age_s = np.where(before_s <= after_s, before_s, -after_s) / _NS_PER_S
        is_late = np.zeros(len(age_s), bool)
        if tolerance_s is not None:
            is_late = np.maximum(before_s, after_s) / _NS_PER_S > tolerance_s
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
        age_s = np.where(has_one, (steps_ns - times_ns[np.maximum(rows, 0)]) / _NS_PER_S, np.nan)
    if tolerance_s is not None:
        has_one = has_one & (np.abs(age_s) <= tolerance_s)
    return Matches(np.where(has_one, rows, NONE), np.where(has_one, age_s, np.nan))

"""Division of the steps of a bag into episodes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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

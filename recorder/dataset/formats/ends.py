"""Ends of episodes in flat arrays: the names that other tools use, and their meaning.

Each name in `MEANINGS` has one of these meanings, for N rows and E episodes:

    terminated   (N,) flags: the step led to a terminal state
    continues    (N,) flags that are 0 where the step led to a terminal state
    truncated    (N,) flags: the episode was cut off after the step
    done         (N,) flags: the episode ended after the step, or the step led to a terminal state
    last         (N,) flags: the step is the last one of its episode
    first        (N,) flags, or (E,) indexes: the step is the first one of its episode
    stops        (N,) flags as for `last`, or (E,) numbers of rows up to the end of each episode
    lengths      (E,) number of rows of each episode
    number       (N,) number or name of the episode of each row

Several sources must not contradict each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.dataset.values import flags
from mcaprl.texts import counted

Kind = Literal["terminated", "truncated"]
Flags = NDArray[np.bool_]

_NAMES = {
    "terminated": "terminals terminations terminated terminal is_terminal",
    "continues": "masks not_done not_dones nonterminals",
    "truncated": "timeouts truncations truncated truncateds timeout truncation is_truncated",
    "done": "dones done dones_float",
    "last": "episode_terminals episode_terminal is_last lasts episode_dones",
    "first": "is_first firsts episode_starts",
    "stops": "ends episode_ends traj_ends episode_stops",
    "lengths": "episode_lengths episode_lens traj_lengths traj_lens trajectory_lengths",
    "number": "episode_ids episode_id episode_index episode_indexes episode_indices episode_idx"
    " traj_ids traj_id traj_index trajectory_ids trajectory_id",
}
MEANINGS = {name: meaning for meaning, names in _NAMES.items() for name in names.split()}
"""Meaning of each array that says where episodes end, by its name."""
_RLDS = ("is_first", "is_last")


@dataclass(frozen=True)
class Ends:
    """Ends of episodes in N rows.

    Attributes:
        terminated: (N,) whether the step led to a terminal state.
        truncated: (N,) whether the episode was truncated after the step.
        last: (N,) whether the step is the last one of its episode, as far as the sources say.
        is_stated: Whether a source says how the rows are divided, even if there is one episode.
        has_truncations: Whether a source can mark the end of an episode that did not terminate.
        is_rlds: Whether the last row of each episode only contains its final observation.
        notes: Assumptions that the user has to know.
    """

    terminated: Flags
    truncated: Flags
    last: Flags
    is_stated: bool
    has_truncations: bool
    is_rlds: bool = False
    notes: list[str] = field(default_factory=list)


def ends_of(found: Mapping[str, Any], count: int, *, dones: Kind | None = None) -> Ends:
    """Combine all arrays that say where episodes end."""
    sources = _Sources(found, count)
    terminated, truncated, done = (
        sources.flags(meaning) for meaning in ("terminated", "truncated", "done")
    )
    for name, continues in sources.every("continues"):
        here = name, ~continues
        if terminated is not None:
            _check_equal(terminated, here)
        terminated = terminated or here
    last = _combined(list(sources.divisions()))
    is_stated = last is not None
    notes: list[str] = []
    if done is not None:
        terminated, last = _with_done(done, terminated, truncated, last, dones, notes)
    if terminated is None and last is None:
        raise LogError("nothing says where episodes end")
    none = np.zeros(count, np.bool_)
    is_terminal = none if terminated is None else terminated[1]
    is_cut = none if truncated is None else truncated[1]
    if last is not None:
        for name, ends in filter(None, (terminated, truncated)):
            _check_within((name, ends), last)
        others = last[1] & ~(is_terminal | is_cut)
        if terminated is None and others.any():
            is_terminal, is_cut = _unknown_kind(last[0], others, is_cut, dones, notes)
        elif truncated is None:
            is_cut = others
    return Ends(
        terminated=is_terminal,
        truncated=is_cut,
        last=is_terminal | is_cut if last is None else last[1] | is_terminal | is_cut,
        is_stated=is_stated and sources.is_complete,
        has_truncations=truncated is not None or last is not None,
        is_rlds="is_terminal" in found and any(name in found for name in _RLDS),
        notes=notes,
    )


Named = tuple[str, Flags]
"""Flags of N rows, and the name of the array that they come from."""


class _Sources:
    """Arrays that say where episodes end.

    Attributes:
        is_complete: Whether a source divides all rows, even if they are one episode.
    """

    def __init__(self, found: Mapping[str, Any], count: int) -> None:
        self._found = {name: found[name] for name in found if name in MEANINGS}
        self._count = count
        self.is_complete = False

    def every(self, meaning: str) -> Iterator[Named]:
        """Yield the flags of each array with a meaning."""
        for name, values in self._with(meaning):
            yield name, self._flags(name, values)

    def flags(self, meaning: str) -> Named | None:
        """Return the flags of the only array with a meaning; None if there is none."""
        every = list(self.every(meaning))
        if len(every) > 1:
            raise LogError(f"there are both {every[0][0]} and {every[1][0]}: remove one of them")
        return every[0] if every else None

    def divisions(self) -> Iterator[Named]:
        """Yield flags of the last rows of episodes for each array that divides the rows."""
        yield from self.every("last")
        for name, values in (*self._with("first"), *self._with("stops")):
            yield name, self._stops(name, values, is_first=MEANINGS[name] == "first")
        for name, values in self._with("lengths"):
            yield name, self._rows(name, np.cumsum(_indexes(name, values, 1)) - 1)
        for name, values in self._with("number"):
            yield name, self._numbers(name, np.asarray(values))

    def _with(self, meaning: str) -> list[tuple[str, Any]]:
        return [(name, self._found[name]) for name in self._found if MEANINGS[name] == meaning]

    def _flags(self, name: str, values: Any) -> Flags:
        found = flags(name, values)
        if found.shape != (self._count,):
            raise LogError(f"{name} has shape {found.shape}, expected {(self._count,)} flags")
        return found

    def _stops(self, name: str, values: Any, *, is_first: bool) -> Flags:
        """Read flags (N,), or increasing numbers of rows (E,); return flags of the last rows."""
        array = np.asarray(values)
        has_flags = array.shape == (self._count,) and bool(np.isin(array, (0, 1)).all())
        if has_flags or array.dtype.kind not in "iu":
            found = self._flags(name, array)
            if not is_first:
                return found
            self.is_complete |= bool(found[:1].all())
            return np.append(found[1:], True)
        rows = _indexes(name, array, 0 if is_first else 1)
        if is_first:
            # The end before the first episode is row -1.
            rows = np.append(rows, self._count)
            return self._rows(name, rows[1:] - 1, start=int(rows[0]))
        return self._rows(name, rows - 1)

    def _rows(self, name: str, rows: NDArray[np.int64], *, start: int = 0) -> Flags:
        """Return flags of these rows, which must increase up to the last row."""
        is_rising = len(rows) > 0 and rows[0] >= 0 and bool((np.diff(rows) > 0).all())
        if start or not is_rising or rows[-1] != self._count - 1:
            raise LogError(
                f"{name} does not divide the {counted(self._count, 'row')} into episodes: it has"
                " neither a flag for each row, nor numbers that fit"
            )
        self.is_complete = True
        found = np.zeros(self._count, np.bool_)
        found[rows] = True
        return found

    def _numbers(self, name: str, array: NDArray[Any]) -> Flags:
        if array.shape != (self._count,) or array.dtype.kind not in "iuUS":
            raise LogError(
                f"{name} has shape {array.shape} and dtype {array.dtype}, expected the number of"
                f" the episode of each of {counted(self._count, 'row')}"
            )
        last = np.append(array[1:] != array[:-1], True)
        firsts = np.append(0, np.flatnonzero(last)[:-1] + 1)
        _, kept = np.unique(array[firsts], return_index=True)
        again = np.setdiff1d(firsts, firsts[kept])
        if len(again):
            raise LogError(
                f"{name} of row {again[0]} is {array[again[0]].item()!r} again, after rows of other"
                " episodes: sort the rows by episode"
            )
        self.is_complete = True
        return last


def _indexes(name: str, values: Any, least: int) -> NDArray[np.int64]:
    """Return whole numbers (E,)."""
    array = np.asarray(values)
    is_list = array.ndim == 1 and array.dtype.kind in "iu"
    if not is_list or (array < least).any() or (array > np.iinfo(np.int64).max // 2).any():
        raise LogError(
            f"{name} has dtype {array.dtype} and shape {array.shape}, expected whole numbers of"
            f" rows from {least}"
        )
    # The sum of lengths must not wrap.
    return np.minimum(array.astype(np.int64), 1 << 40)


def _combined(divisions: list[Named]) -> Named | None:
    """Return the only division, or the first of several that agree.

    The last row may be unmarked by flags, because a file may end within an episode.
    """
    for other in divisions[1:]:
        _check_equal(divisions[0], other, is_division=True)
    if not divisions:
        return None
    last = np.logical_or.reduce([ends for _, ends in divisions])
    return divisions[0][0], last


def _with_done(
    done: Named,
    terminated: Named | None,
    truncated: Named | None,
    last: Named | None,
    dones: Kind | None,
    notes: list[str],
) -> tuple[Named | None, Named | None]:
    """Interpret flags that mark all ends, or only terminal steps.

    Returns:
        The terminal steps, and the last steps; None if they are unknown.
    """
    name, ends = done
    if last is not None:
        _check_within(done, last)
    if terminated is not None:
        is_same = bool((ends == terminated[1]).all())
        if not is_same:
            for other in filter(None, (terminated, truncated)):
                _check_within(other, done)
        return terminated, last if is_same or last is not None else done
    if truncated is not None:
        # Some tools mark all ends in `dones`; others only terminal steps.
        if not (ends & truncated[1]).any():
            return done, last
        _check_within(truncated, done)
        return (name, ends & ~truncated[1]), last or done
    if last is not None and bool((last[1] & ~ends)[:-1].any()):
        return done, last
    if dones == "truncated":
        return None, last or done
    if dones is None:
        notes.append(
            f"'{name}' may also mark truncated episodes, and no other array says which; it is read"
            " as termination (`dones='truncated'` reads it as truncation)"
        )
    return done, last or done


def _unknown_kind(
    name: str, others: Flags, is_cut: Flags, dones: Kind | None, notes: list[str]
) -> tuple[Flags, Flags]:
    """Return terminal and truncated steps if only the ends of episodes are known."""
    none = np.zeros(len(others), np.bool_)
    if dones is None:
        episodes = counted(int(others.sum()), "episode")
        notes.append(
            f"'{name}' ends {episodes}, and no array says whether they terminated; they are read as"
            " truncated (`dones='terminated'` reads them as terminated)"
        )
    return (others, is_cut) if dones == "terminated" else (none, is_cut | others)


def _check_equal(one: Named, other: Named, *, is_division: bool = False) -> None:
    differ = one[1] != other[1]
    if is_division:
        differ[-1:] = False
    if differ.any():
        row = int(differ.argmax())
        first, second = (one, other) if one[1][row] else (other, one)
        raise LogError(_contradiction(first[0], second[0], row))


def _check_within(inner: Named, outer: Named) -> None:
    """Check that each flag of `inner`, except that of the last row, is also one of `outer`."""
    wrong = inner[1] & ~outer[1]
    wrong[-1:] = False
    if wrong.any():
        raise LogError(_contradiction(inner[0], outer[0], int(wrong.argmax())))


def _contradiction(ends: str, goes_on: str, row: int) -> str:
    return (
        f"{ends} and {goes_on} contradict each other in row {row}: '{ends}' has an end there, and"
        f" '{goes_on}' has none; remove or correct one of them"
    )

"""Datasets from flat arrays of transitions with the names that other tools use.

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

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.limits import MAX_MEMBERS_SHOWN
from mcaprl.recorder.dataset.arrays import description_of, exactly, flags, last_steps, numbers
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of, masked
from mcaprl.recorder.format.behavior import FIELDS
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.texts import counted, printable

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


_SCALARS = ("rewards", *(field.plural for field in FIELDS))
COLUMNS = ("observations", "actions", "next_observations", *_SCALARS)
FINALS, TIMES, INFOS = "final_observations", "log_time_ns", "infos"
NAMES = frozenset((*COLUMNS, *MEANINGS, FINALS, TIMES))
"""Names of the arrays that are read."""
_REQUIRED = ("observations", "actions", "rewards")
_TERMINATED = "terminals or terminations or terminated (or another name of docs/formats.md)"


@dataclass(frozen=True)
class FlatOptions:
    """What the user says about flat arrays that do not say it.

    Attributes:
        one_episode: Whether all rows are one episode if nothing marks its end.
        dones: Kind of the ends whose kind is unknown.
    """

    one_episode: bool = False
    dones: Kind | None = None


def flat_dataset(
    found: Mapping[str, Any],
    where: object,
    infos: Mapping[str, NDArray[Any]] | None = None,
    *,
    options: FlatOptions | None = None,
    unread: Sequence[str] = (),
) -> Dataset:
    """Return a dataset of flat arrays.

    If there are neither next nor final observations, the observation of a terminal transition is
    repeated as its next observation. The last transition of any other episode is left out, because
    its next observation is unknown.
    """
    options = options or FlatOptions()
    says_ends = any(MEANINGS.get(name) not in (None, "truncated") for name in found)
    missing = [name for name in _REQUIRED if name not in found]
    missing += [] if says_ends else [_TERMINATED]
    if missing:
        has = ", ".join(sorted([*found, *unread])[:MAX_MEMBERS_SHOWN])
        raise LogError(f"{where} has no {', '.join(missing)}; it has {printable(has) or 'none'}")
    columns = {name: _one_column(name, values, where) for name, values in found.items()}
    for name in ("actions", *_SCALARS):
        if isinstance(columns.get(name), Mapping):
            raise LogError(f"{where}: {name} is a group; a log can store one array of {name}")
    if columns["rewards"].ndim != 1:
        shape = columns["rewards"].shape
        raise SpaceError(f"{where}: rewards has shape {shape}, expected one reward for each step")
    count, unread = len(columns["rewards"]), list(unread)
    for name in [name for name in columns if name in MEANINGS]:
        # Files also have groups with these names, or masks of actions.
        is_group = isinstance(columns[name], Mapping)
        if is_group or (name == "masks" and columns[name].shape != (count,)):
            del columns[name]
            unread.append(name)
    try:
        steps = _Steps(columns, ends_of(columns, count, dones=options.dones))
        steps.check_ends(options)
        counts = (count, steps.frame_count)
        rows = {name: values for name, values in (infos or {}).items() if _is_info(values, counts)}
        unread += [f"{INFOS}/{name}" for name in infos or {} if name not in rows]
        unread += steps.unread()
        episodes = list(steps.episodes(rows))
    except (LogError, SpaceError, UsageError) as error:
        raise type(error)(f"{where}: {error}") from error
    for note in (*steps.notes(), *_unread(unread)):
        warnings.warn(f"{where}: {note}", stacklevel=4)
    description = _described(columns, where)
    return dataset_of(episodes, description, where)


class _Steps:
    """Columns of N transitions, divided into E episodes.

    Attributes:
        frame_count: Number of observations, N + E; N if final observations are unknown.
    """

    def __init__(self, columns: Mapping[str, Any], ends: Ends) -> None:
        self._columns, self._ends = columns, ends
        self._count = len(columns["rewards"])
        self._next = columns.get("next_observations")
        self._finals = columns.get(FINALS) if self._next is None else None
        # With next or final observations, a row is a transition in every format.
        self._has_finals = self._next is not None or self._finals is not None
        self._is_rlds = ends.is_rlds and not self._has_finals
        self._check_lengths()
        self._last = ends.last.copy()
        self._breaks = np.zeros(self._count, np.bool_)
        if self._next is not None:
            self._next = _like(columns["observations"], self._next, "next_observations")
            here, there = _leaves(columns["observations"]), _leaves(self._next)
            self._breaks[last_steps(self._breaks, here, there)] = True
            self._last |= self._breaks
        self._last[-1:] = True
        stops = (np.flatnonzero(self._last) + 1).tolist()
        self._spans = list(zip([0, *stops[:-1]], stops, strict=True))
        if self._next is not None:
            self._finals = rows_of_tree(self._next, np.array(stops) - 1)
        elif self._finals is not None:
            some = rows_of_tree(columns["observations"], slice(len(stops)))
            self._finals = _like(some, self._finals, FINALS)
        self.frame_count = self._count + (len(stops) if self._has_finals else 0)
        self._times = self._times_ns(columns.get(TIMES))

    def unread(self) -> list[str]:
        """Return the names of the columns that are not used."""
        has_times, has_both = self._times is not None, self._next is not None
        return [
            name
            for name, is_used in ((TIMES, has_times), (FINALS, not has_both))
            if name in self._columns and not is_used
        ]

    def _times_ns(self, times: Any) -> NDArray[np.int64] | None:
        """Return the times of all observations; None if there is no whole number for each."""
        if not isinstance(times, np.ndarray) or times.dtype.kind not in "iu":
            return None
        if not self._has_finals or times.shape != (self.frame_count,):
            return None
        return exactly(TIMES, times, np.dtype(np.int64))

    def check_ends(self, options: FlatOptions) -> None:
        """Check that something says where episodes end, or that the user does."""
        is_marked = bool((self._ends.terminated | self._ends.truncated).any())
        if len(self._spans) > 1 and options.one_episode:
            raise UsageError(
                f"one_episode is set, but the arrays have {counted(len(self._spans), 'episode')}"
            )
        if len(self._spans) > 1 or is_marked or self._ends.is_stated or options.one_episode:
            return
        raise LogError(
            f"nothing says where the episodes of {counted(self._count, 'row')} end: no end flag is"
            " set; add the flags, or, if it is one episode, convert it with"
            " `one_episode=True`"
        )

    def episodes(self, infos: Mapping[str, NDArray[Any]]) -> Iterator[EpisodeArrays]:
        """Yield the episodes; see `flat_dataset`."""
        actions, rewards = self._columns["actions"], self._columns["rewards"]
        observations = self._columns["observations"]
        behavior = {f.plural: self._columns[f.plural] for f in FIELDS if f.plural in self._columns}
        for index, (start, stop) in enumerate(self._spans):
            last = stop - self._is_left_out(stop - 1)
            steps, frames = slice(start, last), np.arange(start, last + 1)
            if self._finals is None:
                rows = rows_of_tree(observations, np.minimum(frames, stop - 1))
            else:
                final = rows_of_tree(self._finals, slice(index, index + 1))
                rows = joined_trees([rows_of_tree(observations, slice(start, stop)), final])
            frames += index
            yield EpisodeArrays(
                observations=rows,
                actions=actions[steps],
                rewards=rewards[steps],
                terminated=bool(self._ends.terminated[stop - 1]),
                truncated=bool(self._ends.truncated[stop - 1]),
                times_ns=None if self._times is None else self._times[frames],
                **{name: values[steps] for name, values in behavior.items()},
                infos={
                    name: _info(
                        values[frames]
                        if len(values) > self._count
                        else values[start : min(last + 1, stop)],
                        len(frames),
                    )
                    for name, values in infos.items()
                },
                first_row=start,
            )

    def notes(self) -> Iterator[str]:
        """Yield what the user has to know."""
        yield from self._ends.notes
        lasts = np.array([stop - 1 for _, stop in self._spans])
        is_unclear = self._is_shifted(lasts) if self._next is not None else self._finals is None
        if not self._ends.has_truncations and is_unclear:
            yield (
                "there are no timeouts (or truncations): if a time limit ended an episode, nothing"
                " marks that end, and a transition leads from there into the next episode"
            )
        if self._next is not None:
            yield from self._wrong_next(lasts)
        if self._has_finals:
            return
        dropped = sum(self._is_left_out(row) for row in lasts.tolist())
        repeated = len(lasts) - dropped
        found = []
        if self._is_rlds:
            episodes = counted(dropped, "episode")
            found.append(f"the last row of {episodes} is the final observation, as RLDS stores it")
        elif dropped:
            episodes = counted(dropped, "episode")
            found.append(f"the last steps of {episodes} without a terminal step are left out")
        if repeated:
            episodes = counted(repeated, "terminated episode")
            text = f"the last observation of {episodes} is repeated as next observation"
            found.insert(0, text)
        yield f"there are no next_observations: {', and '.join(found)}"

    def _wrong_next(self, lasts: NDArray[np.int64]) -> Iterator[str]:
        """Yield a note if the next observations of truncated episodes are of the next episodes."""
        cut = lasts[:-1][~self._ends.terminated[lasts[:-1]]]
        if len(cut) and not self._breaks[cut].any():
            yield (
                f"next_observations are those of the following row, also at the ends of"
                f" {counted(len(cut), 'truncated episode')}: there, they may be of another episode"
            )

    def _is_left_out(self, row: int) -> bool:
        """Return whether the last row of an episode is not a transition."""
        return not self._has_finals and (self._is_rlds or not self._ends.terminated[row])

    def _is_shifted(self, lasts: NDArray[np.int64]) -> bool:
        """Return whether next observations are those of the following row, even at all ends."""
        inner = lasts[:-1]
        return len(inner) > 0 and not self._breaks[inner].any()

    def _check_lengths(self) -> None:
        """Check that each column has a row for each reward."""
        for name in COLUMNS:
            for path, array in named_leaves(name, self._columns.get(name)):
                if not array.ndim or len(array) != self._count:
                    rows = len(array) if array.ndim else 1
                    raise SpaceError(
                        f"{path} has shape {array.shape}: there are {rows} {path}, but"
                        f" {self._count} rewards"
                    )


def rows_of_tree(tree: Any, rows: Any) -> Any:
    """Index an array, or each array in nested dicts, with `rows`."""
    if isinstance(tree, Mapping):
        return {key: rows_of_tree(part, rows) for key, part in tree.items()}
    return tree[rows]


def joined_trees(trees: list[Any]) -> Any:
    """Concatenate arrays, or nested dicts of arrays."""
    if isinstance(trees[0], Mapping):
        return {key: joined_trees([tree[key] for tree in trees]) for key in trees[0]}
    return np.concatenate(trees)


def unread_note(names: Sequence[str]) -> str:
    """Return a sentence that names the arrays of a source that are not read."""
    shown = ", ".join(printable(name) for name in names[:MAX_MEMBERS_SHOWN])
    more = len(names) - MAX_MEMBERS_SHOWN
    return f"not read: {shown}{f' and {more} more' if more > 0 else ''}"


def _described(columns: Mapping[str, Any], where: object) -> LogMetadata:
    try:
        return description_of("", columns["observations"], columns["actions"], None, None)
    except SpaceError as error:
        raise SpaceError(f"{where}: {error}") from error


def _one_column(name: str, values: Any, where: object) -> Any:
    """Check that a column of `COLUMNS` is numeric; make flat arrays (N, 1) arrays (N,)."""
    try:
        if isinstance(values, Mapping):
            return {key: _one_column(f"{name}/{key}", values[key], where) for key in values}
        array = (
            numbers(name, values)
            if name.split("/")[0] in (*COLUMNS, FINALS)
            else np.asarray(values)
        )
    except SpaceError as error:
        raise SpaceError(f"{where}: {error}") from error
    is_flat = name in MEANINGS or name in _SCALARS
    return array[:, 0] if is_flat and array.ndim == 2 and array.shape[1] == 1 else array


def _like(tree: Any, other: Any, name: str) -> Any:
    """Return `other` with the keys and dtypes of `tree`."""
    if isinstance(tree, Mapping) and isinstance(other, Mapping) and tree.keys() == other.keys():
        return {key: _like(part, other[key], f"{name}/{key}") for key, part in tree.items()}
    if isinstance(tree, Mapping) or isinstance(other, Mapping) or tree.shape != other.shape:
        raise SpaceError(f"{name} does not have the keys and shapes of the observations")
    return other if other.dtype == tree.dtype else exactly(name, other, tree.dtype)


def named_leaves(name: str, tree: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the name and the values of each array in nested dicts."""
    if isinstance(tree, Mapping):
        for key, part in tree.items():
            yield from named_leaves(f"{name}/{key}", part)
    elif tree is not None:
        yield name, tree


def _leaves(tree: Any) -> list[NDArray[Any]]:
    """Return the arrays in nested dicts, in the order of their names."""
    return [array for _, array in sorted(named_leaves("", tree), key=lambda found: found[0])]


def _is_info(values: NDArray[Any], counts: Sequence[int]) -> bool:
    return values.ndim > 0 and len(values) in counts and values.dtype.kind in "biufU"


def _info(values: NDArray[Any], count: int) -> Any:
    """Append masked rows to an info, up to `count` rows."""
    is_missing = np.arange(count) >= len(values)
    return masked(np.resize(values, (count, *values.shape[1:])), is_missing)


def _unread(names: Sequence[str]) -> list[str]:
    return [unread_note(sorted(names))] if names else []

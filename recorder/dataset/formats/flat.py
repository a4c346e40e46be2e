"""Datasets from flat arrays of transitions with the names that other tools use."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.limits import MAX_MEMBERS_SHOWN
from mcaprl.recorder.dataset.arrays import description_of, last_steps
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.dataset.formats.ends import MEANINGS, Ends, Kind, ends_of
from mcaprl.recorder.dataset.formats.infos import masked
from mcaprl.recorder.dataset.values import exactly, numbers
from mcaprl.recorder.format.behavior import FIELDS
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.texts import counted, printable

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
    """Check that a column of `COLUMNS` is numeric; convert arrays (N, 1) to (N,) if they are flat.

    Raises:
        SpaceError: The column is not numeric.
    """
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

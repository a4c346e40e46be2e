"""Conversion of separate arrays for each episode, as in most formats, to a dataset.

In a row for which the environment returned no info, a float is stored as NaN, and a string as the
empty string. If integers or flags have such rows, all their values are stored as floats, with NaN
in these rows.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError
from mcaprl.limits import (
    ARRAY_COST_BYTES,
    MAX_TIME_NS,
    MAX_UNPACKED_RATIO,
    UNPACKED_ALLOWANCE_BYTES,
)
from mcaprl.recorder.dataset.arrays import (
    behavior_of,
    check_finite,
    check_inside,
    exactly,
    numbers,
    rewards_of,
    with_fresh_times,
)
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.packets import Packets
from mcaprl.recorder.dataset.transitions import Transitions, joined_infos
from mcaprl.recorder.format.behavior import BehaviorField, behavior_field
from mcaprl.recorder.format.messages import EpisodeSummary, add_up, summary_of
from mcaprl.recorder.format.metadata import NO_TIMES, LogMetadata
from mcaprl.recorder.format.spaces import Leaf, action_leaf, observation_leaves
from mcaprl.texts import printable, shortened, size

_MAX_SHOWN = 80


class Budget:
    """Bytes that the arrays of a file or folder may take in memory.

    Files can declare arrays of any size, and compression can make large arrays of few bytes.

    Attributes:
        where: Name of the source, for errors.
    """

    def __init__(self, where: object, stored_bytes: int) -> None:
        """Create a budget in proportion to the size of the source."""
        self.where, self._stored = where, stored_bytes
        self._left = UNPACKED_ALLOWANCE_BYTES + MAX_UNPACKED_RATIO * stored_bytes

    @classmethod
    def of_files(cls, where: object, files: Sequence[Path]) -> Budget:
        """Create a budget for files."""
        try:
            return cls(where, sum(file.stat().st_size for file in files))
        except OSError as error:
            raise LogError(f"{where} cannot be read: {error}") from error

    def take(self, name: str, shape: Sequence[int], item_bytes: int) -> None:
        """Subtract an array before it is read."""
        count = math.prod(shape)
        self._left -= count * item_bytes + ARRAY_COST_BYTES
        if self._left < 0:
            declared = shortened(str(tuple(shape)), _MAX_SHOWN)
            raise LogError(
                f"{self.where}: {printable(name)} has shape {declared}, which is too large for the"
                f" {size(self._stored)} that are stored: unpack the data, or divide it into several"
                " files"
            )


@dataclass(frozen=True)
class EpisodeArrays:
    """Arrays of one episode of T transitions.

    Attributes:
        observations: (T + 1, *shape), or nested dicts of such arrays: the last row is the final
            observation.
        actions: (T,) integers, or (T, *shape).
        rewards: (T,).
        terminated: Whether the last transition led to a terminal state.
        truncated: Whether the episode was truncated after the last transition.
        behavior_probs: (T,) probability of each action; None if unknown.
        behavior_log_probs: (T,) logarithms of probabilities or densities; None if unknown.
        times_ns: (T + 1,) time of each observation, nanoseconds since the Unix epoch; None if
            unknown.
        infos: Masked array of T + 1 rows for each info, by its dotted name.
        summary: Fields of `EpisodeSummary` that the format stores: seed, reason, policy, ...
        first_row: Row of the first transition in a table of all transitions, for errors; None if
            the format stores each episode separately.
    """

    observations: Any
    actions: NDArray[Any]
    rewards: NDArray[Any]
    terminated: bool
    truncated: bool
    behavior_probs: NDArray[Any] | None = None
    behavior_log_probs: NDArray[Any] | None = None
    times_ns: NDArray[np.int64] | None = None
    infos: Mapping[str, Any] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)
    first_row: int | None = None


def dataset_of(
    episodes: Sequence[EpisodeArrays],
    metadata: LogMetadata,
    where: object,
    *,
    has_rewards: bool = True,
    packets: Mapping[tuple[str, ...], Packets] = MappingProxyType({}),
) -> Dataset:
    """Return a dataset of these episodes.

    `packets` has the packets of all images of leaves that are the frames of a video, by their path.

    If the times of the episodes increase strictly from row to row, they become the log_times.
    Otherwise, the data has no times: the log_times start at 0 and increase by the step duration in
    the metadata.

    Rewards and actions must be finite, and discrete values in their space. A log may contain other
    values, which `lint` reports.
    """
    kept = [(index, episode) for index, episode in enumerate(episodes) if len(episode.rewards)]
    if not kept:
        raise LogError(f"{where} has no transitions")
    check_duration(metadata, sum(len(episode.rewards) + 1 for _, episode in kept), where)
    for index, episode in kept:
        place = _place(where, index, episode)
        _check_times_and_shapes(episode, place)
        _check_values(episode, metadata, place, has_rewards=has_rewards)
    return _joined([episode for _, episode in kept], metadata, where, packets)


def check_duration(metadata: LogMetadata, frames: int, where: object) -> None:
    """Check that log_times which increase by the step duration fit into 64 bits."""
    if not 0 < metadata.step_duration_ns * frames < MAX_TIME_NS:
        raise LogError(
            f"{where}: step_duration_ns is {shortened(str(metadata.step_duration_ns), 40)},"
            " expected a positive number of nanoseconds"
        )


def check_times(name: str, times_ns: NDArray[Any]) -> None:
    """Check that the log_times of an episode are whole numbers of nanoseconds, and do not fall."""
    if times_ns.dtype.kind not in "iu" or ((times_ns < 0) | (times_ns >= MAX_TIME_NS)).any():
        raise SpaceError(f"{name} are not times in nanoseconds")
    falls = np.diff(times_ns) < 0
    if falls.any():
        row = int(falls.argmax())
        before, after = times_ns[row].item(), times_ns[row + 1].item()
        raise SpaceError(f"{name} falls from {before} to {after} ns after observation {row}")


def _place(where: object, index: int, episode: EpisodeArrays) -> str:
    return f"{where}" if episode.first_row is not None else f"{where}: episode {index}"


def _check_times_and_shapes(episode: EpisodeArrays, place: str) -> None:
    count = len(episode.rewards)
    for name, column, rows in (
        ("rewards", episode.rewards, count),
        ("log_time_ns", episode.times_ns, count + 1),
        ("behavior_probs", episode.behavior_probs, count),
        ("behavior_log_probs", episode.behavior_log_probs, count),
    ):
        if column is not None and np.shape(column) != (rows,):
            raise SpaceError(f"{place}: {name} has shape {np.shape(column)}, expected {(rows,)}")
    if episode.times_ns is not None:
        check_times(f"{place}: log_time_ns", episode.times_ns)


def _check_values(
    episode: EpisodeArrays, metadata: LogMetadata, place: str, *, has_rewards: bool
) -> None:
    """Check values; see `dataset_of`."""
    first = episode.first_row or 0
    actions = numbers(f"{place}: actions", episode.actions)
    check_finite(f"{place}: actions", actions, first_row=first)
    check_inside(f"{place}: actions", actions, metadata.action_space, first_row=first)
    rewards = numbers(f"{place}: rewards", episode.rewards)
    if has_rewards:
        check_finite(f"{place}: rewards", rewards, first_row=first)
    _behavior(episode, behavior_field(metadata.action_space), f"{place}: ", first)
    for leaf in metadata.leaves:
        name = f"{place}: {leaf.name}"
        space = leaf.of(metadata.observation_space)
        check_inside(name, np.asarray(leaf.of(episode.observations)), space, first_row=first)


def _joined(
    kept: Sequence[EpisodeArrays],
    metadata: LogMetadata,
    where: object,
    packets: Mapping[tuple[str, ...], Packets],
) -> Dataset:
    """Return a dataset of episodes with valid values; see `dataset_of`."""
    leaves = observation_leaves(metadata.observation_space)
    action, kind = action_leaf(metadata.action_space), behavior_field(metadata.action_space)
    lengths = np.array([len(episode.rewards) for episode in kept])
    try:
        columns = Transitions(
            frames=tuple(
                np.concatenate(
                    [_rows(leaf, leaf.of(e.observations), len(e.rewards) + 1) for e in kept]
                )
                for leaf in leaves
            ),
            log_time_ns=_times(kept),
            actions=np.concatenate([_rows(action, e.actions, len(e.rewards)) for e in kept]),
            rewards=np.concatenate([rewards_of("rewards", e.rewards) for e in kept]),
            terminated=_last_rows(lengths, [e.terminated for e in kept]),
            truncated=_last_rows(lengths, [e.truncated for e in kept]),
            behavior=np.concatenate([_behavior(e, kind) for e in kept]),
            episodes=tuple(_summary(k, e) for k, e in enumerate(kept)),
            infos=joined_infos([(e.infos, len(e.rewards) + 1) for e in kept]),
            packets={
                k: packets[leaf.path] for k, leaf in enumerate(leaves) if leaf.path in packets
            },
        )
    except SpaceError as error:
        raise SpaceError(f"{where}: {error}") from error
    if (np.diff(columns.log_time_ns) <= 0).any():
        columns = with_fresh_times(columns, 0, metadata.step_duration_ns)
        metadata = replace(metadata, times=NO_TIMES)
    return Dataset(columns, metadata)


def episode_slices(dataset: Dataset) -> list[tuple[slice, slice]]:
    """Return two slices for each episode: its transitions, and its rows of `Dataset.frames`."""
    lasts = np.cumsum(dataset.episode_lengths).tolist()
    return [
        (slice(last - length, last), slice(last - length + k, last + k + 1))
        for k, (length, last) in enumerate(
            zip(dataset.episode_lengths.tolist(), lasts, strict=True)
        )
    ]


def _rows(leaf: Leaf, values: Any, count: int) -> NDArray[Any]:
    array = numbers(leaf.name, values)
    if array.shape != (count, *leaf.shape):
        raise SpaceError(f"{leaf.name} has shape {array.shape}, expected {(count, *leaf.shape)}")
    return exactly(leaf.name, array, leaf.dtype)


def _times(episodes: Sequence[EpisodeArrays]) -> NDArray[np.int64]:
    parts = [
        np.zeros(len(episode.rewards) + 1, np.int64)
        if episode.times_ns is None
        else episode.times_ns
        for episode in episodes
    ]
    return np.concatenate(parts)


def _last_rows(lengths: NDArray[np.int64], flags: Sequence[bool]) -> NDArray[np.bool_]:
    """Return a column (N,) with each flag in its episode's last row, and False in other rows."""
    column = np.zeros(int(lengths.sum()), bool)
    column[np.cumsum(lengths) - 1] = flags
    return column


def _behavior(
    episode: EpisodeArrays, kind: BehaviorField, place: str = "", first_row: int = 0
) -> NDArray[np.float32]:
    arrays = episode.behavior_probs, episode.behavior_log_probs
    found = behavior_of(kind, *arrays, place=place, first_row=first_row)
    return np.full(len(episode.rewards), np.nan, np.float32) if found is None else found


def _summary(index: int, episode: EpisodeArrays) -> EpisodeSummary:
    times = episode.times_ns
    known: dict[str, Any] = {
        "reason": "terminated" if episode.terminated else "truncated" if episode.truncated else ""
    }
    return summary_of(
        {
            **known,
            **episode.summary,
            "episode": index,
            "length": len(episode.rewards),
            "total_reward": add_up(np.asarray(episode.rewards, np.float64)),
            "terminated": episode.terminated,
            "truncated": episode.truncated,
            "start_time_ns": 0 if times is None else int(times[0]),
            "end_time_ns": 0 if times is None else int(times[-1]),
        }
    )


NO_NAME = r"[/\0\ud800-\udfff]"
"""Pattern of the characters that names in archives and HDF5 files do not have."""
# Floats cannot represent larger integers exactly.
_MAX_EXACT = 2**53


def stored_infos(infos: Mapping[str, Any]) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Return the values (F, *shape) to store by name, and a sentence for each info left out."""
    found, lost = {}, []
    for name, values in infos.items():
        stored = _stored(values)
        if isinstance(stored, str):
            lost.append(f"the info '{name}' is left out, because {stored}")
        else:
            found[name] = stored
    return found, lost


def missing_rows(values: Any) -> NDArray[np.bool_]:
    """Return flags (F,): whether the environment returned no info for the row."""
    mask = np.ma.getmaskarray(values)
    found = np.zeros(len(mask), bool)
    if mask.size:
        found[:] = mask.reshape(len(mask), -1).any(axis=1)
    return found


def masked(values: NDArray[Any], is_missing: NDArray[np.bool_]) -> np.ma.MaskedArray[Any, Any]:
    """Return an info (F, *shape) whose rows are masked where `is_missing` (F,) is set."""
    mask = np.broadcast_to(is_missing.reshape(-1, *[1] * (values.ndim - 1)), values.shape)
    return np.ma.MaskedArray(values, mask.copy())


def info_type(text: str) -> np.dtype[Any]:
    """Return the dtype with this name."""
    try:
        dtype = np.dtype(text)
    except TypeError as error:
        raise ValueError(f"unknown dtype {text!r}") from error
    if dtype.kind not in "biufU":
        raise ValueError(f"dtype {text!r}")
    return dtype


def nested_names(names: Iterable[str]) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """Split each dotted name into the names of nested groups and of an array.

    Returns:
        The parts of each name, and one sentence for each name that cannot be split.
    """
    found: dict[str, tuple[str, ...]] = {}
    lost = []
    every = set(names)
    for name in sorted(every):
        parts = tuple(name.split("."))
        is_group = any(other.startswith(f"{name}.") for other in every)
        if is_group or not all(parts) or re.search(NO_NAME, name):
            reason = "its name is not valid in HDF5"
            if is_group:
                reason = f"another name starts with '{name}.'"
            lost.append(f"the info '{name}' is left out, because {reason}")
        else:
            found[name] = parts
    return found, lost


def _stored(values: Any) -> NDArray[Any] | str:
    """Return the values to store, or the reason why they cannot be stored."""
    data, mask, is_missing = np.ma.getdata(values), np.ma.getmaskarray(values), missing_rows(values)
    if data.dtype.kind not in "biufU":
        return f"values of dtype {data.dtype} cannot be stored"
    if data.dtype.kind == "U":
        if any(re.search(r"[\0\ud800-\udfff]", text) for text in data[~is_missing].ravel()):
            return "a text is not UTF-8"
        return np.where(mask, "", data)
    if not is_missing.any():
        return data
    if data.dtype.kind == "f":
        return np.where(mask, np.nan, data).astype(data.dtype)
    if data.dtype.kind in "iu" and _is_large(data[~is_missing]):
        return "some rows are missing, and the integers are too large for floats"
    return np.where(mask, np.nan, data.astype(np.float64))


def _is_large(values: NDArray[Any]) -> bool:
    return bool(values.size) and max(int(values.max()), -int(values.min())) > _MAX_EXACT

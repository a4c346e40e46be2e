"""Conversion of separate arrays for each episode, as in most formats, to a dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError
from mcaprl.recorder.dataset.arrays import exactly, with_fresh_times
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.transitions import Transitions, joined_infos
from mcaprl.recorder.format.episode_summary import EpisodeSummary, add_up
from mcaprl.recorder.format.metadata import NO_TIMES, LogMetadata
from mcaprl.recorder.format.spaces import Leaf, action_leaf, observation_leaves


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
        times_ns: (T + 1,) time of each observation, nanoseconds since the Unix epoch; None if
            unknown.
        infos: Masked array of T + 1 rows for each info, by its dotted name.
        summary: Fields of `EpisodeSummary` that the format stores: seed, reason, policy, ...
    """

    observations: Any
    actions: NDArray[Any]
    rewards: NDArray[Any]
    terminated: bool
    truncated: bool
    behavior_probs: NDArray[Any] | None = None
    times_ns: NDArray[np.int64] | None = None
    infos: Mapping[str, Any] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)


def dataset_of(episodes: Sequence[EpisodeArrays], metadata: LogMetadata, where: object) -> Dataset:
    """Return a dataset of these episodes.

    If the times of the episodes increase strictly from row to row, they become the log_times.
    Otherwise, the data has no times: the log_times start at 0 and increase by the step duration in
    the metadata.

    Args:
        episodes: Episodes in order; episodes without a transition are left out.
        metadata: Spaces and description of the data.
        where: Name of the source, for errors.

    Raises:
        LogError: There is no transition.
        SpaceError: An array does not fit its space exactly.
    """
    kept = [episode for episode in episodes if len(episode.rewards)]
    if not kept:
        raise LogError(f"{where} has no transitions")
    leaves = observation_leaves(metadata.observation_space)
    action = action_leaf(metadata.action_space)
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
            rewards=np.concatenate([np.asarray(e.rewards, np.float64) for e in kept]),
            terminated=_last_rows(lengths, [e.terminated for e in kept]),
            truncated=_last_rows(lengths, [e.truncated for e in kept]),
            behavior_probs=np.concatenate([_probabilities(e) for e in kept]),
            episodes=tuple(_summary(k, e) for k, e in enumerate(kept)),
            infos=joined_infos([(e.infos, len(e.rewards) + 1) for e in kept]),
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
    array = np.asarray(values)
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


def _probabilities(episode: EpisodeArrays) -> NDArray[np.float32]:
    if episode.behavior_probs is None:
        return np.full(len(episode.rewards), np.nan, np.float32)
    return np.asarray(episode.behavior_probs, np.float32)


def _summary(index: int, episode: EpisodeArrays) -> EpisodeSummary:
    times = episode.times_ns
    known: dict[str, Any] = {
        "reason": "terminated" if episode.terminated else "truncated" if episode.truncated else ""
    }
    known |= dict(episode.summary)
    return EpisodeSummary(
        episode=index,
        length=len(episode.rewards),
        total_reward=add_up(np.asarray(episode.rewards, np.float64)),
        terminated=episode.terminated,
        truncated=episode.truncated,
        start_time_ns=0 if times is None else int(times[0]),
        end_time_ns=0 if times is None else int(times[-1]),
        **known,
    )

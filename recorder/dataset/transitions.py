"""The columns of a dataset.

E episodes with N transitions in total have F = N + E frames: each episode's T + 1 observations, in
order. A transition's observation and next observation are consecutive frames, so no observation is
stored twice.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.actions import MASK_KEY, OBSERVATION_KEY, info_name
from mcaprl.errors import SpaceError, UnknownNameError
from mcaprl.recorder.dataset.images import Frames, joined, rows_of
from mcaprl.recorder.dataset.packets import Packets
from mcaprl.recorder.format.behavior import BehaviorField
from mcaprl.recorder.format.infos import Masked, is_exact, kind_of
from mcaprl.recorder.format.messages import INTERRUPTED, EpisodeSummary, add_up_each
from mcaprl.recorder.format.metadata import LogMetadata


@dataclass(frozen=True)
class Origin:
    """Files and mapping of a dataset.

    Attributes:
        sources: Files that the data was read from.
        logs: Absolute path and weight of each log if the dataset has all of their episodes
            unchanged, else empty. Other processes read the data again from these logs.
        mapping: Keys and values of the mapping that the data was read by, as JSON types.
        report: Report of the mapping on what was read and what was left out.
        grow: Function that returns the data with the episodes that have ended since; None if the
            logs are not followed.
        copy_topics: Function that copies topics of the bag, by names or patterns, to the writer of
            another file; None for other data. Its `where` is for errors.
        telemetry: For a bag, the (F,) log_times of its frames, and what viewers show of its
            quantities, (F,) numbers by name.
        keep: Names and patterns of the topics that are copied by default.
        is_shifted: Whether recordings of the bag overlapped, and have later times in the data.
        labels: For a bag with labels, a function that returns or refuses them, and the (E,) lengths
            of their episodes.
        selection: What `selected` took of other data: its conditions, the `content` of that data,
            and the number of the episode of that data of which each episode is a part.
        labeled: For a bag with labels, the episodes of each recording to which they belong.
    """

    sources: tuple[Path, ...] = ()
    logs: tuple[tuple[Path, float], ...] = ()
    mapping: Mapping[str, Any] | None = None
    report: Any = None
    grow: Callable[[], Any] | None = None
    copy_topics: Callable[..., None] | None = None
    telemetry: tuple[NDArray[np.int64], Mapping[str, NDArray[np.float32]]] | None = None
    keep: tuple[str, ...] = ()
    is_shifted: bool = False
    labels: tuple[Callable[[], Any], NDArray[np.int64]] | None = None
    labeled: tuple[Any, ...] = ()
    selection: Mapping[str, Any] | None = None

    @classmethod
    def common(cls, origins: Sequence[Origin]) -> Origin:
        """Return the origin of concatenated datasets."""
        mappings = [one.mapping for one in origins]
        return cls(
            tuple(path for one in origins for path in one.sources),
            tuple(log for one in origins for log in one.logs if all(o.logs for o in origins)),
            mappings[0] if all(mapping == mappings[0] for mapping in mappings) else None,
        )

    def changed(self) -> Origin:
        """Return the origin of a dataset with other episodes or values."""
        return dataclasses.replace(self, logs=(), grow=None, selection=None)


STEP_COLUMNS = ("actions", "rewards", "terminated", "truncated", "behavior")
"""The columns with one row per transition."""


@dataclass(frozen=True, eq=False, repr=False)
class Transitions:
    """Columns of whole episodes.

    Attributes:
        frames: (F, *shape) array of each leaf of the observation space.
        log_time_ns: (F,) int64, nanoseconds since the Unix epoch.
        actions: (N,) or (N, *shape).
        rewards: (N,) float64.
        terminated: (N,) bool.
        truncated: (N,) bool.
        behavior: (N,) float32, in the meaning of the `BehaviorField` of the action space; NaN where
            unknown.
        episodes: Summaries of the episodes, in order. Their lengths divide the rows into episodes.
        infos: (F, *shape) masked array of each info by its dotted name. Row k is the info that the
            environment returned with frame k; it is masked if the environment returned none.
        packets: Packets of the videos that leaves are the frames of, by the index of the leaf.
    """

    frames: tuple[Frames, ...]
    log_time_ns: NDArray[np.int64]
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    behavior: NDArray[np.float32]
    episodes: tuple[EpisodeSummary, ...]
    infos: Mapping[str, Masked] = field(default_factory=dict)
    packets: Mapping[int, Packets] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the columns' lengths agree."""
        steps = sum(episode.length for episode in self.episodes)
        for name in STEP_COLUMNS:
            assert len(getattr(self, name)) == steps, f"{name} does not have {steps} rows"
        for frames in (*self.frames, self.log_time_ns, *self.infos.values()):
            assert len(frames) == steps + len(self.episodes), "frames and episodes do not agree"

    @property
    def lengths(self) -> NDArray[np.int64]:
        """(E,) number of transitions of each episode."""
        return np.array([episode.length for episode in self.episodes], np.int64)

    @property
    def first_steps(self) -> NDArray[np.int64]:
        """(E,) index of each episode's first transition."""
        return np.cumsum(self.lengths) - self.lengths

    @property
    def first_frames(self) -> NDArray[np.int64]:
        """(E,) index of each episode's first frame."""
        return self.first_steps + np.arange(len(self.episodes))

    def frame_of_step(self) -> NDArray[np.int64]:
        """Return the index (N,) of each transition's observation in `frames`."""
        episode_of_step = np.repeat(np.arange(len(self.episodes)), self.lengths)
        return np.arange(len(self.rewards)) + episode_of_step

    def at(self, steps: Any) -> dict[str, NDArray[Any]]:
        """Return the given rows of each of the `STEP_COLUMNS`, by column name."""
        return {name: getattr(self, name)[steps] for name in STEP_COLUMNS}

    def take(self, chosen: Sequence[int]) -> Transitions:
        """Return a copy of the chosen episodes, in the order of `chosen`."""
        rows = np.array(chosen, np.int64)
        steps = ranges(self.first_steps[rows], self.lengths[rows])
        frames = ranges(self.first_frames[rows], self.lengths[rows] + 1)
        return Transitions(
            frames=tuple(rows_of(leaf, frames) for leaf in self.frames),
            log_time_ns=self.log_time_ns[frames],
            episodes=tuple(self.episodes[k] for k in chosen),
            infos={name: info[frames] for name, info in self.infos.items()},
            packets={leaf: one.rows(frames) for leaf, one in self.packets.items()},
            **self.at(steps),
        )

    def without(self, dropped: NDArray[np.bool_]) -> tuple[Transitions, NDArray[np.int64]]:
        """Return episodes without the dropped steps (N,), and the old index of each new episode.

        An episode is divided at dropped steps. The parts before them are truncated.
        """
        old = np.repeat(np.arange(len(self.episodes)), self.lengths)
        is_first, is_last = np.zeros(len(old), bool), np.zeros(len(old), bool)
        is_first[self.first_steps] = is_last[np.cumsum(self.lengths) - 1] = True
        starts = np.flatnonzero(~dropped & (is_first | np.roll(dropped, 1)))
        stops = np.flatnonzero(~dropped & (is_last | np.roll(dropped, -1))) + 1
        steps, places = ranges(starts, stops - starts), starts + old[starts]
        frames = ranges(places, stops - starts + 1)
        columns = self.at(steps)
        ends = np.cumsum(stops - starts) - 1
        columns["truncated"][ends] |= ~is_last[stops - 1]
        totals = add_up_each(self.rewards, starts.tolist(), stops.tolist())
        episodes = []
        for start, stop, place, total in zip(starts, stops, places, totals, strict=True):
            whole = self.episodes[old[start]]
            part = whole._replace(
                length=int(stop - start),
                total_reward=total,
                start_time_ns=int(self.log_time_ns[place]),
                end_time_ns=int(self.log_time_ns[place + stop - start]),
            )
            if not is_first[start]:
                part = part._replace(seed=None, options="")
            if not is_last[stop - 1]:
                part = part._replace(terminated=False, truncated=True, reason=INTERRUPTED)
            episodes.append(part)
        found = Transitions(
            frames=tuple(rows_of(leaf, frames) for leaf in self.frames),
            log_time_ns=self.log_time_ns[frames],
            episodes=tuple(episodes),
            infos={name: info[frames] for name, info in self.infos.items()},
            packets={leaf: one.rows(frames) for leaf, one in self.packets.items()},
            **columns,
        )
        return found, old[starts]

    @classmethod
    def concatenate(cls, parts: Sequence[Transitions]) -> Transitions:
        """Concatenate the columns of several datasets."""
        if len(parts) == 1:
            return parts[0]
        names = ("log_time_ns", *STEP_COLUMNS)
        leaves = range(len(parts[0].frames))
        return cls(
            infos=joined_infos([(part.infos, len(part.log_time_ns)) for part in parts]),
            packets={
                leaf: Packets.joined([part.packets[leaf] for part in parts])
                for leaf in leaves
                if all(leaf in part.packets for part in parts)
            },
            frames=tuple(joined([part.frames[leaf] for part in parts]) for leaf in leaves),
            episodes=tuple(episode for part in parts for episode in part.episodes),
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names},
        )


@dataclass(frozen=True)
class TransitionBatch:
    """A copy of B transitions of a dataset.

    Attributes:
        observations: (B, *shape), or nested dicts of such arrays.
        actions: (B,) int64, or (B, *shape).
        rewards: (B,) float64.
        terminated: (B,) bool.
        truncated: (B,) bool.
        next_observations: Next observations, in the form of `observations`.
        behavior: (B,) float32 probability of each action under the behavior policy, or natural
            logarithm of its density if actions are floats; NaN where unknown.
        behavior_field: Meaning of `behavior`.
    """

    observations: Any
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    next_observations: Any
    behavior: NDArray[np.float32]
    behavior_field: BehaviorField

    @property
    def behavior_probs(self) -> NDArray[np.float32]:
        """(B,) float32 probabilities; see `Dataset.behavior_probs`."""
        return self.behavior_field.probs(self.behavior)

    @property
    def behavior_log_probs(self) -> NDArray[np.float32]:
        """(B,) float32 logarithms; see `Dataset.behavior_log_probs`."""
        return self.behavior_field.log_probs(self.behavior)


def joined_infos(parts: Sequence[tuple[Mapping[str, Masked], int]]) -> dict[str, Masked]:
    """Concatenate infos; if a part lacks an info, the rows of this part are masked."""
    found: dict[str, Masked] = {}
    for name in dict.fromkeys(name for infos, _ in parts for name in infos):
        present = [infos[name] for infos, _ in parts if name in infos]
        shape, kinds = present[0].shape[1:], {kind_of(one.dtype) for one in present}
        if len(kinds) > 1 or any(one.shape[1:] != shape for one in present):
            raise SpaceError(f"the info '{name}' differs between the parts in shape or kind")
        dtype = np.result_type(*(one.dtype for one in present))
        # Conversion to the common dtype can only change numbers, not flags or text.
        for info in present if kinds == {"number"} else ():
            values = info.compressed()
            if not is_exact(values.astype(dtype), values):
                raise SpaceError(f"the info '{name}' has integers that {dtype} cannot hold")
        every = [
            infos[name].astype(dtype) if name in infos else _nothing(count, shape, dtype)
            for infos, count in parts
        ]
        found[name] = np.ma.concatenate(every)  # type: ignore[no-untyped-call]
    return found


def _nothing(count: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Masked:
    values = np.zeros((count, *shape), dtype)
    return np.ma.MaskedArray(values, np.ones(values.shape, bool))


def ranges(starts: NDArray[np.int64], lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the concatenated indexes of ranges that start at `starts` and have these lengths."""
    ends = np.cumsum(lengths)
    return np.repeat(starts - (ends - lengths), lengths) + np.arange(int(lengths.sum()))


@dataclass(frozen=True, eq=False, repr=False)
class Episode:
    """One episode of T transitions; its arrays are views into the Dataset.

    Attributes:
        index: Index in the Dataset, from 0.
        observations: (T, *shape), or nested dicts of such arrays.
        actions: (T,) int64, or (T, *shape).
        rewards: (T,) float64.
        terminated: (T,) bool; only the last element can be set.
        truncated: (T,) bool; only the last element can be set.
        next_observations: Next observations, in the form of `observations`.
        behavior: (T,) float32 probability of each action under the behavior policy, or natural
            logarithm of its density if actions are floats; NaN where unknown.
        behavior_field: Meaning of `behavior`.
        log_time_ns: (T + 1,) log_time of each observation, nanoseconds.
        summary: The log's summary of the episode: seed, end reason, policy, ...
        infos: (T + 1, *shape) masked array of each info by its dotted name; see `Dataset.infos`.
    """

    index: int
    observations: Any
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    next_observations: Any
    behavior: NDArray[np.float32]
    behavior_field: BehaviorField
    log_time_ns: NDArray[np.int64]
    summary: EpisodeSummary
    infos: Mapping[str, Masked] = field(default_factory=dict)

    @property
    def length(self) -> int:
        """Number of transitions."""
        return len(self.rewards)

    @property
    def behavior_probs(self) -> NDArray[np.float32]:
        """(T,) float32 probabilities; see `Dataset.behavior_probs`."""
        return self.behavior_field.probs(self.behavior)

    @property
    def behavior_log_probs(self) -> NDArray[np.float32]:
        """(T,) float32 logarithms; see `Dataset.behavior_log_probs`."""
        return self.behavior_field.log_probs(self.behavior)

    @property
    def total_reward(self) -> float:
        """Undiscounted return."""
        return self.summary.total_reward

    @property
    def reason(self) -> str:
        """Reason of the episode's end, as the environment reported it."""
        return self.summary.reason

    @property
    def seed(self) -> int | None:
        """Seed passed to `reset`; None if there was none."""
        return self.summary.seed

    @property
    def policy(self) -> str:
        """Name of the behavior policy."""
        return self.summary.policy

    @property
    def epsilon(self) -> float:
        """Probability of a random action; NaN if unknown."""
        return self.summary.epsilon

    def __len__(self) -> int:
        """Return the number of transitions."""
        return self.length

    def __repr__(self) -> str:
        """Return a summary with shapes instead of arrays."""
        return (
            f"Episode(index={self.index}, length={self.length},"
            f" total_reward={self.total_reward:.6g}, reason={self.reason!r}, seed={self.seed},"
            f" observations={shapes(self.observations)}, actions={shapes(self.actions)})"
        )


# Reprs and pickles name the class by this public import path.
Episode.__module__ = "mcaprl"


def shapes(array: Any) -> str:
    """Format the shape and dtype of an array, or of each array in nested dicts."""
    if isinstance(array, dict):
        return "{" + ", ".join(f"{key}: {shapes(part)}" for key, part in array.items()) + "}"
    return f"<{'x'.join(map(str, array.shape))} {array.dtype}>"


def with_mask(
    columns: Transitions, description: LogMetadata, source: str
) -> tuple[Transitions, LogMetadata]:
    """Add the flags of the allowed actions to the observations.

    Returns:
        The columns and metadata of Dict observations, whose part `observation` is the original one.
    """
    space = description.observation_space
    if isinstance(space, spaces.Dict) and MASK_KEY in space.spaces:
        raise SpaceError(f"the observations already have a part {MASK_KEY}: omit mask_from")
    name = info_name(source)
    flags = _part(columns, description, source) if name is None else _info(columns, name)
    if flags.ndim != 2 or not np.isin(flags, (0, 1)).all():
        raise SpaceError(f"{source} is no action mask: expected one flag (0 or 1) for each action")
    masked = spaces.Dict([(OBSERVATION_KEY, space), (MASK_KEY, spaces.MultiBinary(flags.shape[1]))])
    return (
        dataclasses.replace(columns, frames=(*columns.frames, flags.astype(np.int8))),
        dataclasses.replace(description, observation_space=masked, observation_names=()),
    )


def _part(columns: Transitions, description: LogMetadata, source: str) -> NDArray[Any]:
    names = {"/".join(leaf.path): k for k, leaf in enumerate(description.leaves) if leaf.path}
    if source not in names:
        raise UnknownNameError("part of the observation", source, names)
    return np.asarray(columns.frames[names[source]])


def _info(columns: Transitions, name: str) -> NDArray[Any]:
    """Return an info (F, A); all actions are allowed in terminal states without the info."""
    if name not in columns.infos:
        raise UnknownNameError("info", name, columns.infos)
    info = columns.infos[name]
    missing = np.ma.getmaskarray(info).reshape(len(info), -1).any(1)
    last = columns.first_frames + columns.lengths
    ends = columns.terminated[columns.first_steps + columns.lengths - 1]
    needed = np.ones(len(info), bool)
    needed[last[ends]] = False
    if (missing & needed).any():
        frame = int((missing & needed).argmax())
        raise SpaceError(
            f"the environment returned no info {name} with frame {frame}: it must return one with"
            " each observation, also in reset"
        )
    return np.where(missing.reshape(-1, *[1] * (info.ndim - 1)), 1, np.ma.getdata(info))

"""The columns of a dataset.

E episodes with N transitions in total have F = N + E frames: each episode's T + 1 observations, in
order. A transition's observation and next observation are consecutive frames, so no observation is
stored twice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import SpaceError
from mcaprl.recorder.dataset.mapped import Frames, joined, rows_of
from mcaprl.recorder.format.behavior import BehaviorField
from mcaprl.recorder.format.infos import Masked, is_exact, kind_of
from mcaprl.recorder.format.messages import EpisodeSummary

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
            **self.at(steps),
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Transitions]) -> Transitions:
        """Concatenate the columns of several datasets."""
        if len(parts) == 1:
            return parts[0]
        names = ("log_time_ns", *STEP_COLUMNS)
        leaves = range(len(parts[0].frames))
        return cls(
            infos=joined_infos([(part.infos, len(part.log_time_ns)) for part in parts]),
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

"""The columns of a log in memory: each observation once, the rest once per transition.

With E episodes of N transitions in all there are F = N + E frames: the observations of an episode
and its last one, episode after episode. The next observation of a transition is the frame behind
its own, so nothing is stored twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.dataset.mapped import Frames, joined, rows_of
from mcaprl.recorder.format.episode_summary import EpisodeSummary


@dataclass(frozen=True, eq=False, repr=False)
class Transitions:
    """Columns of whole episodes.

    Attributes:
        frames: for each leaf of the observation space, (F, *shape).
        log_time_ns: (F,) int64, nanoseconds since the Unix epoch.
        actions: (N,) or (N, *shape).
        rewards: (N,) float64.
        terminated: (N,) bool.
        truncated: (N,) bool.
        behavior_probs: (N,) float32; NaN where unknown.
        episodes: one for each, in order; their lengths say where they are.
    """

    frames: tuple[Frames, ...]
    log_time_ns: NDArray[np.int64]
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    behavior_probs: NDArray[np.float32]
    episodes: tuple[EpisodeSummary, ...]

    def __post_init__(self) -> None:
        """Make sure that the columns belong together."""
        steps = sum(episode.length for episode in self.episodes)
        for name in ("actions", "rewards", "terminated", "truncated", "behavior_probs"):
            assert len(getattr(self, name)) == steps, f"{name} has not {steps} rows"
        for frames in (*self.frames, self.log_time_ns):
            assert len(frames) == steps + len(self.episodes), "frames and episodes do not agree"

    @property
    def lengths(self) -> NDArray[np.int64]:
        """(E,) transitions of each episode."""
        return np.array([episode.length for episode in self.episodes], np.int64)

    @property
    def first_steps(self) -> NDArray[np.int64]:
        """(E,) the first transition of each episode."""
        return np.cumsum(self.lengths) - self.lengths

    @property
    def first_frames(self) -> NDArray[np.int64]:
        """(E,) the first frame of each episode."""
        return self.first_steps + np.arange(len(self.episodes))

    def frame_of_step(self) -> NDArray[np.int64]:
        """(N,) the frame of each transition's observation; the next one's is one more."""
        episode_of_step = np.repeat(np.arange(len(self.episodes)), self.lengths)
        return np.arange(len(self.rewards)) + episode_of_step

    def take(self, chosen: Sequence[int]) -> Transitions:
        """Copy some episodes, in the order given."""
        rows = np.array(chosen, np.int64)
        steps = spans(self.first_steps[rows], self.lengths[rows])
        frames = spans(self.first_frames[rows], self.lengths[rows] + 1)
        return Transitions(
            frames=tuple(rows_of(leaf, frames) for leaf in self.frames),
            log_time_ns=self.log_time_ns[frames],
            actions=self.actions[steps],
            rewards=self.rewards[steps],
            terminated=self.terminated[steps],
            truncated=self.truncated[steps],
            behavior_probs=self.behavior_probs[steps],
            episodes=tuple(self.episodes[k] for k in chosen),
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Transitions]) -> Transitions:
        """Several logs' columns, one behind the other."""
        if len(parts) == 1:
            return parts[0]
        names = ("log_time_ns", "actions", "rewards", "terminated", "truncated", "behavior_probs")
        leaves = range(len(parts[0].frames))
        return cls(
            frames=tuple(joined([part.frames[leaf] for part in parts]) for leaf in leaves),
            episodes=tuple(episode for part in parts for episode in part.episodes),
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names},
        )


def spans(starts: NDArray[np.int64], lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """The indexes of spans, one behind the other."""
    ends = np.cumsum(lengths)
    return np.repeat(starts - (ends - lengths), lengths) + np.arange(int(lengths.sum()))

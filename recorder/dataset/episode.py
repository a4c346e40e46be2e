"""One episode of a dataset, as views into its columns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format.episode_summary import EpisodeSummary


@dataclass(frozen=True, eq=False, repr=False)
class Episode:
    """One episode of T transitions. Arrays are views into its Dataset.

    Attributes:
        index: in its Dataset, from 0.
        observations: (T, *shape), or nested dicts of such arrays.
        actions: (T,) int64, or (T, *shape).
        rewards: (T,) float64.
        terminated: (T,) bool; only the last can be set.
        truncated: (T,) bool; only the last can be set.
        next_observations: like `observations`, one step on; the last is the episode's last.
        behavior_probs: (T,) float32; NaN where unknown.
        log_time_ns: (T + 1,) when each observation was made, nanoseconds.
        summary: what the log tells of the episode: seed, reason, policy, ...
    """

    index: int
    observations: Any
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    next_observations: Any
    behavior_probs: NDArray[np.float32]
    log_time_ns: NDArray[np.int64]
    summary: EpisodeSummary

    @property
    def length(self) -> int:
        """Transitions."""
        return len(self.rewards)

    @property
    def total_reward(self) -> float:
        """The undiscounted return."""
        return self.summary.total_reward

    @property
    def reason(self) -> str:
        """Why it ended, in the simulator's words."""
        return self.summary.reason

    @property
    def seed(self) -> int | None:
        """Given to reset(); None if none was."""
        return self.summary.seed

    @property
    def policy(self) -> str:
        """Who acted."""
        return self.summary.policy

    @property
    def epsilon(self) -> float:
        """Its exploration; NaN if unknown."""
        return self.summary.epsilon

    def __len__(self) -> int:
        """Transitions."""
        return self.length

    def __repr__(self) -> str:
        """Shapes, not arrays."""
        return (
            f"Episode(index={self.index}, length={self.length},"
            f" total_reward={self.total_reward:.6g}, reason={self.reason!r}, seed={self.seed},"
            f" observations={shapes(self.observations)}, actions={shapes(self.actions)})"
        )


def shapes(array: Any) -> str:
    """Shape and dtype of an array, or of each in nested dicts, for a repr."""
    if isinstance(array, dict):
        return "{" + ", ".join(f"{key}: {shapes(part)}" for key, part in array.items()) + "}"
    return f"<{'x'.join(map(str, array.shape))} {array.dtype}>"

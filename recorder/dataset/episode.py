"""One episode of a dataset, as views into the dataset's columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format.behavior import BehaviorField
from mcaprl.recorder.format.infos import Masked
from mcaprl.recorder.format.messages import EpisodeSummary


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

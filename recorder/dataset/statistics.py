"""Statistics of a dataset, and the calibration of its logged behavior probabilities.

A log contains only the probability p of the action taken. If each action is drawn with its
probability p, the expected value of 1 / p is the number of actions with p > 0. This also works for
a range of probabilities: add up 1 / p over the steps whose p is in the range, and divide by the
number of all steps. The result estimates how many actions per state have a probability in the
range. For example, an epsilon-greedy policy over nine actions has one action of high probability
and eight of low probability.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.actions import joint_actions
from mcaprl.recorder.dataset.images import Frames, MappedImages, blocks_of
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.behavior import PROBABILITY
from mcaprl.recorder.format.spaces import Leaf


@dataclass(frozen=True)
class Column:
    """Statistics of an observation leaf: per element of a vector, or over all pixels of images.

    Attributes:
        mean: Mean of the finite values.
        std: Standard deviation of the finite values.
        low: Smallest value, ignoring NaN.
        high: Largest value, ignoring NaN.
        not_finite: Number of values that are NaN or infinite.
    """

    mean: NDArray[np.float64]
    std: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    not_finite: int


@dataclass(frozen=True)
class Statistics:
    """Statistics of a dataset.

    Attributes:
        episodes: Number of episodes.
        steps: Number of transitions.
        returns: (E,) undiscounted return of each episode.
        lengths: (E,) number of transitions of each episode.
        ends: Number of episodes by end reason.
        duration_s: Total simulated time of the episodes, seconds.
        observations: Statistics of the observations by leaf name.
        action_counts: Number of steps by action, for integer actions; otherwise empty.
    """

    episodes: int
    steps: int
    returns: NDArray[np.float64]
    lengths: NDArray[np.int64]
    ends: Mapping[str, int]
    duration_s: float
    observations: Mapping[str, Column]
    action_counts: Mapping[int, int]

    @property
    def mean_return(self) -> float:
        """Mean return over episodes; NaN if there are no episodes."""
        return float(self.returns.mean()) if len(self.returns) else float("nan")


def describe_columns(columns: Transitions, leaves: Sequence[Leaf]) -> Statistics:
    """Compute the statistics of a dataset's columns."""
    episodes = columns.episodes
    ends = Counter(episode.reason or "unknown" for episode in episodes)
    counts: dict[int, int] = {}
    if columns.actions.ndim == 1 and columns.actions.dtype.kind in "iu":
        values, numbers = np.unique(columns.actions, return_counts=True)
        counts = dict(zip(values.tolist(), numbers.tolist(), strict=True))
    return Statistics(
        episodes=len(episodes),
        steps=len(columns.rewards),
        returns=np.array([episode.total_reward for episode in episodes]),
        lengths=columns.lengths,
        ends=dict(ends.most_common()),
        duration_s=sum(e.end_time_ns - e.start_time_ns for e in episodes) / 1e9,
        observations={
            leaf.name: _describe(leaf, frames)
            for leaf, frames in zip(leaves, columns.frames, strict=True)
        },
        action_counts=counts,
    )


def _describe(leaf: Leaf, frames: Frames) -> Column:
    if leaf.encoding is not None:
        return _describe_image(frames)
    counts, total, squares = (np.zeros(leaf.size) for _ in range(3))
    low, high = np.full((2, leaf.size), np.nan)
    # An element without finite values has the mean 0 / 0 = NaN.
    with np.errstate(all="ignore"):
        for values in _values(leaf, frames):
            finite = np.isfinite(values)
            counts += finite.sum(axis=0)
            total += np.where(finite, values, 0.0).sum(axis=0)
            low = np.fmin(low, np.fmin.reduce(values, axis=0, initial=np.nan))
            high = np.fmax(high, np.fmax.reduce(values, axis=0, initial=np.nan))
        mean = total / counts
        for values in _values(leaf, frames):
            finite = np.isfinite(values)
            squares += np.where(finite, (values - mean) ** 2, 0.0).sum(axis=0)
        std = np.sqrt(squares / counts)
    not_finite = leaf.size * len(frames) - int(counts.sum())
    return Column(mean=mean, std=std, low=low, high=high, not_finite=not_finite)


def _values(leaf: Leaf, frames: Frames) -> Iterator[NDArray[np.float64]]:
    """Yield the values (F, size): those on disk in blocks, those in memory at once."""
    for block in blocks_of(frames) if isinstance(frames, MappedImages) else [frames]:
        yield block.reshape(len(block), leaf.size).astype(np.float64)


def _describe_image(frames: Frames) -> Column:
    """Compute statistics from a histogram of the pixels, to avoid float copies of the images."""
    if not len(frames):
        unknown = np.full(1, np.nan)
        return Column(unknown, unknown, unknown, unknown, not_finite=0)
    counts = sum((np.bincount(frame.ravel(), minlength=256) for frame in frames), np.zeros(256))
    codes = np.arange(256.0)
    seen = codes[counts > 0]
    mean = float((codes * counts).sum() / counts.sum())
    variance = float(((codes - mean) ** 2 * counts).sum() / counts.sum())
    return Column(np.array([mean]), np.array([variance**0.5]), seen[:1], seen[-1:], not_finite=0)


EDGES: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 0.8, 1.0)
"""Edges of the probability ranges (low, high]."""
_STANDARD_ERRORS = 4.0
"""The mean of 1 / p may exceed the number of actions by this many standard errors."""
_MOST_ACTIONS = 1 << 62
_LEAST_CHANCE = 1e-6
"""Lower limit for the chance that a log contains an action of its smallest probability.

If the chance `smallest * available * steps` is below this limit, the probabilities are too small.
"""


@dataclass(frozen=True)
class ProbabilityRange:
    """The steps whose action probability is in a range.

    Attributes:
        probability: Mean action probability.
        steps: Number of steps.
        actions: Estimated number of actions with a probability in the range, averaged over states.
    """

    probability: float
    steps: int
    actions: float


@dataclass(frozen=True)
class Calibration:
    """Consistency of the logged probabilities with the action space.

    Attributes:
        available: Number of actions in the action space.
        actions: Mean of 1 / p, an estimate of the number of actions. It is smaller than `available`
            if some actions are never taken. It is significantly larger only if the logged
            probabilities are too small.
        error: Standard error of `actions`.
        smallest: Smallest logged probability.
        steps: Number of logged probabilities.
        ranges: Estimates for each range of probabilities.
    """

    available: int
    actions: float
    error: float
    smallest: float
    steps: int
    ranges: tuple[ProbabilityRange, ...]

    @property
    def possible(self) -> bool:
        """Whether the probabilities are consistent with the number of actions.

        With A actions, the chance that a step draws an action of probability p or less is at most
        A p. The smallest probability is checked against this bound. The mean of 1 / p is not
        sufficient for this check, because a few tiny probabilities also increase its standard
        error.
        """
        drawable = self.smallest * self.available * self.steps >= _LEAST_CHANCE
        return drawable and (self.actions <= self.available + _STANDARD_ERRORS * self.error + 1e-6)

    def __str__(self) -> str:
        """Return a one-line summary."""
        text = f"{_number(self.actions)} +- {_number(self.error)} actions; the action space has"
        text += f" {self.available}"
        if self.possible:
            return text
        return f"{text}, so the logged probabilities are too small (down to {self.smallest:.2g})"

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object that commands print."""
        found = {name: vars(self)[name] for name in ("available", "actions", "error", "smallest")}
        return {**found, "possible": self.possible, "ranges": [vars(one) for one in self.ranges]}


def calibration(
    behavior: NDArray[np.floating], action_space: spaces.Space[Any]
) -> Calibration | None:
    """Compare the behavior column (N,) of a dataset with the size of the action space.

    Returns:
        The result of the comparison. It is None if the space is not finite, if a probability is
        unknown or not in (0, 1], or if there are fewer than two steps.
    """
    joint = joint_actions(action_space)
    if joint is None or joint.count > _MOST_ACTIONS or len(behavior) < 2:
        return None
    if np.isnan(behavior).any() or PROBABILITY.is_impossible(behavior).any():
        return None
    probs = behavior.astype(np.float64)
    inverse = 1 / probs
    place = np.searchsorted(EDGES, probs)
    ranges = [
        ProbabilityRange(
            float(probs[place == k].mean()),
            int((place == k).sum()),
            float(inverse[place == k].sum() / len(probs)),
        )
        for k in np.flatnonzero(np.bincount(place))
    ]
    actions, smallest = float(inverse.mean()), float(probs.min())
    error = float(inverse.std(ddof=1) / math.sqrt(len(inverse)))
    return Calibration(joint.count, actions, error, smallest, len(probs), tuple(ranges))


def _number(value: float) -> str:
    return f"{value:.2f}" if value < 1e6 else f"{value:.2g}"

"""Statistics of a dataset."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.dataset.mapped import Frames, MappedImages, blocks_of
from mcaprl.recorder.dataset.transitions import Transitions
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

"""Statistics of several runs on several tasks, as in rliable.

    Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
    https://arxiv.org/abs/2108.13264

Scores have the shape (N, M): N runs, each with another seed, of M tasks. Intervals are percentiles
of stratified bootstrap samples: in each task, N runs are drawn with replacement.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims import improvement_probability, interquartile_mean

Floats = NDArray[np.float64]
RESAMPLES = 2_000


def stratified_samples(scores: Floats, random: np.random.Generator) -> Floats:
    """Draw (RESAMPLES, N, M) bootstrap samples of scores (N, M): the runs of each task apart."""
    rows = random.integers(len(scores), size=(RESAMPLES, *scores.shape))
    samples: Floats = np.take_along_axis(scores[None], rows, axis=1)
    return samples


def interval(
    scores: Floats, statistic: Callable[[Floats], Floats] = interquartile_mean, *, seed: int = 0
) -> tuple[float, float]:
    """Return the 95 % interval of a statistic of scores (..., N, M)."""
    found = statistic(stratified_samples(scores, np.random.default_rng(seed)))
    low, high = np.percentile(found, [2.5, 97.5])
    return float(low), float(high)


def profile(scores: Floats, thresholds: Floats) -> Floats:
    """Return the share of all runs (..., N, M) with a score above each of T thresholds, (..., T).

    See the performance profiles of section 4.2, equation 2, of the paper.
    """
    shares: Floats = (scores[..., None] > thresholds).mean(axis=(-3, -2))
    return shares


def improvement(first: Floats, second: Floats) -> float:
    """Return the mean over tasks of the probability that a run of `first` beats one of `second`.

    A tie counts as half a win.

    Args:
        first: (N, M) scores.
        second: (K, M) scores of the same tasks.
    """
    pairs = zip(first.T, second.T, strict=True)
    return float(np.mean([improvement_probability(one[None], other[None]) for one, other in pairs]))


def improvement_interval(first: Floats, second: Floats, *, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of `improvement`, with samples of both."""
    random = np.random.default_rng(seed)
    firsts, seconds = (stratified_samples(each, random) for each in (first, second))
    wins = firsts[:, :, None] > seconds[:, None]
    ties = firsts[:, :, None] == seconds[:, None]
    low, high = np.percentile((wins + 0.5 * ties).mean(axis=(1, 2, 3)), [2.5, 97.5])
    return float(low), float(high)

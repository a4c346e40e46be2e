"""Statistics of returns: robust means, comparisons of policies, and bootstrap intervals.

Returns have the shape (S, E): S training seeds, E episodes of each. Bootstrap samples draw seeds
with replacement, then episodes within each, so that an interval covers the variation between
training runs and between episodes.

    Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
    https://arxiv.org/abs/2108.13264
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RESAMPLES: Final = 2000
CONFIDENCE: Final = 0.95
_PAIRS_AT_ONCE = 1 << 22


def mean(returns: Floats) -> Floats:
    """Return the means (...) of returns (..., S, E)."""
    means: Floats = returns.mean(axis=(-2, -1))
    return means


def median(returns: Floats) -> Floats:
    """Return the medians (...) of returns (..., S, E)."""
    medians: Floats = np.median(returns, axis=(-2, -1))
    return medians


def interquartile_mean(returns: Floats) -> Floats:
    """Return the interquartile means (...) of returns (..., S, E).

    A quarter of the returns, rounded down, is dropped at each end. The result is more robust to
    outliers than the mean, and has less variance than the median.
    """
    ordered = np.sort(returns.reshape(*returns.shape[:-2], -1), axis=-1)
    count = ordered.shape[-1]
    cut = count // 4
    means: Floats = ordered[..., cut : count - cut].mean(axis=-1)
    return means


def bootstrap_interval(
    returns: Floats, statistic: Callable[[Floats], Floats] = mean, *, seed: int = 0
) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of a statistic.

    Args:
        returns: (S, E) returns.
        statistic: Function of (..., S, E), such as `mean`, `median` or `interquartile_mean`.
        seed: Seed of the resampling.
    """
    return _interval(statistic(_resampled(returns, np.random.default_rng(seed))))


def improvement_probability(first: Floats, second: Floats) -> float:
    """Return the probability that an episode of `first` has a higher return than one of `second`.

    Ties count half: this is the Mann-Whitney statistic divided by the number of pairs, 0.5 for
    equal policies.

    Args:
        first: (S, E) returns of the first policy.
        second: (S', E') returns of the second policy.
    """
    return float(_improvement(first.reshape(1, -1), second.reshape(1, -1))[0])


def improvement_interval(first: Floats, second: Floats, *, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of `improvement_probability`."""
    random = np.random.default_rng(seed)
    firsts, seconds = (
        _resampled(returns, random).reshape(RESAMPLES, -1) for returns in (first, second)
    )
    return _interval(_improvement(firsts, seconds))


def _improvement(firsts: Floats, seconds: Floats) -> Floats:
    """Return the probabilities (R,) of improvement for returns (R, N) and (R, M)."""
    pairs = firsts.shape[1] * seconds.shape[1]
    parts = []
    step = max(1, _PAIRS_AT_ONCE // pairs)
    for start in range(0, len(firsts), step):
        one, other = firsts[start : start + step, :, None], seconds[start : start + step, None, :]
        wins = (one > other).sum((1, 2)) + 0.5 * (one == other).sum((1, 2))
        parts.append(wins / pairs)
    return np.concatenate(parts)


def _resampled(returns: Floats, random: np.random.Generator) -> Floats:
    """Return (RESAMPLES, S, E) bootstrap samples of seeds, and of episodes within each seed."""
    seeds, episodes = returns.shape
    rows = random.integers(seeds, size=(RESAMPLES, seeds, 1))
    columns = random.integers(episodes, size=(RESAMPLES, seeds, episodes))
    return returns[rows, columns]


def _interval(values: Floats) -> tuple[float, float]:
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(values, [tail, 100 - tail])
    return float(low), float(high)

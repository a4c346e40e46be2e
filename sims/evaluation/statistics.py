"""Statistics of returns: robust means, comparisons of policies, and intervals.

Returns have the shape (S, E): S training seeds with E episodes each. Episode e starts in the same
state for all seeds.

    Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
    https://arxiv.org/abs/2108.13264

The interval of a mean is a bootstrap-t interval over episodes, combined with Student's t over the
means of the seeds:

    Efron and Tibshirani, "An introduction to the bootstrap", 1993, section 12.5
    Zou and Donner, "Construction of confidence limits about effect measures: a general approach",
    Statistics in Medicine 27, 2008

Of fewer than 10 values, many bootstrap samples contain almost only equal values. Their standard
errors are almost 0, so bootstrap-t intervals are long and vary much, even without bound:

    Owen, "Better bootstrap t confidence intervals for the mean", 2025,
    https://arxiv.org/abs/2508.10083

The interval is then that of Student's t, which is exact for normally distributed values.

Intervals of other statistics are percentiles of bootstrap samples. A sample draws seeds with
replacement, and then episodes within each drawn seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RESAMPLES: Final = 2000
CONFIDENCE: Final = 0.95
LEAST_RESAMPLED: Final = 10
"""Number of values below which the interval of a mean is that of Student's t."""
_PAIRS_AT_ONCE = _VALUES_AT_ONCE = 1 << 22
_STUDENT: Final = {
    1: 12.7062,
    2: 4.30265,
    3: 3.18245,
    4: 2.77645,
    5: 2.57058,
    6: 2.44691,
    7: 2.36462,
    8: 2.30600,
    10: 2.22814,
    14: 2.14479,
    20: 2.08596,
    40: 2.02108,
    math.inf: 1.95996,
}
"""The 97.5 % quantile of Student's t by the degrees of freedom."""


def median(returns: Floats) -> Floats:
    """Return the medians of returns (..., S, E) over seeds and episodes."""
    medians: Floats = np.median(returns, axis=(-2, -1))
    return medians


def interquartile_mean(returns: Floats) -> Floats:
    """Return the interquartile means of returns (..., S, E) over seeds and episodes.

    A quarter of the returns, rounded down, is dropped at each end. The result is more robust to
    outliers than the mean, and has less variance than the median.
    """
    ordered = np.sort(returns.reshape(*returns.shape[:-2], -1), axis=-1)
    count = ordered.shape[-1]
    cut = count // 4
    means: Floats = ordered[..., cut : count - cut].mean(axis=-1)
    return means


def mean_interval(returns: Floats, *, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of the mean.

    With several seeds, the result combines two intervals. The interval of Student's t for the means
    of the seeds covers the variation between seeds. The bootstrap-t interval for the means of the
    start states covers the variation between start states; it is Student's t, too, if there are
    fewer than `LEAST_RESAMPLED` start states. If the lower limits of these intervals
    are a and b below the mean, the lower limit of the result is sqrt(a^2 + b^2) below the mean. The
    upper limit is computed in the same way.

    Args:
        returns: (S, E) returns.
        seed: Seed of the resampling.
    """
    mean = float(returns.mean())
    down, up = 0.0, 0.0
    for means, interval in (
        (returns.mean(axis=1), _student_interval),
        (returns.mean(axis=0), partial(_bootstrap_t_interval, seed=seed)),
    ):
        if len(means) > 1:
            low, high = interval(means)
            down, up = math.hypot(down, mean - low), math.hypot(up, high - mean)
    return mean - down, mean + up


def bootstrap_interval(
    returns: Floats, statistic: Callable[[Floats], Floats], *, seed: int = 0
) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of a statistic.

    Args:
        returns: (S, E) returns.
        statistic: Function of returns (..., S, E), such as `median` or `interquartile_mean`.
        seed: Seed of the resampling.
    """
    return _interval(statistic(_resampled(returns, np.random.default_rng(seed))))


def improvement_probability(first: Floats, second: Floats) -> float:
    """Return the probability that a return from `first` is higher than a return from `second`.

    A tie counts as half a win. The result is the Mann-Whitney U statistic divided by the number of
    pairs; it is 0.5 for equal policies.

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
    """Return (R,) probabilities of improvement, one for each row of returns (R, N) and (R, M)."""
    pairs = firsts.shape[1] * seconds.shape[1]
    parts = []
    step = max(1, _PAIRS_AT_ONCE // pairs)
    for start in range(0, len(firsts), step):
        one, other = firsts[start : start + step, :, None], seconds[start : start + step, None, :]
        wins = (one > other).sum((1, 2)) + 0.5 * (one == other).sum((1, 2))
        parts.append(wins / pairs)
    return np.concatenate(parts)


def _student_interval(values: Floats) -> tuple[float, float]:
    """Return the 95 % interval of the mean of N > 1 normally distributed values."""
    half = student_quantile(len(values) - 1) * _standard_errors(values)
    return float(values.mean() - half), float(values.mean() + half)


def _bootstrap_t_interval(values: Floats, *, seed: int) -> tuple[float, float]:
    """Return the 95 % bootstrap-t interval of the mean of N > 1 values.

    If there are few values, or if many values are equal, the bootstrap samples vary little.
    Therefore, the interval is at least as wide on each side as the interval of Student's t. Samples
    whose standard error is almost 0 are excluded. With fewer than `LEAST_RESAMPLED` values, the
    interval is that of Student's t.
    """
    if len(values) < LEAST_RESAMPLED:
        return _student_interval(values)
    random = np.random.default_rng(seed)
    count, mean, error = len(values), values.mean(), _standard_errors(values)
    studentized = []
    step = max(1, _VALUES_AT_ONCE // count)
    for start in range(0, RESAMPLES, step):
        samples = values[random.integers(count, size=(min(step, RESAMPLES - start), count))]
        errors = _standard_errors(samples)
        known = errors > 1e-9 * error
        studentized.append((samples.mean(axis=-1)[known] - mean) / errors[known])
    quantile = student_quantile(count - 1)
    low, high = -quantile, quantile
    if len(found := np.concatenate(studentized)):
        low, high = min(low, _interval(found)[0]), max(high, _interval(found)[1])
    return float(mean - high * error), float(mean - low * error)


def _standard_errors(values: Floats) -> Floats:
    """Return the standard errors of the means of values (..., N) over the last axis."""
    errors: Floats = values.std(axis=-1, ddof=1) / math.sqrt(values.shape[-1])
    return errors


def student_quantile(degrees_of_freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t, within 0.1 %.

    Values between the rows of a table are interpolated linearly in 1 / degrees of freedom. SciPy,
    which has this function, is not a dependency of this package.
    """
    degrees = np.array(list(_STUDENT))
    quantiles = np.array(list(_STUDENT.values()))
    return float(np.interp(-1 / degrees_of_freedom, -1 / degrees, quantiles))


def _resampled(returns: Floats, random: np.random.Generator) -> Floats:
    """Draw (RESAMPLES, S, E) bootstrap samples: first the seeds, then episodes of each seed."""
    seeds, episodes = returns.shape
    rows = random.integers(seeds, size=(RESAMPLES, seeds, 1))
    columns = random.integers(episodes, size=(RESAMPLES, seeds, episodes))
    return returns[rows, columns]


def _interval(values: Floats) -> tuple[float, float]:
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(values, [tail, 100 - tail])
    return float(low), float(high)

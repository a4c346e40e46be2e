"""Ratios of means over episodes, self-normalized or not: values, standard errors and intervals.

Every off-policy estimate by importance sampling is sum_k w_k mean(a_k) / mean(b_k) over episodes:
b is 1 for the unbiased estimators and the mean weight for the weighted (self-normalized) ones.

Weights that are products over many steps are skewed. Most logs lack the rare episodes with large
weights, so the variance of the weights is too small, and percentile bootstrap intervals are too
narrow: with 50 episodes per log, 95 % intervals contain the true value in only 85 to 93 % of logs.
The bootstrap-t instead divides the error of each resampling by its standard error:

    Efron and Tibshirani, "An introduction to the bootstrap", 1993, section 12.5

The standard error is also estimated from the episodes. If a few episodes contribute most of it, it
has few degrees of freedom. The interval is therefore widened by the ratio of two quantiles: that of
Student's t and that of the normal distribution. The number of degrees of freedom follows from the
contributions of the episodes:

    Satterthwaite, "An approximate distribution of estimates of variance components", Biometrics
    Bulletin 2, 1946
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from mcaprl.sims.evaluation.statistics import LEAST_RESAMPLED

Floats = NDArray[np.float64]

CONFIDENCE: Final = 0.95
_RESAMPLES_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class RatioEstimate:
    """Estimate sum_k w_k (mean a_k / mean b_k), where the means are over E episodes.

    If there are several pairs of arrays a and b, their ratios are added for each k.

    Attributes:
        weights: Weights w (K,).
        pairs: Pairs of arrays a (E, K) and b (E, K). Where b is 0 in all episodes, the ratio is 0.
    """

    weights: Floats
    pairs: tuple[tuple[Floats, Floats], ...]

    @classmethod
    def mean(cls, values: Floats) -> RatioEstimate:
        """Create an estimate of the mean of values (E,)."""
        column = values[:, None]
        return cls(np.ones(1), ((column, np.ones_like(column)),))

    def values(self, counts: Floats) -> Floats:
        """Return the estimate (B,) in each of B resamplings.

        Args:
            counts: Number of times (B, E) that each resampling contains each episode.
        """
        return sum(divide(counts @ a, counts @ b) for a, b in self.pairs) @ self.weights

    def errors(self, counts: Floats) -> Floats:
        """Return the standard errors (B,) of `values(counts)`, by the delta method.

        An episode with the values a_k and b_k changes the estimate by
        sum_k w_k (a_k - q_k b_k) / (E * mean b_k). E is the number of episodes, and q_k is the
        ratio mean a_k / mean b_k. For w, a and b, see the attributes of the class.
        """
        parts = [
            self._errors(counts[start : start + _RESAMPLES_AT_ONCE])
            for start in range(0, len(counts), _RESAMPLES_AT_ONCE)
        ]
        return np.concatenate(parts)

    def interval(self, counts: Floats) -> tuple[float, float]:
        """Return the 95 % bootstrap-t interval, widened for few degrees of freedom.

        A resampling in which all episodes are equal has no standard error and is excluded. If most
        resamplings are excluded, the method returns the percentile interval. With fewer than
        `LEAST_RESAMPLED` episodes, it returns the interval of Student's t; see
        `mcaprl.sims.evaluation.statistics`.

        Args:
            counts: Number of times (B, E) that each resampling contains each episode.
        """
        once = np.ones((1, counts.shape[1]))
        value, error = float(self.values(once)[0]), float(self.errors(once)[0])
        if (episodes := counts.shape[1]) < LEAST_RESAMPLED:
            # The delta method divides by the number of episodes, not by the degrees of freedom.
            error *= np.sqrt(episodes / max(episodes - 1, 1))
            half = float(t.ppf(0.5 + CONFIDENCE / 2, self.degrees_of_freedom())) * error
            return value - half, value + half
        tails = np.array([50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE)])
        resampled, errors = self.values(counts), self.errors(counts)
        # Ignore standard errors that are only rounding errors.
        known = errors > 1e-9 * max(abs(value), error, 1e-300)
        if known.mean() < 0.5:
            low, high = np.percentile(resampled, tails)
        else:
            far, near = np.percentile((resampled[known] - value) / errors[known], tails)
            error *= student_factor(self.degrees_of_freedom())
            low, high = value - near * error, value - far * error
        return float(low), float(high)

    def degrees_of_freedom(self) -> float:
        """Return the degrees of freedom of the standard error, at least 1.

        The number is (sum_i m_i^2)^2 / sum_i m_i^4 - 1, where m_i is the change of the estimate due
        to episode i. If all changes are equal, the number is E - 1.
        """
        once = np.ones((1, len(self.pairs[0][0])))
        shares = self._changes(once)[:, 0] ** 2
        return max(1.0, float(shares.sum() ** 2 / max(np.sum(shares**2), 1e-300)) - 1.0)

    def _errors(self, counts: Floats) -> Floats:
        errors: Floats = np.sqrt((counts.T * self._changes(counts) ** 2).sum(0))
        return errors

    def _changes(self, counts: Floats) -> Floats:
        """Return the change (E, B) of the estimate due to each episode, in each resampling."""
        moved = np.zeros((counts.shape[1], len(counts)))
        for a, b in self.pairs:
            totals = counts @ b
            per_unit = divide(np.broadcast_to(self.weights, totals.shape), totals)
            moved += a @ per_unit.T - b @ (divide(counts @ a, totals) * per_unit).T
        return moved


def student_factor(degrees_of_freedom: float) -> float:
    """Return the ratio of the 97.5 % quantiles of Student's t and the normal distribution."""
    tail = 0.5 + CONFIDENCE / 2
    return float(t.ppf(tail, degrees_of_freedom) / norm.ppf(tail))


def divide(numerators: Floats, denominators: Floats) -> Floats:
    """Return the ratios, and 0 where the denominator is 0."""
    zeros = np.zeros(denominators.shape)
    return np.divide(numerators, denominators, out=zeros, where=denominators > 0)

"""Quotients of means over episodes, how far they can be off, and intervals that know that.

Every off-policy estimate by importance sampling is sum_k w_k mean(a_k) / mean(b_k) over episodes:
b is 1 for the unbiased ones and the weights' mean for the weighted ones.

Weights that are products over many steps are skewed: most logs miss the rare heavy episodes and,
for the same reason, look calm. Percentiles of a bootstrap follow the log in that, and its 95 %
intervals hold the truth in 85 to 93 of 100 logs of 50 episodes. What is resampled here instead is
the error in units of its own standard error, the bootstrap-t:

    Efron and Tibshirani, "An introduction to the bootstrap", 1993, section 12.5

That standard error is itself an estimate, and one of few degrees of freedom where few episodes
carry most of it. So the interval is wider by as much as Student's t of so many is than the normal
distribution; how many follows from how unequal the episodes' shares are:

    Satterthwaite, "An approximate distribution of estimates of variance components", Biometrics
    Bulletin 2, 1946
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

Floats = NDArray[np.float64]

CONFIDENCE: Final = 0.95
_RESAMPLES_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class Quotients:
    """sum_k w_k (mean a_k / mean b_k + ...) over E episodes.

    Attributes:
        weights: (K,) w.
        pairs: of a (E, K) and b (E, K); a quotient whose b is nought in all episodes counts nought.
    """

    weights: Floats
    pairs: tuple[tuple[Floats, Floats], ...]

    @classmethod
    def mean(cls, values: Floats) -> Quotients:
        """The mean of values (E,)."""
        column = values[:, None]
        return cls(np.ones(1), ((column, np.ones_like(column)),))

    def values(self, counts: Floats) -> Floats:
        """(B,) the estimate in each of B resamplings.

        Args:
            counts: (B, E) how often each episode stands in each of them.
        """
        return sum(quotient(counts @ a, counts @ b) for a, b in self.pairs) @ self.weights

    def errors(self, counts: Floats) -> Floats:
        """(B,) the standard error of each of `values(counts)`, by the delta method.

        An episode moves the estimate by sum_k w_k (a_k - q_k b_k) / mean b_k, over the number of
        episodes, where q is the quotient.
        """
        parts = [
            self._errors(counts[start : start + _RESAMPLES_AT_ONCE])
            for start in range(0, len(counts), _RESAMPLES_AT_ONCE)
        ]
        return np.concatenate(parts)

    def interval(self, counts: Floats) -> tuple[float, float]:
        """95 % bootstrap-t interval, wider where few episodes tell how wide it should be.

        Resamplings that are all alike have no standard error and are left out; where most are, the
        interval is that of percentiles.

        Args:
            counts: (B, E) of the resamplings.
        """
        once = np.ones((1, counts.shape[1]))
        value, error = float(self.values(once)[0]), float(self.errors(once)[0])
        tails = np.array([50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE)])
        resampled, errors = self.values(counts), self.errors(counts)
        # Rounding leaves a trace of error where there is none.
        known = errors > 1e-9 * max(abs(value), error, 1e-300)
        if known.mean() < 0.5:
            low, high = np.percentile(resampled, tails)
        else:
            far, near = np.percentile((resampled[known] - value) / errors[known], tails)
            error *= student_factor(self.degrees_of_freedom())
            low, high = value - near * error, value - far * error
        return float(low), float(high)

    def degrees_of_freedom(self) -> float:
        """Of the standard error of the estimate: (sum_i m_i^2)^2 / sum_i m_i^4 - 1, at least 1.

        m_i is how far episode i moves the estimate. Episodes that all move it alike give E - 1.
        """
        once = np.ones((1, len(self.pairs[0][0])))
        shares = self._moves(once)[:, 0] ** 2
        return max(1.0, float(shares.sum() ** 2 / max(np.sum(shares**2), 1e-300)) - 1.0)

    def _errors(self, counts: Floats) -> Floats:
        errors: Floats = np.sqrt((counts.T * self._moves(counts) ** 2).sum(0))
        return errors

    def _moves(self, counts: Floats) -> Floats:
        """(E, B) how far each episode moves the estimate, in each resampling."""
        moved = np.zeros((counts.shape[1], len(counts)))
        for a, b in self.pairs:
            totals = counts @ b
            per_unit = quotient(np.broadcast_to(self.weights, totals.shape), totals)
            moved += a @ per_unit.T - b @ (quotient(counts @ a, totals) * per_unit).T
        return moved


def student_factor(degrees_of_freedom: float) -> float:
    """How much further Student's t reaches for 95 % than the normal distribution does."""
    tail = 0.5 + CONFIDENCE / 2
    return float(t.ppf(tail, degrees_of_freedom) / norm.ppf(tail))


def quotient(numerators: Floats, denominators: Floats) -> Floats:
    """The quotient, and 0 where nothing has any weight."""
    return np.divide(
        numerators,
        denominators,
        out=np.zeros(denominators.shape),
        where=denominators > 0,
    )

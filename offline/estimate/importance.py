"""Off-policy estimates of a policy's value by importance sampling: pure functions.

Each function maps a table of episodes to a `RatioEstimate`, which has a value and an interval:

    TIS     trajectory importance sampling         sum_t gamma^t r_t, times rho of the whole episode
    WIS     weighted                               TIS with rho divided by the sum of all rho
    PDIS    per-decision importance sampling       sum_t gamma^t rho_t r_t
    WPDIS   weighted                               PDIS with rho_t divided by the sum of all rho_t
    DR      doubly robust                          PDIS of the residuals of a model Q
    WDR     weighted doubly robust                 WPDIS of these residuals

Here, rho_t is the product of pi(a|s) / mu(a|s) up to step t, pi is the evaluated policy, and mu is
the behavior policy. TIS, PDIS and DR are unbiased with a large variance; the weighted
(self-normalized) estimators have a small bias and a smaller variance.

    Precup, Sutton and Singh, "Eligibility traces for off-policy policy evaluation", ICML 2000
    Jiang and Li, "Doubly robust off-policy value evaluation", https://arxiv.org/abs/1511.03722
    Thomas and Brunskill, "Data-efficient off-policy policy evaluation for reinforcement learning",
    https://arxiv.org/abs/1604.00923

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

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from mcaprl.sims.evaluation.evaluate import LEAST_RESAMPLED

Floats = NDArray[np.float64]

CONFIDENCE: Final = 0.95
_RESAMPLES_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class RatioEstimate:
    """Estimate sum_k w_k (mean a_k / mean b_k), where the means are over E episodes."""

    weights: Floats  # Weights w (K,)
    # Pairs of arrays a (E, K) and b (E, K). Where b is 0 in all episodes, the ratio is 0.
    pairs: tuple[tuple[Floats, Floats], ...]

    @classmethod
    def mean(cls, values: Floats) -> RatioEstimate:
        """Create an estimate of the mean of values (E,)."""
        column = values[:, None]
        return cls(np.ones(1), ((column, np.ones_like(column)),))

    def values(self, counts: Floats) -> Floats:
        """Return the estimate (B,) in each of B resamplings of the episodes, counts (B, E)."""
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
        `mcaprl.sims.evaluation.evaluate`.
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


@dataclass(frozen=True, eq=False)
class EpisodeTable:
    """E episodes, padded to T steps, one more than the longest episode."""

    rewards: Floats  # (E, T) reward of step t; 0 past the end
    ratios: Floats  # (E, T) pi(a|s) / mu(a|s) of step t; 1 past the end
    q: Floats  # (E, T) Q(s, a) of the model for the action taken; 0 past the end
    # (E, T) V(s) = sum_a pi(a|s) Q(s, a) of the model; 0 past the end, except for the last next
    # state of an episode that is truncated and not terminated.
    v: Floats
    gamma: float  # Discount per step

    def __post_init__(self) -> None:
        """Check that all arrays have the same shape."""
        shapes = {array.shape for array in (self.rewards, self.ratios, self.q, self.v)}
        assert len(shapes) == 1, f"arrays of different shapes: {shapes}"

    @property
    def discounts(self) -> Floats:
        """Discounts gamma^t (T,)."""
        powers: Floats = self.gamma ** np.arange(self.rewards.shape[1], dtype=np.float64)
        return powers

    @property
    def rho(self) -> Floats:
        """Products (E, T) of the ratios up to and including step t."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.cumprod(self.ratios, axis=1, dtype=np.float64)

    @property
    def rho_before(self) -> Floats:
        """Products (E, T) of the ratios before step t."""
        return np.hstack([np.ones((len(self.ratios), 1)), self.rho[:, :-1]])


def trajectory(episodes: EpisodeTable) -> RatioEstimate:
    """Return TIS: the mean of rho_T sum_t gamma^t r_t."""
    return RatioEstimate.mean(episodes.rho[:, -1] * _returns(episodes))


def weighted_trajectory(episodes: EpisodeTable) -> RatioEstimate:
    """Return WIS: the mean of the returns, weighted by rho_T."""
    rho = episodes.rho[:, -1:]
    return RatioEstimate(np.ones(1), ((rho * _returns(episodes)[:, None], rho),))


def per_decision(episodes: EpisodeTable) -> RatioEstimate:
    """Return PDIS: the mean of sum_t gamma^t rho_t r_t."""
    return RatioEstimate.mean((episodes.discounts * (episodes.rho * episodes.rewards)).sum(1))


def weighted_per_decision(episodes: EpisodeTable) -> RatioEstimate:
    """Return WPDIS: sum_t gamma^t (mean rho_t r_t) / (mean rho_t), with means over episodes."""
    rho = episodes.rho
    return RatioEstimate(episodes.discounts, ((rho * episodes.rewards, rho),))


def doubly_robust(episodes: EpisodeTable) -> RatioEstimate:
    """Return DR: the mean of sum_t gamma^t (rho_{t-1} V(s_t) + rho_t (r_t - Q(s_t, a_t)))."""
    # Jiang and Li, equation 10. With a model of zeros, DR is PDIS.
    unexplained = episodes.rho * (episodes.rewards - episodes.q)
    per_step = unexplained + episodes.rho_before * episodes.v
    return RatioEstimate.mean((episodes.discounts * per_step).sum(1))


def weighted_doubly_robust(episodes: EpisodeTable) -> RatioEstimate:
    """Return WDR: DR with rho_t divided by its sum. Thomas and Brunskill, equation 10."""
    rho, before = episodes.rho, episodes.rho_before
    unexplained = rho * (episodes.rewards - episodes.q)
    return RatioEstimate(episodes.discounts, ((unexplained, rho), (before * episodes.v, before)))


ESTIMATORS: Final[dict[str, Callable[[EpisodeTable], RatioEstimate]]] = {
    "TIS": trajectory,
    "WIS": weighted_trajectory,
    "PDIS": per_decision,
    "WPDIS": weighted_per_decision,
    "DR": doubly_robust,
    "WDR": weighted_doubly_robust,
}
"""The estimators by their names in tables."""

WHOLE_EPISODE: Final = ("TIS", "WIS")
"""Estimators with one weight per episode; the others have one per step."""

UNBIASED: Final = ("TIS", "PDIS", "DR")  # Estimators that do not divide by the sum of the weights


def effective_sample_sizes(episodes: EpisodeTable) -> Floats:
    """Return Kish's effective sample size (T,) of each step: (sum rho_t)^2 / sum rho_t^2."""
    return _kish(episodes.rho)


def effective_sample_size(estimator: str, episodes: EpisodeTable) -> float:
    """Return the effective number of episodes of an estimate.

    For TIS and WIS, this is the size at the last step. For the others, it is the harmonic mean over
    steps, weighted with the discounts, because the variances of the steps add up. PDIS and DR are
    not normalized, so one huge weight, even in a late step, determines the estimate. Their result
    is therefore at most the effective sample size of the sums sum_t gamma^t rho_t of the episodes.
    """
    sizes = effective_sample_sizes(episodes)
    if estimator in WHOLE_EPISODE:
        return float(sizes[-1])
    # With gamma = 0, only the first step counts.
    counts = episodes.discounts > 0
    discounts, sizes = episodes.discounts[counts], sizes[counts]
    with np.errstate(divide="ignore"):
        size = float(discounts.sum() / (discounts @ (1 / sizes)))
    if estimator in UNBIASED:
        size = min(size, float(_kish(episodes.rho[:, counts] @ discounts)))
    return size


def usable_steps(episodes: EpisodeTable, lengths: NDArray[np.int64], least: float) -> int:
    """Return how many first steps all have an effective sample size of at least `least`."""
    # An ended episode keeps the weight of its last step, because its rewards of 0 count as well.
    few = effective_sample_sizes(episodes)[: int(lengths.max())] < least
    return int(few.argmax()) if few.any() else len(few)


def mean_weight(estimator: str, episodes: EpisodeTable) -> RatioEstimate | None:
    """Return the mean weight of an unbiased estimator, of expectation 1; None of the others."""
    # A mean far below 1: rare episodes with large weights are missing in the log.
    if estimator not in UNBIASED:
        return None
    if estimator in WHOLE_EPISODE:
        return RatioEstimate.mean(episodes.rho[:, -1])
    return RatioEstimate.mean(episodes.rho @ episodes.discounts / episodes.discounts.sum())


def _kish(weights: Floats) -> Floats:
    """Return (sum w)^2 / sum w^2 over the first axis, without overflow."""
    relative = divide(weights, np.broadcast_to(weights.max(0), weights.shape))
    return divide(relative.sum(0) ** 2, (relative**2).sum(0))


def _returns(episodes: EpisodeTable) -> Floats:
    """Return the discounted returns (E,)."""
    returns: Floats = (episodes.discounts * episodes.rewards).sum(1)
    return returns

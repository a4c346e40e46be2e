"""Scores of policies on the same episodes, with the statistics of returns; scripted pilots.

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

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mcaprl.base_policy import Actor, BasePolicy, as_policy
from mcaprl.errors import UnknownNameError
from mcaprl.sims import SIMS
from mcaprl.sims.evaluation.rollout import (
    EpisodeResult,
    EpsilonGreedy,
    batch_rollout,
    episode_seed,
    rollout,
)
from mcaprl.sims.spec import SimSpec

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
    """Return the interquartile means of returns (..., S, E) over seeds and episodes."""
    # A quarter of the returns, rounded down, is dropped at each end: more robust to outliers than
    # the mean, with less variance than the median.
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
    """Return the 95 % percentile bootstrap interval of a statistic of returns (S, E)."""
    return _interval(statistic(_resampled(returns, np.random.default_rng(seed))))


def improvement_probability(first: Floats, second: Floats) -> float:
    """Return the probability that a return from `first` is higher than one from `second`."""
    # A tie counts half: the Mann-Whitney U statistic divided by the number of pairs.
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
    """Return the 97.5 % quantile of Student's t, within 0.1 %; SciPy is no dependency."""
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


@dataclass(frozen=True)
class PolicyScore:
    """Evaluation result of one policy.

    Attributes:
        policy: Name of the policy.
        results: Episodes of each training seed; a scripted policy counts as one seed.
        mean_return: Mean over seeds and episodes.
        interval: 95 % interval of the mean, over seeds and episodes.
        normalized_score: Score on the scale random = 0, pilot = 1; None without a pilot.
        normalized_interval: Interval on the same scale.
        successes: End reasons that count as success; None if the environment defines none.
    """

    policy: str
    results: tuple[tuple[EpisodeResult, ...], ...] = field(repr=False)
    mean_return: float
    interval: tuple[float, float]
    normalized_score: float | None = None
    normalized_interval: tuple[float, float] | None = None
    successes: tuple[str, ...] | None = None

    @property
    def returns(self) -> NDArray[np.float64]:
        """Returns, (seeds, episodes)."""
        return np.array([[episode.total_reward for episode in seed] for seed in self.results])

    @property
    def has_interval(self) -> bool:
        """Whether the interval is worth showing; that of two seeds rests on one difference."""
        return len(self.results) != 2

    @property
    def ends(self) -> dict[str, int]:
        """Number of episodes by the reason why they ended."""
        return dict(Counter(e.reason for seed in self.results for e in seed).most_common())

    @property
    def command_change(self) -> float | None:
        """Mean change of a Box's commands a step, in their units: the smaller, the smoother."""
        changes = [episode.command_change for seed in self.results for episode in seed]
        return float(np.nanmean(changes)) if np.isfinite(changes).any() else None

    @property
    def success_rate(self) -> float | None:
        """Share of successful episodes; None if the environment does not define success."""
        if self.successes is None:
            return None
        return sum(self.ends.get(reason, 0) for reason in self.successes) / self.returns.size

    def to_json(self) -> dict[str, Any]:
        """Return the fields that `mcaprl evaluate --json` prints."""
        returns = self.returns
        middle = {"median": median, "interquartile_mean": interquartile_mean}
        return {
            "policy": self.policy,
            "episodes": int(returns.size),
            "mean_return": self.mean_return,
            "interval": list(self.interval),
            "normalized_score": self.normalized_score,
            "normalized_interval": self.normalized_interval and list(self.normalized_interval),
            **{name: float(statistic(returns)) for name, statistic in middle.items()},
            **{
                f"{name}_interval": list(bootstrap_interval(returns, statistic))
                for name, statistic in middle.items()
            },
            "seed_means": returns.mean(axis=1).tolist(),
            "success_rate": self.success_rate,
            "command_change": self.command_change,
            "mean_length": float(np.mean([e.length for seed in self.results for e in seed])),
            "ends": self.ends,
            "returns": returns.ravel().tolist(),
        }


def evaluate(
    env: gym.Env[Any, Any],
    policies: Sequence[Actor | None],
    *,
    name: str,
    episodes: int,
    seed: int,
    envs: gym.vector.VectorEnv[Any, Any, Any] | None = None,
    mask_from: str = "",
    on_policy: Callable[[str], None] = lambda name: None,
    on_episode: Callable[[EpisodeResult], None] | None = None,
) -> PolicyScore:
    """Evaluate greedy actions of a policy; all training seeds get the same episodes.

    In an environment without a time limit, an episode may never end: add one with
    `gymnasium.wrappers.TimeLimit`.

    Args:
        env: Environment.
        policies: Policies of the training seeds; [None] for random actions.
        name: Name for tables.
        episodes: Number of episodes of each policy; all policies have the same starts.
        seed: Seed of the episodes.
        envs: Vector environment of `episodes` copies to use instead of `env`; only for policies
            that act on batches.
        mask_from: Source of the mask of random actions; see `mcaprl.actions`.
        on_policy: Function called with each policy's name before its first episode.
        on_episode: Function called after each episode.
    """
    results = []
    for policy in policies:
        on_policy(name if policy is None or len(policies) == 1 else as_policy(policy).name)
        results.append(
            greedy_episodes(
                env,
                policy,
                episodes=episodes,
                seed=seed,
                envs=envs,
                mask_from=mask_from,
                on_episode=on_episode,
            )
        )
    return score_of(name, results, env)


def greedy_episodes(
    env: gym.Env[Any, Any],
    policy: Actor | None,
    *,
    episodes: int,
    seed: int,
    first_episode: int = 0,
    envs: gym.vector.VectorEnv[Any, Any, Any] | None = None,
    mask_from: str = "",
    on_episode: Callable[[EpisodeResult], None] | None = None,
) -> list[EpisodeResult]:
    """Run episodes of one policy greedily; arguments as for `evaluate` and `rollout`."""
    behavior = EpsilonGreedy(policy, 0.0, env.action_space, mask_from)
    if envs is not None and behavior.policy is not None and not behavior.mask_from:
        numbers = range(first_episode, first_episode + episodes)
        seeds = [episode_seed(seed, episode) for episode in numbers]
        return batch_rollout(envs, behavior.policy, seeds, on_episode)
    return rollout(
        env,
        behavior,
        seed=seed,
        episodes=episodes,
        first_episode=first_episode,
        on_episode=on_episode,
    )


def score_of(
    name: str, results: Sequence[Sequence[EpisodeResult]], env: gym.Env[Any, Any]
) -> PolicyScore:
    """Return the score of a policy, given the episodes of each of its training seeds."""
    returns = np.array([[episode.total_reward for episode in one] for one in results])
    return PolicyScore(
        name,
        tuple(map(tuple, results)),
        float(returns.mean()),
        mean_interval(returns),
        successes=getattr(env.unwrapped, "success_reasons", None),
    )


@dataclass(frozen=True)
class Scale:
    """Mean returns of random actions and of the sim's pilot on the same episodes."""

    random: float  # Mean return of random actions
    pilot: float  # Mean return of the pilot; NaN if the sim has no pilot

    @classmethod
    def of(cls, random: PolicyScore, pilot: PolicyScore | None) -> Scale:
        """Return the scale of two scores."""
        return cls(random.mean_return, math.nan if pilot is None else pilot.mean_return)

    def score(self, mean_return: float) -> float:
        """Return the score of a mean return: 0 random, 1 the pilot; NaN if they do not differ."""
        span = self.pilot - self.random
        return (mean_return - self.random) / span if span else math.nan


def normalize(score: PolicyScore, random: PolicyScore, pilot: PolicyScore | None) -> PolicyScore:
    """Add the normalized score (random = 0, pilot = 1) to a score, if there is a pilot."""
    scale = Scale.of(random, pilot)
    mean, *ends = map(scale.score, (score.mean_return, *score.interval))
    if math.isnan(mean):
        return score
    # If the pilot is worse than random actions, the scale is reversed.
    return replace(score, normalized_score=mean, normalized_interval=(min(ends), max(ends)))


@dataclass(frozen=True)
class Improvement:
    """Probability that one policy's episode has a higher return than another policy's episode.

    Attributes:
        better: Policy with the higher mean return.
        than: Policy with the lower mean return.
        probability: Probability of improvement; 0.5 for equal policies.
        interval: 95 % bootstrap interval of the probability.
    """

    better: str
    than: str
    probability: float
    interval: tuple[float, float]

    def to_json(self) -> dict[str, Any]:
        """Return the fields that `mcaprl evaluate --json` prints."""
        return {**vars(self), "interval": list(self.interval)}


def improvements(scores: Sequence[PolicyScore]) -> list[Improvement]:
    """Compare each policy with all policies that have a lower mean return."""
    ordered = sorted(scores, key=lambda score: -score.mean_return)
    return [
        Improvement(
            first.policy,
            second.policy,
            improvement_probability(first.returns, second.returns),
            improvement_interval(first.returns, second.returns),
        )
        for first, second in itertools.combinations(ordered, 2)
    ]


def make_pilot(env: gym.Env[Any, Any]) -> BasePolicy:
    """Create the pilot of the sim in `env`, which may be wrapped."""
    spec = _spec_of(env)
    if spec is None:
        raise UnknownNameError("environment with a pilot", _id_of(env), SIMS)
    return as_policy(spec.make_pilot(env.unwrapped))


def has_pilot(env: gym.Env[Any, Any]) -> bool:
    """Return whether the sim in `env`, which may be wrapped, has a pilot."""
    return _spec_of(env) is not None


def _spec_of(env: gym.Env[Any, Any]) -> SimSpec | None:
    """Return the sim in `env` if it has a pilot."""
    spec = SIMS.find(_id_of(env))
    return spec if spec is not None and spec.pilot is not None else None


def _id_of(env: gym.Env[Any, Any]) -> str:
    sim = env.unwrapped
    return sim.spec.id if sim.spec else type(sim).__name__

"""Scores of policies on the same episodes, with confidence intervals."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mcaprl.base_policy import Actor, as_policy
from mcaprl.sims.evaluation.rollout import (
    EpisodeResult,
    EpsilonGreedy,
    batch_rollout,
    episode_seed,
    rollout,
)
from mcaprl.sims.evaluation.statistics import (
    bootstrap_interval,
    improvement_interval,
    improvement_probability,
    interquartile_mean,
    mean_interval,
    median,
)


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
    def ends(self) -> dict[str, int]:
        """Number of episodes by the reason why they ended."""
        return dict(Counter(e.reason for seed in self.results for e in seed).most_common())

    @property
    def command_change(self) -> float | None:
        """Mean change of the commands a step, in their units; None if they are not those of a Box.

        The smaller it is, the smoother the policy drives.
        """
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
    """Mean returns of random actions and of the sim's pilot on the same episodes.

    Attributes:
        random: Mean return of random actions.
        pilot: Mean return of the pilot; NaN if the sim has no pilot.
    """

    random: float
    pilot: float

    @classmethod
    def of(cls, random: PolicyScore, pilot: PolicyScore | None) -> Scale:
        """Return the scale of two scores."""
        return cls(random.mean_return, math.nan if pilot is None else pilot.mean_return)

    def score(self, mean_return: float) -> float:
        """Return the normalized score of a mean return: 0 for random, 1 for the pilot.

        Without a pilot, or if the pilot's return is that of random actions, it is NaN.
        """
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

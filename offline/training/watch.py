"""What is watched while learning: episodes held out, and signs that values go astray.

Values are compared with what really came: the discounted sum of rewards behind each transition.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from mcaprl.offline.algorithms.config import BootstrapConfig, TrainingConfig
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.batches.buffer import TransitionBuffer

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

MAX_ROWS = 256
"""Transitions that are judged each time, spread evenly over the episodes held out."""
MIN_REACH = 0.3
"""Below this part of an endless return, values can hardly tell a good action from a bad one."""
MAX_EXCESS = 2.0
"""So many times the largest possible return, and a value has run away."""
_CUT_OFF = 0.05
"""What is missing behind a truncated episode may count so much of its worth, and not more."""


class HeldOut:
    """Some transitions of episodes that are not learned from."""

    def __init__(
        self, dataset: Dataset, buffer: TransitionBuffer, episodes: NDArray[np.int64], gamma: float
    ) -> None:
        """Choose the transitions.

        Args:
            dataset: all of it.
            buffer: all of it, packed.
            episodes: numbers of the episodes held out.
            gamma: discount.
        """
        lengths = dataset.episode_lengths
        rows = np.flatnonzero(np.isin(np.repeat(np.arange(len(lengths)), lengths), episodes))
        returns = monte_carlo_returns(dataset, episodes, gamma)
        known = np.isfinite(returns)
        if known.any():
            rows, returns = rows[known], returns[known]
        chosen = np.unique(np.linspace(0, len(rows) - 1, MAX_ROWS).round().astype(np.int64))
        self._rows = torch.from_numpy(rows[chosen]).to(buffer.device)
        self._buffer = buffer
        self.mean_return = float(returns[chosen].mean())

    def terms(self, learner: Learner) -> list[dict[str, float]]:
        """What each seed's networks make of these transitions, by names that begin `held_out_`."""
        seeds = len(learner.seeds)
        with torch.no_grad():
            judged = learner.validate(self._buffer.batch(self._rows.repeat(seeds)))
        means = learner.seed_means({f"held_out_{name}": term for name, term in judged.items()})
        has_values = "q" in learner.models and math.isfinite(self.mean_return)
        known = {"held_out_return": self.mean_return} if has_values else {}
        return [{**mine, **known} for mine in means]


def choose_held_out(n_episodes: int, fraction: float) -> NDArray[np.int64]:
    """Numbers of about `fraction` of the episodes: at least one of ten or more, never all.

    The choice depends on the number of episodes alone, so it is the same for all seeds.
    """
    count = round(fraction * n_episodes)
    if fraction > 0 and n_episodes >= 10:
        count = max(count, 1)
    count = max(0, min(count, n_episodes - 1))
    return np.sort(np.random.default_rng(0).permutation(n_episodes)[:count])


def monte_carlo_returns(
    dataset: Dataset, episodes: NDArray[np.int64], gamma: float
) -> NDArray[np.float64]:
    """The discounted sum of rewards from each transition of some episodes to their ends.

    Args:
        dataset: of all episodes.
        episodes: numbers of those that are asked for, rising.
        gamma: discount.

    Returns:
        As many as these episodes have transitions; NaN where an episode was truncated so soon that
        what is missing may count for more than 5 %.
    """
    returns = []
    ends = np.cumsum(dataset.episode_lengths)
    for number in episodes:
        length = dataset.episode_lengths[number]
        rows = slice(ends[number] - length, ends[number])
        total, sums = 0.0, np.empty(length)
        for step, reward in zip(reversed(range(length)), dataset.rewards[rows][::-1], strict=True):
            total = reward + gamma * total
            sums[step] = total
        if not dataset.terminated[rows.stop - 1]:
            sums[gamma ** np.arange(length, 0, -1.0) > _CUT_OFF] = np.nan
        returns.append(sums)
    return np.concatenate(returns) if returns else np.empty(0)


def largest_return(dataset: Dataset, gamma: float) -> float:
    """No discounted sum of rewards like these is larger in size."""
    longest = float(dataset.episode_lengths.max())
    steps = longest if gamma == 1 else 1 / (1 - gamma)
    return float(np.abs(dataset.rewards).max()) * steps


def horizon_warning(config: TrainingConfig) -> str | None:
    """What to say of settings that leave values no time to learn what is far ahead."""
    if not isinstance(config, BootstrapConfig) or config.reach >= MIN_REACH:
        return None
    copies = config.updates // config.target_interval
    return (
        f"{copies} copies into the target network in {config.updates} updates: values can reach"
        f" {config.reach:.0%} of what gamma {config.gamma} looks ahead to; lower target_interval"
        " or gamma, or give more updates or n_steps"
    )


def divergence_warning(before: float, value: float, limit: float) -> str | None:
    """What to say of values beyond twice the largest possible return that go on growing.

    Args:
        before: mean value of an earlier batch; fresh networks may begin anywhere.
        value: mean value of this one.
        limit: the largest possible return.
    """
    if abs(value) <= max(MAX_EXCESS * limit, 1.0) or abs(value) <= abs(before):
        return None
    return (
        f"values diverge: the mean of a batch is {value:.4g}, and no return can be beyond"
        f" {limit:.4g}; lower the learning rate, or raise target_interval or alpha"
    )

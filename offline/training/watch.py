"""Validation during training: held-out episodes, and warnings about diverging values.

Values are compared with the Monte Carlo return of each transition.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mcaprl.offline.algorithms.config import BootstrapConfig, TrainingConfig
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.texts import counted

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

MAX_ROWS = 256  # Number of transitions per validation, spread evenly over the held-out episodes
MIN_HORIZON_FRACTION = 0.3
"""Below this `horizon_fraction`, the values of good and bad actions hardly differ."""
SHORT_HORIZON = ".* of the horizon of gamma "
"""Regular expression that matches every `horizon_warning`."""
MAX_EXCESS = 2.0
"""Values diverge if their mean is more than this multiple of the largest possible return."""
_CUT_OFF = 0.05
"""Largest discount of the first reward after a truncation; if it is larger, the return is NaN."""


class HeldOut:
    """Transitions of held-out episodes, for validation."""

    def __init__(
        self, dataset: Dataset, buffer: TransitionBuffer, episodes: NDArray[np.int64], gamma: float
    ) -> None:
        """Choose the transitions."""
        lengths = dataset.episode_lengths
        rows = np.flatnonzero(np.isin(np.repeat(np.arange(len(lengths)), lengths), episodes))
        returns = monte_carlo_returns(dataset, episodes, gamma)
        known = np.isfinite(returns)
        if known.any():
            rows, returns = rows[known], returns[known]
        chosen = np.unique(np.linspace(0, len(rows) - 1, MAX_ROWS).round().astype(np.int64))
        self._rows, self._buffer = torch.from_numpy(rows[chosen]), buffer
        self.mean_return = float(returns[chosen].mean())

    def terms(self, learner: Learner) -> list[dict[str, float]]:
        """Return each seed's validation metrics, whose names have the prefix `held_out_`."""
        rows = self._rows.expand(len(learner.seeds), -1).flatten()
        batch = self._buffer.batch(rows.to(self._buffer.device))
        with torch.no_grad():
            terms = learner.validate(learner.encoded(batch))
        means = learner.seed_means({f"held_out_{name}": term for name, term in terms.items()})
        has_values = "q" in learner.models and math.isfinite(self.mean_return)
        known = {"held_out_return": self.mean_return} if has_values else {}
        return [{**mine, **known} for mine in means]


def choose_held_out(wholes: NDArray[np.int64], fraction: float) -> NDArray[np.int64]:
    """Choose about `fraction` of the episodes, for all seeds the same, but never all of them."""
    # Of ten or more, at least one. Of a divided episode (`wholes`), all parts are chosen or none.
    found, number = np.unique(wholes, return_inverse=True)
    n_episodes = len(found)
    count = round(fraction * n_episodes)
    if fraction > 0 and n_episodes >= 10:
        count = max(count, 1)
    count = max(0, min(count, n_episodes - 1))
    chosen = np.random.default_rng(0).permutation(n_episodes)[:count]
    return np.flatnonzero(np.isin(number, chosen))


def monte_carlo_returns(
    dataset: Dataset, episodes: NDArray[np.int64], gamma: float
) -> NDArray[np.float64]:
    """Return the discounted sum of rewards from each transition to the end of its episode."""
    # NaN after a truncation, if the discount of the first missing reward is above 5 %.
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
    """Return an upper bound on the absolute value of the discounted return of any episode."""
    steps = float(dataset.episode_lengths.max()) if gamma == 1 else 1 / (1 - gamma)
    return float(np.abs(dataset.rewards).max()) * steps


def horizon_warning(config: TrainingConfig) -> str | None:
    """Return a warning if the number of target updates is too low for the horizon of gamma."""
    if not isinstance(config, BootstrapConfig) or config.horizon_fraction >= MIN_HORIZON_FRACTION:
        return None
    target_updates = config.updates // config.target_interval
    return (
        f"{counted(target_updates, 'update')} of the target network in {config.updates}: values"
        f" cover {config.horizon_fraction:.0%} of the horizon of gamma {config.gamma}; lower"
        " target_interval or gamma, or raise updates or n_steps"
    )


ABSOLUTE: Final = ".* absolute actions, though"  # Pattern of `relative_warning`


def relative_warning(relation: Sequence[int | None], learner: str) -> str | None:
    """Return a warning if actions that the data declare as relative are learned as absolute."""
    if all(each is None for each in relation):
        return None
    return (
        f"{learner} learns absolute actions, though the data have actions relative to observations:"
        " bc learns these (`algo='bc'`)"
    )


def schedule_warning(earlier: int | None, config: TrainingConfig) -> str | None:
    """Return a warning if a run is continued to more updates while its learning rate decays."""
    if earlier is None or earlier >= config.updates or config.final_learning_rate_fraction == 1:
        return None
    return (
        f"the learning rate decayed over {earlier} updates and continues as for {config.updates}:"
        f" the result differs from a run that was started with {config.updates} updates; with"
        " final_learning_rate_fraction 1, there is no decay"
    )


def divergence_warning(before: float, value: float, limit: float) -> str | None:
    """Return a warning if values grow beyond twice the largest possible return."""
    if abs(value) <= max(MAX_EXCESS * limit, 1.0) or abs(value) <= abs(before):
        return None
    return (
        f"values diverge: the mean of a batch is {value:.4g}, and no return can exceed"
        f" {limit:.4g}; lower the learning rate, or raise target_interval or alpha"
    )

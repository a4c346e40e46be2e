"""The rule by which `auto` chooses among trained candidates.

Each candidate has an estimated value of the first state of each episode: pessimistic FQE by a model
that was trained on other episodes (`mcaprl.offline.estimate.evidence`). The rule:

1. The estimate of a candidate is the mean value of the episodes' first states, over its networks
   and the models that evaluate them.
2. Episodes are resampled, together with the networks and models. The chance that candidate x is
   better than y is the fraction of resamplings in which its estimate is larger.
3. The candidate with the largest estimate is chosen if its chance of being better than the default
   candidate is at least `CONFIDENCE`; otherwise, the default is.

The chances include the noise of the log and of the networks, but not the bias of the models, which
a log does not show.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
CONFIDENCE: Final = 0.9
RESAMPLES: Final = 1_000


@dataclass(frozen=True)
class Rating:
    """Estimate of one candidate.

    Attributes:
        value: Mean estimated discounted return of the episodes.
        interval: 95 % interval of that mean, by resampling.
        best_chance: Fraction of the resamplings in which no other candidate has a larger estimate.
        over_default: Fraction of the resamplings in which the estimate is larger than that of the
            default candidate; None without a default.
    """

    value: float
    interval: tuple[float, float]
    best_chance: float
    over_default: float | None

    def to_json(self) -> dict[str, Any]:
        """Return the attributes as plain JSON types."""
        return {**asdict(self), "interval": list(self.interval)}


def rate(values: Mapping[str, Floats], default: str, seed: int = 0) -> dict[str, Rating]:
    """Rate candidates by the estimated values of the episodes.

    Args:
        values: Value of each episode's first state, for each of M networks and models (M, E), by
            candidate.
        default: Name of the default candidate.
        seed: Seed of the resampling.
    """
    random = np.random.default_rng(seed)
    episodes = next(iter(values.values())).shape[1]
    counts = _counts(random, episodes)
    drawn = {
        name: ((counts @ mine.T) * _counts(random, len(mine))).sum(1)
        for name, mine in values.items()
    }
    best = np.stack(list(drawn.values())).argmax(0)
    return {
        name: Rating(
            float(values[name].mean()),
            tuple(np.percentile(drawn[name], [2.5, 97.5]).tolist()),
            float((best == k).mean()),
            float((drawn[name] > drawn[default]).mean()) if default in drawn else None,
        )
        for k, name in enumerate(values)
    }


def _counts(random: np.random.Generator, size: int) -> Floats:
    """Return how often each of `size` elements is in each resampling, as fractions (B, size)."""
    return random.multinomial(size, np.full(size, 1 / size), RESAMPLES) / size


def ranked(ratings: Mapping[str, Rating]) -> list[str]:
    """Return the candidates from the largest to the smallest estimate."""
    return sorted(ratings, key=lambda name: -ratings[name].value)


def choose(ratings: Mapping[str, Rating], default: str) -> str:
    """Return the candidate that the rule chooses."""
    first = ranked(ratings)[0]
    chance = ratings[first].over_default
    if default in ratings and chance is not None and chance < CONFIDENCE:
        return default
    return first


def survivors(ratings: Mapping[str, Rating], default: str, count: int) -> list[str]:
    """Return the `count` candidates that are trained on: the chosen one, then the best others."""
    chosen = choose(ratings, default)
    order = [chosen, *(name for name in ranked(ratings) if name != chosen)]
    return order[:count]

"""The rule by which `auto` chooses among trained candidates.

Each candidate has an estimated value of the first state of each episode: pessimistic FQE by a model
that was trained on other episodes (`mcaprl.offline.estimate.evidence`). The rule:

1. The score of a candidate is the mean of the estimated values. The mean is over the episodes, the
   networks of the candidate, and the models that evaluate these networks. If the behavior policy is
   almost deterministic, the log has no evidence on other actions. In this case, the score is the
   fraction of the states in which the candidate takes the logged action.
2. The candidate with the largest score is chosen.
3. Episodes are resampled, together with the networks and models. The chance that a candidate is the
   best is the fraction of the resamplings in which its score is the largest.

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
RESAMPLES: Final = 1_000


@dataclass(frozen=True)
class Rating:
    """Estimates of one candidate.

    Attributes:
        value: Mean estimated discounted return of the episodes.
        interval: 95 % interval of that mean, by resampling.
        agreement: Mean over episodes of the fraction of states with the logged action.
        score: `value`, or `agreement` if the behavior is almost deterministic.
        best_chance: Fraction of the resamplings in which no other candidate has a larger score.
    """

    value: float
    interval: tuple[float, float]
    agreement: float
    score: float
    best_chance: float

    def to_json(self) -> dict[str, Any]:
        """Return the attributes as plain JSON types."""
        return {**asdict(self), "interval": list(self.interval)}


def rate(
    values: Mapping[str, Floats],
    agreements: Mapping[str, Floats],
    *,
    imitate: bool,
    seed: int = 0,
) -> dict[str, Rating]:
    """Rate candidates by their values or by their agreement with the log.

    Args:
        values: Arrays (M, E) by candidate: the value of the first state of each of E episodes, for
            each of M pairs of a network and a model.
        agreements: Arrays (M, E) by candidate: the fraction of the states of each episode in which
            the candidate takes the logged action.
        imitate: Whether the score is the agreement instead of the value.
        seed: Seed of the resampling.
    """
    random = np.random.default_rng(seed)
    counts = _counts(random, next(iter(values.values())).shape[1])
    members = {name: _counts(random, len(mine)) for name, mine in values.items()}
    drawn_values, drawn_agreements = (
        {name: ((counts @ mine.T) * members[name]).sum(1) for name, mine in each.items()}
        for each in (values, agreements)
    )
    best = np.stack(list((drawn_agreements if imitate else drawn_values).values())).argmax(0)
    ratings = {}
    for k, name in enumerate(values):
        value, agreement = float(values[name].mean()), float(agreements[name].mean())
        low, high = np.percentile(drawn_values[name], [2.5, 97.5]).tolist()
        score, chance = agreement if imitate else value, float((best == k).mean())
        ratings[name] = Rating(value, (low, high), agreement, score, chance)
    return ratings


def ranked(ratings: Mapping[str, Rating]) -> list[str]:
    """Return the candidates from the largest to the smallest score."""
    return sorted(ratings, key=lambda name: -ratings[name].score)


def _counts(random: np.random.Generator, size: int) -> Floats:
    """Return the fraction (B, size) of each element in each of B resamplings."""
    return random.multinomial(size, np.full(size, 1 / size), RESAMPLES) / size

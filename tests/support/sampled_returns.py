"""Returns of training seeds and episodes with a true mean of 0, and the coverage of intervals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Returns:
    """Distribution of returns: the sum of effects of the seed, of the start, and of both.

    Attributes:
        seeds: Number of training seeds.
        episodes: Number of episodes of each, with the same starts for all seeds.
        skewed: Whether the effects of starts and episodes are lognormal instead of normal.
        spread: Standard deviation of the seeds' effects; that of the episodes is 1.
        skewed_seeds: Whether the effects of seeds are lognormal.
    """

    seeds: int
    episodes: int
    skewed: bool = False
    spread: float = 1.0
    skewed_seeds: bool = False

    def draw(self, random: np.random.Generator) -> Floats:
        """Return returns (S, E); half of an episode's variance is that of its start."""
        of_seeds = _effects(random, (self.seeds, 1), skewed=self.skewed_seeds)
        of_starts = _effects(random, (1, self.episodes), skewed=self.skewed)
        of_both = _effects(random, (self.seeds, self.episodes), skewed=self.skewed)
        if self.seeds == 1:
            return of_both
        return self.spread * of_seeds + math.sqrt(0.5) * (of_starts + of_both)


def coverage(
    returns: Returns, interval: Callable[[Floats], tuple[float, float]], trials: int
) -> float:
    """Return how often the interval of the mean contains 0."""
    random = np.random.default_rng(0)
    hits = 0
    for _ in range(trials):
        low, high = interval(returns.draw(random))
        hits += low <= 0 <= high
    return hits / trials


def _effects(random: np.random.Generator, shape: tuple[int, ...], *, skewed: bool) -> Floats:
    """Draw numbers with mean 0 and variance 1."""
    if not skewed:
        return random.normal(size=shape)
    return (random.lognormal(size=shape) - math.exp(0.5)) / math.sqrt(math.e * (math.e - 1))

"""Random returns of seeds and episodes with a true mean of 0, to measure interval coverage.

`python -m tests.support.sampled_returns` prints the table of `docs/evaluation.md`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.evaluation.evaluate import bootstrap_interval, mean_interval

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Returns:
    """Distribution of returns. A return is the sum of effects of the seed, the start and the pair.

    Attributes:
        seeds: Number of training seeds.
        episodes: Number of episodes of each seed; all seeds have the same starts.
        skewed: Whether the effects of starts and episodes are lognormal instead of normal.
        spread: Standard deviation of the effects of seeds. For the effects of episodes, it is 1.
        skewed_seeds: Whether the effects of seeds are lognormal.
    """

    seeds: int
    episodes: int
    skewed: bool = False
    spread: float = 1.0
    skewed_seeds: bool = False

    def draw(self, random: np.random.Generator) -> Floats:
        """Draw returns (S, E) of S seeds and E episodes.

        With several seeds, half of the variance between episodes is due to their starts.
        """
        of_seeds = _effects(random, (self.seeds, 1), skewed=self.skewed_seeds)
        of_starts = _effects(random, (1, self.episodes), skewed=self.skewed)
        of_both = _effects(random, (self.seeds, self.episodes), skewed=self.skewed)
        if self.seeds == 1:
            return of_both
        return self.spread * of_seeds + math.sqrt(0.5) * (of_starts + of_both)


CASES: Final = {
    "1 seed, 5 episodes, normal": Returns(1, 5),
    "1 seed, 5 episodes, lognormal": Returns(1, 5, skewed=True),
    "1 seed, 30 episodes, normal": Returns(1, 30),
    "1 seed, 30 episodes, lognormal": Returns(1, 30, skewed=True),
    "1 seed, 100 episodes, normal": Returns(1, 100),
    "1 seed, 100 episodes, lognormal": Returns(1, 100, skewed=True),
    "2 seeds, 30 episodes, normal": Returns(2, 30),
    "4 seeds, 30 episodes, normal": Returns(4, 30),
    "4 seeds, 30 episodes, lognormal": Returns(4, 30, skewed=True),
    "4 equal seeds, 30 episodes, normal": Returns(4, 30, spread=0),
    "4 seeds, 100 episodes, normal": Returns(4, 100),
    "4 lognormal seeds, 30 episodes, normal": Returns(4, 30, skewed_seeds=True),
    "10 seeds, 30 episodes, normal": Returns(10, 30),
    "10 lognormal seeds, 30 episodes, normal": Returns(10, 30, skewed_seeds=True),
}


def coverage(
    returns: Returns, interval: Callable[[Floats], tuple[float, float]], trials: int
) -> float:
    """Return the fraction of trials in which the interval of the mean contains 0."""
    random = np.random.default_rng(0)
    hits = 0
    for _ in range(trials):
        low, high = interval(returns.draw(random))
        hits += low <= 0 <= high
    return hits / trials


def main() -> None:
    """Print the table as Markdown."""
    percentiles = partial(bootstrap_interval, statistic=lambda r: np.mean(r, axis=(-2, -1)))
    print("| returns | ours | percentiles |\n|---|---|---|")
    for name, returns in CASES.items():
        ours, theirs = (coverage(returns, each, 2000) for each in (mean_interval, percentiles))
        print(f"| {name} | {100 * ours:.1f} % | {100 * theirs:.1f} % |", flush=True)


def _effects(random: np.random.Generator, shape: tuple[int, ...], *, skewed: bool) -> Floats:
    """Draw numbers with mean 0 and variance 1."""
    if not skewed:
        return random.normal(size=shape)
    return (random.lognormal(size=shape) - math.exp(0.5)) / math.sqrt(math.e * (math.e - 1))


if __name__ == "__main__":
    main()

"""Coverage of the 95 % intervals of mean returns, by simulation.

The table is in `docs/evaluation.md`.

python -m benchmarks.intervals
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Final

import numpy as np

from mcaprl.sims.evaluation.statistics import bootstrap_interval, mean_interval
from tests.support.sampled_returns import Returns, coverage

CASES: Final = {
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


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=2000)
    trials = parser.parse_args().trials
    percentiles = partial(bootstrap_interval, statistic=lambda r: np.mean(r, axis=(-2, -1)))
    print("| returns | ours | percentiles |\n|---|---|---|")
    for name, returns in CASES.items():
        ours, theirs = (coverage(returns, each, trials) for each in (mean_interval, percentiles))
        print(f"| {name} | {100 * ours:.1f} % | {100 * theirs:.1f} % |", flush=True)


if __name__ == "__main__":
    main()

"""Measure updates of offline learners on a GPU, with and without CUDA graphs, and on one core.

`python -m benchmarks.speed.gpu_learning` prints updates per second, summed over the seeds that are
trained at once, for random data of 100,000 transitions with 19 numbers and 6 actions, and default
networks. Without a GPU, it says so and ends.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from mcaprl import Dataset
from mcaprl.offline import ALGORITHMS, TransitionBuffer

ROWS, NUMBERS, ACTIONS, EPISODE = 100_000, 19, 6, 1_000
ALGOS = ("double-dqn", "cql", "iql", "bc")
SEEDS = (1, 8, 32)
BATCHES = (256, 32)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=0.6, help="wall time of each case")
    seconds = parser.parse_args().seconds
    if not torch.cuda.is_available():
        print("no CUDA device: nothing is measured")
        return
    torch.set_num_threads(1)
    data = _data()
    print(f"{torch.cuda.get_device_name()}; updates per second of all seeds")
    print(
        f"{'algorithm':12} {'batch':>5} {'seeds':>5} {'graphs':>8} {'kernels':>8} {'one core':>8}"
    )
    for batch in BATCHES:
        for algo in ALGOS:
            for seeds in SEEDS:
                graphs = _rate(data, algo, batch, seeds, "cuda", True, seconds)
                kernels = _rate(data, algo, batch, seeds, "cuda", False, seconds)
                core = _rate(data, algo, batch, seeds, "cpu", False, seconds)
                print(f"{algo:12} {batch:5} {seeds:5} {graphs:8,.0f} {kernels:8,.0f} {core:8,.0f}")


def _data() -> Dataset:
    """Return random transitions."""
    random = np.random.default_rng(0)
    ends = np.arange(ROWS) % EPISODE == EPISODE - 1
    return Dataset.from_arrays(
        observations=random.standard_normal((ROWS, NUMBERS), np.float32),
        actions=np.concatenate([np.arange(ACTIONS), random.integers(ACTIONS, size=ROWS - ACTIONS)]),
        rewards=random.standard_normal(ROWS),
        terminated=ends,
        truncated=np.zeros(ROWS, bool),
        next_observations=random.standard_normal((ROWS, NUMBERS), np.float32),
    )


def _rate(
    data: Dataset, algo: str, batch: int, seeds: int, device: str, graphs: bool, seconds: float
) -> float:
    """Return the updates per second of all seeds."""
    kind = ALGORITHMS[algo]
    config = kind.config_type(updates=1_000_000, batch_size=batch)
    buffer = TransitionBuffer.from_dataset(data, config.packing).to(torch.device(device))
    learner = kind(config, buffer, range(seeds))
    learner._is_captured &= graphs
    for _ in range(5):
        learner.update()
    began, first = time.perf_counter(), learner.step
    while time.perf_counter() - began < seconds:
        learner.update()
    if device == "cuda":
        torch.cuda.synchronize()
    return seeds * (learner.step - first) / (time.perf_counter() - began)


if __name__ == "__main__":
    main()

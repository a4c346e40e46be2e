"""Compare off-policy estimates with logged and with estimated behavior probabilities.

    python -m benchmarks.studies.estimated_behavior

The task has a known value, the solution of linear equations (tests/support/two_state_task.py). For
each estimator, print the mean and the standard deviation of the estimates from several logs, and
the number of 95 % intervals that contain the true value.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import mcaprl
from mcaprl.offline import FQEConfig, OffPolicyEvaluator
from mcaprl.sims import Policy
from tests.support import two_state_task as task

ESTIMATORS = ("PDIS", "WPDIS", "DR", "WDR")


class _Evaluated(Policy):
    """Policy that is evaluated in the two-state task."""

    def action_probabilities(self, observations: Any) -> NDArray[np.float64]:
        """Return the probabilities (B, 2); an observation is the state, one-hot."""
        return np.asarray(observations, np.float64) @ task.EVALUATED


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=8, help="number of logs")
    parser.add_argument("--episodes", type=int, default=400, help="episodes of a log")
    parser.add_argument("--updates", type=int, default=1_000, help="gradient steps of each model")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = [_estimates(seed, arguments) for seed in range(arguments.logs)]
    print(f"true value {task.true_value():.3f}")
    print("| estimator | behavior_prob | mean | standard deviation | intervals with the value |")
    print("|---|---|---|---|---|")
    for estimator in ESTIMATORS:
        for kind in ("logged", "estimated"):
            rows = np.array([one[estimator, kind] for one in found])
            values, low, high = rows.T
            held = ((low <= task.true_value()) & (task.true_value() <= high)).sum()
            print(
                f"| {estimator} | {kind} | {values.mean():.3f} | {values.std(ddof=1):.3f} |"
                f" {held} of {len(rows)} |"
            )


def _estimates(
    seed: int, arguments: argparse.Namespace
) -> dict[tuple[str, str], tuple[float, float, float]]:
    """Return the value and the interval of each estimate from one log.

    A key is the estimator and the kind of `behavior_prob`: `logged` or `estimated`.
    """
    data = _log(seed, arguments.episodes)
    estimated = mcaprl.estimate_behavior(data, updates=arguments.updates, seed=seed)
    config = FQEConfig(gamma=task.GAMMA, updates=arguments.updates)
    found = {}
    for kind, each in {"logged": data, "estimated": estimated.dataset}.items():
        results = OffPolicyEvaluator(each, config, seed).evaluate(_Evaluated(), "evaluated")
        for one in results.estimates:
            if one.estimator in ESTIMATORS:
                assert one.value is not None
                assert one.interval is not None
                found[one.estimator, kind] = (one.value, *one.interval)
    return found


def _log(seed: int, episodes: int) -> mcaprl.Dataset:
    """Return a log of the task's behavior policy."""
    random = np.random.default_rng(seed)
    rows: list[tuple[int, int, float, int, bool]] = []
    for _ in range(episodes):
        state, ended = 0, False
        while not ended:
            action = int(random.random() < task.BEHAVIOR[state, 1])
            following = int(random.random() < task.TO_ONE[state, action])
            ended = bool(random.random() < task.ENDS)
            rows.append((state, action, task.PAYS[state, action], following, ended))
            state = following
    states, actions, rewards, following_states, ends = map(np.array, zip(*rows, strict=True))
    one_hot = np.eye(2, dtype=np.float32)
    return mcaprl.Dataset.from_arrays(
        observations=one_hot[states],
        next_observations=one_hot[following_states],
        actions=actions,
        rewards=rewards,
        terminated=ends,
        truncated=np.zeros(len(rows), bool),
        behavior_probs=task.BEHAVIOR[states, actions],
    )


if __name__ == "__main__":
    main()

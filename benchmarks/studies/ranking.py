"""Measure how well a log alone ranks the checkpoints of a training run.

    python -m benchmarks.studies.ranking FOLDER --sim lane
    python -m benchmarks.studies.ranking FOLDER --sim racer

Double DQN trains online and records its transitions; its checkpoints are saved. Each checkpoint is
then evaluated twice: its greedy policy runs fresh episodes in the sim, which gives its true value,
and each estimator computes that value from the run's log. The rankings are compared by Spearman's
correlation and by regret@1, for each training seed. The table has the mean and range over seeds.
Two simple rules serve as references. The first rule prefers later checkpoints. The second rule
prefers checkpoints whose Q has a higher mean in the first states.

FOLDER/SIM/ranking.json has all results; finished parts are not repeated.
"""

from __future__ import annotations

import argparse
import json
import math
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

import mcaprl
from mcaprl.files import write_json
from mcaprl.offline import FQEConfig, OffPolicyEvaluator
from mcaprl.online import LearningAgent, Task
from mcaprl.progress import TrainingProgress
from mcaprl.sims import Scale, episode_seed, make_sims

SEEDS: Final = 4
CHECKPOINTS: Final = 8
STEPS: Final = {"lane": 16_000, "racer": 8_000}
"""Training steps, by sim. The numbers are small, because later checkpoints hardly differ."""
EPISODES: Final = 100
FIRST_SEED: Final = 5_000_000
GAMMA: Final = 0.97
RULES: Final = ("the later the better", "own mean Q")


def train(sim: str, folder: Path, seed: int, steps: int) -> tuple[Path, list[Path]]:
    """Train, unless this was done before; return the log and the checkpoints."""
    log = folder / "training.mcap"
    every = steps // CHECKPOINTS
    kept = [folder / f"step-{every * (k + 1)}" for k in range(CHECKPOINTS)]
    if kept[-1].exists():
        return log, kept
    folder.mkdir(parents=True)
    task = Task.for_sim(
        sim, steps=steps, eval_interval=steps, eval_episodes=1, checkpoint_interval=2 * steps
    )
    agent = LearningAgent(task, task.sim, folder, seed, Scale(0.0, 1.0), record=log)

    def keep(progress: TrainingProgress) -> None:
        if progress.done % every == 0:
            path = folder / f"step-{progress.done}"
            path.mkdir()
            agent.save_policy(path)

    with closing(agent):
        agent.learn(keep)
    return log, kept


def true_values(sim: str, policy: Any) -> tuple[float, float]:
    """Return the greedy policy's mean discounted and undiscounted return over fresh episodes."""
    with closing(make_sims(sim, EPISODES)) as envs:
        each: Any = [episode_seed(FIRST_SEED, k) for k in range(EPISODES)]
        observations, _ = envs.reset(seed=each)
        running, discount = np.ones(EPISODES, dtype=np.bool_), 1.0
        discounted, plain = np.zeros(EPISODES), np.zeros(EPISODES)
        while running.any():
            observations, rewards, terminated, truncated, _ = envs.step(policy.act(observations))
            discounted[running] += discount * rewards[running]
            plain[running] += rewards[running]
            running &= ~(terminated | truncated)
            discount *= GAMMA
    return float(discounted.mean()), float(plain.mean())


def ask(sim: str, log: Path, kept: list[Path], config: FQEConfig) -> list[dict[str, Any]]:
    """Return true and estimated values of each checkpoint."""
    dataset = mcaprl.open(log)
    firsts = np.array([episode.observations[0] for episode in dataset.episodes])
    evaluator = OffPolicyEvaluator(dataset, config)
    found = []
    for number, path in enumerate(kept):
        policy = mcaprl.load_policy(path)
        discounted, plain = true_values(sim, policy)
        estimates = evaluator.evaluate(policy, path.stem).estimates
        values = {estimate.estimator: estimate.value for estimate in estimates}
        values |= dict(
            zip(RULES, (number, float(policy.q_values(firsts).max(1).mean())), strict=True)
        )
        trusted = [estimate.estimator for estimate in estimates if estimate.trusted]
        row = {"discounted": discounted, "return": plain, "estimates": values, "trusted": trusted}
        print(path, json.dumps(row), flush=True)
        found.append(row)
    return found


def agreement(rows: list[dict[str, Any]], estimator: str) -> tuple[float, float, float, float]:
    """Compare an estimator's values with the true values of the checkpoints.

    Returns:
        Rank correlations with discounted and with undiscounted returns, regret@1, and the fraction
        of the checkpoints whose estimate is trusted.
    """
    estimated, discounted, plain = (
        np.array([row["estimates"][estimator] if own is None else row[own] for row in rows])
        for own in (None, "discounted", "return")
    )
    return (
        rank_correlation(estimated, discounted),
        rank_correlation(estimated, plain),
        regret_at_1(estimated, discounted),
        float(np.mean([estimator in row["trusted"] for row in rows])),
    )


def show(sim: str, by_seed: list[list[dict[str, Any]]]) -> None:
    """Print one row for each estimator: means over training seeds, and the range."""
    print(f"\n{sim}: {len(by_seed)} training seeds, {len(by_seed[0])} checkpoints each")
    for name in by_seed[0][0]["estimates"]:
        figures = np.array([agreement(rows, name) for rows in by_seed])
        cells = [_mean_and_range(column) for column in figures.T[:3]]
        print(f"| {name} | {' | '.join(cells)} | {figures[:, 3].mean():.0%} |")
    errors = [row["estimates"]["FQE"] - row["discounted"] for rows in by_seed for row in rows]
    spread = [row["discounted"] for rows in by_seed for row in rows]
    print(f"true discounted values {min(spread):.2f} to {max(spread):.2f};", end=" ")
    print(f"FQE: mean absolute error {np.mean(np.abs(errors)):.2f}, bias {np.mean(errors):.2f}")


def rank_correlation(estimated: NDArray[np.floating], true: NDArray[np.floating]) -> float:
    """Return Spearman's correlation: 1 if the estimates rank the policies in their true order.

    Equal values share the mean of their ranks. The result is NaN if all estimates, or all true
    values, are equal.

    >>> rank_correlation(np.array([1.0, 2.0, 3.0]), np.array([10.0, 30.0, 20.0]))
    0.5
    """
    first, second = _ranks(estimated), _ranks(true)
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return float("nan")
    return round(float(np.corrcoef(first, second)[0, 1]), 12)


def regret_at_1(estimated: NDArray[np.floating], true: NDArray[np.floating]) -> float:
    """Return the loss of choosing the highest estimate, as a fraction of the range of values.

    The result is (max V - V of the choice) / (max V - min V). It is 0 for the best policy and 1 for
    the worst.

    >>> regret_at_1(np.array([1.0, 5.0, 3.0]), np.array([10.0, 15.0, 20.0]))
    0.5
    """
    spread = float(np.ptp(true))
    if spread == 0:
        return 0.0
    return float(true.max() - true[estimated.argmax()]) / spread


def _ranks(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return ranks (N,) from 0. Equal values have the mean of their ranks."""
    below = (values[:, None] > values).sum(1)
    equal = (values[:, None] == values).sum(1)
    ranks: NDArray[np.float64] = below + (equal - 1) / 2
    return ranks


def _mean_and_range(column: NDArray[np.float64]) -> str:
    known = column[~np.isnan(column)]
    if not len(known):
        return "none"
    return f"{known.mean():.2f} ({known.min():.2f} to {known.max():.2f})"


def main() -> None:
    """Train, estimate and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sim", choices=STEPS, required=True)
    parser.add_argument("--updates", type=int, default=3_000, help="updates of the FQE model")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    config = FQEConfig(
        updates=arguments.updates,
        gamma=GAMMA,
        batch_size=128,
        hidden=(64, 64),
        target_interval=max(1, math.floor(arguments.updates * (1 - GAMMA) / 6)),
    )
    folder = arguments.folder / arguments.sim
    result = folder / "ranking.json"
    by_seed = json.loads(result.read_text()) if result.exists() else []
    for seed in range(len(by_seed), SEEDS):
        log, kept = train(arguments.sim, folder / f"seed-{seed}", seed, STEPS[arguments.sim])
        by_seed.append(ask(arguments.sim, log, kept, config))
        write_json(result, by_seed)
    show(arguments.sim, by_seed)


if __name__ == "__main__":
    main()

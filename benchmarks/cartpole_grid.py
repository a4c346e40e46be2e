"""Five CartPole logs, five algorithms, four seeds, beside d3rlpy's on the same logs in one run.

    python benchmarks/cartpole_grid.py FOLDER [--seeds 4] [--only cql,bc]

5000 updates of batch 64, learning rate 1e-3, gamma .99, hard target every 200, 256x256. A figure is
the mean return of the last three evaluations (after 4000, 4500 and 5000 updates), 10 episodes each.
d3rlpy takes part where it is installed, with one seed. The result is FOLDER/grid.json, and a table
with the gates that hold or do not, in docs/results.md.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

import mcaprl
from benchmarks.cartpole_data import make_logs
from benchmarks.page import write_section
from mcaprl.offline.algorithms import ALGORITHMS
from mcaprl.offline.buffer import TransitionBuffer
from mcaprl.offline.config import BootstrapConfig
from mcaprl.offline.policy import Scores

UPDATES, EVALUATED_AT, EPISODES = 5000, (4000, 4500, 5000), 10
SHARED: dict[str, Any] = {
    "updates": UPDATES,
    "batch_size": 64,
    "learning_rate": 1e-3,
    "final_learning_rate_fraction": 1.0,
}
VALUES: dict[str, Any] = {"gamma": 0.99, "target_interval": 200}
ALGOS = ("double-dqn", "cql", "bcq", "bc", "iql")
RIVALS = {
    "double-dqn": "DoubleDQNConfig",
    "cql": "DiscreteCQLConfig",
    "bcq": "DiscreteBCQConfig",
    "bc": "DiscreteBCConfig",
}
Act = Callable[[NDArray[Any]], NDArray[Any]]


def mean_return(act: Act, seed: int) -> float:
    """Of the first episode in each of ten environments side by side."""
    envs = gym.make_vec("CartPole-v1", EPISODES, "vector_entry_point")
    observations, _ = envs.reset(seed=seed)
    returns, running = np.zeros(EPISODES), np.ones(EPISODES, bool)
    while running.any():
        observations, rewards, terminated, truncated, _ = envs.step(act(observations))
        returns += rewards * running
        running &= ~(terminated | truncated)
    envs.close()
    return float(returns.mean())


def ours(data: mcaprl.Dataset, algo: str, seeds: int) -> list[float]:
    """The figure of each seed."""
    learner_type = ALGORITHMS[algo]
    values = VALUES if issubclass(learner_type.config_type, BootstrapConfig) else {}
    config = learner_type.config_type(**SHARED, **values)
    learner = learner_type(
        config, TransitionBuffer.from_dataset(data, config.packing), range(seeds)
    )
    found = []
    while learner.step < UPDATES:
        learner.update()
        if learner.step in EVALUATED_AT:
            found.append(
                [mean_return(greedy(learner, seed), learner.step) for seed in range(seeds)]
            )
    return np.mean(found, axis=0).tolist()


def greedy(learner: Any, seed: int) -> Act:
    """How a seed would act now."""
    networks = {name: learner.network(name, seed) for name in learner.policy_models}
    scores = Scores(networks, learner.acts_by, getattr(learner.config, "threshold", 0.0))

    def act(observations: NDArray[Any]) -> NDArray[Any]:
        with torch.no_grad():
            return scores(learner.buffer.encoder.encode(observations)).argmax(1).numpy()

    return act


def theirs(data: mcaprl.Dataset, algo: str) -> list[float]:
    """d3rlpy's figure, of one seed."""
    import d3rlpy

    d3rlpy.seed(0)
    log = d3rlpy.dataset.MDPDataset(
        data.observations,
        data.actions,
        data.rewards.astype(np.float32),
        data.terminated.astype(np.float32),
        data.truncated.astype(np.float32),
        action_space=d3rlpy.ActionSpace.DISCRETE,
    )
    encoder = d3rlpy.models.VectorEncoderFactory([256, 256])
    settings: dict[str, Any] = {"learning_rate": 1e-3, "batch_size": 64, "encoder_factory": encoder}
    if algo != "bc":
        settings |= {"gamma": 0.99, "target_update_interval": 200}
    learner = getattr(d3rlpy.algos, RIVALS[algo])(**settings).create(device="cpu")
    found = []

    def on_update(algorithm: Any, _: int, step: int) -> None:
        if step in EVALUATED_AT:
            found.append(mean_return(algorithm.predict, step))

    learner.fit(
        log,
        n_steps=UPDATES,
        n_steps_per_epoch=UPDATES,
        show_progress=False,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        callback=on_update,
    )
    return [float(np.mean(found))]


def gates(found: dict[str, dict[str, list[float]]], behavior: dict[str, float]) -> dict[str, bool]:
    """What must hold of our own."""
    good = ("medium", "expert")
    return {
        "Double DQN collapses on medium and expert data": all(
            np.mean(found[name]["double-dqn"]) < 0.5 * behavior[name] for name in good
        ),
        "CQL keeps .95 of the behavior there, each seed": all(
            min(found[name]["cql"]) >= 0.95 * behavior[name] for name in good
        ),
        "CQL reaches 125 on random data": np.mean(found["random"]["cql"]) >= 125,
        "CQL reaches 250 on mixed data, and more than Double DQN": np.mean(found["mixed"]["cql"])
        >= max(250.0, float(np.mean(found["mixed"]["double-dqn"]))),
    }


def main() -> None:
    """Run the grid, print it, and say which gates hold."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--only", default=",".join(ALGOS))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    has_rival = importlib.util.find_spec("d3rlpy") is not None
    found: dict[str, dict[str, list[float]]] = {}
    rivals: dict[str, dict[str, list[float]]] = {}
    behavior: dict[str, float] = {}
    for name, data in make_logs(arguments.folder).items():
        behavior[name] = data.statistics.mean_return
        found[name], rivals[name] = {}, {}
        for algo in arguments.only.split(","):
            found[name][algo] = ours(data, algo, arguments.seeds)
            if has_rival and algo in RIVALS:
                rivals[name][algo] = theirs(data, algo)
            print(
                name, algo, found[name][algo], rivals[name].get(algo), file=sys.stderr, flush=True
            )
    result = {"behavior": behavior, "mcaprl": found, "d3rlpy": rivals}
    (arguments.folder / "grid.json").write_text(json.dumps(result, indent=2) + "\n")
    print(text := table(result))
    if set(ALGOS) <= set(arguments.only.split(",")):
        verdicts = [
            f"- {'holds' if holds else 'does not hold'}: {gate}"
            for gate, holds in gates(found, behavior).items()
        ]
        print("\n".join(verdicts))
        write_section("cartpole-grid", "\n".join([text, "", *verdicts]))


def table(result: dict[str, Any]) -> str:
    """Markdown: each cell has our mean, the range of the seeds, and d3rlpy's."""
    algos = list(next(iter(result["mcaprl"].values())))
    lines = [f"| data (behavior) | {' | '.join(algos)} |", "|---|" + "---|" * len(algos)]
    for name, row in result["mcaprl"].items():
        cells = []
        for algo in algos:
            values, rival = row[algo], result["d3rlpy"][name].get(algo)
            beside = f"; d3rlpy {rival[0]:.0f}" if rival else ""
            cells.append(f"{np.mean(values):.0f} ({min(values):.0f}-{max(values):.0f}){beside}")
        lines.append(f"| {name} ({result['behavior'][name]:.0f}) | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()

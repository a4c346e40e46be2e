"""Train five algorithms on five CartPole logs with four seeds, and compare with d3rlpy.

    python benchmarks/studies/cartpole_grid.py FOLDER [--seeds 4] [--only cql,bc]

A training has 5000 updates with batch size 64, learning rate 1e-3, gamma .99, a target sync every
200 updates, and layer widths 256x256. Its result is the mean return of the last three evaluations
(after 4000, 4500 and 5000 updates) of 10 episodes each. d3rlpy is trained with one seed if it is
installed. FOLDER/grid.json has the results of finished trainings, so an interrupted run resumes.
The table is written to docs/results.md. Below it is a list of conditions that the results should
meet, each with `holds` or `does not hold`.
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
from scipy import stats

import mcaprl
from benchmarks.page import write_section
from benchmarks.studies.cartpole_data import NAMES, make_logs
from mcaprl.files import write_json
from mcaprl.offline import ALGORITHMS, BootstrapConfig, Learner, TransitionBuffer, build_head

UPDATES, EVALUATED_AT, EPISODES = 5000, (4000, 4500, 5000), 10
SHARED: dict[str, Any] = {
    "updates": UPDATES,
    "batch_size": 64,
    "learning_rate": 1e-3,
    "final_learning_rate_fraction": 1.0,
}
VALUES: dict[str, Any] = {"gamma": 0.99, "target_interval": 200}
# The table compares the algorithms of the papers, without our normalization.
SPECIAL: dict[str, dict[str, Any]] = {
    "cql": {"scale_rewards": False},
    "iql": {"normalize_advantages": False, "beta": 3.0},
}
ALGOS = ("cql", "double-dqn", "bc", "bcq", "iql")
RIVALS = {
    "double-dqn": "DoubleDQNConfig",
    "cql": "DiscreteCQLConfig",
    "bcq": "DiscreteBCQConfig",
    "bc": "DiscreteBCConfig",
}
GOOD_LOGS = ("medium", "expert")
Act = Callable[[NDArray[Any]], NDArray[Any]]


def mean_return(act: Act, seed: int) -> float:
    """Return the mean return of the first episode in each of ten parallel environments."""
    envs = gym.make_vec("CartPole-v1", EPISODES, "vector_entry_point")
    observations, _ = envs.reset(seed=seed)
    returns, running = np.zeros(EPISODES), np.ones(EPISODES, bool)
    while running.any():
        observations, rewards, terminated, truncated, _ = envs.step(act(observations))
        returns += rewards * running
        running &= ~(terminated | truncated)
    envs.close()
    return float(returns.mean())


def ours(
    data: mcaprl.Dataset, learner_type: type[Learner], seeds: int, **changes: Any
) -> list[float]:
    """Return the mean return of each seed; `changes` are other settings than those of the table."""
    values = VALUES if issubclass(learner_type.config_type, BootstrapConfig) else {}
    special = SPECIAL.get(learner_type.name, {})
    config = learner_type.config_type(**(SHARED | values | special | changes))
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
    """Return the greedy policy of a seed's current network."""
    networks = {name: learner.network(name, seed) for name in learner.policy_models}
    threshold = getattr(learner.config, "threshold", 0.0)
    head = build_head(learner.acts_by, networks, learner.buffer.action_space, threshold)

    def act(observations: NDArray[Any]) -> NDArray[Any]:
        with torch.no_grad():
            return head.scores(learner.buffer.encoder.encode(observations)).argmax(1).numpy()

    return act


def theirs(data: mcaprl.Dataset, algo: str, seed: int, **changes: Any) -> float:
    """Return the mean return of a seed of d3rlpy; `changes` are other settings of its config."""
    import d3rlpy

    d3rlpy.seed(seed)
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
    learner = getattr(d3rlpy.algos, RIVALS[algo])(**(settings | changes)).create(device="cpu")
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
    return float(np.mean(found))


class FlatBC(ALGORITHMS["bc"]):  # type: ignore[misc]
    """Clone with d3rlpy's penalty: half the mean square of the log probabilities."""

    def losses(self, batch: Any) -> dict[str, torch.Tensor]:
        """Return the terms of BC, with the penalty in the loss."""
        terms: dict[str, torch.Tensor] = super().losses(batch)
        log_probs = self.outputs("logits", batch.observations).log_softmax(1)
        return {**terms, "loss": terms["loss"] + 0.5 * log_probs.square().mean(1)}


DECAY = {"final_learning_rate_fraction": 0.02}
Q_SWAPS: dict[str, dict[str, Any]] = {
    "ours": {},
    "d3rlpy": {},
    "ours, falling learning rate": DECAY,
}
SWAPS: dict[tuple[str, str], dict[str, dict[str, Any]]] = {
    ("mixed", "bc"): {
        "ours": {},
        "d3rlpy": {},
        "ours, d3rlpy's penalty": {},
        "d3rlpy, no penalty": {"beta": 0.0},
        "ours, falling learning rate": DECAY,
        "ours, normalized observations": {"normalize": True},
        "ours, weight decay .01": {"weight_decay": 0.01},
        "ours, batch 256": {"batch_size": 256},
    },
    ("replay", "cql"): Q_SWAPS,
    ("replay", "double-dqn"): Q_SWAPS,
}
"""Trainings that differ in one setting, by log and algorithm."""


def swap(data: mcaprl.Dataset, algo: str, name: str, seeds: int, changes: Any) -> list[float]:
    """Return the mean return of each seed of a training of SWAPS."""
    if name.startswith("d3rlpy"):
        return [theirs(data, algo, seed, **changes) for seed in range(seeds)]
    learner_type = FlatBC if name.endswith("d3rlpy's penalty") else ALGORITHMS[algo]
    return ours(data, learner_type, seeds, **changes)


def run_swaps(logs: dict[str, mcaprl.Dataset], path: Path, seeds: int) -> None:
    """Run the missing trainings of SWAPS; write the table of the finished ones to the docs."""
    found: dict[str, list[float]] = json.loads(path.read_text()) if path.exists() else {}
    for (log, algo), trainings in SWAPS.items():
        for name, changes in trainings.items():
            key = f"{log}, {algo} | {name}"
            if key not in found:
                found[key] = swap(logs[log], algo, name, seeds, changes)
                print(key, np.round(found[key]), file=sys.stderr, flush=True)
                write_json(path, found)
    write_section("cartpole-swaps", swap_table(found))


def swap_table(found: dict[str, list[float]]) -> str:
    """Return a row for each training of SWAPS, as Markdown."""
    lines = ["| log, algorithm | training | mean return, 95 % interval | of each seed |"]
    lines.append("|---|---|---|---|")
    for key, values in found.items():
        each = " ".join(f"{value:.0f}" for value in sorted(values))
        lines.append(f"| {key} | {np.mean(values):.0f} ({mean_interval(values)}) | {each} |")
    return "\n".join(lines)


def mean_interval(values: list[float]) -> str:
    """Return the 95 % interval of the mean over seeds, by Student's t."""
    low, high = stats.t.interval(0.95, len(values) - 1, np.mean(values), stats.sem(values) or 1e-9)
    return f"{low:.0f} to {high:.0f}"


Found = dict[str, dict[str, list[float]]]
GATES: dict[str, Callable[[Found, dict[str, float]], bool]] = {
    "Double DQN reaches less than half of the behavior's return on medium and expert data": (
        lambda found, behavior: all(
            bool(np.mean(found[name]["double-dqn"]) < 0.5 * behavior[name]) for name in GOOD_LOGS
        )
    ),
    "CQL reaches .95 of the behavior's return on medium and expert data with each seed": (
        lambda found, behavior: all(
            min(found[name]["cql"]) >= 0.95 * behavior[name] for name in GOOD_LOGS
        )
    ),
    "CQL reaches 125 on random data": (
        lambda found, _: bool(np.mean(found["random"]["cql"]) >= 125)
    ),
    "CQL reaches 250 on mixed data": lambda found, _: bool(np.mean(found["mixed"]["cql"]) >= 250),
    "CQL reaches more than Double DQN on mixed data": (
        lambda found, _: bool(
            np.mean(found["mixed"]["cql"]) > np.mean(found["mixed"]["double-dqn"])
        )
    ),
}
"""Functions that return whether our results satisfy a condition, by its description."""


def verdict(gate: str, result: dict[str, Any]) -> str:
    """Return `holds` or `does not hold`; `not run` if the condition needs missing results."""
    try:
        return "holds" if GATES[gate](result["mcaprl"], result["behavior"]) else "does not hold"
    except KeyError:
        return "not run"


def main() -> None:
    """Run the missing trainings; print the results, and write them to the docs."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--only", default=",".join(ALGOS))
    parser.add_argument("--swaps", action="store_true", help="run SWAPS instead of the table")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    logs, path = make_logs(arguments.folder), arguments.folder / "grid.json"
    if arguments.swaps:
        run_swaps(logs, path.with_name("swaps.json"), arguments.seeds)
        return
    result: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    result["behavior"] = {name: data.statistics.mean_return for name, data in logs.items()}
    for side, algo, name in cells(arguments.only.split(",")):
        row = result.setdefault(side, {}).setdefault(name, {})
        if algo not in row:
            if side == "mcaprl":
                row[algo] = ours(logs[name], ALGORITHMS[algo], arguments.seeds)
            else:
                row[algo] = [theirs(logs[name], algo, seed) for seed in range(arguments.seeds)]
            print(side, name, algo, row[algo], file=sys.stderr, flush=True)
            write_json(path, result)
    print(text := summary(result))
    write_section("cartpole-grid", text)


def cells(algos: list[str]) -> list[tuple[str, str, str]]:
    """Return the library, algorithm and log of each training.

    mcaprl's trainings come first. Without d3rlpy, only mcaprl's trainings are returned.
    """
    wanted = sorted(algos, key=ALGOS.index)
    mine = [("mcaprl", algo, name) for algo in wanted for name in NAMES]
    if importlib.util.find_spec("d3rlpy") is None:
        return mine
    return mine + [("d3rlpy", algo, name) for algo in wanted if algo in RIVALS for name in NAMES]


def summary(result: dict[str, Any]) -> str:
    """Return the table, followed by the verdict on each condition in `GATES`."""
    return "\n".join([table(result), "", *(f"- {verdict(gate, result)}: {gate}" for gate in GATES)])


def table(result: dict[str, Any]) -> str:
    """Return a Markdown table: our mean, the range of our seeds, and d3rlpy's result.

    A cell for which mcaprl has no result contains a dash.
    """
    lines = [f"| data (behavior) | {' | '.join(ALGOS)} |", "|---|" + "---|" * len(ALGOS)]
    for name in NAMES:
        texts = []
        for algo in ALGOS:
            values = result["mcaprl"].get(name, {}).get(algo)
            rival = result.get("d3rlpy", {}).get(name, {}).get(algo)
            own = f"{np.mean(values):.0f} ({min(values):.0f}-{max(values):.0f})" if values else "-"
            texts.append(own + (f"; d3rlpy {rival[0]:.0f}" if rival else ""))
        lines.append(f"| {name} ({result['behavior'][name]:.0f}) | {' | '.join(texts)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()

"""Train the learners of Box actions and d3rlpy's on logs of Pendulum, and compare the returns.

    python -m benchmarks.studies.pendulum_grid FOLDER [--seeds 4] [--updates 20000] [--kinds mixed]

Each algorithm is trained with the published settings on both sides: two layers of 256, learning
rate 3e-4 without decay, batches of 256, gamma 0.99, target networks that follow by 0.5 %, and
normalized observations. The rows `ours` have the defaults of this package instead. A result is the
mean return of 20 episodes after the training; the table has the mean and the 95 % interval over the
seeds. Finished cells are in FOLDER/results.json, so an interrupted study continues.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import mcaprl
from benchmarks.studies.pendulum_data import BLENDS, pendulum, returns_of
from mcaprl.files import write_json

ALGORITHMS = ("bc", "td3-bc", "iql")
PUBLISHED: dict[str, Any] = {
    "learning_rate": 3e-4,
    "final_learning_rate_fraction": 1.0,
    "hidden": (256, 256),
    "normalize": True,
}
PUBLISHED_Q: dict[str, Any] = {"gamma": 0.99, "polyak": 0.005, "scale_rewards": False}
OWN: dict[str, dict[str, Any]] = {
    "bc": PUBLISHED,
    "td3-bc": PUBLISHED | PUBLISHED_Q,
    "iql": PUBLISHED | PUBLISHED_Q | {"normalize_advantages": False},
}
T = {2: 12.71, 3: 4.30, 4: 3.18, 5: 2.78, 6: 2.57, 8: 2.36}
"""Quantiles of Student's t for 95 % intervals of the mean, by the number of seeds."""
D3RLPY = {"bc": "BCConfig", "td3-bc": "TD3PlusBCConfig", "iql": "IQLConfig"}


def ours(data: mcaprl.Dataset, algo: str, seed: int, folder: Path, **settings: Any) -> Any:
    """Train with this package; return the policy."""
    shutil.rmtree(folder, ignore_errors=True)
    return mcaprl.train(data, folder, algo=algo, seed=seed, **settings).policy


def d3rlpys(data: mcaprl.Dataset, algo: str, seed: int, updates: int) -> Any:
    """Train with d3rlpy, whose other defaults are the published settings; return the policy."""
    import d3rlpy

    d3rlpy.seed(seed)
    log = d3rlpy.dataset.MDPDataset(
        data.observations,
        data.actions,
        data.rewards.astype(np.float32),
        data.terminated.astype(np.float32),
        data.truncated.astype(np.float32),
        action_space=d3rlpy.ActionSpace.CONTINUOUS,
    )
    encoder = d3rlpy.models.VectorEncoderFactory([256, 256])
    names = ["encoder"] if algo == "bc" else ["actor_encoder", "critic_encoder"]
    rates = ["learning_rate"] if algo == "bc" else ["actor_learning_rate", "critic_learning_rate"]
    settings: dict[str, Any] = {f"{name}_factory": encoder for name in names}
    settings |= dict.fromkeys(rates, 3e-4) | {"batch_size": 256}
    learner = getattr(d3rlpy.algos, D3RLPY[algo])(
        observation_scaler=d3rlpy.preprocessing.StandardObservationScaler(),
        action_scaler=d3rlpy.preprocessing.MinMaxActionScaler(minimum=[-2.0], maximum=[2.0]),
        **settings,
    ).create("cpu")
    learner.fit(
        log,
        n_steps=updates,
        n_steps_per_epoch=updates,
        show_progress=False,
        save_interval=10,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
    )

    class Policy:
        def act(self, observations: Any) -> Any:
            return learner.predict(observations)

    return Policy()


def main() -> None:
    """Train all cells that have no result yet, and print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--updates", type=int, default=20_000)
    parser.add_argument("--kinds", nargs="+", choices=BLENDS, default=["mixed"])
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.folder.mkdir(parents=True, exist_ok=True)
    results = given.folder / "results.json"
    found: dict[str, float] = json.loads(results.read_text()) if results.exists() else {}
    for kind in given.kinds:
        data = pendulum(kind)
        for seed in range(given.seeds):
            for name, train in cells(data, seed, given.folder / "run", given.updates).items():
                key = f"{kind}, {name}, seed {seed}, {given.updates} updates"
                if key not in found:
                    found[key] = float(np.mean(returns_of(train())))
                    print(f"{key}: {found[key]:.1f}", flush=True)
                    write_json(results, found)
        print(as_table(kind, found, given.seeds, given.updates))


def cells(
    data: mcaprl.Dataset, seed: int, folder: Path, updates: int
) -> dict[str, Callable[[], Any]]:
    """Return the trainings of one seed by name."""
    trainings: dict[str, Callable[[], Any]] = {}
    for algo in ALGORITHMS:
        settings = OWN[algo] | {"updates": updates}
        trainings[f"{algo}, published"] = lambda algo=algo, settings=settings: ours(
            data, algo, seed, folder, **settings
        )
        trainings[f"{algo}, d3rlpy"] = lambda algo=algo: d3rlpys(data, algo, seed, updates)
    for algo in (*ALGORITHMS, "rebrac"):
        trainings[f"{algo}, ours"] = lambda algo=algo: ours(data, algo, seed, folder)
    return trainings


def as_table(kind: str, found: dict[str, float], seeds: int, updates: int) -> str:
    """Return the table of one log as Markdown."""
    lines = [
        f"| {kind} log | ours, published settings | d3rlpy | ours, defaults |",
        "|---|---|---|---|",
    ]
    for algo in (*ALGORITHMS, "rebrac"):
        row = [algo]
        for side in ("published", "d3rlpy", "ours"):
            keys = [f"{kind}, {algo}, {side}, seed {k}, {updates} updates" for k in range(seeds)]
            values = np.array([found[key] for key in keys if key in found])
            if not len(values):
                row.append("")
                continue
            spread = values.std(ddof=1) if len(values) > 1 else np.nan
            half = T.get(len(values), 2.0) * spread / np.sqrt(len(values))
            row.append(f"{values.mean():.0f} +- {half:.0f}")
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()

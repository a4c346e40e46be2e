"""Train five algorithms on six logs of each sim, with four seeds.

    python -m benchmarks.sim_grid FOLDER [--sims lane,racer] [--data weak] [--algos 'cql;bc']

The logs are those of `sim_data`. The settings below are the same for all logs of a sim. The
networks after the last update are scored, without selection by scores in the sim. A score is the
mean return over 30 episodes of each seed, normalized so that random is 0 and the pilot is 1, with a
95 % bootstrap interval over seeds and episodes. FOLDER/SIM/scores.json has each finished cell, so
an interrupted run resumes. At the end, the tables are written to docs/results.md, with a dash for
each missing cell.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import torch

import mcaprl
from benchmarks.page import write_section
from benchmarks.sim_data import NAMES, make_logs
from mcaprl.api import load_policies
from mcaprl.files import write_json
from mcaprl.offline import ALGORITHMS, BootstrapConfig, DQNConfig, TrainingConfig, train
from mcaprl.sims import Policy, PolicyScore, evaluate, make_pilot, make_sim, make_sims, normalize

SEEDS, EPISODES, EPISODE_SEED = 4, 30, 1_000_000
ALGOS: dict[str, tuple[str, dict[str, Any]]] = {
    "cql": ("cql", {}),
    "cql, alpha .1": ("cql", {"alpha": 0.1}),
    "bc": ("bc", {}),
    "double-dqn": ("double-dqn", {}),
    "bcq": ("bcq", {}),
    "iql": ("iql", {}),
}
"""Algorithm and settings, by column; CQL has a penalty weight of 1, its default, or of 0.1."""
SHARED: dict[str, Any] = {"updates": 4_000, "batch_size": 128}
TARGET_INTERVAL = 150
"""Updates between two target syncs; the default has too few syncs for the effective horizon."""
SETTINGS: dict[str, dict[str, Any]] = {
    "lane": {"gamma": 0.97},
    "powerline": {"gamma": 0.95, "n_steps": 3, "learning_rate": 3e-4},
    "racer": {"gamma": 0.98, "n_steps": 3},
}
"""Settings of each sim; behavior cloning uses only the learning rate."""
Cell = dict[str, Any]


def main() -> None:
    """Compute the requested missing cells, and write the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sims", default=",".join(SETTINGS))
    parser.add_argument("--data", default=",".join(NAMES))
    parser.add_argument("--algos", default=";".join(ALGOS))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for sim in arguments.sims.split(","):
        folder = arguments.folder / sim
        paths = make_logs(folder, sim)
        wanted = [
            (name, algo)
            for algo in arguments.algos.split(";")
            for name in arguments.data.split(",")
        ]
        _fill(folder, sim, paths, wanted)
        found = {sim: _read(arguments.folder / sim) for sim in SETTINGS}
        write_section("sim-grid", "\n".join(table(sim, found[sim]) for sim in SETTINGS))


def _fill(
    folder: Path, sim: str, paths: dict[str, Path], wanted: Sequence[tuple[str, str]]
) -> None:
    """Compute the missing cells."""
    with closing(make_sim(sim)) as env:
        random = run(sim, [None])
        pilot = run(sim, [make_pilot(env)], env)
    for name, algo in wanted:
        cells = _read(folder)
        row = cells.setdefault(name, {})
        if algo in row:
            continue
        data = mcaprl.open(paths[name])
        behavior = normalize_mean(data.statistics.mean_return, random, pilot)
        row["behavior"] = {"score": behavior, "transitions": len(data)}
        row[algo] = learn(sim, data, algo, folder / "run", random, pilot)
        print(sim, name, f"behavior {behavior:.2f}", algo, row[algo], flush=True)
        write_json(folder / "scores.json", cells)


def learn(
    sim: str, data: mcaprl.Dataset, algo: str, out: Path, random: PolicyScore, pilot: PolicyScore
) -> Cell:
    """Train all seeds on a log and score them."""
    shutil.rmtree(out, ignore_errors=True)
    train(data, settings_of(sim, *ALGOS[algo]), out, seeds=SEEDS, progress=lambda _: None)
    score = normalize(run(sim, list(load_policies(out))), random, pilot)
    assert score.normalized_score is not None
    assert score.normalized_interval is not None
    return {
        "score": score.normalized_score,
        "interval": list(score.normalized_interval),
        "seeds": [
            normalize_mean(float(mean), random, pilot) for mean in score.returns.mean(axis=1)
        ],
        "ends": score.ends,
    }


def settings_of(sim: str, algo: str, special: dict[str, Any]) -> TrainingConfig:
    """Return the settings of an algorithm for a sim; `special` overrides the shared settings."""
    config_type = ALGORITHMS[algo].config_type
    given = {**SHARED, **SETTINGS[sim], **special}
    if issubclass(config_type, DQNConfig):
        given["target_interval"] = TARGET_INTERVAL
    if not issubclass(config_type, BootstrapConfig):
        given = {name: value for name, value in given.items() if name not in ("gamma", "n_steps")}
    return config_type(**given)


def run(sim: str, policies: Sequence[Policy | None], env: Any = None) -> PolicyScore:
    """Run the same episodes for each policy.

    They run one by one in `env`, or in a batch if `env` is None.
    """
    with closing(make_sim(sim)) as own, closing(make_sims(sim, EPISODES)) as envs:
        return evaluate(
            env or own,
            policies,
            name="",
            episodes=EPISODES,
            seed=EPISODE_SEED,
            envs=None if env else envs,
        )


def normalize_mean(mean_return: float, random: PolicyScore, pilot: PolicyScore) -> float:
    """Return a mean return normalized so that random is 0 and the pilot 1."""
    return (mean_return - random.mean_return) / (pilot.mean_return - random.mean_return)


def table(sim: str, cells: dict[str, dict[str, Cell]]) -> str:
    """Return the table as Markdown: each cell has the mean score and its interval."""
    lines = [f"**{sim}**", "", f"| log (behavior) | {' | '.join(ALGOS)} |"]
    lines.append("|---|" + "---|" * len(ALGOS))
    for name in NAMES:
        row = cells.get(name, {})
        behavior = f" ({row['behavior']['score']:.2f})" if row else ""
        texts = [_text(row.get(algo)) for algo in ALGOS]
        lines.append(f"| {name}{behavior} | {' | '.join(texts)} |")
    return "\n".join([*lines, ""])


def _text(cell: Cell | None) -> str:
    if cell is None:
        return "-"
    low, high = cell["interval"]
    return f"{cell['score']:.2f} ({low:.2f} to {high:.2f})"


def _read(folder: Path) -> dict[str, dict[str, Cell]]:
    path = folder / "scores.json"
    found: dict[str, dict[str, Cell]] = json.loads(path.read_text()) if path.exists() else {}
    return found


if __name__ == "__main__":
    main()

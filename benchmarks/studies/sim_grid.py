"""Train five algorithms on six logs of each sim, CQL and IQL in two ways, with four seeds.

    python -m benchmarks.studies.sim_grid FOLDER [--sims lane,racer] [--data weak] [--algos cql]

The logs are those of `sim_data`. The settings below are the same for all logs of a sim. The
networks after the last update are scored, without selection by scores in the sim. A score is the
mean return over 30 episodes of each seed, normalized so that random is 0 and the pilot is 1, with a
95 % bootstrap interval over seeds and episodes. FOLDER/SIM/scores.json has each finished cell, so
an interrupted run resumes. After each sim, the tables are written to docs/results.md, with a dash
for each missing cell.

    python -m benchmarks.studies.sim_grid FOLDER --study [--sims lane,racer] [--data weak]

compares settings instead of algorithms, on the same logs and with the same seeds: the columns of
STUDY. All of them are trained with the smaller networks and batches of SMALL, so the scores can be
compared with one another, but not with those of the grid. The results are in
FOLDER/SIM/study.json. The last rows are the mean over the logs, and the mean
difference from the first column of the same algorithm, with a 95 % bootstrap interval over the logs
on which both have been run.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch

import mcaprl
from benchmarks.page import write_section
from benchmarks.studies.sim_data import NAMES, WRONG, log_names, make_logs, pilot_of
from mcaprl.api import load_policies
from mcaprl.files import write_json
from mcaprl.offline import ALGORITHMS, BootstrapConfig, DQNConfig, TrainingConfig, train
from mcaprl.sims import Policy, PolicyScore, evaluate, make_sim, make_sims, normalize

Special = dict[str, Any] | Callable[[mcaprl.Dataset], dict[str, Any]]
SEEDS, EPISODES, EPISODE_SEED = 4, 30, 1_000_000
PLAIN_CQL: dict[str, Any] = {"scale_rewards": False}
PLAIN_IQL: dict[str, Any] = {"normalize_advantages": False, "beta": 3.0}
NORMALIZED_IQL: dict[str, Any] = {"normalize_advantages": True, "beta": 0.5}
ALGOS: dict[str, tuple[str, Special]] = {
    "cql": ("cql", PLAIN_CQL),
    "cql, alpha .1": ("cql", {**PLAIN_CQL, "alpha": 0.1}),
    "bc": ("bc", {}),
    "double-dqn": ("double-dqn", {}),
    "bcq": ("bcq", {}),
    "iql": ("iql", PLAIN_IQL),
    "iql, normalized, beta .5": ("iql", NORMALIZED_IQL),
}
"""Algorithm and settings, by column; without normalization if its name does not say so."""


def above_entropy(data: mcaprl.Dataset) -> dict[str, Any]:
    """Return settings of CQL with a target gap of 0.2 nats above that of a perfect clone.

    The gap of a clone is the entropy of the behavior, so the target bounds the divergence of the
    softmax of Q from the behavior.
    """
    entropy = -float(np.log(data.behavior_probs.astype(np.float64)).mean())
    return {"target_gap": entropy + 0.2, "scale_rewards": True}


STUDY: dict[str, tuple[str, Special]] = {
    "cql": ("cql", PLAIN_CQL),
    "cql, scaled": ("cql", {"scale_rewards": True}),
    "cql, gap 1, scaled": ("cql", {"target_gap": 1.0, "scale_rewards": True}),
    "cql, gap of a clone + .2, scaled": ("cql", above_entropy),
    "iql": ("iql", PLAIN_IQL),
    "iql, normalized, beta .5": ("iql", NORMALIZED_IQL),
}
"""Columns of the comparison of settings; the first one of each algorithm has no normalization."""
SHARED: dict[str, Any] = {"updates": 4_000, "batch_size": 128}
SMALL: dict[str, Any] = {"batch_size": 64, "hidden": (128, 128)}
"""Settings that differ from SHARED in the studies of settings and of selection."""
TARGET_INTERVAL = 150
"""Updates between two target syncs; the default has too few syncs for the effective horizon."""
SETTINGS: dict[str, dict[str, Any]] = {
    "lane": {"gamma": 0.97},
    "powerline": {"gamma": 0.95, "n_steps": 3, "learning_rate": 3e-4},
    "racer": {"gamma": 0.98, "n_steps": 3},
    "CartPole-v1": {"gamma": 0.99},
    "Acrobot-v1": {"gamma": 0.99},
}
"""Settings of each sim; behavior cloning uses only the learning rate."""
SIMS = tuple(WRONG)
"""Sims of the tables."""
Cell = dict[str, Any]


def main() -> None:
    """Compute the requested missing cells, and write the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sims", default=",".join(SIMS))
    parser.add_argument("--data", default=",".join(NAMES))
    parser.add_argument("--study", action="store_true")
    parser.add_argument("--algos", help="columns, separated by semicolons; default: all")
    arguments = parser.parse_args()
    columns = STUDY if arguments.study else ALGOS
    torch.set_num_threads(1)
    for sim in arguments.sims.split(","):
        folder = arguments.folder / sim
        paths = make_logs(folder, sim)
        wanted = [
            (name, algo)
            for algo in (arguments.algos.split(";") if arguments.algos else columns)
            for name in arguments.data.split(",")
            if name in log_names(sim)
        ]
        name = "study.json" if arguments.study else "scores.json"
        _fill(folder / name, sim, paths, wanted, SMALL if arguments.study else {})
        found = {sim: read_cells(arguments.folder / sim / name) for sim in SIMS}
        if arguments.study:
            print(text := study_table(found))
            write_section("sim-settings", text)
        else:
            write_section("sim-grid", "\n".join(table(sim, found[sim]) for sim in SIMS))


def _fill(
    results: Path,
    sim: str,
    paths: dict[str, Path],
    wanted: Sequence[tuple[str, str]],
    shared: dict[str, Any],
) -> None:
    """Compute the missing cells of the file `results`; `shared` overrides values of SHARED."""
    folder = results.parent
    with closing(make_sim(sim)) as env:
        random = run(sim, [None])
        pilot = run(sim, [pilot_of(sim, folder, env)], env)
    for name, algo in wanted:
        cells = read_cells(results)
        row = cells.setdefault(name, {})
        if algo in row:
            continue
        data = mcaprl.open(paths[name])
        behavior = normalize_mean(data.statistics.mean_return, random, pilot)
        row["behavior"] = {"score": behavior, "transitions": len(data)}
        row[algo] = learn(sim, data, algo, shared, folder / "run", random, pilot)
        print(sim, name, f"behavior {behavior:.2f}", algo, row[algo], flush=True)
        write_json(results, cells)


def learn(
    sim: str,
    data: mcaprl.Dataset,
    algo: str,
    shared: dict[str, Any],
    out: Path,
    random: PolicyScore,
    pilot: PolicyScore,
) -> Cell:
    """Train all seeds on a log and score them."""
    shutil.rmtree(out, ignore_errors=True)
    name, special = {**ALGOS, **STUDY}[algo]
    special = special(data) if callable(special) else special
    settings = settings_of(sim, name, {**shared, **special})
    train(data, settings, out, seeds=SEEDS, progress=lambda _: None)
    return cell_of(run(sim, list(load_policies(out))), random, pilot)


def cell_of(found: PolicyScore, random: PolicyScore, pilot: PolicyScore) -> Cell:
    """Return the normalized score of all seeds, and those of each."""
    score = normalize(found, random, pilot)
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


def run(
    sim: str, policies: Sequence[Policy | None], env: Any = None, **options: Any
) -> PolicyScore:
    """Run the same episodes of a sim with these arguments for each policy.

    They run one by one in `env`, or in a batch if `env` is None.
    """
    with (
        closing(make_sim(sim, **options)) as own,
        closing(make_sims(sim, EPISODES, **options)) as envs,
    ):
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


def table(
    sim: str,
    cells: dict[str, dict[str, Cell]],
    names: Sequence[str] = NAMES,
    columns: Collection[str] = ALGOS,
) -> str:
    """Return the table as Markdown: each cell has the mean score and its interval."""
    lines = [f"**{sim}**", "", f"| log (behavior) | {' | '.join(columns)} |"]
    lines.append("|---|" + "---|" * len(columns))
    for name in names:
        row = cells.get(name, {})
        behavior = f" ({row['behavior']['score']:.2f})" if row else ""
        texts = [_text(row.get(column)) for column in columns]
        lines.append(f"| {name}{behavior} | {' | '.join(texts)} |")
    return "\n".join([*lines, ""])


def study_table(cells: dict[str, dict[str, dict[str, Cell]]]) -> str:
    """Return the comparison of settings as Markdown: one row for each log, and two summaries."""
    lines = [f"| log (behavior) | {' | '.join(STUDY)} |", "|---|" + "---|" * len(STUDY)]
    scores: dict[str, list[float]] = {column: [] for column in STUDY}
    for sim, of_sim in cells.items():
        for name in log_names(sim):
            row = of_sim.get(name, {})
            behavior = f" ({row['behavior']['score']:.2f})" if row else ""
            texts = [_text(row.get(column)) for column in STUDY]
            lines.append(f"| {sim} {name}{behavior} | {' | '.join(texts)} |")
            for column, found in scores.items():
                found.append(row[column]["score"] if column in row else np.nan)
    means, differences = [], []
    for column, (algo, _) in STUDY.items():
        first = next(name for name, (other, _) in STUDY.items() if other == algo)
        mine = np.array(scores[column])
        change = mine - np.array(scores[first])
        means.append(_interval_text(mine[~np.isnan(mine)]))
        kept = change[~np.isnan(change)]
        differences.append("" if column == first else _interval_text(kept))
    lines.append(f"| mean | {' | '.join(means)} |")
    lines.append(f"| minus the first column | {' | '.join(differences)} |")
    return "\n".join(lines)


def _interval_text(values: Any) -> str:
    """Return a mean with its 95 % bootstrap interval and the number of values."""
    if not len(values):
        return "-"
    draws = np.random.default_rng(0).choice(values, (1_000, len(values))).mean(1)
    low, high = np.percentile(draws, [2.5, 97.5])
    return f"{values.mean():.2f} ({low:.2f} to {high:.2f}; n = {len(values)})"


def _text(cell: Cell | None) -> str:
    if cell is None:
        return "-"
    low, high = cell["interval"]
    return f"{cell['score']:.2f} ({low:.2f} to {high:.2f})"


def read_cells(path: Path) -> dict[str, dict[str, Cell]]:
    """Return the finished cells, by log and column."""
    found: dict[str, dict[str, Cell]] = json.loads(path.read_text()) if path.exists() else {}
    return found


if __name__ == "__main__":
    main()

"""Measure how well the best offline policy can be chosen from a log alone.

    python -m benchmarks.selection FOLDER [--sims lane,racer] [--data weak,expert] [--seeds 4]

The candidates are algorithms of offline learning. On each log of `sim_data`, each candidate is
trained with the settings of `sim_grid`. Its true score is measured in the sim. Other scores are
computed from the log: FQE with and without pessimism, the policy's own values, its Bellman error
and its support in the log. FOLDER/SIM has one JSON file for each finished log, so an interrupted
run resumes.

A rule chooses one candidate by the scores from the log. The regret of a rule is the true score of
the best candidate minus that of the chosen candidate; both scores are means over seeds. The table
has the mean and the largest regret of each rule over the finished logs.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

import mcaprl
from benchmarks.sim_data import NAMES, make_logs
from benchmarks.sim_grid import SETTINGS, normalize_mean, run, settings_of
from mcaprl.api import load_policies
from mcaprl.files import write_json
from mcaprl.offline import EvidenceCollector, fqe_config, train
from mcaprl.sims import make_pilot, make_sim

CANDIDATES: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "cql": ("cql", {}),
    "cql, scaled": ("cql", {"scale_rewards": True}),
    "cql, alpha .1": ("cql", {"alpha": 0.1}),
    "bc": ("bc", {}),
    "double-dqn": ("double-dqn", {}),
    "bcq": ("bcq", {}),
    "iql, beta .3": ("iql", {"normalize_advantages": True, "beta": 0.3}),
    "iql, beta 1": ("iql", {"normalize_advantages": True, "beta": 1.0}),
}
MODEL_UPDATES: Final = 2_000
Row = dict[str, Any]


def collect(sim: str, log: Path, out: Path, seeds: int) -> list[Row]:
    """Train all candidates on a log; return a row for each seed, with its score and evidence."""
    with closing(make_sim(sim)) as env:
        random, pilot = run(sim, [None]), run(sim, [make_pilot(env)], env)
    data = mcaprl.open(log)
    rows: list[Row] = []
    policies: list[Any] = []
    for name, (algo, special) in CANDIDATES.items():
        shutil.rmtree(out, ignore_errors=True)
        config = settings_of(sim, algo, special)
        train(data, config, out, seeds=seeds, progress=lambda _: None)
        mine = load_policies(out)
        returns = run(sim, mine).returns.mean(axis=1)
        for seed, mean in enumerate(returns):
            score = normalize_mean(float(mean), random, pilot)
            rows.append({"candidate": name, "seed": seed, "score": score})
        policies += mine
    clone = policies[[row["candidate"] for row in rows].index("bc")]
    model = fqe_config(SETTINGS[sim]["gamma"], MODEL_UPDATES)
    for kind, pessimistic in (("pessimistic", True), ("plain", False)):
        found = EvidenceCollector(data, clone, model, pessimistic=pessimistic).collect(policies)
        for row, evidence in zip(rows, found, strict=True):
            row[kind] = evidence.to_json()
    return rows


def means(rows: list[Row], value: Callable[[Row], float | None]) -> dict[str, float]:
    """Return the mean of a value over the seeds, for each candidate that has this value."""
    found: dict[str, list[float]] = {}
    for row in rows:
        if (one := value(row)) is not None:
            found.setdefault(row["candidate"], []).append(one)
    return {name: float(np.mean(values)) for name, values in found.items()}


def rules() -> dict[str, Callable[[list[Row]], str]]:
    """Return the rules: functions that choose a candidate by the rows of a log."""

    def highest(value: Callable[[Row], float | None]) -> Callable[[list[Row]], str]:
        def choose(rows: list[Row]) -> str:
            values = means(rows, value)
            return max(values, key=values.__getitem__)

        return choose

    def always(name: str) -> Callable[[list[Row]], str]:
        return lambda rows: name

    return {
        **{f"always {name}": always(name) for name in CANDIDATES},
        "largest own Q": highest(lambda row: row["plain"]["own_value"]),
        "smallest Bellman error": highest(
            lambda row: (error := row["plain"]["bellman_error"]) and -error
        ),
        "FQE, first states": highest(lambda row: row["plain"]["first_value"]),
        "FQE, all states": highest(lambda row: row["plain"]["mean_value"]),
        "pessimistic FQE, first states": highest(lambda row: row["pessimistic"]["first_value"]),
        "pessimistic FQE, all states": highest(lambda row: row["pessimistic"]["mean_value"]),
    }


def show(folder: Path) -> None:
    """Print the regret of each rule over all finished logs."""
    logs = [json.loads(path.read_text()) for path in sorted(folder.glob("*/selection-*.json"))]
    print(f"{len(logs)} logs")
    for rule, choose in rules().items():
        regrets = []
        for rows in logs:
            scores = means(rows, lambda row: row["score"])
            regrets.append(max(scores.values()) - scores[choose(rows)])
        print(f"| {rule} | {np.mean(regrets):.3f} | {np.max(regrets):.2f} |")


def main() -> None:
    """Collect the missing logs, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sims", default=",".join(SETTINGS))
    parser.add_argument("--data", default=",".join(NAMES))
    parser.add_argument("--seeds", type=int, default=4)
    given = parser.parse_args()
    torch.set_num_threads(1)
    for sim in given.sims.split(","):
        folder = given.folder / sim
        paths = make_logs(folder, sim)
        for name in given.data.split(","):
            result = folder / f"selection-{name}.json"
            if not result.exists():
                rows = collect(sim, paths[name], folder / f"run-{name}", given.seeds)
                write_json(result, rows)
                print(sim, name, means(rows, lambda row: row["score"]), flush=True)
    show(given.folder)


if __name__ == "__main__":
    main()

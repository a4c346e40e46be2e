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
import functools
import json
import shutil
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

import mcaprl
from benchmarks.sim_data import make_logs
from benchmarks.sim_grid import SETTINGS, normalize_mean, run, settings_of
from mcaprl.api import load_policies
from mcaprl.files import write_json
from mcaprl.offline import EvidenceCollector, fqe_config, train
from mcaprl.progress import TrainingProgress
from mcaprl.sims import PolicyScore, make_pilot, make_sim

CANDIDATES: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "cql": ("cql", {}),
    "cql, scaled": ("cql", {"scale_rewards": True}),
    "cql, alpha .1": ("cql", {"alpha": 0.1}),
    "bc": ("bc", {}),
    "double-dqn": ("double-dqn", {}),
    "bcq": ("bcq", {}),
    "iql": ("iql", {"normalize_advantages": True, "beta": 0.3}),
}
SMALL: Final = {"batch_size": 64, "hidden": (128, 128)}
"""Settings that differ from those of `sim_grid`, so that a log takes minutes."""

SHORT, MODEL_UPDATES, SHORT_MODEL_UPDATES = 1_000, 1_000, 500
"""Updates of the short training, of FQE, and of FQE after the short training."""
ORDER: Final = ("expert", "weak", "mixed", "replay", "medium", "random")
Row = dict[str, Any]


def learn(sim: str, data: mcaprl.Dataset, name: str, out: Path, seeds: int) -> None:
    """Train a candidate into `out`, and copy its policies after `SHORT` updates to `out`/short."""
    part = out.with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)

    def keep_short(now: TrainingProgress) -> None:
        if now.done == SHORT:
            names = shutil.ignore_patterns("events*", "checkpoint*", "metrics*")
            folder = f"seed-{now.seed}"
            shutil.copytree(part / folder, part / "short" / folder, ignore=names)

    config = replace(settings_of(sim, *CANDIDATES[name]), **SMALL)
    train(data, config, part, seeds=seeds, progress=keep_short)
    part.rename(out)


def score(sim: str, policies: list[Any]) -> list[float]:
    """Return the score of each policy in the sim."""
    random, pilot = _references(sim)
    returns = run(sim, policies).returns.mean(axis=1)
    return [normalize_mean(float(mean), random, pilot) for mean in returns]


@functools.cache
def _references(sim: str) -> tuple[PolicyScore, PolicyScore]:
    """Return the scores of the random policy and of the pilot, which are 0 and 1 by definition."""
    with closing(make_sim(sim)) as env:
        return run(sim, [None]), run(sim, [make_pilot(env)], env)


def collect(sim: str, log: Path, out: Path, names: list[str]) -> list[Row]:
    """Return a row of evidence for each seed of trained candidates, short and full."""
    data = mcaprl.open(log)
    rows: list[Row] = []
    policies: list[Any] = []
    for name in names:
        for kind, folder in (("short", out / name / "short"), ("full", out / name)):
            mine = load_policies(folder)
            rows += [{"candidate": name, "seed": k, "kind": kind} for k in range(len(mine))]
            policies += mine
    clone = load_policies(out / "bc")[0]
    for label, kind, pessimistic, updates in (
        ("pessimistic", "full", True, MODEL_UPDATES),
        ("plain", "full", False, MODEL_UPDATES),
        ("pessimistic", "short", True, SHORT_MODEL_UPDATES),
    ):
        model = replace(fqe_config(SETTINGS[sim]["gamma"], updates), batch_size=64)
        which = [
            k
            for k, row in enumerate(rows)
            if row["kind"] == kind and (pessimistic or row["seed"] == 0)
        ]
        collector = EvidenceCollector(data, clone, model, pessimistic=pessimistic)
        found = collector.collect([policies[k] for k in which])
        for k, evidence in zip(which, found, strict=True):
            rows[k][label] = evidence.to_json()
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
    parser.add_argument("--data", default=",".join(ORDER))
    parser.add_argument("--algos", default=";".join(CANDIDATES))
    parser.add_argument("--seeds", type=int, default=4)
    given = parser.parse_args()
    torch.set_num_threads(1)
    for name in given.data.split(","):
        for sim in given.sims.split(","):
            _fill(given.folder / sim, sim, name, given.algos.split(";"), given.seeds)
    show(given.folder)


def _fill(folder: Path, sim: str, name: str, candidates: list[str], seeds: int) -> None:
    """Train and score the missing candidates on a log, and collect the evidence."""
    log = make_logs(folder, sim)[name]
    path, result = folder / f"scores-{name}.json", folder / f"evidence-{name}.json"
    scores: dict[str, list[float]] = json.loads(path.read_text()) if path.exists() else {}
    rows: list[Row] = json.loads(result.read_text()) if result.exists() else []
    data = mcaprl.open(log)
    for candidate in candidates:
        out = folder / name / candidate
        if not out.exists():
            out.parent.mkdir(exist_ok=True)
            learn(sim, data, candidate, out, seeds)
        if candidate not in scores:
            scores[candidate] = score(sim, load_policies(out))
            write_json(path, scores)
            print(sim, name, candidate, scores[candidate], flush=True)
    known = {row["candidate"] for row in rows}
    if missing := [candidate for candidate in candidates if candidate not in known]:
        write_json(result, rows + collect(sim, log, folder / name, missing))
        print(sim, name, "evidence", flush=True)


if __name__ == "__main__":
    main()

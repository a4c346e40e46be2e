"""Measure how well the best offline policy can be chosen from a log alone.

    python -m benchmarks.selection FOLDER [--sims lane,racer] [--data weak,expert] [--seeds 2]

The candidates are algorithms of offline learning. On each log of `sim_data`, each candidate is
trained with the settings of `sim_grid`. Its true score is measured in the sim. Other scores are
computed from the log: FQE with and without pessimism, the policy's own values, its Bellman error
and its support in the log. FOLDER/SIM has the policies and two JSON files for each log, so an
interrupted run resumes.

A rule chooses one candidate by the scores from the log. The regret of a rule is the true score of
the best candidate minus that of the chosen candidate; both scores are means over seeds. The table
has the mean regret of each rule over the finished logs, with a 95 % bootstrap interval over logs,
and the largest regret. In the last row, a rule is never chosen by the logs on which its regret is
computed: on the logs of each sim, the row uses the rule with the smallest mean regret on the logs
of the other sims.
"""

from __future__ import annotations

import argparse
import functools
import json
import shutil
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from gymnasium.spaces import Discrete

import mcaprl
from benchmarks.sim_data import make_logs
from benchmarks.sim_grid import SETTINGS, normalize_mean, run, settings_of
from mcaprl.api import load_policies
from mcaprl.files import write_json
from mcaprl.offline import DETERMINISTIC, EvidenceCollector, fqe_config, train
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
    """Evaluate the random policy and the pilot, whose normalized scores are 0 and 1."""
    with closing(make_sim(sim)) as env:
        return run(sim, [None]), run(sim, [make_pilot(env)], env)


def collect(sim: str, log: Path, out: Path, names: list[str]) -> list[Row]:
    """Return one row of evidence per candidate, seed, and length of training (short or full)."""
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


@dataclass(frozen=True)
class Log:
    """Finished log.

    Attributes:
        sim: Name of its sim.
        name: Name of the log.
        entropy: Entropy of the behavior, from 0 to 1, computed from the logged probabilities.
        scores: Mean true score of each candidate.
        rows: Evidence for each candidate and seed.
    """

    sim: str
    name: str
    entropy: float
    scores: dict[str, float]
    rows: list[Row]

    def means(self, label: str, field: str, kind: str = "full") -> dict[str, float]:
        """Return the mean of a number over the seeds, for each candidate that has it."""
        found: dict[str, list[float]] = {}
        for row in self.rows:
            if row["kind"] == kind and (value := row.get(label, {}).get(field)) is not None:
                found.setdefault(row["candidate"], []).append(value)
        return {name: float(np.mean(values)) for name, values in found.items()}

    def regret(self, rule: Rule) -> float:
        """Return the regret of a rule."""
        return max(self.scores.values()) - self.scores[rule(self)]


Rule = Callable[[Log], str]


def largest(values: dict[str, float]) -> str:
    """Return the name with the largest value."""
    return max(values, key=values.__getitem__)


def auto(log: Log, threshold: float = DETERMINISTIC, survivors: int | None = None) -> str:
    """Return the candidate that `auto` chooses.

    Below the entropy `threshold`, this is the candidate with the largest agreement, otherwise the
    candidate with the largest value by pessimistic FQE.
    """
    field = "agreement" if log.entropy < threshold else "first_value"
    values = log.means("pessimistic", field)
    if survivors is not None:
        short = log.means("pessimistic", field, "short")
        kept = sorted(short, key=short.__getitem__)[-survivors:]
        values = {name: values[name] for name in kept}
    return largest(values)


def rules(candidates: Iterable[str]) -> dict[str, Rule]:
    """Return the rules: functions that choose a candidate on a log."""

    def highest(label: str, field: str) -> Rule:
        return lambda log: largest(log.means(label, field))

    def always(name: str) -> Rule:
        return lambda log: name

    return {
        **{f"always {name}": always(name) for name in candidates},
        "largest own Q": highest("pessimistic", "own_value"),
        "smallest Bellman error": lambda log: largest(
            {name: -error for name, error in log.means("pessimistic", "bellman_error").items()}
        ),
        "FQE, first states": highest("plain", "first_value"),
        "FQE, all states": highest("plain", "mean_value"),
        "pessimistic FQE, first states": highest("pessimistic", "first_value"),
        "pessimistic FQE, all states": highest("pessimistic", "mean_value"),
        "agreement with the behavior": highest("pessimistic", "agreement"),
        **{f"auto, entropy below {t}": partial(auto, threshold=t) for t in (0.02, 0.05, 0.1, 0.2)},
        "auto, 3 survivors": partial(auto, survivors=3),
        "auto, 4 survivors": partial(auto, survivors=4),
    }


def read_logs(folder: Path) -> list[Log]:
    """Return all finished logs, with only the candidates that have evidence on every log."""
    found = []
    for path in sorted(folder.glob("*/evidence-*.json")):
        name, sim = path.stem.removeprefix("evidence-"), path.parent.name
        data = mcaprl.open(path.with_name(f"{name}.mcap"))
        assert isinstance(data.action_space, Discrete)
        nats = -np.log(data.behavior_probs.astype(np.float64)).mean()
        scores = json.loads(path.with_name(f"scores-{name}.json").read_text())
        means = {candidate: float(np.mean(values)) for candidate, values in scores.items()}
        rows = json.loads(path.read_text())
        found.append(Log(sim, name, float(nats / np.log(data.action_space.n)), means, rows))
    common = set.intersection(*({row["candidate"] for row in log.rows} for log in found))
    return [
        replace(
            log,
            scores={name: log.scores[name] for name in CANDIDATES if name in common},
            rows=[row for row in log.rows if row["candidate"] in common],
        )
        for log in found
    ]


def show(folder: Path) -> None:
    """Print the regret of each rule over all finished logs."""
    logs = read_logs(folder)
    names = [f"{log.sim} {log.name}" for log in logs]
    print(f"{len(logs)} logs: {', '.join(names)}; candidates: {', '.join(logs[0].scores)}")
    table = rules(logs[0].scores)
    regrets = {name: np.array([log.regret(rule) for log in logs]) for name, rule in table.items()}
    fair = np.zeros(len(logs))
    for sim in {log.sim for log in logs}:
        mine = np.array([log.sim == sim for log in logs])
        if not mine.all():
            best = min(regrets, key=lambda name: regrets[name][~mine].mean())
            fair[mine] = regrets[best][mine]
            print(f"the best rule on the other sims than {sim}: {best}")
    random = np.random.default_rng(0)
    for name, each in {**regrets, "the best rule on other sims": fair}.items():
        draws = random.choice(each, (1_000, len(each))).mean(1)
        low, high = np.percentile(draws, [2.5, 97.5])
        single = " ".join(f"{regret:.2f}" for regret in each)
        print(
            f"| {name} | {each.mean():.3f} ({low:.2f} to {high:.2f}) | {each.max():.2f} | {single}"
        )


def main() -> None:
    """Collect the missing logs, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sims", default=",".join(SETTINGS))
    parser.add_argument("--data", default=",".join(ORDER))
    parser.add_argument("--algos", default=";".join(CANDIDATES))
    parser.add_argument("--seeds", type=int, default=2)
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

"""Measure how well the best offline policy can be chosen from a log alone.

    python -m benchmarks.studies.selection FOLDER [--sims lane,racer] [--data weak] [--seeds 2]
    python -m benchmarks.studies.selection FOLDER --second [...]
    python -m benchmarks.studies.selection [--second]

The candidates are algorithms of offline learning. On each log of `sim_data`, each candidate is
trained with the settings of `sim_grid --study`. Its true score is measured in the sim. Other scores
are computed from the log: FQE with and without pessimism, the policy's own values, its Bellman
error, its support in the log, and the losses of BVFT and SBV (`q_scores`). FOLDER/SIM has the
policies and three JSON files for each log, so an interrupted run resumes. `--save` saves the scores
of all finished logs in `selection.json` beside this file, from which the last command prints the
tables. With `--second`, the logs are those of the second set of `sim_data`, in another FOLDER, and
the scores are saved in `selection_second.json`.

BVFT and SBV rate Q-functions. BC has none, so both are computed in two ways: with the Q-function of
the candidate, in which case BC is not chosen, and with the one by which FQE evaluates the
candidate's policy. The target of the candidate's Q-function has the value of the action that the
candidate takes; for candidates that are greedy this is the largest value, as in the papers. The
target of FQE's Q-function has its largest value: the error is then small if FQE sees no action that
is better than the policy's.

A rule chooses one candidate by the scores from the log. The regret of a rule is the true score of
the best candidate minus that of the chosen candidate; both scores are means over seeds. The first
table has the mean regret of each rule over the finished logs, with a 95 % bootstrap interval over
logs, and the largest regret. In the last row, a rule is never chosen by the logs on which its
regret is computed: on the logs of each sim, the row uses the rule with the smallest mean regret on
the logs of the other sims.

All candidates of the first table are the last checkpoints of their trainings, so "always cql" is
the choice of a user who trains with the default algorithm and uses its last checkpoint. The second
table is about the checkpoints of one training, the last one and the one after `SHORT` updates. A
rule chooses one of the two; its regret is the score of the better one minus that of the chosen one,
as a mean over the candidates. This is what "last checkpoint" means in the literature: papers on
offline learning report the policy after the last update, because nothing in the log says which
checkpoint is better.
"""

from __future__ import annotations

import argparse
import functools
import json
import shutil
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

import mcaprl
from benchmarks.studies.q_scores import bvft, sbv
from benchmarks.studies.sim_data import FIRST, SECOND, LogSet, log_names, make_logs, pilot_of
from benchmarks.studies.sim_grid import SETTINGS, SMALL, normalize_mean, run, settings_of
from mcaprl.api import load_policies
from mcaprl.errors import PolicyError
from mcaprl.files import write_json
from mcaprl.offline import (
    DETERMINISTIC,
    CQLConfig,
    EvidenceCollector,
    TransitionBuffer,
    fqe_config,
    train,
)
from mcaprl.progress import TrainingProgress
from mcaprl.sims import PolicyScore, make_sim

CANDIDATES: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "cql": ("cql", {"scale_rewards": False}),
    "cql, scaled": ("cql", {"scale_rewards": True}),
    "cql, alpha .1": ("cql", {"scale_rewards": False, "alpha": 0.1}),
    "bc": ("bc", {}),
    "double-dqn": ("double-dqn", {}),
    "bcq": ("bcq", {}),
    "iql": ("iql", {"normalize_advantages": True, "beta": 0.3}),
}
FINALISTS: Final = ("iql", "cql, alpha .1")
"""Candidates among which `auto` chooses by default."""
SHORT, MODEL_UPDATES, SHORT_MODEL_UPDATES = 1_000, 1_000, 500
"""Updates of the short training, of FQE, and of FQE after the short training."""
AT_SHORT: Final = f" after {SHORT}"
"""Suffix of a candidate in the file of scores, for its policies after the short training."""
FQE_NAME: Final = "fqe.npz"
ORDER: Final = ("expert", "weak", "mixed", "replay", "medium", "random")
RESULTS: Final = Path(__file__).with_suffix(".json")
SECOND_RESULTS: Final = RESULTS.with_name("selection_second.json")
LABELS: Final = ("pessimistic", "plain", "tournament")
"""Kinds of evidence in a row."""
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


def score(sim: str, folder: Path, policies: list[Any]) -> list[float]:
    """Return the score of each policy in the sim; `folder` has the sim's logs."""
    random, pilot = _references(sim, folder)
    returns = run(sim, policies).returns.mean(axis=1)
    return [normalize_mean(float(mean), random, pilot) for mean in returns]


@functools.cache
def _references(sim: str, folder: Path) -> tuple[PolicyScore, PolicyScore]:
    """Evaluate the random policy and the pilot, whose normalized scores are 0 and 1."""
    with closing(make_sim(sim)) as env:
        return run(sim, [None]), run(sim, [pilot_of(sim, folder, env)], env)


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
            if label == "plain":
                path = out / rows[k]["candidate"] / FQE_NAME
                np.savez(path, logged=evidence.logged_values, after=evidence.next_values)
    return rows


def tournament(sim: str, log: Path, out: Path, names: list[str]) -> list[Row]:
    """Return rows with the losses of BVFT and SBV, in units of the spread of the log's returns."""
    data = mcaprl.open(log)
    packing = CQLConfig(gamma=SETTINGS[sim]["gamma"], scale_rewards=True).packing
    buffer = TransitionBuffer.from_dataset(data, packing)
    (rewards, discounts), scale = buffer.returns.double().numpy(), buffer.reward_scale
    actions, half = buffer.actions.numpy(), np.arange(len(data.episodes)) % 2 == 0
    steps, first_half = np.arange(len(data)), np.repeat(half, data.episode_lengths)
    first_action = int(getattr(buffer.action_space, "start", 0))
    rows: list[Row] = []
    for name in names:
        policies = load_policies(out / name)
        rows += [
            {"candidate": name, "seed": k, "kind": "full", "tournament": {}}
            for k in range(len(policies))
        ]

    def add(kind: str, which: list[Row], values: list[Any], next_values: list[Any]) -> None:
        """Add the losses of Q-functions with values (N,) each in units of the reward."""
        q = np.array(values, np.float64) / scale
        targets = rewards + discounts * np.array(next_values) / scale
        losses = {
            f"bvft_{kind}": bvft(q, targets, 1.0),
            f"sbv_{kind}": sbv(q, targets, data.observations, actions, first_half),
        }
        for field, each in losses.items():
            for row, loss in zip(which, each.tolist(), strict=True):
                row["tournament"][field] = loss

    found = []
    for row in rows:
        policy = load_policies(out / row["candidate"])[row["seed"]]
        try:
            q, q_t = (policy.q_values(seen) for seen in (data.observations, data.next_observations))
        except PolicyError:
            continue
        next_actions = policy.act(data.next_observations) - first_action
        found.append((row, q[steps, actions], q_t[steps, next_actions]))
    add("own", *map(list, zip(*found, strict=True)))
    firsts = [row for row in rows if row["seed"] == 0]
    fitted = [np.load(out / row["candidate"] / FQE_NAME) for row in firsts]
    add("fqe", firsts, [one["logged"] for one in fitted], [one["after"] for one in fitted])
    return rows


@dataclass(frozen=True)
class Log:
    """Finished log.

    Attributes:
        sim: Name of its sim.
        name: Name of the log.
        entropy: Entropy of the behavior, from 0 to 1, computed from the logged probabilities.
        scores: Mean true score of each candidate.
        short_scores: The same after the short training.
        rows: Evidence for each candidate and seed.
    """

    sim: str
    name: str
    entropy: float
    scores: dict[str, float]
    short_scores: dict[str, float]
    rows: list[Row]

    def means(self, label: str, field: str, kind: str = "full") -> dict[str, float]:
        """Return the mean of a number over the seeds, for each candidate that has it."""
        found: dict[str, list[float]] = {}
        for row in self.rows:
            if row["kind"] == kind and (value := row.get(label, {}).get(field)) is not None:
                found.setdefault(row["candidate"], []).append(value)
        return {name: float(np.mean(values)) for name, values in found.items()}

    def summary(self) -> dict[str, Any]:
        """Return the attributes as JSON types; its rows have the means over the seeds."""
        kept: dict[tuple[str, str], Row] = {}
        for row in self.rows:
            key = row["candidate"], row["kind"]
            kept.setdefault(key, {"candidate": key[0], "seed": 0, "kind": key[1]})
            for label in LABELS:
                numbers = {k: v for k, v in row.get(label, {}).items() if isinstance(v, float)}
                for field in numbers:
                    mean = self.means(label, field, key[1])[key[0]]
                    kept[key].setdefault(label, {})[field] = float(f"{mean:.8g}")
        return {**vars(self), "rows": list(kept.values())}

    def regret(self, rule: Rule) -> float:
        """Return the regret of a rule."""
        return max(self.scores.values()) - self.scores[rule(self)]

    @property
    def agrees(self) -> bool:
        """Whether `auto` rates candidates by their agreement with the behavior."""
        return self.entropy < DETERMINISTIC

    def checkpoint_regret(self, rule: CheckpointRule) -> float:
        """Return the mean regret of a rule that chooses between the two checkpoints."""
        regrets = []
        for name, short in self.short_scores.items():
            full = self.scores[name]
            regrets.append(max(short, full) - (full if rule(self, name) else short))
        return float(np.mean(regrets))


Rule = Callable[[Log], str]
CheckpointRule = Callable[[Log, str], bool]
"""Function that returns whether it chooses the last checkpoint of a candidate on a log."""


def later_if_larger(field: str) -> CheckpointRule:
    """Return the rule that chooses the checkpoint with the larger number.

    Without this number, it chooses the last checkpoint.
    """

    def rule(log: Log, name: str) -> bool:
        short, full = (log.means("pessimistic", field, kind) for kind in ("short", "full"))
        return name not in full or full[name] >= short[name]

    return rule


CHECKPOINT_RULES: Final[dict[str, CheckpointRule]] = {
    "last checkpoint": lambda log, name: True,
    "first checkpoint": lambda log, name: False,
    "largest own Q": later_if_larger("own_value"),
    "pessimistic FQE, first states": later_if_larger("first_value"),
    "agreement with the behavior": later_if_larger("agreement"),
    "auto": lambda log, name: later_if_larger("agreement" if log.agrees else "first_value")(
        log, name
    ),
}


def largest(values: dict[str, float]) -> str:
    """Return the name with the largest value."""
    return max(values, key=values.__getitem__)


def auto(
    log: Log,
    finalists: Sequence[str] = (),
    threshold: float = DETERMINISTIC,
    survivors: int | None = None,
) -> str:
    """Return the candidate that `auto` chooses.

    Below the entropy `threshold`, this is the candidate with the largest agreement, otherwise the
    candidate with the largest value by pessimistic FQE. If there are `finalists`, it is one of
    them.
    """
    field = "agreement" if log.entropy < threshold else "first_value"
    values = log.means("pessimistic", field)
    if finalists:
        return largest({name: values[name] for name in finalists})
    if survivors is not None:
        short = log.means("pessimistic", field, "short")
        kept = sorted(short, key=short.__getitem__)[-survivors:]
        values = {name: values[name] for name in kept}
    return largest(values)


def ranks(log: Log) -> str:
    """Return the candidate with the largest sum of two ranks, or of agreement as in `auto`.

    The ranks are those of its mean value by pessimistic FQE, and of the loss of FQE's Q-function by
    SBV: a value counts for less if the function that gives it has a large error.
    """
    if log.agrees:
        return auto(log)
    values = log.means("pessimistic", "mean_value")
    losses = log.means("tournament", "sbv_fqe")
    return largest(
        {
            name: sum(value > other for other in values.values())
            + sum(losses[name] < other for other in losses.values())
            for name, value in values.items()
        }
    )


def rules(candidates: Iterable[str]) -> dict[str, Rule]:
    """Return the rules: functions that choose a candidate on a log."""

    def highest(label: str, field: str) -> Rule:
        return lambda log: largest(log.means(label, field))

    def smallest(label: str, field: str) -> Rule:
        return lambda log: largest({name: -loss for name, loss in log.means(label, field).items()})

    def always(name: str) -> Rule:
        return lambda log: name

    return {
        **{f"always {name}": always(name) for name in candidates},
        "largest own Q": highest("pessimistic", "own_value"),
        "smallest Bellman error": smallest("pessimistic", "bellman_error"),
        "BVFT, own Q": smallest("tournament", "bvft_own"),
        "BVFT, FQE's Q": smallest("tournament", "bvft_fqe"),
        "SBV, own Q": smallest("tournament", "sbv_own"),
        "SBV, FQE's Q": smallest("tournament", "sbv_fqe"),
        "FQE, first states": highest("plain", "first_value"),
        "FQE, all states": highest("plain", "mean_value"),
        "pessimistic FQE, first states": highest("pessimistic", "first_value"),
        "pessimistic FQE, all states": highest("pessimistic", "mean_value"),
        "agreement with the behavior": highest("pessimistic", "agreement"),
        "auto": partial(auto, finalists=FINALISTS),
        **{
            f"auto, all candidates, entropy below {t}": partial(auto, threshold=t)
            for t in (0.02, 0.05, 0.1, 0.2)
        },
        "ranks of pessimistic FQE and SBV": ranks,
        "auto, all candidates, 3 survivors": partial(auto, survivors=3),
        "auto, all candidates, 4 survivors": partial(auto, survivors=4),
    }


def read_logs(folder: Path) -> list[Log]:
    """Return all finished logs, with only the candidates that have evidence on every log."""
    found = []
    for path in sorted(folder.glob("*/tournament-*.json")):
        name, sim = path.stem.removeprefix("tournament-"), path.parent.name
        data = mcaprl.open(path.with_name(f"{name}.mcap"))
        assert isinstance(data.action_space, Discrete)
        nats = -np.log(data.behavior_probs.astype(np.float64)).mean()
        scores = json.loads(path.with_name(f"scores-{name}.json").read_text())
        means = {candidate: float(np.mean(values)) for candidate, values in scores.items()}
        short = {one: means.pop(f"{one}{AT_SHORT}") for one in list(means) if AT_SHORT not in one}
        rows = json.loads(path.with_name(f"evidence-{name}.json").read_text())
        rows += json.loads(path.read_text())
        entropy = float(nats / np.log(data.action_space.n))
        found.append(Log(sim, name, entropy, means, short, rows))
    common = set.intersection(*({row["candidate"] for row in log.rows} for log in found))
    return [
        replace(
            log,
            scores={name: log.scores[name] for name in CANDIDATES if name in common},
            short_scores={name: log.short_scores[name] for name in CANDIDATES if name in common},
            rows=[row for row in log.rows if row["candidate"] in common],
        )
        for log in found
    ]


def show(logs: list[Log]) -> None:
    """Print the regret of each rule over the logs, in two tables."""
    names = [f"{log.sim} {log.name}" for log in logs]
    print(f"{len(logs)} logs: {', '.join(names)}; candidates: {', '.join(logs[0].scores)}")
    table = rules(logs[0].scores)
    regrets = {name: np.array([log.regret(rule) for log in logs]) for name, rule in table.items()}
    fair = np.zeros(len(logs))
    for sim in sorted({log.sim for log in logs}):
        mine = np.array([log.sim == sim for log in logs])
        if not mine.all():
            best = min(regrets, key=lambda name: regrets[name][~mine].mean())
            fair[mine] = regrets[best][mine]
            print(f"the best rule on the other sims than {sim}: {best}")
    print(regret_rows({**regrets, "the best rule on other sims": fair}))
    print(f"checkpoints of one training, after {SHORT} updates and the last:")
    checkpoints = {
        name: np.array([log.checkpoint_regret(rule) for log in logs])
        for name, rule in CHECKPOINT_RULES.items()
    }
    print(regret_rows(checkpoints))


def regret_rows(regrets: dict[str, NDArray[np.float64]]) -> str:
    """Return a row for each rule: mean regret with interval, largest regret, single regrets."""
    random, rows = np.random.default_rng(0), []
    for name, each in regrets.items():
        draws = random.choice(each, (1_000, len(each))).mean(1)
        low, high = np.percentile(draws, [2.5, 97.5])
        single = " ".join(f"{regret:.2f}" for regret in each)
        mean = f"{each.mean():.3f} ({low:.2f} to {high:.2f})"
        rows.append(f"| {name} | {mean} | {each.max():.2f} | {single} |")
    return "\n".join(rows)


def main() -> None:
    """Collect the missing logs, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, nargs="?", help="default: show the saved scores")
    parser.add_argument("--sims", default=",".join(SETTINGS))
    parser.add_argument("--data", default=",".join(ORDER))
    parser.add_argument("--algos", default=";".join(CANDIDATES))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--second", action="store_true", help="use the second set of logs")
    parser.add_argument("--save", action="store_true", help="save the scores for later")
    given = parser.parse_args()
    torch.set_num_threads(1)
    logs, results = (SECOND, SECOND_RESULTS) if given.second else (FIRST, RESULTS)
    if given.folder is None:
        show([Log(**log) for log in json.loads(results.read_text())])
        return
    for name in given.data.split(","):
        for sim in given.sims.split(","):
            if name in log_names(sim):
                _fill(given.folder / sim, sim, name, logs, given.algos.split(";"), given.seeds)
    found = read_logs(given.folder)
    if given.save:
        write_json(results, [log.summary() for log in found])
    show(found)


def _fill(
    folder: Path, sim: str, name: str, logs: LogSet, candidates: list[str], seeds: int
) -> None:
    """Train and score the missing candidates on a log, and collect the evidence."""
    log = make_logs(folder, sim, logs)[name]
    path, result = folder / f"scores-{name}.json", folder / f"evidence-{name}.json"
    scores: dict[str, list[float]] = json.loads(path.read_text()) if path.exists() else {}
    rows: list[Row] = json.loads(result.read_text()) if result.exists() else []
    data = mcaprl.open(log)
    for candidate in candidates:
        out = folder / name / candidate
        if not out.exists():
            out.parent.mkdir(exist_ok=True)
            learn(sim, data, candidate, out, seeds)
        for key, policies in ((candidate, out), (f"{candidate}{AT_SHORT}", out / "short")):
            if key not in scores:
                scores[key] = score(sim, folder, load_policies(policies))
                write_json(path, scores)
                print(sim, name, key, scores[key], flush=True)
    known = {row["candidate"] for row in rows}
    if missing := [candidate for candidate in candidates if candidate not in known]:
        write_json(result, rows + collect(sim, log, folder / name, missing))
        print(sim, name, "evidence", flush=True)
    _compare(folder, sim, name, log)


def _compare(folder: Path, sim: str, name: str, log: Path) -> None:
    """Run BVFT and SBV again if candidates were added."""
    path = folder / f"tournament-{name}.json"
    evidence = json.loads((folder / f"evidence-{name}.json").read_text())
    names = list(dict.fromkeys(row["candidate"] for row in evidence))
    earlier = json.loads(path.read_text()) if path.exists() else []
    if names != list(dict.fromkeys(row["candidate"] for row in earlier)):
        write_json(path, tournament(sim, log, folder / name, names))
        print(sim, name, "BVFT and SBV", flush=True)


if __name__ == "__main__":
    main()

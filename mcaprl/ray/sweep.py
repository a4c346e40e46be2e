"""Training with many settings by Ray Tune. Trials with low off-policy scores are stopped early.

The results are a table, an image and a page.

OUT/sweep.json             trials and data, which must be equal when the sweep is resumed
OUT/NAME/                  run folder of a trial
OUT/NAME.scores.json       scores so far, or the error that ended the trial

    algos: [bc, cql]              algorithms, or a mapping from algorithms to their settings
    settings:                     settings; each applies to the algorithms that have it
      updates: 4000
      learning_rate: [3e-4, 1e-3] each value of a list is tried, in all combinations
    seeds: 2                      number of networks of each combination
    seed: 0                       seed of the first network
    score:
      every: 1000                 updates between two scores
      fraction: 0.2               part of the episodes that is used only for scores
      updates: 1000               updates of the model that the estimators use
      epsilon: 0.1                probability of random actions of the scored policies
      gamma: 0.97                 discount of the scores
    stop: 3                       1 of 3 trials continues after each stage; 0: all continue

Only `algos` is required.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.errors import (
    LogError,
    McaprlError,
    OutputExistsError,
    ReportError,
    TrainingError,
    UsageError,
    import_extra,
)
from mcaprl.files import (
    locked_folder,
    read_json,
    read_yaml,
    work_folder,
    write_atomically,
    write_json,
)
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.registry import choose_algorithm
from mcaprl.offline.estimate.fqe import FQEConfig
from mcaprl.offline.estimate.off_policy import OffPolicyEvaluator
from mcaprl.offline.policy import read_policy
from mcaprl.offline.training.train import train
from mcaprl.page import COLORS, PAGE_NAME, Figure, Section, Table, new_figure, save_png, write_page
from mcaprl.progress import Advance, TrainingProgress
from mcaprl.ray.cluster import restored_handlers
from mcaprl.ray.tasks import MOST_DEATHS, check_machine, check_machines
from mcaprl.recorder.dataset.log_reader import LogReader
from mcaprl.recorder.format.metadata import installed_versions
from mcaprl.recorder.source import Data, logs_of, open_data
from mcaprl.runs import saved_updates
from mcaprl.settings import check_settings
from mcaprl.texts import counted

MOST_TRIALS = 10_000


@dataclass(frozen=True)
class Scoring:
    """Settings for scoring policies. The docstring of the module describes the fields."""

    every: int = 1_000
    fraction: float = 0.2
    updates: int = 1_000
    epsilon: float = 0.1
    gamma: float = 0.97

    def __post_init__(self) -> None:
        """Validate the fields."""
        for name in ("every", "updates"):
            if getattr(self, name) < 1:
                raise UsageError(f"score: {name} must be at least 1, got {getattr(self, name)}")
        if not 0 < self.fraction < 1:
            raise UsageError(f"score: fraction must be between 0 and 1, got {self.fraction}")
        for name in ("epsilon", "gamma"):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"score: {name} must be within [0, 1], got {getattr(self, name)}")


@dataclass(frozen=True)
class Trial:
    """One combination of algorithm and settings.

    Attributes:
        name: Name of the folder of the trial, such as `cql-003`.
        algo: Name of the algorithm.
        config: Settings.
        varied: This trial's values of the settings that have several values in the file.
    """

    name: str
    algo: str
    config: TrainingConfig
    varied: dict[str, Any]


@dataclass(frozen=True)
class SweepPlan:
    """Content of a sweep file."""

    trials: tuple[Trial, ...]
    seeds: int = 1
    seed: int = 0
    score: Scoring = field(default_factory=Scoring)
    stop: int = 3


def read_plan(source: str | Path | Mapping[str, Any]) -> SweepPlan:
    """Read and check a sweep file, or a mapping of the same form."""
    where, tree = "the sweep", source
    if not isinstance(source, Mapping):
        where, tree = str(source), read_yaml(Path(source), "ray")
    try:
        return _plan(tree)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error


def _plan(tree: object) -> SweepPlan:
    tree = _mapping("a sweep", tree, ["algos", "settings", "seeds", "seed", "score", "stop"])
    found = tree.get("algos")
    if isinstance(found, list):
        found = {str(name): {} for name in found}
    if not isinstance(found, Mapping) or not found:
        raise UsageError("algos must be a list of algorithms, or a mapping to their settings")
    common = _mapping("settings", tree.get("settings"), None)
    names = {str(name) for name in common}
    numbers = {
        name: _typed(name, tree.get(name, default), default)
        for name, default in (("seeds", 1), ("seed", 0), ("stop", 3))
    }
    if numbers["seeds"] < 1 or numbers["seed"] < 0 or numbers["stop"] not in (0, *range(2, 100)):
        raise UsageError("seeds must be at least 1, seed at least 0, and stop 0 or 2 to 99")
    score = _scoring(tree.get("score"))
    trials: list[Trial] = []
    for algo, own in found.items():
        _, defaults = choose_algorithm(str(algo))
        own = _mapping(f"algos: {algo}", own, None)
        known = {one.name for one in fields(defaults)}
        check_settings(str(algo), defaults, map(str, own))
        names -= known
        values = {name: value for name, value in common.items() if name in known} | dict(own)
        trials += _combinations(str(algo), defaults, values, score, len(trials))
    if names:
        for name in sorted(names):
            # No algorithm has this setting. Raise the error of the first algorithm, which lists
            # the settings that it has.
            check_settings(
                str(next(iter(found))), choose_algorithm(str(next(iter(found))))[1], [name]
            )
    return SweepPlan(tuple(trials), score=score, **numbers)


def _combinations(
    algo: str, defaults: TrainingConfig, values: Mapping[str, Any], score: Scoring, first: int
) -> list[Trial]:
    choices = {
        name: [_typed(name, one, getattr(defaults, name)) for one in _listed(name, value, defaults)]
        for name, value in values.items()
    }
    several = [name for name, options in choices.items() if len(options) > 1]
    found = []
    for number, chosen in enumerate(itertools.product(*choices.values()), first):
        if number >= MOST_TRIALS:
            raise UsageError(f"more than {MOST_TRIALS:,} combinations: remove some values")
        settings = dict(zip(choices, chosen, strict=True))
        # Policies are scored at each checkpoint, so `every` is the checkpoint interval.
        config = type(defaults)(**{"checkpoint_interval": score.every, **settings})
        if config.checkpoint_interval != score.every:
            raise UsageError("checkpoint_interval is the `every` of score: set that instead")
        varied = {name: settings[name] for name in several}
        found.append(Trial(f"{algo}-{number:03d}", algo, config, varied))
    return found


def _listed(name: str, value: Any, defaults: TrainingConfig) -> list[Any]:
    """Return the values to try."""
    # Where each value of the setting is a list, a flat list is one value, a list of lists several.
    is_list = isinstance(value, list)
    if isinstance(getattr(defaults, name), tuple):
        return value if is_list and any(isinstance(one, list) for one in value) else [value]
    if is_list and not value:
        raise UsageError(f"{name} has no values")
    return value if is_list else [value]


def _typed(name: str, value: Any, default: Any) -> Any:
    """Return a value as the type of the default."""
    kind = type(default)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is tuple and isinstance(value, list | tuple):
        if all(type(one) is int for one in value):
            return tuple(value)
    elif type(value) is kind:
        return value
    wanted = {"int": "a whole number", "float": "a number", "bool": "true or false"}
    text = wanted.get(kind.__name__, "a list of whole numbers" if kind is tuple else "text")
    raise UsageError(f"{name} must be {text}, got {json.dumps(value, default=str, skipkeys=True)}")


def _scoring(tree: object) -> Scoring:
    known = {one.name: one.default for one in fields(Scoring)}
    given = _mapping("score", tree, list(known))
    return Scoring(**{name: _typed(name, value, known[name]) for name, value in given.items()})


def _mapping(what: str, tree: object, known: list[str] | None) -> Mapping[str, Any]:
    if tree is None and what != "a sweep":
        return {}
    if not isinstance(tree, Mapping):
        raise UsageError(f"{what} must be a mapping of names to values")
    for name in tree:
        if known is not None and name not in known:
            raise UsageError(f"{what} has no key {name!r}; it has {', '.join(known)}")
    return tree


PLAN_NAME, SCORES_NAME = "sweep.json", "scores.json"
_SPLIT_SEED = 0


@dataclass(frozen=True)
class Score:
    """Off-policy score of the policies of a trial after a number of updates.

    Attributes:
        updates: Number of finished updates.
        values: Estimated discounted return of each seed's policy.
        estimator: `WDR`, or `FQE` if the log has no behavior probabilities.
        trusted: Whether all these estimates are trusted.
    """

    updates: int
    values: list[float]
    estimator: str
    trusted: bool

    @property
    def mean(self) -> float:
        """Mean over the seeds."""
        return float(np.mean(self.values))


@dataclass(frozen=True)
class _Saved:
    """Content of a file with the scores of a trial."""

    scores: tuple[Score, ...]
    error: str


@dataclass(frozen=True)
class TrialResult:
    """Outcome of a trial.

    Attributes:
        trial: Algorithm and settings.
        folder: Run folder, whose policies can be evaluated.
        scores: Scores in chronological order; empty if the trial failed before its first score.
        error: Error that ended the trial; empty if there was none.
    """

    trial: Trial
    folder: Path
    scores: tuple[Score, ...]
    error: str

    @property
    def status(self) -> str:
        """`finished`, `stopped early`, or `failed: ` and the reason."""
        if self.error:
            return f"failed: {self.error}"
        updates = self.scores[-1].updates if self.scores else 0
        return "finished" if updates == self.trial.config.updates else "stopped early"


def sweep_on_ray(
    data: Data, plan: SweepPlan, out: Path, *, workers: int | None, resume: bool, advance: Advance
) -> list[TrialResult]:
    """Run the trials on the cluster, as `mcaprl.sweep`; return the results, best score first."""
    tune = import_extra("ray.tune", "ray")
    logs = logs_of(data, weighted=True)
    identity = {
        "trials": [[one.name, one.algo, one.config.to_json()] for one in plan.trials],
        "seeds": [plan.seed, plan.seeds],
        "score": asdict(plan.score),
        "data": [[path.name, LogReader(path).checksum, weight] for path, weight in logs.items()],
    }
    with locked_folder(out, TrainingError):
        check_machines([out, *logs])
        _open(out, json.loads(json.dumps(identity)), resume)
        with work_folder(out / "tune") as folder:
            run = partial(_try, logs, plan, out, installed_versions())
            errors = _run(tune, run, plan, folder, workers, advance)
        for error in errors:
            raise TrainingError(f"{out}: {str(error).strip().splitlines()[-1]}")
    results = [_result(one, out) for one in plan.trials]
    if not any(one.scores for one in results):
        raise TrainingError(f"{out}: all trials failed; the first one: {results[0].status}")
    return sorted(results, key=lambda one: -one.scores[-1].mean if one.scores else np.inf)


def _open(out: Path, identity: dict[str, Any], resume: bool) -> None:
    path = out / PLAN_NAME
    if not resume:
        if any(one for one in out.iterdir() if not one.name.startswith(".")):
            raise OutputExistsError(
                f"{out} exists: choose another folder, or resume its sweep (`resume=True`)"
            )
    elif not path.exists():
        raise TrainingError(f"{out} has no sweep to resume: start a new one without `resume=True`")
    elif (found := read_json(path, TrainingError, dict[str, Any])) != identity:
        names = [name for name in identity if found.get(name) != identity[name]]
        raise TrainingError(
            f"cannot resume: {path} has other {', '.join(names)}; resume with the same sweep file"
            " and data, or choose another folder"
        )
    write_json(path, identity, TrainingError)


def _run(
    tune: Any, run: Any, plan: SweepPlan, folder: Path, workers: int | None, advance: Advance
) -> list[Exception]:
    """Run a function for each trial, in the folder of Ray Tune; return Ray's errors."""
    most = max(one.config.updates for one in plan.trials)
    scheduler = None
    if plan.stop and most > plan.score.every:
        scheduler = import_extra("ray.tune.schedulers", "ray").ASHAScheduler(
            time_attr="updates",
            metric="score",
            mode="max",
            max_t=most,
            grace_period=plan.score.every,
            reduction_factor=plan.stop,
        )

    class Counter(tune.Callback):  # type: ignore[misc]
        def on_trial_complete(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
            advance(1)

    # Without this variable, Ray prints a box with its settings at any verbosity.
    os.environ.setdefault("RAY_AIR_NEW_OUTPUT", "0")
    for name in ("ray.tune", "ray.train"):
        logging.getLogger(name).setLevel(logging.ERROR)
    tuner = tune.Tuner(
        tune.with_resources(run, {"CPU": 1}),
        param_space={"number": tune.grid_search(list(range(len(plan.trials))))},
        tune_config=tune.TuneConfig(scheduler=scheduler, max_concurrent_trials=workers),
        run_config=tune.RunConfig(
            name="sweep",
            storage_path=str(folder),
            verbose=0,
            callbacks=[Counter()],
            failure_config=tune.FailureConfig(max_failures=MOST_DEATHS),
        ),
    )
    with restored_handlers():
        return list(tuner.fit().errors)


def _try(
    logs: dict[Path, float],
    plan: SweepPlan,
    out: Path,
    versions: dict[str, str],
    chosen: dict[str, int],
) -> None:
    """Run one trial on a worker of Ray Tune, or continue that of a killed worker."""
    trial = plan.trials[chosen["number"]]
    try:
        check_machine(versions, [out])
        _train(logs, plan, trial, out)
    except McaprlError as error:
        # A failed trial does not end the sweep: other settings may work.
        _save(out / trial.name, _result(trial, out).scores, str(error))


def _train(logs: dict[Path, float], plan: SweepPlan, trial: Trial, out: Path) -> None:
    from ray import tune

    folder = out / trial.name
    dataset = open_data([str(path) for path in logs], weights=list(logs.values()))
    learned, kept = _divided(len(dataset.weights), plan.score.fraction)
    evaluator = OffPolicyEvaluator(
        dataset._take(kept),
        FQEConfig(gamma=plan.score.gamma, updates=plan.score.updates),
        _SPLIT_SEED,
    )
    earlier = _result(trial, out).scores
    scores = list(earlier)
    for score in earlier:
        tune.report({"score": score.mean, "updates": score.updates})
    done = scores[-1].updates if scores else 0

    def add(updates: int) -> None:
        nonlocal done
        done = updates
        scores.append(_score(folder, plan, evaluator, updates))
        _save(folder, scores, "")
        tune.report({"score": scores[-1].mean, "updates": updates})

    def progress(now: TrainingProgress) -> None:
        is_due = now.done % plan.score.every == 0 or now.done == now.total
        if now.seed == plan.seed + plan.seeds - 1 and is_due and now.done > done:
            add(now.done)

    # A worker can be killed after it has written a checkpoint, and before its score.
    if (saved := saved_updates(folder, plan.seeds)) > done:
        add(saved)
    train(
        dataset._take(learned),
        trial.config,
        folder,
        seeds=plan.seeds,
        seed=plan.seed,
        resume=folder.exists(),
        progress=progress,
    )


def _score(folder: Path, plan: SweepPlan, evaluator: OffPolicyEvaluator, updates: int) -> Score:
    values, trusted, estimator = [], True, "FQE"
    for seed in range(plan.seed, plan.seed + plan.seeds):
        policy = read_policy(folder / f"seed-{seed}")
        found = evaluator.evaluate(policy, policy.name, epsilon=plan.score.epsilon)
        by_name = {one.estimator: one for one in found.estimates}
        chosen = by_name["WDR"] if by_name["WDR"].value is not None else by_name["FQE"]
        estimator, trusted = chosen.estimator, trusted and chosen.trusted
        values.append(float(chosen.value or 0.0))
    return Score(updates, values, estimator, trusted)


def _divided(episodes: int, fraction: float) -> tuple[list[int], list[int]]:
    """Split the episodes at random into a part for training and a part for scores."""
    order = np.random.default_rng(_SPLIT_SEED).permutation(episodes)
    count = max(round(fraction * episodes), 2)
    if count >= episodes:
        raise LogError(f"a sweep needs 3 episodes or more, the logs have {episodes}")
    return np.sort(order[count:]).tolist(), np.sort(order[:count]).tolist()


def _save(folder: Path, scores: Sequence[Score], error: str) -> None:
    content = asdict(_Saved(tuple(scores), error))
    write_json(folder.with_name(f"{folder.name}.{SCORES_NAME}"), content, TrainingError)


def _result(trial: Trial, out: Path) -> TrialResult:
    path = out / f"{trial.name}.{SCORES_NAME}"
    found = _Saved((), "")
    with suppress(FileNotFoundError):
        found = read_json(path, TrainingError, _Saved)
    if not all(one.values for one in found.scores):
        raise TrainingError(f"{path} cannot be read: a score has no values")
    return TrialResult(trial, out / trial.name, found.scores, found.error)


TABLE_NAME, IMAGE_NAME = "sweep.csv", "sweep.png"
_MOST_NAMES = 12


def table_of(results: Sequence[TrialResult]) -> Table:
    """Return a table with a row for each trial. `score` is the mean over the seeds."""
    varied = list(dict.fromkeys(name for one in results for name in one.trial.varied))
    columns = ["trial", *varied, "score", "lowest", "highest", "estimator", "updates", "status"]
    rows = []
    for one in results:
        settings = [_text(one.trial.varied.get(name, "")) for name in varied]
        score = ["", "", "", ""]
        updates = 0
        if one.scores:
            last = one.scores[-1]
            numbers = (last.mean, min(last.values), max(last.values))
            name = last.estimator if last.trusted else f"{last.estimator}, not trusted"
            score, updates = [*(f"{value:.3f}" for value in numbers), name], last.updates
        rows.append([one.trial.name, *settings, *score, str(updates), one.status])
    return Table(columns, rows)


def write_table(path: Path, table: Table) -> None:
    """Write a table as CSV."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(table.rows)
    write_atomically(path, text.getvalue().encode(), ReportError)


def sweep_figure(results: Sequence[TrialResult]) -> Any:
    """Draw the score of each trial over its updates. A dot marks the end of a trial."""
    figure, axes = new_figure((8, 4.5))
    shown = [one for one in results if one.scores]
    algos = list(dict.fromkeys(one.trial.algo for one in results))
    for rank, one in enumerate(shown):
        color = COLORS[algos.index(one.trial.algo) % len(COLORS)]
        updates = [score.updates for score in one.scores]
        means = [score.mean for score in one.scores]
        axes.plot(updates, means, color=color, lw=2.2 if rank == 0 else 1, alpha=0.85)
        axes.plot(updates[-1:], means[-1:], "o", color=color, ms=6 if rank == 0 else 4)
    for number, algo in enumerate(algos):
        axes.plot([], [], color=COLORS[number % len(COLORS)], label=algo)
    if len(shown) <= _MOST_NAMES:
        _name_ends(axes, shown)
    axes.set_xlabel("updates; thick: the best trial")
    axes.set_ylabel("off-policy score")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _name_ends(axes: Any, shown: Sequence[TrialResult]) -> None:
    """Write the names of the trials beside their last scores, without overlaps."""
    low, high = axes.get_ylim()
    step, above = (high - low) / 28, np.inf
    for one in sorted(shown, key=lambda one: -one.scores[-1].mean):
        last = one.scores[-1]
        place = min(last.mean, above - step)
        axes.annotate(
            one.trial.name, (last.updates, place), (7, 0), textcoords="offset points", va="center"
        ).set_fontsize(7.5)
        above = place
    axes.set_xlim(right=axes.get_xlim()[1] * 1.12)


def write_sweep(results: Sequence[TrialResult], plan: SweepPlan, out: Path) -> Table:
    """Write `sweep.csv`, `sweep.png` and `index.html` to a folder; return the table."""
    table = table_of(results)
    write_table(out / TABLE_NAME, table)
    figure = sweep_figure(results)
    save_png(figure, out / IMAGE_NAME)
    score = plan.score
    text = (
        f"The score is the off-policy estimate of the discounted return (gamma {score.gamma:g}) of"
        f" the trained policies with {score.epsilon:.0%} random actions, on {score.fraction:.0%}"
        " of the episodes, which no policy has learned from. Lowest and highest are those of the"
        " seeds. The best of many scores is too high by chance: evaluate its policies in the sim,"
        " or on other logs."
    )
    lead = (
        f"{counted(len(results), 'trial')} with {counted(plan.seeds, 'seed')} each; best:"
        f" {results[0].trial.name}."
    )
    drawn = Figure.of("Off-policy score during training", figure)
    sections = [Section("Scores", figures=[drawn]), Section("Trials", text=text, table=table)]
    write_page(out / PAGE_NAME, "Sweep", lead, sections)
    return table


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else f"{value}"

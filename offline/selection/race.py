"""Training of several candidates, of which only the best are trained to the end.

    RUN/config.json       settings of `auto` and the data
    RUN/clone             clone of the behavior policy, which distinguishes likely from rare actions
    RUN/candidates/NAME   run of a candidate
    RUN/stages.json       evaluations of the candidates after the short and the full training
    RUN/choice.json       what was chosen, and why
    RUN/seed-K            policy of the chosen candidate

All candidates are trained with a fraction of the updates (the short training) and rated. The best
of the finalists are trained with the rest and rated again, and the one with the largest score is
chosen. After the first candidate's short training, RUN/seed-K always has a policy, also if the run
is interrupted.

For the actions of a Box, the candidates are others, and the estimates decide only if they are right
for the behavior of the log and clear (`mcaprl.offline.selection.choice.decide`).

The score of a candidate is the mean of its estimated values of the first states of the episodes:
pessimistic FQE by models that were trained on other episodes (`mcaprl.offline.estimate.evidence`).
The mean is over the episodes, the networks of the candidate, and the models. If the behavior policy
is almost deterministic, the log has no evidence on other actions. In this case, the score is the
fraction of the states in which the candidate takes the logged action.
"""

from __future__ import annotations

import math
import shutil
import time
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.actions import BoxActions
from mcaprl.errors import TrainingError, UnknownNameError, UsageError, import_extra
from mcaprl.files import read_json, replacing_folder, subfolder, write_json
from mcaprl.offline.algorithms.config import BOX_CONFIGS, CONFIGS, TrainingConfig
from mcaprl.offline.algorithms.heads import BoxHead
from mcaprl.offline.batches.buffer import discrete_actions
from mcaprl.offline.estimate.box import BehaviorCheck
from mcaprl.offline.estimate.evidence import (
    FOLDS,
    BoxEvidenceCollector,
    Evidence,
    EvidenceCollector,
    fqe_config,
    likely,
    likely_commands,
    of_both,
    weighted_value,
)
from mcaprl.offline.estimate.values import by_rows
from mcaprl.offline.policy import Policy, read_policy
from mcaprl.offline.selection.choice import (
    AGREEMENT,
    ESTIMATE,
    STOPPED_EARLY,
    UNTESTED,
    Choice,
    LogTraits,
    Rating,
    Tried,
    decide,
)
from mcaprl.offline.selection.config import ALL, AUTO, AutoConfig
from mcaprl.offline.training.metrics import OfflineSummary
from mcaprl.offline.training.train import facts_of, train, with_source
from mcaprl.offline.training.watch import ABSOLUTE, SHORT_HORIZON, horizon_warning, relative_warning
from mcaprl.progress import Pause, ProgressCallback, TrainingProgress
from mcaprl.recorder.dataset.lint import lint
from mcaprl.recorder.format.behavior import PROBABILITY
from mcaprl.runs import (
    METRICS_NAME,
    POLICY_NAME,
    RunIdentity,
    choose_seeds,
    locked_run,
    open_run,
    policy_files,
    saved_updates,
)
from mcaprl.texts import counted

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

Floats = NDArray[np.float64]
STAGES_NAME: Final = "stages.json"
RESAMPLES: Final = 1_000
LEAST_COVERAGE: Final = 0.5
"""Fraction of the actions that must be likely in the log before Double DQN is tried."""
ENSEMBLE: Final = 2
"""Number of models that evaluate a policy, each with its own halves of the log and weights."""
SHARES: Final = (0.35, 0.5, 0.8, 0.95)
"""Fractions of the budget after which the short training, its rating, the full training end."""
CLONE_UPDATES: Final = 2_000  # Maximum number of updates of the clone of the behavior policy
_IQL_INTERVAL: Final = 50
_OWN: Final = ("finalists", "survivors", "short_fraction", "model_updates")
_PROBE_UPDATES: Final = 10
_LEAST_MODEL_UPDATES: Final = 100


@dataclass(frozen=True)
class Candidate:
    """Algorithm with settings that differ from the shared ones."""

    name: str  # Name in tables and of the folder of its run
    algo: str
    special: Mapping[str, Any]  # Settings that differ from the shared ones
    is_box: bool = False  # Whether the algorithm is that for the actions of a Box

    def config(self, shared: AutoConfig) -> TrainingConfig:
        """Return the settings of the algorithm. Its special settings override the shared ones."""
        # For a Box, the shared settings are those that differ from the defaults of `auto`.
        defaults = (BOX_CONFIGS if self.is_box else CONFIGS)[self.algo]()
        names = {field.name for field in fields(defaults)}.difference(_OWN)
        given = {
            each.name: getattr(shared, each.name)
            for each in fields(shared)
            if each.name in names
            and not (self.is_box and getattr(shared, each.name) == each.default)
        }
        if self.algo == "iql" and not self.is_box:
            given["target_interval"] = min(_IQL_INTERVAL, shared.target_interval)
        given["checkpoint_interval"] = shared.candidate_interval
        return replace(defaults, **{**given, **self.special})


PORTFOLIO: Final = (
    Candidate("iql", "iql", {"normalize_advantages": True, "beta": 0.3}),
    Candidate("cql-alpha-0.1", "cql", {"alpha": 0.1}),
    Candidate("bcq", "bcq", {}),
    Candidate("cql", "cql", {}),
    Candidate("bc", "bc", {}),
    Candidate("cql-scaled", "cql", {"scale_rewards": True}),
    Candidate("double-dqn", "double-dqn", {}),
)
"""All candidates, in the order of their training; the first is used if none can be evaluated."""
BOX_PORTFOLIO: Final = (
    Candidate("iql", "iql", {}, is_box=True),
    Candidate("rebrac", "rebrac", {}, is_box=True),
    Candidate("td3-bc", "td3-bc", {}, is_box=True),
    Candidate("bc", "bc", {}, is_box=True),
    Candidate("bc-top-0.1", "bc", {"top": 0.1}, is_box=True),
)
"""The same for the actions of a Box."""


def portfolio(space: spaces.Space[Any]) -> tuple[Candidate, ...]:
    """Return the candidates for an action space."""
    if isinstance(space, spaces.Box):
        return BOX_PORTFOLIO
    discrete_actions(space, AUTO)
    return PORTFOLIO


def eligible(config: AutoConfig, trying: Sequence[Candidate]) -> frozenset[str]:
    """Return the finalists, or all candidates that are tried if one of the finalists is not."""
    names = frozenset(one.name for one in trying)
    finalists = frozenset(config.finalists.split(","))
    return finalists if finalists <= names else names


def rate(
    values: Mapping[str, Floats], agreements: Mapping[str, Floats], *, imitate: bool, seed: int = 0
) -> dict[str, Rating]:
    """Rate candidates by their values or by their agreement with the log, the best first."""
    # Arrays are (M, E): pairs of a network and a model, and episodes. Both are resampled, so that
    # the chances include the noise of the log and of the networks, but not the models' bias.
    random = np.random.default_rng(seed)
    counts = _counts(random, next(iter(values.values())).shape[1])
    members = {name: _counts(random, len(mine)) for name, mine in values.items()}
    drawn_values, drawn_agreements = (
        {name: ((counts @ mine.T) * members[name]).sum(1) for name, mine in each.items()}
        for each in (values, agreements)
    )
    best = np.stack(list((drawn_agreements if imitate else drawn_values).values())).argmax(0)
    ratings = {}
    for k, name in enumerate(values):
        value, agreement = float(values[name].mean()), float(agreements[name].mean())
        low, high = np.percentile(drawn_values[name], [2.5, 97.5]).tolist()
        score, chance = agreement if imitate else value, float((best == k).mean())
        ratings[name] = Rating(value, (low, high), agreement, score, chance)
    return dict(sorted(ratings.items(), key=lambda each: -each[1].score))


def _counts(random: np.random.Generator, size: int) -> Floats:
    """Return the fraction (B, size) of each element in each of B resamplings."""
    return random.multinomial(size, np.full(size, 1 / size), RESAMPLES) / size


def select(
    dataset: Dataset,
    config: AutoConfig,
    out: Path,
    *,
    seeds: int | None = None,
    seed: int | None = None,
    resume: bool = False,
    device: str = "cpu",
    progress: ProgressCallback = lambda now: None,
) -> tuple[Choice, list[OfflineSummary]]:
    """Train all candidates, choose one from the log alone; return it and a summary per seed."""
    if config.report:
        import_extra("jinja2", "report")
    known = [one.name for one in portfolio(dataset.action_space)]
    if isinstance(dataset.action_space, spaces.Box):
        # Actions that cannot be learned are refused before the run folder is created.
        BoxActions.of(dataset.action_space, dataset.actions)
    if config.finalists != AutoConfig.finalists:
        for name in config.finalists.split(","):
            if name not in (*known, ALL):
                raise UnknownNameError("candidate", name, known)
    if dataset.origin.grow is not None:
        raise UsageError(f"`follow=True` is not for `algo={AUTO!r}`: omit it")
    if message := relative_warning(dataset.relative_to, f"each candidate of {AUTO} but bc"):
        warnings.warn(message, stacklevel=2)
    given, dataset = dataset, with_source(dataset, config.mask_from)
    if len(dataset.episodes) < FOLDS:
        raise UsageError(f"`algo={AUTO!r}` needs {FOLDS} episodes or more in the log")
    numbers = choose_seeds(out, seeds, seed, resume)
    parts: dict[str, Any] = {"algo": AUTO, "config": config.to_json()}
    # The estimates of all candidates are averages over the same seeds, so none can be added.
    parts |= {"seeds": len(numbers), "seed": numbers.start, "data": dataset.fingerprint}
    identity = RunIdentity(parts)
    with locked_run(out, resume):
        open_run(out, identity, resume, numbers, **facts_of(given, identity))
        choice, summaries = _Race(dataset, config, out, numbers, device, progress).run()
    if config.report:
        choice.write_report(Path(config.report), f"Choice of a policy for {dataset.env_id}")
    return choice, summaries


class _Race:
    """State of one run of `select`."""

    def __init__(
        self,
        dataset: Dataset,
        config: AutoConfig,
        out: Path,
        seeds: range,
        device: str,
        progress: ProgressCallback,
    ) -> None:
        self._dataset, self._config, self._out = dataset, config, out
        self._seeds, self._device = seeds, device
        self._began, self._budget_s = time.perf_counter(), 60 * config.budget_minutes
        self._progress = progress
        self._in_time = True
        self._done: dict[tuple[str, int], int] = {}
        self._total = 0

    def run(self) -> tuple[Choice, list[OfflineSummary]]:
        """Run both stages. Return the choice, and a summary for each seed."""
        clone = self._clone()
        traits = _traits(self._dataset, clone)
        candidates = portfolio(self._dataset.action_space)
        skipped = _skipped(traits, candidates)
        trying = {one.name: one for one in candidates if one.name not in skipped}
        among = eligible(self._config, list(trying.values()))

        def finalists(names: Iterable[str]) -> list[str]:
            return [name for name in names if name in among] or list(names)

        short, full = self._config.short_updates, self._config.updates
        survivors = min(len(among), self._config.survivors)
        self._total = len(trying) * short + survivors * (full - short)
        _warn_about_short_horizons(trying.values(), self._config)
        self._train(list(trying.values()), short, SHARES[0])
        names = [name for name in trying if self._updates(name)]
        imitate = traits.is_deterministic
        first = self._evaluate("short", names, clone, imitate, 0.5, SHARES[1])
        going = finalists(names)
        if first:
            going = self._going(finalists(first))
            self._publish(going[0])
        self._train([trying[name] for name in going], full, SHARES[2])
        second = self._evaluate("full", going, clone, imitate, 1.0, SHARES[3])
        last = second or first
        order = finalists(last or names)
        chosen, rule = self._decide(order, last, imitate)
        order = [chosen, *(name for name in order if name != chosen)]
        tried = {name: Tried(self._updates(name), outcome="not evaluated") for name in names}
        tried |= {name: replace(one, outcome=STOPPED_EARLY) for name, one in first.items()}
        tried |= second
        for name, outcome in zip(order, ("chosen", "runner-up")[: len(last) or 1], strict=False):
            tried[name] = replace(tried[name], outcome=outcome)
        late = trying.keys() - tried.keys()
        tried |= {name: Tried(outcome="no checkpoint within the budget") for name in late}
        tried |= {name: Tried(outcome=f"not tried: {why}") for name, why in skipped.items()}
        table = {name: tried[name] for name in dict.fromkeys([*order, *first, *trying, *tried])}
        choice = Choice.of(chosen, rule, len(last), traits, table, self._in_time)
        self._publish(choice.chosen)
        choice.write(self._out)
        return choice, self._summaries(choice.chosen, trying[choice.chosen].algo)

    def _going(self, order: list[str]) -> list[str]:
        """Return the candidates that get all updates; for a Box, the portfolio's first is one."""
        # It is chosen if the estimates do not decide.
        going = order[: self._config.survivors]
        usual = BOX_PORTFOLIO[0].name
        is_box = isinstance(self._dataset.action_space, spaces.Box)
        return [*going[:-1], usual] if is_box and usual in order and usual not in going else going

    def _decide(
        self, order: Sequence[str], last: Mapping[str, Tried], imitate: bool
    ) -> tuple[str, str]:
        """Choose among candidates, given the best first; return the choice and the rule."""
        if not last:
            return order[0], UNTESTED
        if imitate:
            return order[0], AGREEMENT
        check = last[order[0]].check
        if check is None:
            return order[0], ESTIMATE
        ratings = {name: one for name in order if (one := last[name].rating)}
        prior = [one.name for one in BOX_PORTFOLIO if one.name in ratings]
        return decide(ratings, prior, check)

    def _left_s(self, share: float) -> float:
        """Return the seconds until a fraction of the budget is used; 0 if it has been used."""
        return max(0.0, self._began + share * self._budget_s - time.perf_counter())

    def _stop_after(self, ends: float) -> None:
        """Raise `Pause` if the time is up."""
        if time.perf_counter() > ends:
            self._in_time = False
            raise Pause

    def _clone(self) -> Policy:
        """Clone the behavior policy."""
        updates = min(self._config.updates, CLONE_UPDATES)
        config = replace(self._config, updates=updates, held_out=0.0)
        is_box = isinstance(self._dataset.action_space, spaces.Box)
        clone = Candidate(
            "clone", "bc", {"head": "gaussian", "relative": False} if is_box else {}, is_box
        )
        ends = time.perf_counter() + self._left_s(SHARES[0] / 2)
        folder = self._out / "clone"
        self._train_into(folder, clone.config(config), range(1), lambda now: self._stop_after(ends))
        return read_policy(policy_files(folder)[0].parent)

    def _train(self, candidates: Sequence[Candidate], until: int, share: float) -> None:
        """Train candidates until `until` updates or their times are used; the first one anyway."""
        for k, candidate in enumerate(candidates):
            left_s = self._left_s(share) / (len(candidates) - k)
            if self._updates(candidate.name) >= until:
                pass
            elif left_s > 0 or not (k or self._updates(candidate.name)):
                progress = self._until(candidate.name, until, time.perf_counter() + left_s)
                config = candidate.config(self._config)
                self._train_into(self._folder(candidate.name), config, self._seeds, progress)
            else:
                self._in_time = False
            self._publish(candidate.name, only_new=True)

    def _until(self, name: str, until: int, ends: float) -> ProgressCallback:
        """Return a callback that reports all candidates as one training, and pauses this one."""

        def report(now: TrainingProgress) -> None:
            self._done[name, now.seed] = now.done
            if not now.terms:
                return
            self._progress(self._now(now.seed, now.terms))
            if now.seed == self._seeds[-1]:
                if now.done >= until:
                    raise Pause
                self._stop_after(ends)

        return report

    def _now(self, seed: int, terms: Mapping[str, float], activity: str = "") -> TrainingProgress:
        """Return the progress of a seed of all candidates together."""
        done = sum(count for (_, each), count in self._done.items() if each == seed)
        return TrainingProgress(seed, min(done, self._total), self._total, terms, activity)

    def _train_into(
        self, folder: Path, config: TrainingConfig, seeds: range, progress: ProgressCallback
    ) -> None:
        """Start or resume a run. Return when it ends, or when the callback pauses it."""
        subfolder(folder.parent)
        with suppress(Pause), warnings.catch_warnings():
            # `_warn_about_short_horizons` names the candidates, once for both stages.
            warnings.filterwarnings("ignore", SHORT_HORIZON)
            warnings.filterwarnings("ignore", ABSOLUTE)
            train(
                self._dataset,
                config,
                folder,
                seeds=len(seeds),
                seed=seeds[0],
                resume=folder.exists(),
                device=self._device,
                progress=progress,
            )

    def _evaluate(
        self,
        kind: str,
        names: Sequence[str],
        clone: Policy,
        imitate: bool,
        fraction: float,
        share: float,
    ) -> dict[str, Tried]:
        """Return the results of candidates, best first; an empty dict if the time is too short."""
        stages = self._read_stages()
        if kind not in stages:
            found = self._collect(names, clone, self._config.model_updates * fraction, share)
            stages[kind] = self._rate(found, imitate) if found else {}
            if self._in_time:
                content = {
                    stage: {name: asdict(one) for name, one in tried.items()}
                    for stage, tried in stages.items()
                }
                write_json(self._out / STAGES_NAME, content, TrainingError)
        return stages[kind]

    def _collect(
        self, names: Sequence[str], clone: Policy, wanted: float, share: float
    ) -> dict[str, list[Evidence]]:
        """Return the evidence of all models on the networks of each candidate, if time allows."""
        policies = {name: self._policies(name) for name in names}
        activity = f"evaluating {counted(len(names), 'candidate')}"
        self._progress(self._now(self._seeds[-1], {}, activity))
        ends, updates = time.perf_counter() + self._left_s(share), round(wanted)
        ticks: list[float] = []

        def check() -> None:
            ticks.append(time.perf_counter())
            self._stop_after(ends)

        def evaluate(updates: int, member: int) -> list[Evidence]:
            is_box = isinstance(self._dataset.action_space, spaces.Box)
            model = fqe_config(self._config.gamma, updates, is_box=is_box)
            model = replace(model, clip_actions=self._config.clip_actions)
            collector = (BoxEvidenceCollector if is_box else EvidenceCollector)(
                self._dataset, clone, model, seed=member
            )
            return collector.collect([one for each in policies.values() for one in each], check)

        evidence: dict[str, list[Evidence]] = {}
        with suppress(Pause):
            if math.isfinite(ends):
                # A few updates show how many fit into the time.
                evaluate(_PROBE_UPDATES, 0)
                per_update_s = (ticks[-1] - ticks[0]) / (len(ticks) - 1)
                left_s = ends - time.perf_counter()
                affordable = 0.8 * left_s / max(per_update_s * FOLDS * ENSEMBLE, 1e-9)
                updates = min(updates, int(affordable))
            if updates < min(_LEAST_MODEL_UPDATES, wanted):
                self._in_time = False
                return {}
            for member in range(ENSEMBLE):
                found = iter(evaluate(updates, member))
                for name, each in policies.items():
                    evidence.setdefault(name, []).extend(next(found) for _ in each)
        return evidence

    def _rate(self, evidence: Mapping[str, list[Evidence]], imitate: bool) -> dict[str, Tried]:
        lengths = self._dataset.episode_lengths
        starts = np.cumsum(lengths) - lengths
        values = {name: np.stack([one.first_values for one in e]) for name, e in evidence.items()}
        agreements = {
            name: np.stack([np.add.reduceat(one.agrees.astype(np.float64), starts) for one in e])
            / lengths
            for name, e in evidence.items()
        }
        ratings = rate(values, agreements, imitate=imitate)
        return {name: self._tried(name, one, evidence[name]) for name, one in ratings.items()}

    def _tried(self, name: str, rating: Rating, evidence: Sequence[Evidence]) -> Tried:
        errors = [one.bellman_error for one in evidence if one.bellman_error is not None]
        weighted = [weighted_value(self._dataset, one, self._config.gamma) for one in evidence]
        known = [one for one in weighted if one is not None]
        return Tried(
            self._updates(name),
            rating,
            float(np.mean([one.support for one in evidence])),
            float(np.mean(errors)) if errors else None,
            tuple(np.mean(known, axis=0).tolist()) if known else None,
            check=_check(evidence),
        )

    def _folder(self, name: str) -> Path:
        return self._out / "candidates" / name

    def _updates(self, name: str) -> int:
        """Return the number of updates of a candidate's saved policies; 0 if a seed has none."""
        return saved_updates(self._folder(name), len(self._seeds))

    def _policies(self, name: str) -> list[Policy]:
        return [read_policy(file.parent) for file in policy_files(self._folder(name))]

    def _publish(self, name: str, *, only_new: bool = False) -> None:
        """Copy the policies of a candidate to the folders of the seeds in the run."""
        for seed in self._seeds:
            source, target = self._folder(name) / f"seed-{seed}", self._out / f"seed-{seed}"
            if not (source / POLICY_NAME).exists() or (only_new and target.exists()):
                continue
            with replacing_folder(target, TrainingError, overwrite=True) as folder:
                for file in ("policy.safetensors", POLICY_NAME, METRICS_NAME):
                    shutil.copyfile(source / file, folder / file)

    def _summaries(self, name: str, algo: str) -> list[OfflineSummary]:
        updates, seconds = self._updates(name), time.perf_counter() - self._began
        return [
            OfflineSummary(self._out / f"seed-{seed}", algo, seed, updates, 0, seconds, {})
            for seed in self._seeds
        ]

    def _read_stages(self) -> dict[str, dict[str, Tried]]:
        path = self._out / STAGES_NAME
        if not path.exists():
            return {}
        try:
            found = read_json(path, TrainingError, dict[str, dict[str, Tried]])
        except TrainingError as error:
            raise TrainingError(f"cannot resume: {error}") from error
        stages = {}
        for kind, stage in found.items():
            scores = {name: one.rating.score for name, one in stage.items() if one.rating}
            if len(scores) < len(stage):
                raise TrainingError(f"cannot resume: {path}: a candidate has no rating")
            stages[kind] = {name: stage[name] for name in sorted(scores, key=lambda n: -scores[n])}
        return stages


def _traits(dataset: Dataset, clone: Policy) -> LogTraits:
    """Return the properties of a log. The clone imitates its behavior policy."""
    is_box = isinstance(dataset.action_space, spaces.Box)
    entropy, coverage, known = (_spread_of_commands if is_box else _spread)(dataset, clone)
    returns = dataset.statistics.returns
    return LogTraits(
        episodes=len(dataset.episodes),
        transitions=len(dataset),
        mean_return=float(returns.mean()),
        return_spread=float(returns.std()),
        terminated=float(dataset.terminated.sum() / len(dataset.episodes)),
        entropy=entropy,
        coverage=coverage,
        probabilities=known,
        problems=tuple(one.what for one in lint(dataset) if one.severity == "problem"),
    )


def _spread(dataset: Dataset, clone: Policy) -> tuple[float, float, bool]:
    """Return the entropy and coverage of a log, and whether its probabilities are known."""
    chances = by_rows(clone.action_probabilities, dataset.observations).astype(np.float64)
    behavior = dataset.behavior_probs.astype(np.float64)
    known = not bool((np.isnan(behavior) | PROBABILITY.is_impossible(behavior)).any())
    logs = np.log(np.where(chances > 0, chances, 1.0))
    nats = -np.log(behavior).mean() if known else -(chances * logs).sum(1).mean()
    entropy = float(nats / np.log(max(chances.shape[1], 2)))
    return entropy, float(likely(chances).mean()), known


def _spread_of_commands(dataset: Dataset, clone: Policy) -> tuple[float, float, bool]:
    """Return the same for the actions of a Box."""
    assert isinstance(clone.head, BoxHead)
    box, seen, logs = clone.head.box, dataset.observations, dataset.behavior_log_probs
    known = bool(np.isfinite(logs).all())
    if not known:
        inside = box.unscaled(box.scaled(dataset.actions).clip(-1, 1))
        logs = of_both(clone.log_prob, seen, inside)
    nats = -logs.astype(np.float64).mean() + box.log_scale - box.size * np.log(2)
    random = box.unscaled(np.random.default_rng(0).uniform(-1, 1, (len(dataset), box.size)))
    width = min(float(np.exp(nats / box.size)), 1.0)
    return width, float(likely_commands(clone, seen, random).mean()), known


def _check(evidence: Sequence[Evidence]) -> BehaviorCheck | None:
    """Return what the models predict for the behavior of a log with the actions of a Box."""
    predicted = np.array([one.behavior[0] for one in evidence])
    returned = np.mean([one.behavior[1] for one in evidence], axis=0)
    if not len(returned):
        return None
    models = predicted.mean(1)
    drawn = _counts(np.random.default_rng(0), len(returned)) @ returned
    low, high = np.percentile(drawn, [2.5, 97.5]).tolist()
    means = float(models.mean()), float(models.std()), float(returned.mean())
    return BehaviorCheck(*means, (low, high))


def _skipped(traits: LogTraits, candidates: Sequence[Candidate]) -> dict[str, str]:
    """Return a dict from the name of each candidate that is not tried on a log to the reason."""
    skipped = {}
    if traits.coverage <= LEAST_COVERAGE and candidates is PORTFOLIO:
        skipped["double-dqn"] = (
            f"only {traits.coverage:.0%} of the actions are likely in the log, and it overestimates"
            " the others"
        )
    if traits.return_spread == 0 and traits.terminated == 0:
        alike = "all episodes have the same return, so there is nothing to prefer"
        skipped |= {one.name: alike for one in candidates if one.algo not in ("bc", "bcq", "cql")}
    return skipped


def _warn_about_short_horizons(candidates: Iterable[Candidate], shared: AutoConfig) -> None:
    """Warn once about all candidates that have the same short horizon."""
    found: dict[str, list[str]] = {}
    for one in candidates:
        if message := horizon_warning(one.config(shared)):
            found.setdefault(message, []).append(one.name)
    for message, names in found.items():
        warnings.warn(f"{', '.join(names)}: {message}", stacklevel=2)

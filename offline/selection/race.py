"""Training of several candidates, of which only the best are trained to the end.

    RUN/config.json       settings of `auto` and the data
    RUN/clone             clone of the behavior policy, which distinguishes likely from rare actions
    RUN/candidates/NAME   run of a candidate
    RUN/stages.json       evaluations of the candidates after the short and the full training
    RUN/choice.json       what was chosen, and why
    RUN/seed-K            policy of the chosen candidate

All candidates are trained with a fraction of the updates (the short training). The best of the
finalists, by `rule`, are trained with the rest, and one of them is chosen. After the first
candidate's short training, RUN/seed-K always has a policy, also if the run is interrupted.
"""

from __future__ import annotations

import math
import shutil
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import TrainingError, UsageError
from mcaprl.files import parse_json, read_file, replacing_folder, subfolder, write_json
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.estimate.evidence import (
    FOLDS,
    Evidence,
    EvidenceCollector,
    fqe_config,
    weighted_value,
)
from mcaprl.offline.policy import Policy, read_policy
from mcaprl.offline.selection.choice import (
    STOPPED_EARLY,
    Choice,
    Tried,
    advice_for,
    confidence_of,
    reason_of,
)
from mcaprl.offline.selection.config import AUTO, AutoConfig
from mcaprl.offline.selection.portfolio import (
    Candidate,
    LogTraits,
    check_finalists,
    eligible,
    skipped_candidates,
    traits_of,
    tried,
)
from mcaprl.offline.selection.rule import Rating, ranked, rate
from mcaprl.offline.training.metrics import OfflineSummary
from mcaprl.offline.training.train import fingerprint, train, with_source
from mcaprl.offline.training.watch import SHORT_HORIZON, horizon_warning
from mcaprl.progress import ProgressCallback, TrainingProgress
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

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

STAGES_NAME: Final = "stages.json"
ENSEMBLE: Final = 2
"""Number of models that evaluate a policy.

Each has its own halves of the log and its own weights.
"""
SHARES: Final = (0.35, 0.5, 0.8, 0.95)
"""Fractions of the budget after which the four phases end.

The phases are the short training, its evaluation, the full training and its evaluation.
"""
CLONE_UPDATES: Final = 2_000
"""Maximum number of updates of the clone of the behavior policy."""
_NO_TIME: Final = "the budget ended before {} had a checkpoint: give more minutes"
_PROBE_UPDATES: Final = 10
_LEAST_MODEL_UPDATES: Final = 100
_SHORT_MODEL_FRACTION: Final = 0.5


class _Pause(Exception):
    """Exception that a progress callback raises to stop a training."""


@dataclass(frozen=True)
class Stage:
    """Evaluations of candidates after the same number of updates.

    Attributes:
        tried: Results of each candidate.
    """

    tried: dict[str, Tried]

    @property
    def ratings(self) -> dict[str, Rating]:
        """Rating of each candidate that has one."""
        return {name: one.rating for name, one in self.tried.items() if one.rating}

    def to_json(self) -> dict[str, Any]:
        """Return the evaluations as plain JSON types."""
        return {name: one.to_json() for name, one in self.tried.items()}

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Stage:
        """Return the evaluations that `to_json` returned."""
        return cls({name: Tried.from_json(one) for name, one in found.items()})


def select(
    dataset: Dataset,
    config: AutoConfig,
    out: Path,
    *,
    seeds: int | None = None,
    seed: int | None = None,
    weights: NDArray[np.float64] | None = None,
    resume: bool = False,
    device: str = "cpu",
    budget_minutes: float | None = None,
    progress: ProgressCallback = lambda now: None,
) -> tuple[Choice, list[OfflineSummary]]:
    """Train all candidates on a dataset, and choose one policy from the log alone.

    Args:
        dataset: Dataset with discrete actions.
        config: Settings.
        out: Folder of the run; it must be empty or not exist.
        seeds: Number of networks of each candidate; its estimates are averages over them. None
            selects 1; with `resume`, that of the run.
        seed: Seed of the first network. None selects 0; with `resume`, that of the run.
        weights: (E,) relative sampling weight of a transition of each episode; default: all equal.
        resume: Whether to resume the run in `out`.
        device: `cpu` or `cuda`.
        budget_minutes: Wall time after which no update is started; None for no bound.
        progress: Callback for the progress of all candidates together.

    Returns:
        The choice, and a summary for each seed of the chosen candidate.

    Raises:
        OutputExistsError: `out` exists and is not empty.
        SpaceError: The algorithms do not support these observations or actions.
        TrainingError: A loss is not finite; `out` cannot be written, or contains a run with other
            data or settings; or the budget ended before any policy was trained.
        UnknownNameError: A finalist is not a candidate.
        UsageError: There are too few episodes, or the run to resume has other seeds.
    """
    check_finalists(config)
    dataset = with_source(dataset, config.mask_from)
    if len(dataset.episodes) < FOLDS:
        raise UsageError(f"--algo {AUTO} needs {FOLDS} episodes or more in the log")
    weights = np.ones(len(dataset.episodes)) if weights is None else weights
    numbers = choose_seeds(out, seeds, seed, resume)
    parts: dict[str, Any] = {"algo": AUTO, "config": config.to_json()}
    # The estimates of all candidates are averages over the same seeds, so none can be added.
    parts |= {"seeds": len(numbers), "seed": numbers.start, "data": fingerprint(dataset, weights)}
    with locked_run(out, resume):
        open_run(
            out,
            RunIdentity(parts),
            resume,
            numbers,
            env_id=dataset.env_id,
            transitions=len(dataset),
        )
        race = _Race(
            dataset,
            config,
            out,
            numbers,
            weights,
            device,
            _Clock(budget_minutes),
            progress,
        )
        return race.run()


class _Clock:
    """Wall time of a run with a budget."""

    def __init__(self, minutes: float | None) -> None:
        self._began = time.perf_counter()
        self._budget_s = math.inf if minutes is None else 60 * minutes

    @property
    def is_bounded(self) -> bool:
        """Whether there is a budget."""
        return self._budget_s < math.inf

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._began

    def left_s(self, share: float) -> float:
        """Return the seconds until a fraction of the budget is used; 0 if it has been used."""
        return max(0.0, share * self._budget_s - self.elapsed_s)


class _Race:
    """State of one run of `select`."""

    def __init__(
        self,
        dataset: Dataset,
        config: AutoConfig,
        out: Path,
        seeds: range,
        weights: NDArray[np.float64],
        device: str,
        clock: _Clock,
        progress: ProgressCallback,
    ) -> None:
        self._dataset, self._config, self._out = dataset, config, out
        self._seeds, self._weights, self._device = seeds, weights, device
        self._clock, self._progress = clock, progress
        self._in_time = True
        self._eligible: frozenset[str] = frozenset()

    def run(self) -> tuple[Choice, list[OfflineSummary]]:
        """Run both stages. Return the choice, and a summary for each seed."""
        clone, traits = self._look()
        skipped = skipped_candidates(traits)
        trying = tried(skipped)
        short, full = self._config.short_updates, self._config.updates
        self._eligible = eligible(self._config, trying)
        count = min(len(self._eligible), self._config.survivors)
        total = len(trying) * short + count * (full - short)
        bar = _Bar(self._progress, total)
        self._warn_about_short_horizons(trying)
        stages = self._read_stages()
        for k, candidate in enumerate(trying):
            share_s = self._clock.left_s(SHARES[0]) / (len(trying) - k)
            self._train(candidate, short, share_s, bar)
            self._publish(candidate.name, only_first=True)
        names = [one.name for one in trying if self._updates(one.name)]
        if not names:
            raise TrainingError(_NO_TIME.format(trying[0].name))
        first = stages.get("short") or self._evaluate(
            "short",
            names,
            clone,
            imitate=traits.is_deterministic,
            fraction=_SHORT_MODEL_FRACTION,
            share=SHARES[1],
        )
        going = self._finalists(names)
        if first:
            going = self._finalists(ranked(first.ratings))[: self._config.survivors]
            self._publish(going[0])
        for k, name in enumerate(going):
            candidate = next(one for one in trying if one.name == name)
            self._train(candidate, full, self._clock.left_s(SHARES[2]) / (len(going) - k), bar)
        second = stages.get("full") or self._evaluate(
            "full",
            going,
            clone,
            imitate=traits.is_deterministic,
            fraction=1.0,
            share=SHARES[3],
        )
        choice = self._choose(traits, skipped, first, second, names)
        self._publish(choice.chosen)
        choice.write(self._out)
        return choice, self._summaries(choice.chosen)

    def _warn_about_short_horizons(self, candidates: Sequence[Candidate]) -> None:
        """Warn once about all candidates that have the same short horizon."""
        found: dict[str, list[str]] = {}
        for one in candidates:
            if message := horizon_warning(one.config(self._config)):
                found.setdefault(message, []).append(one.name)
        for message, names in found.items():
            warnings.warn(f"{', '.join(names)}: {message}", stacklevel=2)

    def _finalists(self, names: Sequence[str]) -> list[str]:
        """Return the finalists among the candidates; all candidates if none is a finalist."""
        return [name for name in names if name in self._eligible] or list(names)

    def _look(self) -> tuple[Policy, LogTraits]:
        """Clone the behavior policy, and determine the properties of the log."""
        count = min(self._config.updates, CLONE_UPDATES)
        shared = replace(self._config, updates=count, held_out=0.0)
        config = Candidate("clone", "bc", {}).config(shared)
        ends = time.perf_counter() + self._clock.left_s(SHARES[0] / 2)

        def stop(now: TrainingProgress) -> None:
            if time.perf_counter() > ends:
                self._in_time = False
                raise _Pause

        folder = self._out / "clone"
        self._train_into(folder, config, range(1), stop)
        files = policy_files(folder)
        if not files:
            raise TrainingError(_NO_TIME.format("the clone of the behavior"))
        clone = read_policy(files[0].parent)
        return clone, traits_of(self._dataset, clone)

    def _train(self, candidate: Candidate, until: int, share_s: float, bar: _Bar) -> None:
        """Train a candidate until it has `until` updates or its share of the time is used."""
        if self._updates(candidate.name) >= until:
            return
        if not share_s > 0:
            self._in_time = False
            return
        ends = time.perf_counter() + share_s

        def stop(now: TrainingProgress) -> None:
            bar.show(candidate.name, now)
            if now.seed != self._seeds[-1]:
                return
            if now.done >= until:
                raise _Pause
            if time.perf_counter() > ends:
                self._in_time = False
                raise _Pause

        config = candidate.config(self._config)
        self._train_into(self._folder(candidate.name), config, self._seeds, stop)

    def _train_into(
        self, folder: Path, config: TrainingConfig, seeds: range, progress: ProgressCallback
    ) -> None:
        """Start or resume a run. Return when it ends, or when the callback pauses it."""
        subfolder(folder.parent)
        with suppress(_Pause), warnings.catch_warnings():
            # `_warn_about_short_horizons` names the candidates, once for both stages.
            warnings.filterwarnings("ignore", SHORT_HORIZON)
            train(
                self._dataset,
                config,
                folder,
                seeds=len(seeds),
                seed=seeds[0],
                weights=self._weights,
                resume=folder.exists(),
                device=self._device,
                progress=progress,
            )

    def _agreements(self, evidence: Evidence) -> NDArray[np.float64]:
        """Return the fraction (E,) of each episode's states where the policy agrees.

        A policy agrees in a state if it takes the logged action.
        """
        lengths = self._dataset.episode_lengths
        agrees = evidence.agrees.astype(np.float64)
        return np.add.reduceat(agrees, np.cumsum(lengths) - lengths) / lengths

    def _evaluate(
        self,
        kind: str,
        names: Sequence[str],
        clone: Policy,
        *,
        imitate: bool,
        fraction: float,
        share: float,
    ) -> Stage | None:
        """Evaluate candidates. Return None if the time is too short."""
        policies = [(name, policy) for name in names for policy in self._policies(name)]
        ends = time.perf_counter() + self._clock.left_s(share)
        updates = round(self._config.model_updates * fraction)
        if self._clock.is_bounded:
            updates = min(updates, self._affordable(clone, policies, ends))
        if updates < min(_LEAST_MODEL_UPDATES, self._config.model_updates * fraction):
            self._in_time = False
            return None
        evidence: dict[str, list[Evidence]] = {name: [] for name in names}
        try:
            for member in range(ENSEMBLE):
                found = self._collect(clone, policies, updates, member, ends)
                for (name, _), one in zip(policies, found, strict=True):
                    evidence[name].append(one)
        except _Pause:
            self._in_time = False
            if not all(evidence.values()):
                return None
        values, agreements = (
            {name: np.stack([table(one) for one in of_it]) for name, of_it in evidence.items()}
            for table in (lambda one: one.first_values, self._agreements)
        )
        ratings = rate(values, agreements, imitate=imitate)
        stage = Stage(
            {name: self._tried(name, ratings[name], evidence[name]) for name in names},
        )
        if self._in_time:
            self._write_stage(kind, stage)
        return stage

    def _collect(
        self,
        clone: Policy,
        policies: Sequence[tuple[str, Policy]],
        updates: int,
        member: int,
        ends: float,
        ticks: list[float] | None = None,
    ) -> list[Evidence]:
        """Return one model's evidence for each policy. Raise `_Pause` if the time is up."""

        def check() -> None:
            now = time.perf_counter()
            if ticks is not None:
                ticks.append(now)
            if now > ends:
                raise _Pause

        model = fqe_config(self._config.gamma, updates)
        collector = EvidenceCollector(self._dataset, clone, model, seed=member)
        return collector.collect([policy for _, policy in policies], on_update=check)

    def _affordable(
        self, clone: Policy, policies: Sequence[tuple[str, Policy]], ends: float
    ) -> int:
        """Run a few updates of the models, and estimate how many fit into the time."""
        ticks: list[float] = []
        try:
            self._collect(clone, policies, _PROBE_UPDATES, 0, ends, ticks)
        except _Pause:
            return 0
        began = time.perf_counter()
        per_update_s = (ticks[-1] - ticks[0]) / (len(ticks) - 1)
        return int(0.8 * (ends - began) / max(per_update_s * FOLDS * ENSEMBLE, 1e-9))

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
        )

    def _choose(
        self,
        traits: LogTraits,
        skipped: Mapping[str, str],
        first: Stage | None,
        second: Stage | None,
        names: Sequence[str],
    ) -> Choice:
        """Return the choice according to the latest evaluation."""
        last = second or first
        ratings = last.ratings if last else {}
        order = self._finalists(ranked(ratings))
        chosen = (order or self._finalists(names))[0]
        rest = [name for name in ranked(first.ratings) if name not in order] if first else []
        known = {name: Tried(self._updates(name), outcome="not evaluated") for name in names}
        for stage, outcome in ((first, STOPPED_EARLY), (second, "")):
            for name, one in stage.tried.items() if stage else ():
                known[name] = replace(one, outcome=outcome)
        runners = [name for name in order if name != chosen][:1]
        for name, outcome in [(name, "runner-up") for name in runners] + [(chosen, "chosen")]:
            known[name] = replace(known[name], outcome=outcome)
        shown = dict.fromkeys([chosen, *runners, *order, *rest, *names])
        table = {name: known[name] for name in shown}
        table |= {
            one.name: Tried(outcome="no checkpoint within the budget")
            for one in tried(skipped)
            if one.name not in table
        }
        table |= {name: Tried(outcome=f"not tried: {why}") for name, why in skipped.items()}
        return Choice(
            chosen,
            reason_of(chosen, ratings, traits),
            confidence_of(chosen, ratings),
            advice_for(traits, table, self._in_time),
            self._in_time,
            traits,
            table,
        )

    def _folder(self, name: str) -> Path:
        return self._out / "candidates" / name

    def _updates(self, name: str) -> int:
        """Return the number of updates of a candidate's saved policies; 0 if a seed has none."""
        return saved_updates(self._folder(name), len(self._seeds))

    def _policies(self, name: str) -> list[Policy]:
        return [read_policy(file.parent) for file in policy_files(self._folder(name))]

    def _publish(self, name: str, *, only_first: bool = False) -> None:
        """Copy the policies of a candidate to the folders of the seeds in the run."""
        for seed in self._seeds:
            source, target = self._folder(name) / f"seed-{seed}", self._out / f"seed-{seed}"
            if not (source / POLICY_NAME).exists() or (only_first and target.exists()):
                continue
            with replacing_folder(target, TrainingError, overwrite=True) as folder:
                for file in ("policy.safetensors", POLICY_NAME, METRICS_NAME):
                    shutil.copyfile(source / file, folder / file)

    def _summaries(self, name: str) -> list[OfflineSummary]:
        updates = self._updates(name)
        algo = next(one.algo for one in tried({}) if one.name == name)
        folders = [(seed, self._out / f"seed-{seed}") for seed in self._seeds]
        seconds = self._clock.elapsed_s
        return [
            OfflineSummary(folder, algo, seed, updates, 0, seconds, {}) for seed, folder in folders
        ]

    def _read_stages(self) -> dict[str, Stage]:
        path = self._out / STAGES_NAME
        if not path.exists():
            return {}
        try:
            found = parse_json(read_file(path))
            return {kind: Stage.from_json(stage) for kind, stage in found.items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise TrainingError(f"cannot resume: {path} cannot be read: {error}") from error

    def _write_stage(self, kind: str, stage: Stage) -> None:
        stages = {**self._read_stages(), kind: stage}
        content = {name: one.to_json() for name, one in stages.items()}
        write_json(self._out / STAGES_NAME, content, TrainingError)


class _Bar:
    """Progress of all candidates together, reported as if it were one training."""

    def __init__(self, report: ProgressCallback, total: int) -> None:
        self._report, self._total = report, total
        self._done: dict[tuple[str, int], int] = {}

    def show(self, name: str, now: TrainingProgress) -> None:
        """Report the updates of all candidates of a seed."""
        self._done[name, now.seed] = now.done
        done = sum(count for (_, seed), count in self._done.items() if seed == now.seed)
        self._report(TrainingProgress(now.seed, min(done, self._total), self._total, now.terms))

"""Train one algorithm on one dataset, with several seeds at once, into a run folder.

RUN/config.json                         algorithm, settings, data
RUN/curves.png                          all seeds' curves, see `curves`
RUN/seed-0/policy.json, .safetensors    see `policy`
RUN/seed-0/checkpoint.safetensors       see `checkpoint`
RUN/seed-0/metrics.csv                  loss terms by update; the same for TensorBoard
RUN/seed-1/...
"""

from __future__ import annotations

import hashlib
import time
import warnings
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import TrainingError, UsageError
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.learner import Learner, NotFiniteError
from mcaprl.offline.algorithms.registry import choose_algorithm
from mcaprl.offline.batches.buffer import TransitionBuffer, choose_device
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.offline.policy import POLICY_NAME, load_policy, save_policy
from mcaprl.offline.training.checkpoint import (
    CHECKPOINT_NAME,
    Checkpoint,
    RunIdentity,
    read_checkpoint,
    save_checkpoint,
)
from mcaprl.offline.training.follow import CHECK_INTERVAL, GrowingLogs, with_more_data
from mcaprl.offline.training.metrics import MetricsWriter
from mcaprl.offline.training.run_folder import RunFolder
from mcaprl.offline.training.summary import RunSummary
from mcaprl.offline.training.watch import (
    HeldOut,
    choose_held_out,
    divergence_warning,
    horizon_warning,
    largest_return,
)
from mcaprl.progress import ProgressCallback, TrainingProgress, terminal_progress

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

_T = TypeVar("_T")


def train(
    dataset: Dataset,
    algo: str | TrainingConfig,
    out: str | Path,
    *,
    seeds: int = 1,
    seed: int = 0,
    weights: NDArray[np.float64] | None = None,
    resume: bool = False,
    other_data: bool = False,
    follow: GrowingLogs | None = None,
    device: str = "cpu",
    progress: ProgressCallback | None = None,
) -> list[RunSummary]:
    """Train on a dataset; the same seed, data and machine give the same weights.

    Args:
        dataset: with discrete actions.
        algo: a name such as `cql`, with default settings, or a config such as
            `CQLConfig(alpha=0.5)`.
        out: the run's folder; it must not exist, or be empty.
        seeds: how many networks to train, side by side; they do not depend on each other.
        seed: of the first; the others count up from it.
        weights: (E,) how often each transition of an episode is drawn, relative to others; default:
            all alike.
        resume: go on from the last checkpoints in `out`. What is not there yet starts afresh.
        other_data: when resuming, go on even if the checkpoints are from other data.
        follow: logs that `dataset` was read from and that grow; each episode that is finished
            while the networks learn is learned from, too.
        device: `cpu` or `cuda`: there the data and the networks are, and the updates are made.
        progress: called with each row of metrics; None shows a bar where stderr is a terminal.

    Returns:
        One summary for each seed.

    Raises:
        UnknownNameError: there is no such algorithm.
        UsageError: there is no such device.
        OutputExistsError: `out` is taken.
        SpaceError: the algorithm cannot learn with these observations or actions.
        TrainingError: the loss is NaN or infinite, or `out` has a run with other data or settings.
    """
    if seeds < 1 or seed < 0:
        raise UsageError(f"seeds must be at least 1 and seed at least 0, got {seeds} and {seed}")
    place = choose_device(device)
    learner_type, config = choose_algorithm(algo)
    weights = np.ones(len(dataset.episodes)) if weights is None else weights
    _check_weights(weights, len(dataset.episodes))
    identity = RunIdentity(learner_type.name, config, _fingerprint(dataset, weights), other_data)
    source = {"env_id": dataset.env_id, "transitions": len(dataset)}
    folder = RunFolder(Path(out), identity, source)
    held_out = choose_held_out(len(weights), config.held_out)
    buffer = TransitionBuffer.from_dataset(
        dataset,
        config.packing,
        encoder=_earlier_encoder(folder) if resume and other_data else None,
        weights=np.where(np.isin(np.arange(len(weights)), held_out), 0.0, weights),
    ).to(place)
    folder.open(resume)
    if message := horizon_warning(config):
        warnings.warn(message, stacklevel=2)
    run = _Run.over(folder, dataset, buffer, held_out, follow)
    with nullcontext(progress) if progress else terminal_progress("updates", "loss") as report:
        return run.train(learner_type, range(seed, seed + seeds), report)


@dataclass(frozen=True)
class _Run:
    """What all seeds of a run share.

    Attributes:
        folder: of the run.
        dataset: that it learns from.
        buffer: the same, packed.
        held_out: transitions to judge the networks by, if any.
        limit: no return can be larger in size.
        never_drawn: numbers of the held-out episodes.
        follow: the logs, if they may grow.
    """

    folder: RunFolder
    dataset: Dataset
    buffer: TransitionBuffer
    held_out: HeldOut | None
    limit: float
    never_drawn: NDArray[np.int64]
    follow: GrowingLogs | None

    @classmethod
    def over(
        cls,
        folder: RunFolder,
        dataset: Dataset,
        buffer: TransitionBuffer,
        held_out: NDArray[np.int64],
        follow: GrowingLogs | None,
    ) -> _Run:
        """A run that holds out some episodes, given by their numbers."""
        gamma = buffer.packing.gamma
        watched = HeldOut(dataset, buffer, held_out, gamma) if len(held_out) else None
        limit = largest_return(dataset, gamma)
        return cls(folder, dataset, buffer, watched, limit, held_out, follow)

    def train(
        self, learner_type: type[Learner], seeds: range, report: ProgressCallback
    ) -> list[RunSummary]:
        """Train seeds, side by side if their checkpoints are at the same update."""
        summaries = []
        for start in _starts(self.folder, seeds):
            learner = learner_type(self.folder.identity.config, self.buffer, list(start))
            for seed, checkpoint in start.items():
                if checkpoint is not None:
                    checkpoint.restore(learner, seed)
            summaries += self._train_learner(learner, report)
        return sorted(summaries, key=lambda summary: summary.seed)

    def _train_learner(self, learner: Learner, report: ProgressCallback) -> list[RunSummary]:
        """Make all updates that are left to a learner's seeds."""
        began, resumed_at = time.perf_counter(), learner.step
        updates, seeds = learner.config.updates, learner.seeds
        terms: list[dict[str, float]] = [{} for _ in seeds]
        warned = False
        with ExitStack() as stack:
            metrics = [
                stack.enter_context(MetricsWriter(self.folder.of_seed(seed), learner.step + 1))
                for seed in (seeds if learner.step < updates else ())
            ]
            while learner.step < updates:
                learner = self._with_new_episodes(learner)
                before, terms = terms, self._train_to_next_stop(learner, metrics)
                warned = warned or self._warn(before, terms)
                for seed, mine in zip(seeds, terms, strict=True):
                    report(TrainingProgress(seed, learner.step, updates, mine))
        seconds = time.perf_counter() - began
        folders = [self.folder.of_seed(seed) for seed in seeds]
        return [
            RunSummary(folder, learner.name, seed, updates, resumed_at, seconds, mine)
            for folder, seed, mine in zip(folders, seeds, terms, strict=True)
        ]

    def _train_to_next_stop(
        self, learner: Learner, metrics: list[MetricsWriter]
    ) -> list[dict[str, float]]:
        """Update until something is to be written, and write it."""
        config = learner.config
        while True:
            terms = self._check(learner.update)
            last = learner.step == config.updates
            checkpoint_due = last or learner.step % config.checkpoint_interval == 0
            if checkpoint_due or learner.step % config.log_interval == 0:
                break
        values = learner.seed_means(terms)
        if self.held_out is not None:
            judged = self.held_out.terms(learner)
            values = [mine | held for mine, held in zip(values, judged, strict=True)]
        if self.follow is not None:
            known = {"transitions": float(len(learner.buffer))}
            values = [mine | known for mine in values]
        rate = config.learning_rate_at(learner.step - 1)
        for writer, mine in zip(metrics, values, strict=True):
            writer.write(learner.step, rate, mine)
        if checkpoint_due:
            self._save(learner)
        return values

    def _with_new_episodes(self, learner: Learner) -> Learner:
        """The learner, now and then with the episodes that were logged meanwhile."""
        if self.follow is None or learner.step % CHECK_INTERVAL or not self.follow.grow():
            return learner
        return with_more_data(learner, self.follow.dataset, self.never_drawn)

    def _save(self, learner: Learner) -> None:
        """Write each seed's policy and then its checkpoint.

        The checkpoint comes last: a kill before it costs updates, but leaves no policy behind that
        is older than a finished run.
        """
        for seed in learner.seeds:
            folder = self.folder.of_seed(seed)
            save_policy(folder, learner, seed, self.dataset.env_id, self.dataset.env_kwargs)
            save_checkpoint(folder, learner, seed, self.folder.identity)

    def _check(self, work: Callable[[], _T]) -> _T:
        """Do a part of the work; a loss that is not finite stops the run."""
        try:
            return work()
        except NotFiniteError as error:
            paths = sorted(self.folder.path.glob(f"seed-*/{CHECKPOINT_NAME}"))
            good = ", ".join(map(str, paths)) or "none yet"
            raise TrainingError(
                f"update {error.update} of {self.folder.path}: {error}. Last good checkpoint:"
                f" {good}. Look for huge values in the data, or lower the learning rate"
            ) from error

    def _warn(self, before: list[dict[str, float]], now: list[dict[str, float]]) -> bool:
        """Tell of values that run away, once; gives whether it was told."""
        for earlier, later in zip(before, now, strict=True):
            if "mean_q" not in earlier:
                continue
            if message := divergence_warning(earlier["mean_q"], later["mean_q"], self.limit):
                warnings.warn(message, stacklevel=2)
                return True
        return False


def _starts(folder: RunFolder, seeds: range) -> list[dict[int, Checkpoint | None]]:
    """Seeds with their checkpoints, in groups that have done the same number of updates."""
    groups: dict[int, dict[int, Checkpoint | None]] = {}
    for seed in seeds:
        checkpoint = read_checkpoint(folder.of_seed(seed), folder.identity)
        groups.setdefault(checkpoint.step if checkpoint else 0, {})[seed] = checkpoint
    return list(groups.values())


def _earlier_encoder(folder: RunFolder) -> ObservationEncoder | None:
    """The normalisation that the weights in a folder are used to."""
    policies = sorted(folder.path.glob(f"seed-*/{POLICY_NAME}"))
    return load_policy(policies[0].parent).encoder if policies else None


def _fingerprint(dataset: Dataset, weights: NDArray[np.float64]) -> str:
    """Of the data, and of their weights where these differ."""
    if len(set(weights.tolist())) < 2:
        return dataset.fingerprint
    return hashlib.sha256(dataset.fingerprint.encode() + weights.tobytes()).hexdigest()


def _check_weights(weights: NDArray[np.float64], n_episodes: int) -> None:
    if weights.shape != (n_episodes,) or not np.isfinite(weights).all() or (weights < 0).any():
        raise UsageError(
            f"weights must be {n_episodes} numbers of at least 0, one for each episode"
        )

"""Train one algorithm on one dataset, with several seeds, into a run folder.

RUN/config.json                         algorithm, settings, data
RUN/seed-0/policy.json, .safetensors    see `policy`
RUN/seed-0/checkpoint.safetensors       see `checkpoint`
RUN/seed-0/metrics.csv                  loss terms by update; the same for TensorBoard
RUN/seed-1/...
"""

from __future__ import annotations

import json
import time
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from mcaprl.errors import OutputExistsError, TrainingError, UsageError
from mcaprl.files import write_json
from mcaprl.offline.algorithms import choose_algorithm
from mcaprl.offline.buffer import TransitionBuffer
from mcaprl.offline.checkpoint import (
    CHECKPOINT_NAME,
    RunIdentity,
    load_checkpoint,
    save_checkpoint,
)
from mcaprl.offline.config import TrainingConfig
from mcaprl.offline.learner import Learner, NotFiniteError
from mcaprl.offline.metrics import MetricsWriter
from mcaprl.offline.policy import save_policy
from mcaprl.progress import ProgressCallback, TrainingProgress, terminal_progress

if TYPE_CHECKING:
    from mcaprl.recorder.dataset import Dataset

CONFIG_NAME = "config.json"


@dataclass(frozen=True)
class RunSummary:
    """How the training of one seed ended.

    Attributes:
        folder: with the policy, RUN/seed-K.
        algo: the algorithm's name.
        seed: K.
        updates: done in all.
        resumed_at: updates that an earlier session had done; 0 for a fresh start.
        seconds: wall time of this session.
        terms: the last update's loss terms; empty if there was nothing left to do.
    """

    folder: Path
    algo: str
    seed: int
    updates: int
    resumed_at: int
    seconds: float
    terms: dict[str, float]


def train(
    dataset: Dataset,
    algo: str | TrainingConfig,
    out: str | Path,
    *,
    seeds: int = 1,
    seed: int = 0,
    resume: bool = False,
    progress: ProgressCallback | None = None,
) -> list[RunSummary]:
    """Train on a dataset; the same seed, data and machine give the same weights.

    Args:
        dataset: with discrete actions.
        algo: `dqn`, `double-dqn`, `cql` or `bc` with default settings, or a config such as
            `CQLConfig(alpha=0.5)`.
        out: the run's folder; it must not exist, or be empty.
        seeds: how many networks to train, one after the other.
        seed: of the first; the others count up from it.
        resume: go on from the last checkpoints in `out`. What is not there yet starts afresh.
        progress: called with each row of metrics; None shows a bar where stderr is a terminal.

    Returns:
        One summary for each seed.

    Raises:
        UnknownNameError: there is no such algorithm.
        OutputExistsError: `out` is taken.
        SpaceError: the algorithm cannot learn with these observations or actions.
        TrainingError: the loss is NaN or infinite, or `out` has a run with other data or settings.
    """
    if seeds < 1 or seed < 0:
        raise UsageError(f"seeds must be at least 1 and seed at least 0, got {seeds} and {seed}")
    learner_type, config = choose_algorithm(algo)
    buffer = TransitionBuffer.from_dataset(dataset)
    run = _Run(Path(out), dataset, RunIdentity(learner_type.name, config, dataset.fingerprint))
    run.open(resume)
    with nullcontext(progress) if progress else terminal_progress("updates", "loss") as report:
        return [
            run.train_seed(learner_type, buffer, number, report)
            for number in range(seed, seed + seeds)
        ]


@dataclass(frozen=True)
class _Run:
    """A run folder, and what every seed in it shares."""

    folder: Path
    dataset: Dataset
    identity: RunIdentity

    def open(self, resume: bool) -> None:
        """Make the folder, or make sure that it is this run's."""
        path = self.folder / CONFIG_NAME
        if resume and path.exists():
            self._check_same_run(path)
            return
        if self.folder.is_file() or (self.folder.is_dir() and any(self.folder.iterdir())):
            raise OutputExistsError(
                f"{self.folder} exists: choose another folder"
                + (
                    "; it holds no run to resume"
                    if resume
                    else ", or resume the run in it (--resume)"
                )
            )
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise TrainingError(f"cannot write {self.folder}: {error.strerror}") from error
        source = {"env_id": self.dataset.env_id, "transitions": len(self.dataset.rewards)}
        write_json(path, {**self.identity.to_json(), **source})

    def train_seed(
        self,
        learner_type: type[Learner],
        buffer: TransitionBuffer,
        seed: int,
        report: ProgressCallback,
    ) -> RunSummary:
        """Train one network, from its last checkpoint if it has one."""
        folder = self.folder / f"seed-{seed}"
        folder.mkdir(exist_ok=True)
        began = time.perf_counter()
        with torch.random.fork_rng(devices=[]):
            learner = learner_type(self.identity.config, buffer, seed)
            load_checkpoint(folder, learner, self.identity)
            resumed_at = learner.step
            terms: dict[str, float] = {}
            if resumed_at < learner.config.updates:
                terms = self._train(folder, learner, seed, report)
        seconds = time.perf_counter() - began
        return RunSummary(folder, learner.name, seed, learner.step, resumed_at, seconds, terms)

    def _train(
        self, folder: Path, learner: Learner, seed: int, report: ProgressCallback
    ) -> dict[str, float]:
        """Make all updates that are left; gives the last one's terms."""
        updates = learner.config.updates
        with MetricsWriter(folder, learner.step + 1) as metrics:
            while True:
                terms = self._train_to_next_stop(folder, learner, metrics)
                report(TrainingProgress(seed, learner.step, updates, terms))
                if learner.step == updates:
                    return terms

    def _train_to_next_stop(
        self, folder: Path, learner: Learner, metrics: MetricsWriter
    ) -> dict[str, float]:
        """Update until something is to be written, and write it."""
        config = learner.config
        while True:
            terms = _update(folder, learner)
            last = learner.step == config.updates
            checkpoint_due = last or learner.step % config.checkpoint_interval == 0
            if not (checkpoint_due or learner.step % config.log_interval == 0):
                continue
            values = {name: term.item() for name, term in terms.items()}
            metrics.write(learner.step, config.learning_rate_at(learner.step - 1), values)
            if checkpoint_due:
                # The checkpoint comes last: a kill before it costs updates, but leaves no policy
                # behind that is older than a finished run.
                save_policy(folder, learner, self.dataset.env_id, self.dataset.env_kwargs)
                save_checkpoint(folder, learner, self.identity)
            return values

    def _check_same_run(self, path: Path) -> None:
        self.identity.check_same(read_config(path), path)


def read_config(path: Path) -> dict[str, Any]:
    """What RUN/config.json says: `algo`, `config`, `data` and where the data came from.

    Raises:
        TrainingError: it cannot be read, or is no JSON object.
    """
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise TrainingError(f"cannot resume: {path} cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise TrainingError(f"cannot resume: {path} is no JSON object")
    return found


def _update(folder: Path, learner: Learner) -> dict[str, torch.Tensor]:
    try:
        return learner.update()
    except NotFiniteError as error:
        path = folder / CHECKPOINT_NAME
        good = path if path.exists() else "none yet"
        raise TrainingError(
            f"update {learner.step + 1} of {folder}: {error}. Last good checkpoint: {good}. "
            "Look for NaN or huge values in the data, or lower the learning rate"
        ) from error

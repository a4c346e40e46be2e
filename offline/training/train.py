"""Train one algorithm on one dataset, with several seeds at once, into a run folder.

`mcaprl.runs` lists the files of a run folder. A resumed run has the same result as an uninterrupted
one: `checkpoint.safetensors` contains one seed's tensors (weights, target network, optimizer,
generator), and its header the number of updates and the run's identity. All are in one file,
because two files would be inconsistent if the process were killed between the two writes.
"""

from __future__ import annotations

import time
import warnings
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.actions import BoxActions, has_source
from mcaprl.errors import TrainingError, UsageError
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.learner import Learner, NotFiniteError
from mcaprl.offline.algorithms.registry import Algorithm, choose_algorithm
from mcaprl.offline.batches.buffer import TransitionBuffer, choose_device
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.offline.batches.relative import RelativeActions
from mcaprl.offline.policy import read_policy, save_policy
from mcaprl.offline.training.metrics import MetricsWriter, OfflineSummary
from mcaprl.offline.training.watch import (
    HeldOut,
    choose_held_out,
    divergence_warning,
    horizon_warning,
    largest_return,
    relative_warning,
    schedule_warning,
)
from mcaprl.progress import Pause, ProgressCallback, TrainingProgress, terminal_progress
from mcaprl.recorder.edit.piece import episode_values
from mcaprl.runs import (
    CHECKPOINT_NAME,
    RunIdentity,
    choose_seeds,
    locked_run,
    open_run,
    policy_files,
    read_updates,
    seed_folder,
)

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset
from safetensors import SafetensorError

from mcaprl.runs import broken_checkpoint
from mcaprl.storage.tensor_files import read_tensors, write_tensors


@dataclass(frozen=True)
class Checkpoint:
    """Stored state of the training of one seed."""

    path: Path
    step: int  # Number of finished updates
    tensors: dict[str, Tensor]  # State as `Learner.state` returns it

    def restore(self, learner: Learner, seed: int) -> None:
        """Load this state into a seed of a fresh learner."""
        try:
            learner.load_state(seed, self.tensors, self.step)
        except (KeyError, RuntimeError) as error:
            raise broken_checkpoint(self.path, error) from error


def save_checkpoint(folder: Path, learner: Learner, seed: int, identity: RunIdentity) -> None:
    """Replace the checkpoint in a folder with the current training state of a seed."""
    description = {"step": learner.step, **identity.parts}
    write_tensors(folder / CHECKPOINT_NAME, learner.state(seed), description)


def read_checkpoint(folder: Path, identity: RunIdentity) -> Checkpoint | None:
    """Read the checkpoint in a folder; return None if there is none."""
    path = folder / CHECKPOINT_NAME
    if not path.exists():
        return None
    try:
        tensors, description = read_tensors(path)
        identity.check_same(description, path)
        return Checkpoint(path, int(description["step"]), tensors)
    except (OSError, SafetensorError, ValueError, KeyError) as error:
        raise broken_checkpoint(path, error) from error


_VALUES: Final = {"mean_q", "held_out_policy_q"}
"""Terms that a diverging learner increases without limit."""
CHECK_INTERVAL: Final = 500
"""Number of updates between two checks of logs that grow. After each check that finds new episodes,
all data are packed again."""


def train(
    dataset: Dataset,
    algo: str | type[Learner] | TrainingConfig | Algorithm,
    out: str | Path,
    *,
    seeds: int | None = None,
    seed: int | None = None,
    resume: bool = False,
    other_data: bool = False,
    device: str = "cpu",
    progress: ProgressCallback | None = None,
) -> list[OfflineSummary]:
    """Train on a dataset; the same seed, data and machine produce the same weights.

    Args:
        dataset: Dataset with actions of a finite space or of a Box. If `mcaprl.open` follows its
            logs, episodes that end during the training are added.
        algo: Name such as `cql` or a subclass of `Learner`, for default settings; a config such as
            `CQLConfig(alpha=0.5)`; or a class and its config, as an `Algorithm`.
        out: Folder of the run; it must be empty or not exist.
        seeds: Number of networks to train in parallel; they are independent of each other. None
            selects 1; with `resume`, that of the run.
        seed: Seed of the first network; network k uses seed + k. None selects 0; with `resume`,
            that of the run.
        resume: Whether to resume from the checkpoints in `out`. Seeds without a checkpoint
            start from update 0. With more updates than the run has, it is continued to this number.
        other_data: Whether to accept checkpoints trained on other data when resuming.
        device: Device of the data, the networks and the updates, `cpu` or `cuda`.
        progress: Callback for each row of metrics; None shows a bar if stderr is a terminal.

    Returns:
        One summary for each seed.

    Raises:
        UnknownNameError: There is no such algorithm.
        UsageError: There is no such device, or the run to resume has other seeds.
        OutputExistsError: `out` exists and is not empty.
        SpaceError: The algorithm does not support these observations or actions.
        TrainingError: The loss is NaN or infinite. Or `out` cannot be written, another training
            writes to it, or it contains a run with other data or settings. Or there is no run to
            resume.
    """
    folder = Path(out)
    numbers = choose_seeds(folder, seeds, seed, resume)
    choose_device(device)
    algorithm = choose_algorithm(algo, space=dataset.action_space)
    identity = run_identity(dataset, algorithm, other_data)
    with locked_run(folder, resume):
        run = _prepared(dataset, algorithm, folder, identity, device, reuses=resume)
        start_run(dataset, algorithm.config, folder, identity, numbers, resume)
        with nullcontext(progress) if progress else terminal_progress("updates", "loss") as report:
            return run.train(numbers, report)


def train_seeds(
    dataset: Dataset,
    algorithm: Algorithm,
    folder: Path,
    identity: RunIdentity,
    seeds: range,
    *,
    device: str,
    report: ProgressCallback,
) -> list[OfflineSummary]:
    """Train some seeds of a run that another process started, from their checkpoints."""
    run = _prepared(dataset, algorithm, folder, identity, device, reuses=True)
    return run.train(seeds, report)


def run_identity(dataset: Dataset, algorithm: Algorithm, other_data: bool) -> RunIdentity:
    """Return the identity of the run of a dataset, which may differ if its logs are followed."""
    learner_type, config = algorithm
    data = with_source(dataset, config.mask_from).fingerprint
    parts = {"algo": learner_type.name, "config": config.to_json(), "data": data}
    other_data = other_data or dataset.origin.grow is not None
    return RunIdentity(parts, other_data, longer=True, defaults=type(config)().to_json())


def start_run(
    dataset: Dataset,
    config: TrainingConfig,
    folder: Path,
    identity: RunIdentity,
    seeds: range,
    resume: bool,
) -> None:
    """Write or check the config of a locked run; warn of settings that hardly learn."""
    late = schedule_warning(read_updates(folder), config) if resume else None
    open_run(folder, identity, resume, seeds, **facts_of(dataset, identity))
    algo = str(identity.parts["algo"])
    relation = () if hasattr(config, "relative") else dataset.relative_to
    relative = relative_warning(relation, algo)
    for message in filter(None, (late, horizon_warning(config), relative)):
        warnings.warn(message, stacklevel=3)


def facts_of(dataset: Dataset, identity: RunIdentity) -> dict[str, Any]:
    """Return what `config.json` says of the data."""
    found: dict[str, Any] = {"env_id": dataset.env_id, "transitions": len(dataset)}
    if dataset.origin.selection is not None:
        found["source"] = dict(dataset.origin.selection)
    elif dataset.content != identity.parts["data"]:
        found["source"] = {"data": dataset.content}
    return found


def with_source(dataset: Dataset, source: str) -> Dataset:
    """Return a dataset with the masks of `mask_from`, unless it has them or there is no source."""
    if not source or has_source(dataset.observation_space):
        return dataset
    return dataset.with_action_mask(source)


def _prepared(
    dataset: Dataset,
    algorithm: Algorithm,
    folder: Path,
    identity: RunIdentity,
    device: str,
    *,
    reuses: bool,
) -> _Run:
    """Pack the data of a run; with other data and `reuses`, in the scales of its policies."""
    config = algorithm.config
    source, dataset = dataset, with_source(dataset, config.mask_from)
    held_out = choose_held_out(dataset.wholes, config.held_out)
    scales = earlier_scales(folder) if reuses and identity.other_data else Scales()
    buffer = _packed(dataset, config, scales, held_out).to(choose_device(device))
    gamma = buffer.packing.gamma
    validation = HeldOut(dataset, buffer, held_out, gamma) if len(held_out) else None
    limit = largest_return(dataset, gamma)
    return _Run(folder, identity, algorithm, source, buffer, validation, limit, held_out)


@dataclass(frozen=True)
class _Run:
    """Data and settings shared by all seeds of a run."""

    folder: Path
    identity: RunIdentity  # Algorithm, settings and data of the run
    algorithm: Algorithm
    dataset: Dataset  # Training data, including held-out episodes, without the masks of `mask_from`
    buffer: TransitionBuffer  # The same data as tensors
    held_out: HeldOut | None  # Transitions for validation, if any
    limit: float  # Upper bound on the absolute value of a return
    held_out_episodes: NDArray[np.int64]  # Numbers of the held-out episodes

    def train(self, seeds: range, report: ProgressCallback) -> list[OfflineSummary]:
        """Train seeds, in parallel if their checkpoints are at the same update."""
        (learner_type, config), summaries = self.algorithm, []
        for start in self._starts(seeds):
            learner = learner_type(config, self.buffer, list(start))
            for seed, checkpoint in start.items():
                if checkpoint is not None:
                    checkpoint.restore(learner, seed)
            summaries += self._train_learner(learner, report)
        return sorted(summaries, key=lambda summary: summary.seed)

    def _starts(self, seeds: range) -> list[dict[int, Checkpoint | None]]:
        """Return seeds with their checkpoints, grouped by the number of finished updates."""
        groups: dict[int, dict[int, Checkpoint | None]] = {}
        for seed in seeds:
            checkpoint = read_checkpoint(seed_folder(self.folder, seed), self.identity)
            groups.setdefault(checkpoint.step if checkpoint else 0, {})[seed] = checkpoint
        return list(groups.values())

    def _train_learner(self, learner: Learner, report: ProgressCallback) -> list[OfflineSummary]:
        """Run the remaining updates of a learner's seeds."""
        began, resumed_at = time.perf_counter(), learner.step
        updates, seeds = learner.config.updates, learner.seeds
        terms: list[dict[str, float]] = [{} for _ in seeds]
        warned = False
        for seed in seeds if resumed_at else ():
            report(TrainingProgress(seed, resumed_at, updates, {}))
        with ExitStack() as stack:
            metrics = [
                stack.enter_context(
                    closing(MetricsWriter(seed_folder(self.folder, seed), learner.step + 1))
                )
                for seed in (seeds if learner.step < updates else ())
            ]
            while learner.step < updates:
                learner = self._with_new_episodes(learner)
                before, terms = terms, self._train_to_next_stop(learner, metrics)
                warned = warned or self._warn(before, terms)
                try:
                    for seed, mine in zip(seeds, terms, strict=True):
                        report(TrainingProgress(seed, learner.step, updates, mine))
                except Pause:
                    self._save(learner)
                    raise
        seconds = time.perf_counter() - began
        folders = [seed_folder(self.folder, seed) for seed in seeds]
        return [
            OfflineSummary(folder, learner.name, seed, updates, resumed_at, seconds, mine)
            for folder, seed, mine in zip(folders, seeds, terms, strict=True)
        ]

    def _train_to_next_stop(
        self, learner: Learner, metrics: list[MetricsWriter]
    ) -> list[dict[str, float]]:
        """Train until metrics or a checkpoint must be written, and write them."""
        config = learner.config
        while True:
            is_reported = learner.is_reported
            terms = self._update(learner)
            if is_reported:
                break
        last = learner.step == config.updates
        checkpoint_due = last or learner.step % config.checkpoint_interval == 0
        values = learner.seed_means(terms)
        if self.held_out is not None:
            validated = self.held_out.terms(learner)
            values = [mine | held for mine, held in zip(values, validated, strict=True)]
        if self.dataset.origin.grow is not None:
            size = {"transitions": float(len(learner.buffer))}
            values = [mine | size for mine in values]
        rate = config.learning_rate_at(learner.step - 1)
        for writer, mine in zip(metrics, values, strict=True):
            writer.write(learner.step, rate, mine)
        if checkpoint_due:
            self._save(learner)
        return values

    def _with_new_episodes(self, learner: Learner) -> Learner:
        """Add new episodes every `CHECK_INTERVAL` updates; then return a new learner."""
        if self.dataset.origin.grow is None or learner.step % CHECK_INTERVAL:
            return learner
        grown = self.dataset.grow()
        if len(grown) == len(learner.buffer):
            return learner
        grown = with_source(grown, learner.config.mask_from)
        return with_more_data(learner, grown, self.held_out_episodes)

    def _save(self, learner: Learner) -> None:
        """Write policies, then checkpoints: a finished run's policy is never outdated."""
        for seed in learner.seeds:
            folder = seed_folder(self.folder, seed)
            data = self.dataset
            save_policy(folder, learner, seed, data.env_id, data.env_kwargs, data.action_commands)
            save_checkpoint(folder, learner, seed, self.identity)

    def _update(self, learner: Learner) -> dict[str, Tensor]:
        """Run one update. If the loss is not finite, raise an error that lists the checkpoints."""
        try:
            return learner.update()
        except NotFiniteError as error:
            paths = sorted(self.folder.glob(f"seed-*/{CHECKPOINT_NAME}"))
            good = ", ".join(map(str, paths)) or "none yet"
            raise TrainingError(
                f"update {error.update} of {self.folder}: {error}. Last good checkpoint:"
                f" {good}. Look for huge values in the data, or lower the learning rate"
            ) from error

    def _warn(self, before: list[dict[str, float]], now: list[dict[str, float]]) -> bool:
        """Warn about diverging values; return whether there was a warning."""
        for earlier, later in zip(before, now, strict=True):
            for name in _VALUES & earlier.keys():
                if message := divergence_warning(earlier[name], later[name], self.limit):
                    warnings.warn(f"{self.folder}: {message}", stacklevel=2)
                    return True
        return False


class Scales(NamedTuple):
    """Scales as in `TransitionBuffer`, of other data; None for those of the training data."""

    encoder: ObservationEncoder | None = None
    reward_scale: float | None = None
    box: BoxActions | None = None
    relative: RelativeActions | None = None


def earlier_scales(folder: Path) -> Scales:
    """Return the scales of the run in a folder, if it has a policy."""
    policies = policy_files(folder)
    if not policies:
        return Scales()
    policy = read_policy(policies[0].parent)
    boxes = (getattr(policy.head, name, None) for name in ("box", "relative"))
    return Scales(policy.encoder, policy.reward_scale, *boxes)


def _packed(
    dataset: Dataset, config: TrainingConfig, scales: Scales, held_out: NDArray[np.int64]
) -> TransitionBuffer:
    """Pack a dataset; draw from the best episodes, and not from those that are held out."""
    weights = dataset.weights * best_episodes(dataset, *config.best)
    weights[held_out] = 0.0
    return TransitionBuffer.from_dataset(
        dataset, config.packing, weights=weights, **scales._asdict()
    )


def best_episodes(dataset: Dataset, fraction: float, by: str = "") -> NDArray[np.bool_]:
    """Return a mask (E,) of the fraction of the episodes with the largest values, at least one."""
    # All with the last one's value are in it. `by` is an expression, or empty for the return.
    lengths = dataset.episode_lengths
    if fraction == 1 or not len(lengths):
        return np.ones(len(lengths), bool)
    if by:
        values = episode_values(by, dataset)
    else:
        values = np.add.reduceat(dataset.rewards, np.cumsum(lengths) - lengths)
    ordered = np.sort(values[~np.isnan(values)])[::-1]
    if not len(ordered):
        raise UsageError(f"top_by: '{by}' has no value in any of the {len(values)} episodes")
    count = max(1, round(fraction * len(lengths)))
    found: NDArray[np.bool_] = values >= ordered[:count][-1]
    return found


def with_more_data(
    learner: Learner, dataset: Dataset, held_out_episodes: NDArray[np.int64]
) -> Learner:
    """Return a learner for the grown dataset, with the weights and state of `learner`."""
    earlier = learner.buffer
    scales = Scales(earlier.encoder, earlier.reward_scale, earlier.box, earlier.relative)
    buffer = _packed(dataset, learner.config, scales, held_out_episodes).to(earlier.device)
    grown = type(learner)(learner.config, buffer, learner.seeds)
    for seed in learner.seeds:
        grown.load_state(seed, learner.state(seed), learner.step)
    return grown

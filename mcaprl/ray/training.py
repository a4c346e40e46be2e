"""Offline training on the workers of a Ray cluster, each of which holds some of the episodes.

Ray Train starts the workers and connects them. If a worker is lost, Ray Train restarts all workers,
and they continue from the checkpoints of the run. The first worker writes the same files as a local
training.
"""

from __future__ import annotations

import hashlib
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import ClusterError, McaprlError, SpaceError, UsageError, import_extra
from mcaprl.files import work_folder
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.batches.buffer import discrete_actions
from mcaprl.offline.batches.share import GroupShare, divided
from mcaprl.offline.batches.sources import weighted_logs
from mcaprl.offline.training.metrics import OfflineSummary
from mcaprl.offline.training.train import (
    check_weights,
    earlier_scales,
    identity_parts,
    train_share,
    with_source,
    without,
)
from mcaprl.offline.training.watch import choose_held_out, horizon_warning, schedule_warning
from mcaprl.progress import ProgressCallback, TrainingProgress
from mcaprl.ray.board import Board
from mcaprl.ray.cluster import cpus, restored_handlers
from mcaprl.ray.workers import MOST_DEATHS, check_machine, check_machines
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.log_reader import LogReader
from mcaprl.recorder.format.metadata import LogMetadata, installed_versions
from mcaprl.runs import RunIdentity, locked_run, open_run, read_updates
from mcaprl.texts import counted

_POLL_S = 0.2


@dataclass(frozen=True)
class TrainingRequest:
    """Request for a training. Its fields are the arguments of `mcaprl.train`."""

    config: TrainingConfig
    out: Path
    seeds: range
    threads: int
    device: str
    resume: bool
    other_data: bool


@dataclass(frozen=True)
class _Logs:
    """Summaries of the logs.

    Attributes:
        paths: Absolute paths.
        lengths: Array for each log: the number of transitions of each episode.
        weights: Relative sampling weight of a transition, for each log.
        description: Metadata that the logs have in common.
        fingerprint: SHA-256 of the logs' checksums and weights.
    """

    paths: list[Path]
    lengths: list[NDArray[np.int64]]
    weights: list[float]
    description: LogMetadata
    fingerprint: str

    @property
    def all_lengths(self) -> NDArray[np.int64]:
        """Number of transitions (E,) in each of the E episodes of all logs."""
        return np.concatenate(self.lengths)

    @property
    def all_weights(self) -> NDArray[np.float64]:
        """Weight (E,) of one transition in each of the E episodes of all logs."""
        return np.repeat(self.weights, list(map(len, self.lengths)))


@dataclass(frozen=True)
class _Job:
    """Arguments of the task on each worker."""

    request: TrainingRequest
    logs: _Logs
    identity: RunIdentity
    versions: dict[str, str]
    board: Any


def train_on_ray(
    data: Sequence[str],
    request: TrainingRequest,
    *,
    workers: int | None,
    progress: ProgressCallback,
) -> list[OfflineSummary]:
    """Train on the cluster that this process is connected to.

    Args:
        data: Logs and weights, as for `open_weighted`; all workers must see local logs.
        request: The training.
        workers: Number of workers; default: number of CPUs of the cluster, or number of
            GPUs if the device is `cuda`.
        progress: Function called with each row of metrics.

    Returns:
        One summary for each seed.

    Raises:
        ClusterError: The cluster has fewer processors, a machine has other versions or does not
            see a path, or workers died repeatedly.
        McaprlError: As for a local training.
    """
    import ray

    logs = _read_summaries(data)
    discrete_actions(logs.description.action_space)
    check_weights(logs.all_weights, len(logs.all_weights))
    count = _workers(workers, request.device, sum(map(len, logs.lengths)))
    parts = identity_parts(request.config, logs.fingerprint)
    identity = RunIdentity(parts, request.other_data, longer=True)
    with locked_run(request.out, request.resume):
        earlier = read_updates(request.out) if request.resume else None
        check_machines([request.out, *logs.paths])
        transitions = int(logs.all_lengths.sum())
        open_run(
            request.out,
            identity,
            request.resume,
            request.seeds,
            env_id=logs.description.env_id,
            transitions=transitions,
        )
        for message in (
            horizon_warning(request.config),
            schedule_warning(earlier, request.config),
        ):
            if message:
                warnings.warn(message, stacklevel=2)
        board = ray.remote(Board).options(num_cpus=0).remote()
        job = _Job(request, logs, identity, installed_versions(), board)
        with _following(board, progress):
            _fit(job, count)
        summaries, error = ray.get(board.outcome.remote())
    if error is not None:
        raise error
    assert summaries is not None
    return list(summaries)


def _fit(job: _Job, workers: int) -> None:
    """Run the workers. If they fail, the board contains the error."""
    import ray

    train = import_extra("ray.train", "ray")
    trainer = import_extra("ray.train.torch", "ray").TorchTrainer
    with work_folder(job.request.out / "ray") as folder:
        fitted = trainer(
            partial(_train_on_worker, job),
            scaling_config=train.ScalingConfig(
                num_workers=workers,
                use_gpu=job.request.device == "cuda",
                resources_per_worker={"CPU": 1}
                | ({"GPU": 1} if job.request.device == "cuda" else {}),
            ),
            run_config=train.RunConfig(
                name="run",
                storage_path=str(folder),
                failure_config=train.FailureConfig(max_failures=MOST_DEATHS),
            ),
        )
        try:
            with restored_handlers():
                fitted.fit()
        except train.TrainingFailedError as error:
            _, ours = ray.get(job.board.outcome.remote())
            if ours is None:
                raise _failure(job.request.out, error) from error


def _failure(out: Path, error: Exception) -> ClusterError:
    lines = str(error).strip().splitlines()
    return ClusterError(
        f"{out}: workers failed repeatedly; the checkpoints are kept: continue with --resume"
        f" ({lines[-1].strip()})"
    )


def _train_on_worker(job: _Job) -> None:
    import ray

    if ray.get(job.board.outcome.remote())[1] is not None:
        # Ray restarts all workers after any error, even if the error would occur again.
        return
    try:
        _train(job)
    except McaprlError as error:
        ray.get(job.board.fail.remote(error))
        raise
    except (RuntimeError, OSError):
        # These errors occur if another worker was lost. They are not stored on the board.
        raise
    except Exception as error:
        ray.get(job.board.fail.remote(error))
        raise


def _train(job: _Job) -> None:
    import ray
    import torch
    from ray.train import get_context

    request, logs = job.request, job.logs
    torch.set_num_threads(request.threads)
    rank, count = get_context().get_world_rank(), get_context().get_world_size()
    lengths, weights = logs.all_lengths, logs.all_weights
    first, stop = divided(lengths, count)[rank]
    held_out = choose_held_out(len(lengths), request.config.held_out)
    share = GroupShare(lengths, without(weights, held_out), first, stop)
    dataset = _read_episodes(job, share, first, stop)
    if isinstance(dataset, McaprlError):
        # All workers end without raising the error, because Ray Train would restart them.
        ray.get(job.board.fail.remote(dataset))
        return

    def report(news: TrainingProgress | str) -> None:
        if not ray.get(job.board.report.remote(news)):
            raise SystemExit("the calling process ended the training")

    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: report(str(message))
        summaries = train_share(
            dataset,
            request.config,
            request.out,
            job.identity,
            share,
            held_out[(held_out >= first) & (held_out < stop)] - first,
            request.seeds,
            device=request.device,
            scales=share.from_first(_scales(request)),
            report=report,
        )
    if share.is_first:
        ray.get(job.board.finish.remote(summaries))


def _scales(request: TrainingRequest) -> tuple[Any, Any]:
    reused = request.resume and request.other_data
    return earlier_scales(request.out) if reused else (None, None)


def _read_episodes(job: _Job, share: GroupShare, first: int, stop: int) -> Dataset | McaprlError:
    """Read the episodes from `first` up to, but not including, `stop`, counted over all logs.

    If one of the workers fails, return its error on all of them.
    """
    found: Dataset | McaprlError
    try:
        check_machine(job.versions, [job.request.out])
        found = _read_logs(job, first, stop)
    except McaprlError as error:
        found = error
    errors = share.gather(found if isinstance(found, McaprlError) else None)
    return next(filter(None, errors), found)


def _read_logs(job: _Job, first: int, stop: int) -> Dataset:
    parts, begin = [], 0
    for path, lengths in zip(job.logs.paths, job.logs.lengths, strict=True):
        mine = np.arange(max(first - begin, 0), min(stop - begin, len(lengths)))
        begin += len(lengths)
        if len(mine):
            check_machine(job.versions, [path])
            parts.append(LogReader(path).read(mine))
    return with_source(Dataset.concatenate(parts), job.request.config.mask_from)


def _read_summaries(data: Sequence[str]) -> _Logs:
    pairs = weighted_logs(data)
    paths, weights = [path for path, _ in pairs], [weight for _, weight in pairs]
    digest = hashlib.sha256(repr(weights if len(set(weights)) > 1 else "").encode())
    lengths, descriptions = [], []
    for path in paths:
        log = LogReader(path)
        lengths.append(log.lengths)
        digest.update(log.checksum.encode())
        descriptions.append(log.description)
        for role in ("observation_space", "action_space"):
            spaces = [getattr(descriptions[k], role) for k in (0, -1)]
            if spaces[0] != spaces[1]:
                raise SpaceError(f"{path} differs in {role}: {spaces[1]}, not {spaces[0]}")
    return _Logs(paths, lengths, weights, LogMetadata.common(descriptions), digest.hexdigest())


def _workers(wanted: int | None, device: str, episodes: int) -> int:
    """Return the number of workers. Each of them needs a processor and an episode."""
    import ray

    kind = "GPU" if device == "cuda" else "CPU"
    available = int(ray.cluster_resources().get("GPU", 0)) if kind == "GPU" else cpus()
    if available < (wanted or 1):
        few = f"{counted(available, kind)} for {counted(wanted or 1, 'worker')}"
        raise ClusterError(f"the cluster has {few}: start more machines, or lower --workers")
    if wanted is not None and wanted > episodes:
        raise UsageError(
            f"--workers {wanted}: the logs have only {counted(episodes, 'episode')} to divide"
        )
    return min(wanted or available, episodes)


@contextmanager
def _following(board: Any, progress: ProgressCallback) -> Iterator[None]:
    """Call `progress` with new results until the block ends.

    If `progress` raises an error, the training ends.
    """
    import ray

    ended = threading.Event()
    errors: list[BaseException] = []

    def follow() -> None:
        while not errors:
            is_last = ended.wait(_POLL_S)
            for one in ray.get(board.take.remote()):
                if isinstance(one, str):
                    texts.append(one)
                    continue
                try:
                    progress(one)
                except BaseException as error:
                    errors.append(error)
                    ray.get(board.fail.remote(ClusterError("stopped")))
                    return
            if is_last:
                return

    texts: list[str] = []
    thread = threading.Thread(target=follow, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        for text in dict.fromkeys(texts):
            warnings.warn(text, stacklevel=4)
    if errors:
        raise errors[0]

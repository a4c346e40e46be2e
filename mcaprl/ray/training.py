"""Offline training on the workers of a Ray cluster: each seed of a run is a task.

If a worker is killed, another one continues its seed from the last checkpoint.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcaprl.errors import ClusterError
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.batches.sources import open_weighted, weighted_logs
from mcaprl.offline.training.metrics import OfflineSummary
from mcaprl.offline.training.train import run_identity, start_run, train_seeds, with_source
from mcaprl.progress import ProgressCallback
from mcaprl.ray.cluster import cpus
from mcaprl.ray.tasks import Send, WorkerDiedError, check_machines, run_tasks
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import RunIdentity, locked_run
from mcaprl.texts import counted


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
class _SeedTask:
    """Training of one seed: the logs and weights as for `open_weighted`, and the request."""

    data: list[str]
    request: TrainingRequest
    identity: RunIdentity
    seed: int


def train_on_ray(
    data: Sequence[str],
    dataset: Dataset,
    weights: Any,
    request: TrainingRequest,
    *,
    workers: int | None,
    progress: ProgressCallback,
) -> list[OfflineSummary]:
    """Train on the cluster that this process is connected to.

    Args:
        data: Logs and weights, as for `open_weighted`; all workers must see local logs.
        dataset: The same logs.
        weights: Weights (E,) of the episodes.
        request: The training.
        workers: Largest number of seeds at a time; default: number of CPUs of the cluster, or
            number of GPUs if the device is `cuda`.
        progress: Function called with each row of metrics.

    Returns:
        One summary for each seed.

    Raises:
        ClusterError: The cluster has fewer processors, a machine has other versions or does not
            see a path, or workers died repeatedly.
        McaprlError: As for a local training.
    """
    workers = _workers(workers, request.device)
    config, out, seeds = request.config, request.out, request.seeds
    dataset = with_source(dataset, config.mask_from)
    identity = run_identity(dataset, config, weights, request.other_data)
    logs = weighted_logs(data)
    texts: dict[str, None] = {}

    def on_message(index: int, message: Any) -> None:
        if isinstance(message, str):
            texts[message] = None
        else:
            progress(message)

    with locked_run(out, request.resume):
        paths = [out, *(path for path, _ in logs)]
        check_machines(paths)
        start_run(dataset, config, out, identity, seeds, request.resume)
        names = [f"{path}:{weight!r}" for path, weight in logs]
        try:
            summaries = run_tasks(
                _train_seed,
                [_SeedTask(names, request, identity, seed) for seed in seeds],
                workers=workers,
                gpus=int(request.device == "cuda"),
                paths=paths,
                on_message=on_message,
            )
        except WorkerDiedError as error:
            raise ClusterError(
                f"{out}: workers failed repeatedly; the checkpoints are kept: continue with"
                f" --resume ({error.cause})"
            ) from error
        finally:
            for text in texts:
                warnings.warn(text, stacklevel=3)
    return summaries


def _train_seed(task: _SeedTask, send: Send) -> OfflineSummary:
    import torch

    request = task.request
    torch.set_num_threads(request.threads)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: send(str(message))
        dataset, weights = open_weighted(task.data, threads=request.threads)
        (summary,) = train_seeds(
            dataset,
            request.config,
            request.out,
            task.identity,
            range(task.seed, task.seed + 1),
            weights=weights,
            device=request.device,
            report=send,
        )
    return summary


def _workers(wanted: int | None, device: str) -> int:
    """Return the number of workers. Each of them needs a processor."""
    import ray

    kind = "GPU" if device == "cuda" else "CPU"
    available = int(ray.cluster_resources().get("GPU", 0)) if kind == "GPU" else cpus()
    if available < (wanted or 1):
        few = f"{counted(available, kind)} for {counted(wanted or 1, 'worker')}"
        raise ClusterError(f"the cluster has {few}: start more machines, or lower --workers")
    return wanted or available

"""Offline training on the workers of a Ray cluster: each seed of a run is a task.

If a worker is killed, another one continues its seed from the last checkpoint.
"""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path

from mcaprl.errors import ClusterError
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.training.metrics import OfflineSummary
from mcaprl.offline.training.train import run_identity, start_run, train_seeds
from mcaprl.progress import ProgressCallback, TrainingProgress
from mcaprl.ray.cluster import cpus
from mcaprl.ray.tasks import Send, WorkerDiedError, check_machines, run_tasks
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.source import logs_of, open_data
from mcaprl.runs import RunIdentity, locked_run
from mcaprl.texts import counted


def train_on_ray(
    dataset: Dataset,
    config: TrainingConfig,
    out: Path,
    *,
    seeds: range,
    resume: bool,
    other_data: bool,
    threads: int,
    device: str,
    workers: int | None,
    progress: ProgressCallback,
) -> list[OfflineSummary]:
    """Train on the workers, which read the logs of the dataset again."""
    logs, workers = logs_of(dataset), _workers(workers, device)
    texts: dict[str, None] = {}

    def on_news(news: TrainingProgress | str) -> None:
        if isinstance(news, str):
            texts[news] = None
        else:
            progress(news)

    with locked_run(out, resume):
        paths = [out, *logs]
        check_machines(paths)
        identity = run_identity(dataset, config, other_data)
        start_run(dataset, config, out, identity, seeds, resume)
        try:
            return run_tasks(
                partial(_train_seed, logs, config, out, identity, threads, device),
                seeds,
                workers=workers,
                gpus=int(device == "cuda"),
                paths=paths,
                on_news=on_news,
            )
        except WorkerDiedError as error:
            raise ClusterError(
                f"{out}: workers failed repeatedly; the checkpoints are kept: continue with"
                f" --resume ({error.cause})"
            ) from error
        finally:
            for text in texts:
                warnings.warn(text, stacklevel=3)


def _train_seed(
    logs: dict[Path, float],
    config: TrainingConfig,
    out: Path,
    identity: RunIdentity,
    threads: int,
    device: str,
    seed: int,
    send: Send,
) -> OfflineSummary:
    """Train one seed; send its rows of metrics, and warnings as texts."""
    import torch

    torch.set_num_threads(threads)
    seeds = range(seed, seed + 1)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: send(0, str(message))
        names = [str(path) for path in logs]
        dataset = open_data(names, weights=list(logs.values()), threads=threads)
        (summary,) = train_seeds(
            dataset,
            config,
            out,
            identity,
            seeds,
            device=device,
            report=lambda now: send(now.done, now),
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

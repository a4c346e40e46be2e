"""Tasks on the workers of a Ray cluster, such as the training of each seed of a run.

If a worker is killed, Ray repeats its task; a training continues from its last checkpoint.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

from mcaprl.errors import ClusterError, McaprlError
from mcaprl.offline.algorithms.registry import Algorithm
from mcaprl.offline.training.metrics import OfflineSummary
from mcaprl.offline.training.train import run_identity, start_run, train_seeds
from mcaprl.progress import Advance, ProgressCallback, TrainingProgress
from mcaprl.ray.cluster import cpus
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.format.metadata import installed_versions
from mcaprl.recorder.source import logs_of, open_data
from mcaprl.runs import RunIdentity, locked_run
from mcaprl.texts import counted

T = TypeVar("T")
Result = TypeVar("Result")


class Send(Protocol):
    """Function that sends a task's amount of work so far, and news, to the calling process."""

    def __call__(self, done: int, news: Any = None) -> None:
        """Send a message."""


Task = Callable[[T, Send], Result]
"""Function of a module, called with a request. If it is repeated, it must have the same result."""

MOST_DEATHS = 10
"""Number of deaths of workers, without progress between them, at which a task fails."""
_INTERVAL_S = 0.1


class WorkerDiedError(Exception):
    """Too many workers died in the task of the request with this index, without progress."""

    def __init__(self, index: int, cause: str) -> None:
        """Store the index, and the cause of the last death."""
        super().__init__(index, cause)
        self.index, self.cause = index, cause


def run_tasks(
    task: Task[T, Result],
    requests: Sequence[T],
    *,
    workers: int | None = None,
    gpus: int = 0,
    paths: Sequence[Path] = (),
    advance: Advance = lambda amount: None,
    on_news: Callable[[Any], None] = lambda news: None,
) -> list[Result]:
    """Run a task for each request on the cluster."""
    # Return the results in the order of the requests. At most `workers` tasks run at a time, with
    # one CPU each, on machines with the versions of this process that see `paths`. `advance` gets
    # the amount of new work, `on_news` the news that tasks send; repeated tasks send theirs again.
    # If a task fails, or on an interrupt, all end.
    import ray
    from ray.util.queue import Queue

    here = _on_node(ray.get_runtime_context().get_node_id())
    messages = Queue(actor_options=here)
    run = ray.remote(run_task).options(num_cpus=1, num_gpus=gpus, max_retries=MOST_DEATHS - 1)
    versions, most = installed_versions(), workers or cpus()
    waiting, calls, results = list(range(len(requests)))[::-1], dict[Any, int](), {}
    done, progressed = [0] * len(requests), set[int]()
    try:
        while waiting or calls:
            while waiting and len(calls) < most:
                index = waiting.pop()
                call = run.remote(task, requests[index], index, messages, versions, list(paths))
                calls[call] = index
            ready, _ = ray.wait(list(calls), timeout=_INTERVAL_S)
            # A task that has ended has sent all its messages.
            for index, amount, news in messages.get_nowait_batch(messages.qsize()):
                if amount > done[index]:
                    advance(amount - done[index])
                    done[index] = amount
                    progressed.add(index)
                if news is not None:
                    on_news(news)
            for call in ready:
                index = calls.pop(call)
                try:
                    results[index] = _result(call, index, paths)
                except WorkerDiedError:
                    if index not in progressed:
                        raise
                    # Ray's retries are used up. Give the task new ones, because it gets on.
                    progressed.remove(index)
                    waiting.append(index)
    finally:
        for call in calls:
            ray.cancel(call, force=True)
        messages.shutdown(force=True)
    return [results[index] for index in range(len(requests))]


def run_task(
    task: Task[T, Result],
    request: T,
    index: int,
    messages: Any,
    versions: dict[str, str],
    paths: Sequence[Path],
) -> Result:
    """Check the machine of this worker, then run a task."""
    check_machine(versions, paths)
    return task(request, lambda done, news=None: messages.put((index, done, news)))


def _result(call: Any, index: int, paths: Sequence[Path]) -> Any:
    import ray

    try:
        return ray.get(call)
    except ray.exceptions.RayTaskError as error:
        # Errors of this package are one line. All other errors keep the worker's traceback.
        if isinstance(error.cause, McaprlError | OSError):
            raise error.cause from None
        check_machines(paths)
        raise
    except ray.exceptions.RayError as error:
        raise WorkerDiedError(index, _cause(error)) from error


def check_machine(versions: dict[str, str], paths: Sequence[Path]) -> None:
    """Check that a worker's machine has the same versions and files as the calling process."""
    mine = installed_versions()
    for name in versions.keys() | mine.keys():
        if versions.get(name) != mine.get(name):
            raise ClusterError(
                f"the worker at {_here()} has {name} {mine.get(name, 'not installed')}, this"
                f" process {versions.get(name, 'not installed')}: install the same versions on all"
                " machines"
            )
    for path in paths:
        if not path.exists():
            raise ClusterError(
                f"the worker at {_here()} cannot see {path}: choose a path on a file system that"
                " all machines share"
            )


def check_machines(paths: Sequence[Path]) -> None:
    """Check all machines of the cluster that this process is connected to."""
    import ray

    check, versions = ray.remote(check_machine), installed_versions()
    nodes = [one["NodeID"] for one in ray.nodes() if one["Alive"] and one["Resources"].get("CPU")]
    calls = [check.options(**_on_node(node)).remote(versions, list(paths)) for node in nodes]
    try:
        ray.get(calls)
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        if isinstance(cause, McaprlError):
            raise cause from None
        raise ClusterError(
            "the workers of the cluster cannot start: install mcaprl with the same extras on all"
            f" machines ({_cause(error)})"
        ) from None


def _on_node(node: str) -> dict[str, Any]:
    """Return options that run a task or an actor on this node, without a CPU for itself."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    return {"num_cpus": 0, "scheduling_strategy": NodeAffinitySchedulingStrategy(node, soft=False)}


def _cause(error: Exception) -> str:
    """Return the first sentences of Ray's explanation, which name the cause of a death."""
    return str(error).strip().splitlines()[-1].partition(" Some common causes")[0]


def _here() -> str:
    """Return the address of this machine."""
    import ray

    return str(ray.util.get_node_ip_address())


def train_on_ray(
    dataset: Dataset,
    algorithm: Algorithm,
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
        identity = run_identity(dataset, algorithm, other_data)
        start_run(dataset, algorithm.config, out, identity, seeds, resume)
        try:
            return run_tasks(
                partial(_train_seed, logs, algorithm, out, identity, threads, device),
                seeds,
                workers=workers,
                gpus=int(device == "cuda"),
                paths=paths,
                on_news=on_news,
            )
        except WorkerDiedError as error:
            raise ClusterError(
                f"{out}: workers failed repeatedly; the checkpoints are kept: continue with"
                f" `resume=True` ({error.cause})"
            ) from error
        finally:
            for text in texts:
                warnings.warn(text, stacklevel=3)


def _train_seed(
    logs: dict[Path, float],
    algorithm: Algorithm,
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
            algorithm,
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
        raise ClusterError(f"the cluster has {few}: start more machines, or lower `workers=`")
    return wanted or available

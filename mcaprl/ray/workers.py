"""Tasks on the worker processes of a Ray cluster. If a worker is killed, its tasks are repeated."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from mcaprl.errors import ClusterError, McaprlError
from mcaprl.progress import Advance
from mcaprl.ray.cluster import cpus
from mcaprl.recorder.format.metadata import installed_versions

T = TypeVar("T")
Result = TypeVar("Result")
Report = Callable[[int], None]
"""Function that a task calls with the amount of work it has done so far."""
Task = Callable[[T, Report], Result]
"""Function of a module, called with a request and a `Report`.

If a worker is killed, its task is repeated. The task must then have the same result.
"""

MOST_DEATHS = 10
"""Number of deaths of workers in a row, without progress between them, at which a task fails."""
_INTERVAL_S = 0.1
_POLLS_PER_S = 100


class WorkerDiedError(Exception):
    """Too many workers died while they ran one task.

    Attributes:
        index: Index of the task's request.
        cause: Cause of the last death.
    """

    def __init__(self, index: int, cause: str) -> None:
        """Store the index and the cause."""
        super().__init__(index, cause)
        self.index, self.cause = index, cause


def check_machine(versions: dict[str, str], paths: Sequence[Path]) -> None:
    """Check that a worker's machine has the same versions and files as the calling process.

    Raises:
        ClusterError: A version differs, or a path does not exist here.
    """
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
    """Check all machines of the cluster that this process is connected to.

    Raises:
        ClusterError: A machine has other versions, does not see a path, or cannot import mcaprl.
    """
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    check = ray.remote(check_machine)
    nodes = [one["NodeID"] for one in ray.nodes() if one["Alive"] and one["Resources"].get("CPU")]
    calls = [
        check.options(
            num_cpus=0, scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)
        ).remote(installed_versions(), list(paths))
        for node in nodes
    ]
    try:
        ray.get(calls)
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        raise cause if isinstance(cause, McaprlError) else _cannot_start(error) from None


def _cannot_start(error: Exception) -> ClusterError:
    return ClusterError(
        "the workers of the cluster cannot start: install mcaprl with the same extras on all"
        f" machines ({_cause(error)})"
    )


def _cause(error: Exception) -> str:
    """Return the first sentences of Ray's explanation, which name the cause of a death."""
    return str(error).strip().splitlines()[-1].partition(" Some common causes")[0]


def _here() -> str:
    """Return the address of this machine."""
    import ray

    return str(ray.util.get_node_ip_address())


class Worker:
    """Process of a cluster, which runs one task after the other and reports its progress."""

    def __init__(self) -> None:
        """Begin without a task."""
        self._progress = (-1, 0)

    def check(self, versions: dict[str, str], paths: Sequence[Path]) -> None:
        """Check this machine; raise the same errors as `check_machine`."""
        check_machine(versions, paths)

    def run(self, task: Task[T, Result], index: int, request: T) -> tuple[Result, int]:
        """Run a task; return its result and the amount of work that it reported last."""
        self._progress = (index, 0)

        def report(amount: int) -> None:
            self._progress = (index, amount)

        return task(request, report), self._progress[1]

    def progress(self) -> tuple[int, int]:
        """Return the index of the current task, and the amount of work it has done."""
        return self._progress


def run_tasks(
    task: Task[T, Result],
    requests: Sequence[T],
    *,
    workers: int | None = None,
    paths: Sequence[Path] = (),
    advance: Advance = lambda amount: None,
) -> list[Result]:
    """Run a task for each request on the workers of the cluster that this process is connected to.

    If a worker is killed, another worker repeats its task. If a task fails, or this process is
    interrupted, all workers end.

    Args:
        task: Function of a module.
        requests: Arguments of the tasks; they are pickled.
        workers: Number of workers, with one CPU each; default: number of CPUs of the cluster.
        paths: Paths that each worker must see.
        advance: Function called with the amount of work done since its last call.

    Raises:
        ClusterError: A worker cannot start, has other versions, or does not see a path.
        WorkerDiedError: Workers died repeatedly, and the task made no progress.
        Exception: A task raised it.
    """
    import ray

    pool = _Pool(ray, task, requests, list(paths), advance)
    try:
        return pool.run(min(workers or cpus(), len(requests)))
    finally:
        pool.end()


@dataclass
class _State:
    """Progress of one task.

    Attributes:
        done: Amount of work that was reported to the caller.
        at_death: Value of `done` when a worker last died in the task.
        deaths: Number of workers that died since `done` last changed.
    """

    done: int = 0
    at_death: int = -1
    deaths: int = 0


@dataclass
class _Pool:
    """Workers, their calls and the tasks that wait."""

    ray: Any
    task: Task[Any, Any]
    requests: Sequence[Any]
    paths: list[Path]
    advance: Advance
    calls: dict[Any, tuple[Any, int | None]] = field(default_factory=dict)
    polls: dict[Any, Any] = field(default_factory=dict)
    results: dict[int, Any] = field(default_factory=dict)
    failed_starts: int = 0

    def __post_init__(self) -> None:
        self.states = [_State() for _ in self.requests]
        self.waiting = deque(range(len(self.requests)))
        self.kind = self.ray.remote(Worker).options(num_cpus=1, max_concurrency=2, max_restarts=0)

    def run(self, workers: int) -> list[Any]:
        for _ in range(workers):
            self.start()
        # The rate of all polls together is limited to what one process can handle.
        interval_s = max(_INTERVAL_S, workers / _POLLS_PER_S)
        next_poll = time.monotonic() + interval_s
        while len(self.results) < len(self.requests):
            ready, _ = self.ray.wait([*self.calls, *self.polls], timeout=interval_s)
            for call in ready:
                if call in self.polls:
                    self.take_progress(call)
                else:
                    self.take_result(call)
            if time.monotonic() >= next_poll:
                self.poll()
                next_poll = time.monotonic() + interval_s
        return [self.results[index] for index in range(len(self.requests))]

    def end(self) -> None:
        for worker in {worker for worker, _ in self.calls.values()}:
            self.ray.kill(worker)

    def start(self) -> None:
        worker = self.kind.remote()
        # A worker gets a task only when it has a CPU, so that no task waits for a free CPU.
        self.calls[worker.check.remote(installed_versions(), self.paths)] = (worker, None)

    def take_result(self, call: Any) -> None:
        worker, index = self.calls.pop(call)
        try:
            found = self.ray.get(call)
        except self.ray.exceptions.RayTaskError as error:
            # Errors of this package are one line. All other errors keep the worker's traceback.
            raise error.cause if isinstance(error.cause, McaprlError | OSError) else error from None
        except self.ray.exceptions.RayError as error:
            self.ray.kill(worker)
            self.replace(index, error)
            return
        if index is not None:
            result, amount = found
            self.count(index, amount)
            self.results[index] = result
        self.failed_starts = 0
        if self.waiting:
            following = self.waiting.popleft()
            work = worker.run.remote(self.task, following, self.requests[following])
            self.calls[work] = (worker, following)
        else:
            self.ray.kill(worker)

    def replace(self, index: int | None, error: Exception) -> None:
        """Start another worker in place of a dead worker, whose task is the next to run."""
        if index is None:
            self.failed_starts += 1
            if self.failed_starts >= MOST_DEATHS:
                raise _cannot_start(error)
        else:
            state = self.states[index]
            state.deaths = state.deaths + 1 if state.at_death == state.done else 1
            state.at_death = state.done
            if state.deaths >= MOST_DEATHS:
                raise WorkerDiedError(index, _cause(error))
            self.waiting.appendleft(index)
        self.start()

    def poll(self) -> None:
        asked = set(self.polls.values())
        for worker, index in self.calls.values():
            if index is not None and worker not in asked:
                self.polls[worker.progress.remote()] = worker

    def take_progress(self, call: Any) -> None:
        del self.polls[call]
        try:
            index, amount = self.ray.get(call)
        except self.ray.exceptions.RayError:
            # The worker died. The call that runs its task reports the error.
            return
        if index >= 0 and index not in self.results:
            self.count(index, amount)

    def count(self, index: int, amount: int) -> None:
        """Report new work of a task.

        A repeated task reports nothing until its amount of work exceeds `done`.
        """
        state = self.states[index]
        if amount > state.done:
            self.advance(amount - state.done)
            state.done = amount

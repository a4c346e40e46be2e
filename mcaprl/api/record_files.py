"""Recording of a file, or of several into a folder: by processes of this one, or by Ray."""

from __future__ import annotations

import itertools
import math
import multiprocessing
import os
import shutil
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import FrameType
from typing import Any, Literal, TypeVar

import gymnasium as gym
import numpy as np

from mcaprl._interrupt import is_postponed, send_to_main_thread
from mcaprl.api.policies import SCRIPTED, policies_of, policy_names
from mcaprl.api.ranges import ClusterOptions
from mcaprl.base_policy import BasePolicy
from mcaprl.errors import LogError, McaprlError, NoStepsError, OutputExistsError
from mcaprl.files import check_target, locked_file, locked_folder, work_folder
from mcaprl.progress import Advance
from mcaprl.recorder.dataset.log_reader import LogReader
from mcaprl.recorder.dataset.open import (
    MANIFEST_NAME,
    UNFINISHED_NAME,
    LogFile,
    unfinished_folder,
    write_manifest,
)
from mcaprl.recorder.format.behavior import behavior_field
from mcaprl.recorder.format.messages import INTERRUPTED
from mcaprl.recorder.record.wrapper import RecordMcap
from mcaprl.recorder.repair.recover import recover_log
from mcaprl.sims.evaluation.rollout import (
    EpisodeResult,
    EpsilonGreedy,
    NoisyPolicy,
    make_limited,
    make_or_borrow,
    noisy_name,
    rollout,
)
from mcaprl.system import END, STOPS, blocked_stops, unblock_stops
from mcaprl.texts import counted


@dataclass(frozen=True)
class FileRequest:
    """One file to record; its fields are the arguments of `record`."""

    sim: str | gym.Env[Any, Any]
    out: Path
    policy: str | BasePolicy
    epsilon: float
    noise: float
    noise_per_episode: bool
    episodes: int | None
    steps: int | None
    seed: int
    sim_options: Mapping[str, Any]
    scene: bool
    camera: bool | str
    infos: bool | Sequence[str]
    keys: Sequence[str] | None
    compression: str
    overwrite: bool
    append: bool
    rotate_mb: float | None
    max_steps: int | None
    first_episode: int = 0  # Number of the first episode; an episode's seed depends on its number

    @property
    def policy_name(self) -> str:
        """Name of the policy in the log."""
        given = self.policy
        name = given.name if isinstance(given, BasePolicy) else policy_names([given])[given]
        return noisy_name(name, self.noise, per_episode=self.noise_per_episode)


def record_file(
    request: FileRequest, on_episode: Callable[[EpisodeResult], None] | None = None
) -> list[EpisodeResult]:
    """Record one file in this process."""
    with closing(_env(request)) as env:
        behavior = _behavior(request, env)
        recorder = _recorder(request, env, behavior)

        name = behavior_field(env.action_space).name

        def set_behavior(value: float) -> None:
            setattr(recorder, name, value)

        with closing(recorder):
            return rollout(
                recorder,
                behavior,
                seed=request.seed,
                episodes=request.episodes,
                steps=request.steps,
                # Appended episodes continue the numbering, which determines the seeds.
                first_episode=request.first_episode + recorder.episodes,
                on_action=set_behavior,
                on_episode=on_episode,
            )


def try_request(request: FileRequest) -> None:
    """Create the file of a request and remove it, to find errors before the first episode."""
    with work_folder(request.out) as trial, closing(_env(request)) as env:
        behavior = _behavior(request, env)
        _recorder(replace(request, out=trial / "trial.mcap"), env, behavior).close()


def _env(request: FileRequest) -> gym.Env[Any, Any]:
    if isinstance(request.camera, str) and isinstance(request.sim, str):
        options = {"render_mode": "rgb_array", **request.sim_options}
        request = replace(request, sim_options=options)
    # A number of steps ends the recording, so it needs no default limit.
    if request.steps is not None and request.max_steps is None:
        return make_or_borrow(request.sim, **request.sim_options)
    return make_limited(request.sim, request.max_steps, **request.sim_options)


def _behavior(request: FileRequest, env: gym.Env[Any, Any]) -> EpsilonGreedy:
    policy, space = policies_of(request.policy, env)[0], env.action_space
    if request.noise:
        policy = NoisyPolicy(policy, request.noise, space, per_episode=request.noise_per_episode)
    return EpsilonGreedy(policy, request.epsilon, space)


def _recorder(request: FileRequest, env: gym.Env[Any, Any], behavior: EpsilonGreedy) -> RecordMcap:
    megabytes = request.rotate_mb
    return RecordMcap(
        env,
        request.out,
        policy=request.policy_name,
        epsilon=behavior.epsilon,
        seed=request.seed,
        compression=request.compression,
        overwrite=request.overwrite,
        append=request.append,
        max_file_bytes=None if megabytes is None else math.ceil(megabytes * 1e6),
        scene=request.scene,
        camera=request.camera,
        infos=request.infos,
        keys=request.keys,
    )


T = TypeVar("T")
_Kind = Literal["message", "done", "interrupted", "error"]


class WorkerEndedError(Exception):
    """A worker ended before its task was done."""

    def __init__(self, index: int, exit_code: int) -> None:
        """Describe the exit code of a process."""
        # Cause of the end, such as `was killed by SIGKILL`.
        # Index of the worker's request.
        self.index, self.cause = index, f"ended with exit code {exit_code}"
        if exit_code < 0:
            with suppress(ValueError):
                self.cause = f"was killed by {signal.Signals(-exit_code).name}"
        super().__init__(f"worker {index} {self.cause}")


def run_workers(
    task: Callable[[T, Callable[[Any], None]], None],
    requests: Sequence[T],
    on_message: Callable[[int, Any], None],
) -> None:
    """Run a task in one process for each request, until all are done."""
    # If a worker fails, or this process is interrupted or killed, all other tasks receive a
    # KeyboardInterrupt; if it was not killed, this function waits until they end.
    context = multiprocessing.get_context("spawn")
    # Only this process has `held`, the write end of the pipe. Therefore, the pipe closes when this
    # process ends.
    ours, held = context.Pipe(duplex=False)
    processes = []
    open_pipes: dict[Connection, int] = {}
    try:
        with blocked_stops():
            for index, request in enumerate(requests):
                messages, sender = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(task, request, ours, sender))
                process.start()
                sender.close()
                processes.append(process)
                open_pipes[messages] = index
        while open_pipes:
            ready = wait(list(open_pipes))
            for messages, index in [item for item in open_pipes.items() if item[0] in ready]:
                try:
                    kind, content = messages.recv()
                except (EOFError, ConnectionResetError):
                    del open_pipes[messages]
                    processes[index].join()
                    raise WorkerEndedError(index, processes[index].exitcode or 0) from None
                if kind == "message":
                    on_message(index, content)
                elif kind == "error":
                    raise content
                elif kind == "interrupted":
                    raise KeyboardInterrupt
                else:
                    del open_pipes[messages]
    finally:
        held.close()
        for messages in open_pipes:
            # Drain the pipe, because a worker that is blocked on a full pipe would not end.
            with suppress(EOFError, OSError):
                while True:
                    messages.recv_bytes()
        for process in processes:
            process.join()


def _work(
    task: Callable[[T, Callable[[Any], None]], None], request: T, parent: Connection, to: Connection
) -> None:
    """Run a task; send its messages, and then its outcome."""
    outcome: tuple[_Kind, Any]
    try:
        for number in STOPS:
            if signal.getsignal(number) is not signal.SIG_IGN or number == END:
                signal.signal(number, _interrupt_once)
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
        unblock_stops()
        task(request, partial(_send, to))
        outcome = "done", None
    except KeyboardInterrupt:
        outcome = "interrupted", None
    except Exception as error:
        if not isinstance(error, McaprlError | OSError):
            error.add_note(f"in a worker process:\n{traceback.format_exc()}")
        outcome = "error", error
    _ignore_stops()
    with suppress(BrokenPipeError):
        to.send(outcome)


def _send(to: Connection, content: Any) -> None:
    try:
        to.send(("message", content))
    except BrokenPipeError:
        # The parent was killed.
        _interrupt_once()


def _end_with(parent: Connection) -> None:
    """Interrupt the main thread when the parent exits or closes the pipe."""
    with suppress(EOFError, OSError):
        parent.recv()
    send_to_main_thread(END)


def _interrupt_once(number: int = END, frame: FrameType | None = None) -> None:
    if is_postponed(number, frame):
        return
    # The terminal and the parent both send a signal. The second must not interrupt the clean-up.
    _ignore_stops()
    raise KeyboardInterrupt


def _ignore_stops() -> None:
    # Do not use SIG_IGN, because Python then prints an error for a signal that has already arrived.
    for number in STOPS:
        signal.signal(number, _ignore)


def _ignore(*_: Any) -> None:
    pass


# Default number of files on Ray: at most 64, each with at least 10,000 steps.
_MOST_SHARDS, _LEAST_STEPS = 64, 10_000


def record_shards(
    whole: FileRequest, processes: int, on_episode: Callable[[EpisodeResult], None]
) -> list[EpisodeResult]:
    """Record episodes in parallel, with one file per process."""
    shards = _divided(whole, processes)
    with _new_folder(whole, shards[0]):
        results: list[list[EpisodeResult]] = [[] for _ in shards]

        def on_message(shard: int, result: EpisodeResult) -> None:
            results[shard].append(result)
            on_episode(result)

        try:
            run_workers(_record_shard, shards, on_message)
        except WorkerEndedError as error:
            episodes = counted(len(results[error.index]), "finished episode")
            raise LogError(
                f"{shards[error.index].out}: its process {error.cause}; the {episodes} in it and"
                " those of the other shards are kept"
            ) from error
    return [result for shard in results for result in shard]


def _divided(whole: FileRequest, parts: int) -> list[FileRequest]:
    """Return the requests of the shards."""
    shares = enumerate(_shares(whole.episodes or whole.steps or 0, parts))
    digits = max(2, len(str(parts - 1)))
    return [
        replace(
            whole,
            out=whole.out / f"shard-{number:0{digits}d}.mcap",
            episodes=None if whole.episodes is None else end - start,
            steps=None if whole.steps is None else end - start,
            # With `steps`, the number of episodes is unknown: each shard gets 2**20 indexes.
            first_episode=start if whole.episodes is not None else number << 20,
        )
        for number, (start, end) in shares
        if end > start
    ]


@contextmanager
def _new_folder(whole: FileRequest, first: FileRequest) -> Iterator[None]:
    """Lock the shards' folder, check the request by a trial, and remove an earlier recording."""
    if whole.out.is_file():
        raise OutputExistsError(f"{whole.out} exists and is a file: choose the name of a folder")
    with locked_folder(whole.out):
        old = _replaceable(whole.out, overwrite=whole.overwrite)
        try_request(first)
        for path in old:
            with locked_file(path):
                path.unlink()
        # Also remove the manifest of an earlier recording, because it lists other files.
        check_target(whole.out / MANIFEST_NAME, overwrite=True)
        (whole.out / MANIFEST_NAME).unlink(missing_ok=True)
        yield


def _record_shard(request: FileRequest, send: Callable[[EpisodeResult], None]) -> None:
    record_file(request, send)


def record_on_ray(
    whole: FileRequest, parts: int | None, options: ClusterOptions, advance: Advance
) -> list[EpisodeResult]:
    """Record shards on the workers of a Ray cluster, then write the manifest of the folder."""
    # The shards, and so the episodes, do not depend on the number of workers.
    from mcaprl.ray.tasks import WorkerDiedError, run_tasks

    # Workers have other working directories, so all paths must be absolute.
    whole = replace(whole, out=whole.out.absolute(), policy=_absolute(str(whole.policy)))
    shards = _divided(whole, _count(whole, parts))
    with options.connected(), _new_folder(whole, shards[0]):
        hidden = unfinished_folder(whole.out)
        paths = [hidden] if whole.policy in SCRIPTED else [hidden, Path(str(whole.policy))]
        try:
            results = run_tasks(
                _record_on_worker, shards, workers=options.workers, paths=paths, advance=advance
            )
        except WorkerDiedError as error:
            raise LogError(
                f"{shards[error.index].out}: workers died repeatedly without finishing another"
                f" episode ({error.cause}); the other finished shards are kept"
            ) from error
        shutil.rmtree(hidden)
        files = [
            LogFile(shard.out.name, len(one), sum(e.length for e in one), shard.out.stat().st_size)
            for shard, one in zip(shards, results, strict=True)
        ]
        write_manifest(whole.out, files)
    return [result for shard in results for result in shard]


def _record_on_worker(request: FileRequest, send: Callable[[int], None]) -> list[EpisodeResult]:
    """Record a shard, or continue that of a killed worker; return all its episodes."""
    # Until the shard is complete, its log is in the hidden folder.
    unfinished = request.out.parent / UNFINISHED_NAME / request.out.name
    if not request.out.exists():
        kept = _repaired(unfinished)
        done = len(kept) if request.episodes else sum(result.length for result in kept)
        send(done)
        rest = (request.episodes or request.steps or 0) - done

        def on_episode(result: EpisodeResult) -> None:
            nonlocal done
            done += 1 if request.episodes else result.length
            send(done)

        if rest > 0:
            part = replace(
                request,
                out=unfinished,
                episodes=rest if request.episodes else None,
                steps=rest if request.steps else None,
                overwrite=False,
                append=bool(kept),
            )
            record_file(part, on_episode)
        with unfinished.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(unfinished, request.out)
    return _episodes_of(request.out)


def _repaired(path: Path) -> list[EpisodeResult]:
    """Repair the log of a killed worker, so that it can be continued; return its episodes."""
    if not path.exists():
        return []
    repaired = path.with_suffix(".repaired")
    with locked_file(path):
        pass
    try:
        recover_log(path, repaired, overwrite=True)
        kept = _episodes_of(repaired)
    except LogError:
        # The file has no finished episode.
        kept = []
    # A worker that was stopped instead of killed has closed the log with an interrupted episode.
    # Such a log is recorded again from its beginning.
    if kept and kept[-1].reason != INTERRUPTED:
        os.replace(repaired, path)
        return kept
    repaired.unlink(missing_ok=True)
    path.unlink()
    return []


def _episodes_of(path: Path) -> list[EpisodeResult]:
    """Return the result of each episode of a log, without positions."""
    try:
        summaries = LogReader(path).episode_summaries()
    except NoStepsError:
        return []
    nowhere = np.empty((0, 2))
    return [
        EpisodeResult(one.seed or 0, one.total_reward, one.length, one.reason, nowhere)
        for one in summaries
    ]


def _count(whole: FileRequest, parts: int | None) -> int:
    """Return the number of shards, which is small enough that no shard is empty."""
    if whole.episodes is not None:
        return min(parts or _MOST_SHARDS, whole.episodes)
    steps = whole.steps or 0
    return min(parts or _MOST_SHARDS, steps if parts else max(steps // _LEAST_STEPS, 1))


def _absolute(policy: str) -> str:
    return policy if policy in SCRIPTED else os.path.abspath(policy)


def _replaceable(folder: Path, *, overwrite: bool) -> list[Path]:
    """Return the shards of an earlier recording."""
    old = sorted(folder.glob("*.mcap"))
    foreign = [path.name for path in old if not path.name.startswith("shard-")]
    if foreign:
        raise OutputExistsError(f"{folder} has other logs ({foreign[0]}): choose another folder")
    if old and not overwrite:
        raise OutputExistsError(f"{folder} exists: choose another folder, or pass `overwrite=True`")
    for path in old:
        check_target(path, overwrite=True)
    return old


def _shares(total: int, parts: int) -> list[tuple[int, int]]:
    """Split range(total) into half-open ranges whose lengths differ by at most one.

    >>> _shares(5, 2)
    [(0, 2), (2, 5)]
    """
    edges = [total * part // parts for part in range(parts + 1)]
    return list(itertools.pairwise(edges))

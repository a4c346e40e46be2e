"""Recording: a policy acts in a sim, and the log stores each step."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from mcaprl.api.environments import all_options
from mcaprl.api.policies import policies_of, policy_names
from mcaprl.api.ranges import check_fraction, check_least
from mcaprl.errors import LogError, OutputExistsError, UsageError
from mcaprl.files import check_target, locked_file, locked_folder, work_folder
from mcaprl.progress import ProgressBar, no_progress
from mcaprl.recorder.record.wrapper import RecordMcap
from mcaprl.remote import check_upload, upload_all
from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.rollout import EpisodeResult, EpsilonGreedy, rollout
from mcaprl.texts import counted
from mcaprl.workers import WorkerEndedError, run_workers


@dataclass(frozen=True)
class Recording:
    """Result of `record`.

    Attributes:
        out: Written file or folder.
        episodes: Number of episodes.
        steps: Number of steps.
        mean_return: Mean of the episodes' returns.
        return_std: Standard deviation of the episodes' returns.
        size_bytes: Size of all files of `out`, including earlier episodes.
        results: Result of each episode.
    """

    out: Path
    episodes: int
    steps: int
    mean_return: float
    return_std: float
    size_bytes: int
    results: tuple[EpisodeResult, ...] = field(repr=False)


@dataclass(frozen=True)
class _Request:
    """One file to record; its fields are the arguments of `record`.

    Attributes:
        first_episode: Number of the first episode; an episode's seed depends on its number.
    """

    sim: str
    out: Path
    policy: str
    epsilon: float
    episodes: int | None
    steps: int | None
    seed: int
    sim_options: Mapping[str, Any]
    scene: bool
    camera: bool
    infos: bool | Sequence[str]
    compression: str
    overwrite: bool
    append: bool
    rotate_mb: float | None
    first_episode: int = 0


def record(
    sim: str,
    out: str | Path,
    *,
    policy: str | Path = "pilot",
    epsilon: float = 0.0,
    episodes: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    envs: int = 1,
    observation: str | None = None,
    rules: str | None = None,
    sim_options: Mapping[str, Any] | None = None,
    scene: bool = True,
    camera: bool = False,
    infos: bool | Sequence[str] = False,
    compression: str = "zstd",
    overwrite: bool = False,
    append: bool = False,
    rotate_mb: float | None = None,
    upload: str | None = None,
    progress: ProgressBar = no_progress,
) -> Recording:
    """Record episodes of a sim into an MCAP file; write each episode when it ends.

    Args:
        sim: Short name of a sim, or a Gymnasium id.
        out: File to write; with several processes, a folder with one file per process.
        policy: `pilot`, `random`, or the path of a trained policy.
        epsilon: Probability of a random action instead of the policy's.
        episodes: Number of episodes; exclusive with `steps`.
        steps: Number of steps; exclusive with `episodes`.
        seed: Seed of the recording.
        envs: Number of processes. With more than one, a script needs
            `if __name__ == "__main__"`, since each process imports the script.
        observation: Observation that the sim returns, such as `depth`.
        rules: Rules of the sim, such as `classic`.
        sim_options: Other arguments of the environment.
        scene: Whether topics that only viewers use are recorded.
        camera: Whether metric depth images are recorded.
        infos: Whether the infos of the environment are recorded, or the names of infos to record.
        compression: Compression of chunks: `zstd`, `lz4` or `none`.
        overwrite: Whether existing logs are replaced.
        append: Whether the episodes are added to an existing file.
        rotate_mb: Size in MB after which a new file is started; None for one file.
        upload: URL to which the log is copied when it is complete: a file such as
            `s3://bucket/lane.mcap`, or the folder of several files. The local files remain.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: The arguments contradict each other, or a number is out of range.
        UnknownNameError: There is no such sim or policy.
        OutputExistsError: `out` exists and may not be replaced.
        LogError: The log cannot be written.
    """
    request = _Request(
        sim=sim,
        out=Path(out),
        policy=str(policy),
        epsilon=epsilon,
        episodes=episodes,
        steps=steps,
        seed=seed,
        sim_options=all_options(observation, rules, sim_options),
        scene=scene,
        camera=camera,
        infos=infos,
        compression=compression,
        overwrite=overwrite,
        append=append,
        rotate_mb=rotate_mb,
    )
    _check_request(request, envs)
    if upload is not None:
        check_upload(upload)
    with progress(f"recording {sim}", episodes or steps) as advance:

        def on_episode(result: EpisodeResult) -> None:
            advance(1 if episodes else result.length)

        if envs == 1:
            results = _record_file(request, on_episode)
        else:
            results = _record_shards(request, envs, on_episode)
    if upload is not None:
        upload_all(_files(request.out), upload)
    returns = np.array([result.total_reward for result in results])
    return Recording(
        request.out,
        len(results),
        sum(result.length for result in results),
        float(returns.mean()),
        float(returns.std()),
        sum(path.stat().st_size for path in _files(request.out)),
        tuple(results),
    )


def _check_request(request: _Request, envs: int) -> None:
    if (request.episodes is None) == (request.steps is None):
        raise UsageError("record needs either --episodes N or --steps N")
    check_fraction(epsilon=request.epsilon)
    check_least(1, episodes=request.episodes, steps=request.steps, envs=envs)
    check_least(0, seed=request.seed)
    if envs > 1 and request.append:
        raise UsageError("--append needs one file, but --envs writes several: omit one option")
    if envs > 1 and request.out.suffix == ".mcap":
        raise UsageError(
            f"--envs {envs} writes one file per process into a folder; {request.out} is the name of"
            " a file"
        )


def _files(out: Path) -> list[Path]:
    """Return the written files: one file, its rotated parts, or the shards in a folder."""
    if out.is_file():
        return [out]
    return sorted(out.glob("*.mcap") if out.is_dir() else out.parent.glob(f"{out.stem}-*.mcap"))


def _record_file(
    request: _Request, on_episode: Callable[[EpisodeResult], None] | None = None
) -> list[EpisodeResult]:
    """Record one file in this process."""
    with closing(make_sim(request.sim, **request.sim_options)) as env:
        behavior = _behavior(request, env)
        recorder = _recorder(request, env, behavior)

        def set_probability(probability: float) -> None:
            recorder.behavior_prob = probability

        with closing(recorder):
            return rollout(
                recorder,
                behavior,
                seed=request.seed,
                episodes=request.episodes,
                steps=request.steps,
                # Continue the numbering: appended episodes have the seeds of one longer recording.
                first_episode=request.first_episode + recorder.episodes,
                on_action=set_probability,
                on_episode=on_episode,
            )


def _behavior(request: _Request, env: gym.Env[Any, Any]) -> EpsilonGreedy:
    return EpsilonGreedy(policies_of(request.policy, env)[0], request.epsilon, env.action_space)


def _recorder(request: _Request, env: gym.Env[Any, Any], behavior: EpsilonGreedy) -> RecordMcap:
    megabytes = request.rotate_mb
    return RecordMcap(
        env,
        request.out,
        policy=policy_names([request.policy])[request.policy],
        epsilon=behavior.epsilon,
        seed=request.seed,
        compression=request.compression,
        overwrite=request.overwrite,
        append=request.append,
        max_file_bytes=None if megabytes is None else math.ceil(megabytes * 1e6),
        scene=request.scene,
        camera=request.camera,
        infos=request.infos,
    )


def _record_shards(
    whole: _Request, processes: int, on_episode: Callable[[EpisodeResult], None]
) -> list[EpisodeResult]:
    """Record episodes in parallel, with one file per process.

    Raises:
        OutputExistsError: The folder contains logs that may not be replaced.
        LogError: Another recording is writing to the folder, or a process was killed.
    """
    if whole.out.is_file():
        raise OutputExistsError(f"{whole.out} exists and is a file: choose the name of a folder")
    sim, options = whole.sim, whole.sim_options
    shards = [
        replace(
            whole,
            out=whole.out / f"shard-{number:02d}.mcap",
            episodes=None if whole.episodes is None else end - start,
            steps=None if whole.steps is None else end - start,
            # With `steps`, the number of episodes is unknown: reserve 2**20 numbers per shard.
            first_episode=start if whole.episodes is not None else number << 20,
        )
        for number, (start, end) in enumerate(
            _shares(whole.episodes or whole.steps or 0, processes)
        )
        if end > start
    ]
    with locked_folder(whole.out):
        old = _replaceable(whole.out, overwrite=whole.overwrite)
        # A trial recording lets an invalid request fail before any file is replaced.
        with work_folder(shards[0].out) as trial, closing(make_sim(sim, **options)) as env:
            behavior = _behavior(whole, env)
            _recorder(replace(shards[0], out=trial / "trial.mcap"), env, behavior).close()
        for path in old:
            with locked_file(path):
                path.unlink()
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


def _record_shard(request: _Request, send: Callable[[EpisodeResult], None]) -> None:
    _record_file(request, send)


def _replaceable(folder: Path, *, overwrite: bool) -> list[Path]:
    """Return the shards of an earlier recording.

    Raises:
        OutputExistsError: They may not be replaced, or the folder contains other logs.
        LogError: One of them is being recorded.
    """
    old = sorted(folder.glob("*.mcap"))
    foreign = [path.name for path in old if not path.name.startswith("shard-")]
    if foreign:
        raise OutputExistsError(f"{folder} has other logs ({foreign[0]}): choose another folder")
    if old and not overwrite:
        raise OutputExistsError(f"{folder} exists: choose another folder, or pass --overwrite")
    for path in old:
        check_target(path, overwrite=True)
    return old


def _shares(total: int, parts: int) -> list[tuple[int, int]]:
    """Split a count into half-open ranges whose lengths differ by at most one.

    >>> _shares(5, 2)
    [(0, 2), (2, 5)]
    """
    edges = [total * part // parts for part in range(parts + 1)]
    return list(itertools.pairwise(edges))

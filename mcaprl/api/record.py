"""Recording: a policy acts in a sim, and the log stores each step."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from mcaprl.api.environments import all_options, check_names, name_of, trained_options
from mcaprl.api.policies import by_name
from mcaprl.api.ranges import ClusterOptions, check_fraction, check_least, check_positive
from mcaprl.api.record_files import FileRequest, record_file, record_on_ray, record_shards
from mcaprl.base_policy import Actor
from mcaprl.errors import UsageError
from mcaprl.files import check_log_name
from mcaprl.progress import ProgressBar, no_progress
from mcaprl.recorder.dataset.open import MANIFEST_NAME
from mcaprl.sims.evaluation.rollout import EpisodeResult, warn_of_cuts
from mcaprl.storage.remote import check_upload, upload_all


@dataclass(frozen=True)
class Recording:
    """Result of `record`.

    Attributes:
        out: File or folder to write, as in the call.
        episodes: Number of episodes.
        steps: Number of steps.
        mean_return: Mean of the episodes' returns.
        return_std: Standard deviation of the episodes' returns.
        size_bytes: Size of all files, including earlier episodes.
        files: Paths of the logs: `out`, the logs in this folder, or with `rotate_mb` the numbered
            files.
        results: Result of each episode.
    """

    out: Path
    episodes: int
    steps: int
    mean_return: float
    return_std: float
    size_bytes: int
    files: tuple[Path, ...]
    results: tuple[EpisodeResult, ...] = field(repr=False)


def record(
    sim: str | gym.Env[Any, Any],
    out: str | Path,
    *,
    policy: str | PathLike[str] | Actor = "pilot",
    epsilon: float = 0.0,
    noise: float = 0.0,
    noise_per_episode: bool = False,
    episodes: int | None = None,
    steps: int | None = None,
    max_steps: int | None = None,
    seed: int = 0,
    envs: int = 1,
    observation: str | None = None,
    rules: str | None = None,
    actions: str | int | None = None,
    sim_options: Mapping[str, Any] | None = None,
    trust_env: bool = False,
    scene: bool = True,
    camera: bool | str = False,
    infos: bool | Sequence[str] = False,
    keys: Sequence[str] | None = None,
    compression: str = "zstd",
    overwrite: bool = False,
    append: bool = False,
    rotate_mb: float | None = None,
    upload: str | None = None,
    ray: bool = False,
    workers: int | None = None,
    address: str | None = None,
    shards: int | None = None,
    progress: ProgressBar = no_progress,
) -> Recording:
    """Record episodes of a sim into an MCAP file; write each episode when it ends.

    Args:
        sim: Short name of a sim, a Gymnasium id, or an environment, which stays open.
        out: File to write; with several processes, a folder with one file per process.
        policy: `pilot`, `random`, the path of a trained policy, a policy or another object with a
            method `act(observations)` for batches of observations. Only policies of this package,
            and those with a true attribute `is_deterministic`, get a `behavior_prob`. Actions of
            floats get a `behavior_log_prob` from the method `log_prob(observations, actions)` of
            policies that are not deterministic.
        epsilon: Probability of a random action instead of the policy's.
        noise: Standard deviation of Gaussian noise that is added to each part of continuous
            actions, as a fraction of half the range of the part. The noisy action is within the
            bounds, by truncation of the distribution, and the log has its exact density.
        noise_per_episode: Whether the standard deviation of each episode is drawn uniformly between
            0 and `noise`.
        episodes: Number of episodes; exclusive with `steps`.
        steps: Number of steps; exclusive with `episodes`.
        max_steps: Steps after which an episode is truncated, with the reason `step_limit`. None
            selects 27,000 if the environment has no time limit and `episodes` is given.
        seed: Seed of the recording.
        envs: Number of processes. With more than one, a script needs
            `if __name__ == "__main__"`, because each process imports the script.
        observation: Observation that the sim returns, such as `depth`.
        rules: Rules of the sim, such as `classic`.
        actions: Actions of the sim, such as `continuous`.
        sim_options: Other arguments of the environment. Without any argument, a trained policy acts
            with the arguments of its training if that was in the same environment.
        trust_env: Whether the arguments of the training may be passed to environments other than
            the sims of `SIMS`.
        scene: Whether topics that only viewers use are recorded.
        camera: Whether metric depth images are recorded; or `h264` for a video of what the
            environment renders (extra `video`).
        infos: Whether the infos of the environment are recorded, or the names of infos to record.
        keys: Keys of the parts of a Dict or Tuple observation that are recorded; default: all.
        compression: Compression of chunks: `zstd`, `lz4` or `none`.
        overwrite: Whether existing logs are replaced.
        append: Whether the episodes are added to an existing file.
        rotate_mb: Size in MB after which a new file is started; None for one file.
        upload: URL to which the log is copied when it is complete: a file such as
            `s3://bucket/lane.mcap`, or the folder of several files. The local files remain.
        ray: Whether Ray workers record the episodes. `out` is then a folder that all workers must
            see. Each log appears in the folder when it is complete. `manifest.json` appears when
            all logs are complete. The number of workers has no effect on the episodes.
        workers: Number of Ray workers; default: number of CPUs of the cluster.
        address: Address of a Ray cluster, `HOST:PORT` or `auto`; default: RAY_ADDRESS, else a
            local cluster for this call.
        shards: Number of files that Ray workers write; default: up to 64. With `steps`, the last
            episode of each file may be interrupted.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: The arguments contradict each other, or a number is out of range.
        UnknownNameError: There is no such sim or policy.
        OutputExistsError: `out` exists and may not be replaced.
        LogError: The log cannot be written, or workers died repeatedly.
        ClusterError: The Ray cluster cannot be used.
        MissingExtraError: Ray is not installed.
    """
    options = all_options(observation, rules, actions, sim_options)
    sim_name, ((shown, chosen),) = name_of(sim), by_name([policy]).items()
    request = FileRequest(
        sim=sim,
        out=Path(out),
        policy=chosen,
        epsilon=epsilon,
        noise=noise,
        noise_per_episode=noise_per_episode,
        episodes=episodes,
        steps=steps,
        seed=seed,
        sim_options=trained_options(
            [chosen] if isinstance(chosen, str) else [], sim, options, trust_env=trust_env
        ),
        scene=scene,
        camera=camera,
        infos=infos,
        keys=keys,
        compression=compression,
        overwrite=overwrite,
        append=append,
        rotate_mb=rotate_mb,
        max_steps=max_steps,
    )
    _check_request(request, envs)
    if ray or envs > 1:
        check_names(sim, chosen)
    on_cluster = ClusterOptions(ray, workers, address)
    on_cluster.check(shards=shards)
    if ray:
        _check_for_ray(request, envs)
    elif envs == 1:
        check_log_name(request.out)
    if upload is not None:
        check_upload(upload, overwrite=overwrite or append)
    with progress(f"recording {sim_name}", episodes or steps) as advance:

        def on_episode(result: EpisodeResult) -> None:
            advance(1 if episodes else result.length)

        if ray:
            results = record_on_ray(request, shards, on_cluster, advance)
        elif envs == 1:
            results = record_file(request, on_episode)
        else:
            results = record_shards(request, envs, on_episode)
    warn_of_cuts(results, shown, sim_name)
    files = _files(request.out, rotated=request.rotate_mb is not None)
    if upload is not None:
        upload_all([*files, request.out / MANIFEST_NAME] if ray else files, upload)
    returns = np.array([result.total_reward for result in results])
    return Recording(
        request.out,
        len(results),
        sum(result.length for result in results),
        float(returns.mean()),
        float(returns.std()),
        sum(path.stat().st_size for path in files),
        tuple(files),
        tuple(results),
    )


def _check_request(request: FileRequest, envs: int) -> None:
    if (request.episodes is None) == (request.steps is None):
        raise UsageError("record needs either `episodes=N` or `steps=N`")
    check_fraction(epsilon=request.epsilon, noise=request.noise)
    if request.noise_per_episode and not request.noise:
        raise UsageError("`noise_per_episode=True` needs a largest deviation: pass `noise=S`")
    if request.rotate_mb is not None:
        check_positive(rotate_mb=request.rotate_mb)
    check_least(
        1, episodes=request.episodes, steps=request.steps, max_steps=request.max_steps, envs=envs
    )
    check_least(0, seed=request.seed)
    if envs > 1 and request.append:
        raise UsageError(
            "`append=True` needs one file, but `envs=` writes several: omit one of them"
        )
    if envs > 1 and request.out.suffix == ".mcap":
        raise UsageError(
            f"`envs={envs}` writes one file per process into a folder; {request.out} is the name of"
            " a file"
        )


def _check_for_ray(request: FileRequest, envs: int) -> None:
    check_least(1, envs=envs)
    given = {"envs": envs > 1, "append": request.append, "rotate_mb": request.rotate_mb}
    for name, value in given.items():
        if value:
            raise UsageError(f"`{name}=` is for recording without `ray=True`: omit one of them")
    if request.out.suffix == ".mcap":
        raise UsageError(
            f"`ray=True` writes several files into a folder; {request.out} is the name of a file"
        )


def _files(out: Path, *, rotated: bool) -> list[Path]:
    """Return the written files: one file, its rotated parts, or the shards in a folder."""
    # Beside the parts, there may be a file `out` of an earlier recording.
    if out.is_file() and not rotated:
        return [out]
    if out.is_dir():
        return sorted(out.glob("*.mcap"))
    pattern = re.escape(out.stem) + r"-\d{5}\.mcap"
    return sorted(path for path in out.parent.iterdir() if re.fullmatch(pattern, path.name))

"""`mcaprl record`: a policy acts, the log fills."""

from __future__ import annotations

import itertools
import math
import multiprocessing
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from mcaprl.api.policies import policies_of, policy_names
from mcaprl.cli.options import sim_options
from mcaprl.cli.show import counted, progress, size
from mcaprl.errors import OutputExistsError, UsageError
from mcaprl.recorder.format.writing import COMPRESSIONS
from mcaprl.recorder.record.wrapper import RecordMcap
from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.rollout import EpisodeResult, EpsilonGreedy, rollout


@dataclass(frozen=True)
class Recording:
    """What to record.

    Attributes:
        sim: short name or Gymnasium id.
        sim_options: arguments to the environment.
        out: file to write.
        policy: `pilot`, `random` or a path.
        epsilon: probability of a random action.
        episodes: how many, or None to count steps.
        steps: how many, or None.
        first_episode: number of the first episode, on which its seed depends.
        seed: of the recording.
        scene: record what viewers show.
        camera: record metric depth images.
        compression: of chunks.
        overwrite: replace a file that is there.
        append: go on behind the last episode of a file that is there.
        rotate_mb: begin another file behind the episode that made one as large; None for one file.
    """

    sim: str
    sim_options: dict[str, Any]
    out: Path
    policy: str
    epsilon: float
    episodes: int | None
    steps: int | None
    first_episode: int
    seed: int
    scene: bool
    camera: bool
    compression: str
    overwrite: bool
    append: bool
    rotate_mb: float | None


@click.command()
@click.argument("sim")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="File to write.")
@click.option("--policy", default="pilot", show_default=True, help="pilot, random, or a path.")
@click.option(
    "--epsilon",
    default=0.0,
    show_default=True,
    type=click.FloatRange(0, 1),
    help="Probability of a random action instead of the policy's.",
)
@click.option("--episodes", type=click.IntRange(1), help="How many episodes to record.")
@click.option("--steps", type=click.IntRange(1), help="How many steps, instead.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option(
    "--envs",
    default=1,
    show_default=True,
    type=click.IntRange(1),
    help="Processes; with more than one, OUT is a folder with a file of each.",
)
@sim_options
@click.option("--no-scene", is_flag=True, help="Leave out what only viewers show.")
@click.option("--camera", is_flag=True, help="Record metric depth images on /camera/depth.")
@click.option("--compression", default="zstd", show_default=True, type=click.Choice(COMPRESSIONS))
@click.option("--overwrite", is_flag=True, help="Replace a file that is there.")
@click.option("--append", is_flag=True, help="Go on behind the last episode of a file.")
@click.option(
    "--rotate-mb",
    type=click.FloatRange(0, min_open=True),
    help="Begin another file (OUT-00000.mcap, OUT-00001.mcap, ...) when one has this many MB.",
)
def record(envs: int, sim_arguments: dict[str, Any], no_scene: bool, **request: Any) -> None:
    """Record episodes of SIM into an MCAP file.

    SIM is lane, powerline, racer, highway-lane, or any Gymnasium id. Each finished episode is on
    disk at once.
    """
    whole = Recording(sim_options=sim_arguments, scene=not no_scene, first_episode=0, **request)
    _check_request(whole, envs)
    with progress(f"recording {whole.sim}", whole.episodes or whole.steps) as advance:

        def on_episode(result: EpisodeResult) -> None:
            advance(1 if whole.episodes else result.length)

        if envs == 1:
            results = run_recording(whole, on_episode)
        else:
            results = run_shards(whole, envs, on_episode)
    _print_summary(whole, results)


def _check_request(whole: Recording, envs: int) -> None:
    if (whole.episodes is None) == (whole.steps is None):
        raise UsageError("record needs --episodes N or --steps N, one of the two")
    if math.isnan(whole.epsilon):
        raise UsageError("--epsilon nan: give a probability from 0 to 1")
    if envs > 1 and whole.append:
        raise UsageError("--append goes on in one file, and --envs writes several: leave out one")
    if envs > 1 and whole.out.suffix == ".mcap":
        raise UsageError(
            f"--envs {envs} writes a file of each into a folder; {whole.out} is no name for one"
        )


def _print_summary(whole: Recording, results: list[EpisodeResult]) -> None:
    returns = np.array([result.total_reward for result in results])
    length = sum(result.length for result in results)
    bytes_ = sum(path.stat().st_size for path in _files(whole.out))
    click.echo(
        f"{whole.out}: {counted(len(results), 'episode')}, {counted(length, 'step')},"
        f" mean return {returns.mean():.2f} (standard deviation {returns.std():.2f}),"
        f" {size(bytes_)}"
    )


def _files(out: Path) -> list[Path]:
    """What was written: a file, its parts, or the shards in a folder."""
    if out.is_file():
        return [out]
    return sorted(out.glob("*.mcap") if out.is_dir() else out.parent.glob(f"{out.stem}-*.mcap"))


def run_recording(
    recording: Recording, on_episode: Callable[[EpisodeResult], None] | None = None
) -> list[EpisodeResult]:
    """Record one file in this process."""
    megabytes = recording.rotate_mb
    env = make_sim(recording.sim, **recording.sim_options)
    with closing(env):
        policy = policies_of(recording.policy, env)[0]
        behavior = EpsilonGreedy(policy, recording.epsilon, env.action_space)
        recorder = RecordMcap(
            env,
            recording.out,
            policy=policy_names([recording.policy])[recording.policy],
            epsilon=behavior.epsilon,
            seed=recording.seed,
            compression=recording.compression,
            overwrite=recording.overwrite,
            append=recording.append,
            max_file_bytes=None if megabytes is None else math.ceil(megabytes * 1e6),
            scene=recording.scene,
            camera=recording.camera,
        )

        def tell_probability(probability: float) -> None:
            recorder.behavior_prob = probability

        with closing(recorder):
            return rollout(
                recorder,
                behavior,
                seed=recording.seed,
                episodes=recording.episodes,
                steps=recording.steps,
                # Appended episodes have the seeds that they would have had in one recording.
                first_episode=recording.first_episode + recorder.episodes,
                on_action=tell_probability,
                on_episode=on_episode,
            )


def run_shards(
    whole: Recording, processes: int, on_episode: Callable[[EpisodeResult], None]
) -> list[EpisodeResult]:
    """Record shards of a folder in as many processes; together the same episodes as one would.

    Raises:
        OutputExistsError: the folder holds logs already that may not be replaced.
    """
    # What is wrong with the request is told before anything is touched.
    with closing(make_sim(whole.sim, **whole.sim_options)) as env:
        policies_of(whole.policy, env)
    old = sorted(whole.out.glob("*.mcap")) if whole.out.is_dir() else []
    foreign = [path.name for path in old if not path.name.startswith("shard-")]
    if foreign:
        raise OutputExistsError(f"{whole.out} has other logs ({foreign[0]}): choose another folder")
    if (old and not whole.overwrite) or whole.out.is_file():
        raise OutputExistsError(f"{whole.out} exists: choose another folder, or pass --overwrite")
    for path in old:
        path.unlink()
    shards = [
        replace(
            whole,
            out=whole.out / f"shard-{number:02d}.mcap",
            episodes=None if whole.episodes is None else end - start,
            steps=None if whole.steps is None else end - start,
            # Counted in steps, a shard cannot know how many episodes the others have.
            first_episode=start if whole.episodes is not None else number << 20,
        )
        for number, (start, end) in enumerate(
            _shares(whole.episodes or whole.steps or 0, processes)
        )
        if end > start
    ]
    context = multiprocessing.get_context("spawn")
    results = []
    with ProcessPoolExecutor(len(shards), context, initializer=_end_as_interrupted) as pool:
        for shard_results in pool.map(run_recording, shards):
            results += shard_results
            for result in shard_results:
                on_episode(result)
    return results


def _end_as_interrupted() -> None:
    """Let SIGTERM end a shard as Ctrl-C does: with its file closed."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def _shares(total: int, parts: int) -> list[tuple[int, int]]:
    """Split a count into runs that differ by one at most.

    >>> _shares(5, 2)
    [(0, 2), (2, 5)]
    """
    edges = [total * part // parts for part in range(parts + 1)]
    return list(itertools.pairwise(edges))

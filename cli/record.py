"""`mcaprl record`: record a policy in a sim."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

import mcaprl
from mcaprl.cli.completion import Name, policies, sims
from mcaprl.cli.help import Command
from mcaprl.cli.options import (
    camera_option,
    integer_option,
    keys_option,
    max_steps_option,
    ray_options,
    sim_options,
    trust_run_option,
)
from mcaprl.cli.progress import keeping, working
from mcaprl.cli.show import echo
from mcaprl.texts import counted, size


def _compressions() -> Iterable[str]:
    from mcaprl.recorder.format.writing import COMPRESSIONS

    return COMPRESSIONS


@click.command(cls=Command)
@click.argument("sim", type=Name(sims))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="File to write.")
@click.option(
    "--policy",
    default="pilot",
    show_default=True,
    type=Name(policies, is_path=True),
    help="pilot, random, or a path.",
)
@click.option(
    "--epsilon",
    default=0.0,
    show_default=True,
    type=click.FloatRange(0, 1),
    help="Probability of a random action instead of the policy's.",
)
@click.option(
    "--noise",
    default=0.0,
    show_default=True,
    metavar="S",
    type=click.FloatRange(0, 1),
    help="Standard deviation of Gaussian noise on continuous actions, as a fraction of half their"
    " range.",
)
@click.option(
    "--noise-per-episode",
    is_flag=True,
    help="Draw the deviation of each episode uniformly between 0 and --noise.",
)
@click.option("--episodes", type=click.IntRange(1), help="Number of episodes to record.")
@click.option(
    "--steps",
    type=click.IntRange(1),
    help="Number of steps to record, instead of a number of episodes.",
)
@max_steps_option
@integer_option("--seed", "Seed of the recording.", least=0)
@integer_option(
    "--envs",
    "Number of processes; with more than one, OUT is a folder with one file per process.",
    least=1,
)
@sim_options
@trust_run_option
@click.option("--no-scene", is_flag=True, help="Omit the topics that only viewers use.")
@camera_option(
    "Record metric depth images on /camera/depth; with h264, what the environment renders, as video"
    " on /camera/image."
)
@click.option("--infos", is_flag=True, help="Record the info dicts that the environment returns.")
@keys_option
@click.option(
    "--compression",
    default="zstd",
    show_default=True,
    type=Name(_compressions),
    help="Compression of chunks: zstd, lz4 or none.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@click.option("--append", is_flag=True, help="Add the episodes to an existing file.")
@click.option(
    "--rotate-mb",
    type=click.FloatRange(0, min_open=True),
    help="Size in MB after which a new file is started (OUT-00000.mcap, OUT-00001.mcap, ...).",
)
@click.option(
    "--upload", metavar="URL", help="Copy the finished log to a URL, such as s3://bucket/lane.mcap."
)
@ray_options
@click.option(
    "--shards",
    type=click.IntRange(1),
    help="With --ray: number of files that are written into the folder OUT.  [default: up to 64]",
)
def record(no_scene: bool, **request: Any) -> None:
    """Record episodes of SIM into an MCAP file.

    SIM is lane, powerline, racer, highway-lane, or any Gymnasium id. Each episode is
    written when it ends.
    """
    kept = f"finished {'logs' if request['ray'] else 'episodes'} are kept"
    with keeping(kept), working("loading the sim and the policy") as bar:
        found = mcaprl.record(**request, scene=not no_scene, progress=bar)
    written = str(found.out)
    if not found.out.exists():
        parts = [str(path) for path in found.files]
        written = parts[0] if len(parts) == 1 else f"{parts[0]} to {parts[-1]}"
    echo(
        f"{written}: {counted(found.episodes, 'episode')}, {counted(found.steps, 'step')},"
        f" mean return {found.mean_return:.2f} (standard deviation {found.return_std:.2f}),"
        f" {size(found.size_bytes)}"
    )

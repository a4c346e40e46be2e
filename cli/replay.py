"""`mcaprl replay`: look at logged episodes again, and check that the simulator still makes them."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import click
import gymnasium as gym

from mcaprl.cli.show import progress
from mcaprl.errors import UsageError
from mcaprl.recorder.dataset import Dataset
from mcaprl.recorder.reader import find_logs, open_logs
from mcaprl.recorder.verify import verify
from mcaprl.sims import make_sim


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("--episode", type=click.IntRange(0), help="This one only, counted from 0.")
@click.option("--verify", "verifies", is_flag=True, help="Step the sim again and compare.")
@click.option("--sim", help="Step this sim instead of the one that the log names.")
def replay(files: tuple[str, ...], episode: int | None, verifies: bool, sim: str | None) -> int:
    """Play FILE... to Foxglove, or step the sim through it again with --verify."""
    paths = find_logs(files)
    if verifies:
        same = [_verify(path, episode, sim) for path in paths]
        return int(not all(same))
    return 0


def _verify(path: Path, episode: int | None, sim: str | None) -> bool:
    """Compare one file with the sim and tell what was found; whether all is the same."""
    dataset = open_logs(path)
    check_episode(dataset, episode, path)
    with closing(sim_of(dataset, path, sim)) as env, progress("stepping", len(dataset)) as advance:
        found = verify(dataset, env, only=episode, on_frame=lambda _, step: advance(min(step, 1)))
    if found.unseeded:
        shown = ", ".join(map(str, found.unseeded[:10])) + ", ..." * (len(found.unseeded) > 10)
        click.echo(
            f"{path}: the log has no seed of {len(found.unseeded)} episodes, so they were not"
            f" compared: {shown}"
        )
    if found.difference is not None:
        click.echo(f"{path}: {found.difference}")
    elif found.episodes:
        click.echo(
            f"{path}: {found.episodes} episodes and {found.steps} steps compared: every"
            " observation, reward and end is the same, bit for bit"
        )
    return found.difference is None and found.episodes > 0


def sim_of(dataset: Dataset, path: Path, sim: str | None = None) -> gym.Env[Any, Any]:
    """Make the environment that a log was recorded in.

    Args:
        dataset: the log.
        path: of it.
        sim: short name or id, where the log's own is not the right one.

    Raises:
        UsageError: the log names none, or it cannot be made.
    """
    name = sim or dataset.env_id
    if not name:
        raise UsageError(f"{path} does not tell which environment it is of: pass --sim")
    return make_sim(name, **dataset.env_kwargs)


def check_episode(dataset: Dataset, episode: int | None, path: Path) -> None:
    """Make sure that a log has the episode asked for."""
    last = len(dataset.episodes) - 1
    if episode is not None and episode > last:
        raise UsageError(f"--episode {episode}: {path} has episodes 0 to {last}")

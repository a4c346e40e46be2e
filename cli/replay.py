"""`mcaprl replay`: look at logged episodes again, and check that the simulator still makes them."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import click
import gymnasium as gym

from mcaprl.cli.show import counted, print_problems, progress
from mcaprl.errors import UsageError
from mcaprl.files import write_json
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.open import find_logs, open_logs
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.viewer.log_layout import attached_layout
from mcaprl.recorder.viewer.playback import Player, Track
from mcaprl.recorder.viewer.player_server import LiveServer
from mcaprl.recorder.viewer.prefix import prefixes_of, side_by_side
from mcaprl.recorder.viewer.verify import verify
from mcaprl.sims import make_sim


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("--episode", type=click.IntRange(0), help="This one only, counted from 0.")
@click.option(
    "--speed",
    default=1.0,
    show_default=True,
    type=click.FloatRange(0, min_open=True),
    help="Simulated seconds in a second.",
)
@click.option("--loop", is_flag=True, help="Begin again at the end.")
@click.option(
    "--port",
    default=8765,
    show_default=True,
    type=click.IntRange(0, 65535),
    help="Of 127.0.0.1, to listen on; 0 takes any that is free.",
)
@click.option("--verify", "verifies", is_flag=True, help="Step the sim again and compare.")
@click.option("--video", type=click.Path(path_type=Path), help="Film to write: .mp4 or .gif.")
@click.option("--contact-sheet", type=click.Path(path_type=Path), help="Stills to write: .png.")
@click.option("--overwrite", is_flag=True, help="Replace a picture that is there.")
@click.option("--sim", help="Step this sim instead of the one that the log names.")
def replay(
    files: tuple[str, ...],
    episode: int | None,
    speed: float,
    loop: bool,
    port: int,
    verifies: bool,
    sim: str | None,
    video: Path | None,
    contact_sheet: Path | None,
    overwrite: bool,
) -> int:
    """Play FILE... to Foxglove; or check it with --verify; or film an episode with --video.

    Several files play side by side: all start at the same time, each below a word of its own.
    """
    paths = find_logs(files)
    if verifies:
        same = [_verify(path, episode, sim) for path in paths]
        return int(not all(same))
    if video or contact_sheet:
        from mcaprl.cli.video import make_film

        if len(paths) > 1:
            raise UsageError("a film shows one file; give each a film of its own")
        check_episode(open_logs(paths[0], columns=[]), episode, paths[0])
        make_film(
            paths[0],
            episode or 0,
            sim=sim,
            speed=speed,
            video=video,
            sheet=contact_sheet,
            overwrite=overwrite,
        )
        return 0
    _play(paths, episode, speed=speed, loops=loop, port=port)
    return 0


def sim_of(
    dataset: Dataset, path: Path, sim: str | None = None, **others: Any
) -> gym.Env[Any, Any]:
    """Make the environment that a log was recorded in.

    Args:
        dataset: the log.
        path: of it.
        sim: short name or id, where the log's own is not the right one.
        **others: arguments beside the log's.

    Raises:
        UsageError: the log names none, or it cannot be made.
    """
    name = sim or dataset.env_id
    if not name:
        raise UsageError(f"{path} does not tell which environment it is of: pass --sim")
    return make_sim(name, **{**dataset.env_kwargs, **others})


def check_episode(dataset: Dataset, episode: int | None, path: Path) -> None:
    """Make sure that a log has the episode asked for."""
    last = len(dataset.episodes) - 1
    if episode is not None and episode > last:
        raise UsageError(f"--episode {episode}: {path} has episodes 0 to {last}")


def _play(
    paths: Sequence[Path], episode: int | None, *, speed: float, loops: bool, port: int
) -> None:
    """Serve until Ctrl-C."""
    datasets = [open_logs(path, columns=[]) for path in paths]
    windows = []
    for path, dataset in zip(paths, datasets, strict=True):
        check_episode(dataset, episode, path)
        chosen = dataset.episodes if episode is None else dataset.episodes[episode : episode + 1]
        windows.append((int(chosen[0].log_time_ns[0]), int(chosen[-1].log_time_ns[-1])))
    readers = [McapReader(path) for path in paths]
    tracks = [Track(*pair) for pair in zip(readers, windows, strict=True)]
    player = Player(tracks, speed=speed, loops=loops)
    starts = [int(e.log_time_ns[0]) for e in datasets[0].episodes] if episode is None else []
    prefixes = prefixes_of(paths)
    layout = side_by_side([attached_layout(reader) for reader in readers], prefixes)
    server = LiveServer(
        player,
        prefixes=prefixes,
        episode_starts_ns=starts,
        name=", ".join(path.name for path in paths),
        port=port,
    )
    with tempfile.TemporaryDirectory(prefix="mcaprl-") as folder, closing(server):
        layout_path = Path(folder) / "foxglove-layout.json"
        write_json(layout_path, layout)
        click.echo(f"open {server.app_url}")
        click.echo(f"or connect any viewer of the Foxglove protocol to {server.url}")
        click.echo(f"layout to import: {layout_path}")
        click.echo("Ctrl-C ends it")
        try:
            server.run(threading.Event())
        except KeyboardInterrupt:
            click.echo("ended")


def _verify(path: Path, episode: int | None, sim: str | None) -> bool:
    """Compare one file with the sim and tell what was found; whether all is the same."""
    dataset = open_logs(path)
    check_episode(dataset, episode, path)
    with closing(sim_of(dataset, path, sim)) as env, progress("stepping", len(dataset)) as advance:
        found = verify(dataset, env, only=episode, on_frame=lambda _, step: advance(min(step, 1)))
    print_problems(found.problems(str(path)))
    if found.difference is None and found.episodes:
        click.echo(
            f"{path}: {counted(found.episodes, 'episode')} and {counted(found.steps, 'step')}"
            " compared: every observation, reward and end is the same, bit for bit"
        )
    return found.difference is None and found.episodes > 0

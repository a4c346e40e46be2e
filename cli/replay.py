"""`mcaprl replay`: show logged episodes in Foxglove or as a video, or compare them with the sim."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

import mcaprl
from mcaprl.cli.completion import Name, sims
from mcaprl.cli.help import Command
from mcaprl.cli.options import PATH, integer_option, origin_option, trust_option
from mcaprl.cli.progress import hint, working
from mcaprl.cli.show import echo, print_address, print_problems
from mcaprl.errors import UsageError
from mcaprl.texts import counted

if TYPE_CHECKING:
    from mcaprl.api.replay import LiveAddress


@click.command(cls=Command)
@click.argument("files", nargs=-1, required=True, metavar="LOG...", type=PATH)
@click.option("--episode", type=click.IntRange(0), help="Index of a single episode, from 0.")
@click.option(
    "--speed",
    default=1.0,
    show_default=True,
    type=click.FloatRange(0, min_open=True),
    help="Simulated seconds per second.",
)
@click.option("--loop", is_flag=True, help="Restart at the end.")
@integer_option(
    "--port", "Port on 127.0.0.1; 0 for any free port.", least=0, most=65535, default=8765
)
@origin_option
@click.option("--verify", "verifies", is_flag=True, help="Compare each step with the sim.")
@click.option("--video", type=click.Path(path_type=Path), help="Video to write, .mp4 or .gif.")
@click.option("--contact-sheet", type=click.Path(path_type=Path), help="PNG image to write.")
@click.option("--overwrite", is_flag=True, help="Replace an existing video or image.")
@click.option("--sim", type=Name(sims), help="Sim to step instead of the logged one.")
@trust_option
def replay(
    files: tuple[str, ...],
    episode: int | None,
    speed: float,
    loop: bool,
    port: int,
    allow_origin: tuple[str, ...],
    verifies: bool,
    sim: str | None,
    trust_env: bool,
    video: Path | None,
    contact_sheet: Path | None,
    overwrite: bool,
) -> int:
    """Play LOG... in Foxglove, compare it with the sim, or render an episode as a video.

    Several logs play side by side: all start at the same time, each with its own topic prefix.
    """
    if verifies and (video or contact_sheet):
        raise UsageError("--verify writes no video or image: run replay once for each")
    from mcaprl.recorder.dataset.open import find_logs

    if verifies:
        same = [_verify(path, episode, sim, trust_env) for path in find_logs(files)]
        return int(not all(same))
    if video or contact_sheet:
        paths = find_logs(files)
        if len(paths) > 1:
            raise UsageError("a video shows one file: render each file separately")
        with working("reading the log") as bar:
            drawn = mcaprl.render(
                paths[0],
                episode=episode or 0,
                sim=sim,
                trust_env=trust_env,
                speed=speed,
                video=video,
                contact_sheet=contact_sheet,
                overwrite=overwrite,
                progress=bar,
            )
        if video:
            echo(f"{video}: {drawn.frames} images of episode {drawn.episode}")
        if contact_sheet:
            echo(f"{contact_sheet}: {drawn.stills} stills of episode {drawn.episode}")
        return 0
    mcaprl.replay(
        files,
        episode=episode,
        speed=speed,
        loop=loop,
        port=port,
        allow_origin=allow_origin,
        on_open=_print_open,
    )
    echo("ended")
    return 0


def _print_open(address: LiveAddress) -> None:
    print_address(address)
    hint("press Ctrl-C to stop")


def _verify(path: Path, episode: int | None, sim: str | None, trust_env: bool) -> bool:
    """Compare one file with the sim, print the result, and return whether all steps match."""
    with working("reading the log") as bar:
        found = mcaprl.verify(path, episode=episode, sim=sim, trust_env=trust_env, progress=bar)
    print_problems(found.problems(str(path)))
    if found.difference is None and found.episodes:
        echo(
            f"{path}: {counted(found.episodes, 'episode')} and {counted(found.steps, 'step')}"
            " compared: every observation, reward and end is the same, bit for bit"
        )
    return found.difference is None and found.episodes > 0

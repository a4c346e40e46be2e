"""`mcaprl replay`: show logged episodes in a viewer, or compare them with the sim."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import mcaprl
from mcaprl.cli.completion import Name, sims
from mcaprl.cli.help import Command
from mcaprl.cli.options import PATH, env_arg_option, origin_option, trust_option
from mcaprl.cli.progress import hint, working
from mcaprl.cli.show import echo, print_address, print_problems
from mcaprl.errors import UsageError
from mcaprl.texts import counted, size

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
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    help="Port on 127.0.0.1; 0 for any free port.  [default: 8765, with --browser 0]",
)
@origin_option
@click.option("--browser", is_flag=True, help="Show a page in the browser instead of Foxglove.")
@click.option(
    "--save", type=click.Path(path_type=Path), help="Page of one episode to write, .html."
)
@click.option("--verify", "verifies", is_flag=True, help="Compare each step with the sim.")
@click.option(
    "--video", type=click.Path(path_type=Path), help="Video to write, .mp4, .gif or .webp."
)
@click.option("--contact-sheet", type=click.Path(path_type=Path), help="PNG image to write.")
@click.option(
    "--height",
    type=int,
    help="Height of the images of a logged scene in pixels; the width is 16/9 of the height."
    "  [default: 540]",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing page, video or image.")
@click.option("--sim", type=Name(sims), help="Sim to step instead of the logged one.")
@env_arg_option
@trust_option
def replay(
    files: tuple[str, ...],
    episode: int | None,
    speed: float,
    loop: bool,
    port: int | None,
    allow_origin: tuple[str, ...],
    browser: bool,
    save: Path | None,
    verifies: bool,
    sim: str | None,
    sim_options: dict[str, Any] | None,
    trust_env: bool,
    video: Path | None,
    contact_sheet: Path | None,
    height: int | None,
    overwrite: bool,
) -> int:
    """Play LOG... in Foxglove or in the browser, compare it with the sim, or render an episode.

    In Foxglove, several logs play side by side. They start at the same time, and the topics of each
    log have their own prefix.
    """
    draws = video is not None or contact_sheet is not None
    if verifies + browser + (save is not None or draws) > 1:
        raise UsageError(
            "--verify, --browser, and writing a page, video or image exclude each other:"
            " run replay once for each"
        )
    with working("reading the log"):
        from mcaprl.recorder.dataset.open import find_logs

        paths = find_logs(files)
    stepped: dict[str, Any] = {"sim": sim, "trust_env": trust_env, "sim_options": sim_options}
    if verifies:
        same = [_verify(path, episode, stepped) for path in paths]
        return int(not all(same))
    if (browser or save or draws) and len(paths) > 1:
        raise UsageError("a page or video shows one log: run replay once for each log")
    chosen: dict[str, Any] = {"episode": episode or 0, "speed": speed, "overwrite": overwrite}
    if save is not None:
        with working("writing the page"):
            length = mcaprl.save_page(paths[0], save, loop=loop, **chosen)
        echo(f"{save}: episode {chosen['episode']}, {size(length)}")
    if draws:
        _render(paths[0], video, contact_sheet, height=height, **chosen, **stepped)
    if save is not None or draws:
        return 0
    served: dict[str, Any] = {"speed": speed, "loop": loop}
    if port is not None:
        served["port"] = port
    _serve(files if not browser else paths[:1], browser, episode, allow_origin, **served)
    echo("ended")
    return 0


def _serve(
    files: Sequence[str | Path],
    browser: bool,
    episode: int | None,
    allow_origin: tuple[str, ...],
    **options: Any,
) -> None:
    """Serve logs until Ctrl-C, and print the address when the server is ready."""
    with ExitStack() as waiting:
        waiting.enter_context(working("reading the log"))

        def print_ready(address: Any) -> None:
            waiting.close()
            (_print_page if browser else _print_open)(address)

        if browser:
            mcaprl.browse(files[0], episode=episode or 0, on_open=print_ready, **options)
        else:
            options["allow_origin"] = allow_origin
            mcaprl.replay(files, episode=episode, on_open=print_ready, **options)


def _render(path: Path, video: Path | None, sheet: Path | None, **options: Any) -> None:
    """Write a video, a contact sheet, or both, and print what was written."""
    with working("reading the log") as bar:
        drawn = mcaprl.render(path, video=video, contact_sheet=sheet, progress=bar, **options)
    if video is not None:
        echo(f"{video}: {drawn.frames} images of episode {drawn.episode}")
    if sheet is not None:
        echo(f"{sheet}: {drawn.stills} stills of episode {drawn.episode}")


def _print_page(url: str) -> None:
    echo(f"open {url}")
    hint("press Ctrl-C to stop")


def _print_open(address: LiveAddress) -> None:
    print_address(address)
    hint("press Ctrl-C to stop")


def _verify(path: Path, episode: int | None, stepped: dict[str, Any]) -> bool:
    """Compare one file with the sim, print the result, and return whether all steps match."""
    with working("reading the log") as bar:
        found = mcaprl.verify(path, episode=episode, progress=bar, **stepped)
    print_problems(found.problems(str(path)))
    if found.difference is None and found.episodes:
        echo(
            f"{path}: {counted(found.episodes, 'episode')} and {counted(found.steps, 'step')}"
            " compared: every observation, reward and end is the same, bit for bit"
        )
    return found.difference is None and found.episodes > 0

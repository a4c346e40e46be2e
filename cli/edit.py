"""`mcaprl merge`, `split`, `filter` and `slice`: logs made of parts of other logs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import click

import mcaprl
from mcaprl.cli.help import Command
from mcaprl.cli.options import PATH, json_option
from mcaprl.cli.progress import working
from mcaprl.cli.show import echo, print_json
from mcaprl.errors import UsageError
from mcaprl.texts import counted

if TYPE_CHECKING:
    from mcaprl.recorder.edit.piece import Edited

_overwrite_option = click.option("--overwrite", is_flag=True, help="Replace existing output.")


@click.command(cls=Command)
@click.argument("logs", nargs=-1, required=True, metavar="LOG... OUT", type=PATH)
@click.option("--shift", is_flag=True, help="Delay each log that overlaps a previous one in time.")
@_overwrite_option
@json_option
def merge(logs: tuple[str, ...], shift: bool, overwrite: bool, as_json: bool) -> None:
    """Join LOG... into the new log OUT, with all topics, metadata and attachments."""
    if len(logs) < 2:
        raise UsageError("merge needs LOG... and OUT")
    with working("copying"):
        found = mcaprl.merge(logs[:-1], logs[-1], shift=shift, overwrite=overwrite)
    _show([found], as_json)


@click.command(cls=Command)
@click.argument("log", type=PATH)
@click.argument("out", type=PATH)
@click.option("--episodes", type=int, help="Number of episodes of each part.")
@click.option("--ratio", metavar="A:B[:C...]", help="Relative sizes of the parts, such as 8:1:1.")
@click.option("--seed", type=click.IntRange(0), help="Assign episodes at random with this seed.")
@_overwrite_option
@json_option
def split(
    log: str,
    out: str,
    episodes: int | None,
    ratio: str | None,
    seed: int | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Copy the episodes of LOG to several logs in the new folder OUT."""
    shares = None if ratio is None else [_number("ratio", part) for part in ratio.split(":")]
    with working("copying"):
        found = mcaprl.split(
            log, out, episodes=episodes, ratio=shares, seed=seed, overwrite=overwrite
        )
    _show(found, as_json)


@click.command("filter", cls=Command)
@click.argument("expression")
@click.argument("log", type=PATH)
@click.argument("out", type=PATH)
@_overwrite_option
@json_option
def filter_(expression: str, log: str, out: str, overwrite: bool, as_json: bool) -> None:
    """Copy the episodes of LOG for which EXPRESSION is true to the new log OUT.

    EXPRESSION is a condition such as "length > 100 and reason == 'crash'" on: episode, length,
    total_reward, terminated, truncated, reason, policy, epsilon, seed, options, start_s,
    duration_s.
    """
    with working("copying"):
        found = mcaprl.filter(expression, log, out, overwrite=overwrite)
    _show([found], as_json)


@click.command("slice", cls=Command)
@click.argument("log", type=PATH)
@click.argument("out", type=PATH)
@click.option("--steps", metavar="A:B", help="Transitions from A to B; B is not included.")
@click.option("--time", metavar="A:B", help="Seconds since the first message of LOG.")
@_overwrite_option
@json_option
def slice_(
    log: str, out: str, steps: str | None, time: str | None, overwrite: bool, as_json: bool
) -> None:
    """Copy the part of LOG between two steps or times to the new log OUT.

    Episodes that contain A or B are shortened. If A or B is empty, the start or end of LOG is used.
    """
    bounds = {
        "steps": None if steps is None else _bounds("steps", steps),
        "time": None if time is None else _bounds("time", time),
    }
    with working("copying"):
        found = mcaprl.slice(log, out, **bounds, overwrite=overwrite)
    _show([found], as_json)


def _show(results: list[Edited], as_json: bool) -> None:
    if as_json:
        print_json({"logs": [vars(found) | {"out": str(found.out)} for found in results]})
        return
    for found in results:
        episodes, steps = counted(found.episodes, "episode"), counted(found.steps, "step")
        chunks = f"{found.whole_chunks} of {found.whole_chunks + found.rewritten_chunks} chunks"
        messages = counted(found.messages, "message")
        echo(f"{found.out}: {episodes}, {steps}, {messages}; {chunks} copied unchanged")


def _bounds(option: str, text: str) -> tuple[float | None, float | None]:
    """Parse A:B; an empty bound is None."""
    parts = text.split(":")
    if len(parts) != 2:
        raise UsageError(f"--{option} is '{text}', expected A:B, such as 100:200")
    first, last = (None if not part.strip() else _number(option, part) for part in parts)
    return first, last


def _number(option: str, text: str) -> float:
    try:
        number = int(text) if option == "steps" else float(text)
    except ValueError as error:
        raise UsageError(f"--{option} has '{text}', which is not a number") from error
    if not (math.isfinite(number) and number >= 0):
        raise UsageError(f"--{option} has '{text}', expected a number of 0 or more")
    return number

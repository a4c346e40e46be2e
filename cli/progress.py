"""Progress bars and hints, which `--quiet` omits."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Final

import click

from mcaprl.cli.show import echo
from mcaprl.progress import (
    ProgressBar,
    ProgressCallback,
    no_progress,
    terminal_progress,
    terminal_wait,
)

_QUIET: Final = "mcaprl.quiet"


def quiet_option() -> click.Option:
    """Return the option `--quiet`, which every command has."""
    return click.Option(
        ["-q", "--quiet"],
        is_flag=True,
        expose_value=False,
        callback=lambda context, _, value: context.meta.update({_QUIET: value}),
        help="Print results, warnings and errors only: no progress and no hints.",
    )


def hint(text: str) -> None:
    """Print a line that says what the user can do next."""
    if not is_quiet():
        echo(text)


def working(text: str) -> AbstractContextManager[ProgressBar]:
    """Show on a terminal that a command is working, until the command opens a progress bar."""
    return nullcontext(no_progress) if is_quiet() else terminal_wait(text)


def training_progress(unit: str, *terms: str) -> AbstractContextManager[ProgressCallback]:
    """Show progress bars of training; see `mcaprl.progress.terminal_progress`."""
    return nullcontext(lambda _: None) if is_quiet() else terminal_progress(unit, *terms)


@contextmanager
def keeping(text: str) -> Iterator[None]:
    """Context manager that adds what is kept to the message of an interruption."""
    try:
        yield
    except KeyboardInterrupt as error:
        error.add_note(text)
        raise


@contextmanager
def checkpoints_kept(run: Path, resumed: bool) -> Iterator[None]:
    """Context manager that says what `--resume` does, of an interrupted or resumed training."""
    from mcaprl.runs import CHECKPOINT_NAME, CONFIG_NAME

    def has_checkpoint() -> bool:
        return next(run.rglob(CHECKPOINT_NAME), None) is not None

    if resumed and (run / CONFIG_NAME).exists() and not has_checkpoint():
        hint(f"{run} has no checkpoint: the training begins again")
    try:
        yield
    except KeyboardInterrupt as error:
        if has_checkpoint():
            error.add_note("continue with --resume")
        elif (run / CONFIG_NAME).exists():
            error.add_note("there was no checkpoint yet; --resume begins again")
        raise


def is_quiet() -> bool:
    """Return whether the program prints results only."""
    context = click.get_current_context(silent=True)
    return context is not None and context.meta.get(_QUIET, False)

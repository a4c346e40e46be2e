"""Command-line interface; `mcaprl --help` lists the commands.

User errors are printed as one line on stderr; `mcaprl.cli.help` lists the exit codes. Each
command calls the functions of the public API that `mcaprl` lists. Torch and numba are imported only
by the commands that need them.
"""

from __future__ import annotations

import signal
import sys
import threading
import warnings
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any

import click

from mcaprl._interrupt import INTERRUPTED, raise_interrupt, repeat_lost_interrupt
from mcaprl._version import __version__
from mcaprl.cli.completion import completion
from mcaprl.cli.drive import drive
from mcaprl.cli.evaluate import evaluate
from mcaprl.cli.help import EXIT_CODES, Program
from mcaprl.cli.logs import (
    annotate,
    check,
    convert,
    filter_,
    info,
    label,
    layout,
    merge,
    recover,
    relabel,
    slice_,
    split,
)
from mcaprl.cli.record import record
from mcaprl.cli.replay import replay
from mcaprl.cli.show import echo
from mcaprl.cli.train_offline import export, train_offline
from mcaprl.cli.train_online import train_online
from mcaprl.errors import McaprlError

__all__ = ["EXIT_CODES", "cli", "main", "run"]


@click.group(
    cls=Program, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(__version__, prog_name="mcaprl", message="%(prog)s %(version)s")
def cli() -> None:
    """Record reinforcement learning episodes as MCAP logs, learn from logs, and replay them."""


_COMMANDS = (
    record,
    train_online,
    train_offline,
    evaluate,
    drive,
    annotate,
    export,
    replay,
    convert,
    merge,
    split,
    filter_,
    slice_,
    relabel,
    label,
    info,
    check,
    recover,
    layout,
    completion,
)
for _command in _COMMANDS:
    cli.add_command(_command)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the program and exit."""
    # SIGTERM and SIGHUP act like Ctrl-C, so that a recording closes its file. A signal that is
    # ignored, such as SIGHUP under nohup, stays ignored.
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, raise_interrupt)
    sys.unraisablehook = repeat_lost_interrupt
    warnings.showwarning = _print_warning
    threading.excepthook = _on_thread_error
    sys.exit(run(arguments))


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the program and return its exit code; print user errors to stderr."""
    try:
        code = cli.main(arguments, prog_name="mcaprl", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return error.exit_code
    except click.UsageError as error:
        if isinstance(error, click.NoSuchOption):
            # Click names options that are less alike.
            near = get_close_matches(error.option_name, error.possibilities or (), cutoff=0.75)
            error = click.NoSuchOption(error.option_name, possibilities=near, ctx=error.ctx)
        command = error.ctx.command_path if error.ctx else "mcaprl"
        return _fail(f"{error.format_message()} (see {command} --help)", error.exit_code)
    except click.ClickException as error:
        return _fail(error.format_message(), error.exit_code)
    except McaprlError as error:
        return _fail(str(error), error.exit_code)
    except OSError as error:
        return _fail(f"{error.filename or 'output'}: {error.strerror}", 1)
    except (click.Abort, KeyboardInterrupt) as error:
        # Click converts a KeyboardInterrupt or EOFError to an Abort. The notes say what is kept.
        cause = error.__cause__ or error
        if isinstance(cause, EOFError):
            raise cause from None
        notes = getattr(cause, "__notes__", [])
        return _fail("; ".join(["interrupted", *notes]), INTERRUPTED)
    return code if isinstance(code, int) else 0


def _fail(message: str, code: int) -> int:
    line = " ".join(message.split())
    echo(f"mcaprl: {line}", err=True)
    return code


def _print_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning on one line, without its source location."""
    echo(f"mcaprl: warning: {' '.join(str(message).split())}", err=True)


def _on_thread_error(arguments: threading.ExceptHookArgs) -> None:
    """Print an exception raised in a thread, unless it is an OSError."""
    # TensorBoard's writer thread may raise an OSError. TensorBoard raises it again in the training
    # thread, and `run` prints it.
    if not issubclass(arguments.exc_type, OSError):
        threading.__excepthook__(arguments)

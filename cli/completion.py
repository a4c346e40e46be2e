"""`mcaprl completion`, and the names that it completes."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import click
from click.shell_completion import CompletionItem, get_completion_class

from mcaprl.cli.help import Command

SHELLS = ("bash", "zsh", "fish")


class Name(click.ParamType[str]):
    """Text that shells complete; the function of the public API validates it."""

    name = "text"

    def __init__(self, names: Callable[[], Iterable[str]], *, is_path: bool = False) -> None:
        """Create the type."""
        self._names, self._is_path = names, is_path

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return the known names that start with the text, or a request for paths."""
        found = [CompletionItem(name) for name in self._names() if name.startswith(incomplete)]
        return found or ([CompletionItem(incomplete, type="file")] if self._is_path else [])


def sims() -> Iterable[str]:
    """Return the names of the sims."""
    from mcaprl.sims import SIMS

    return SIMS


def policies() -> Iterable[str]:
    """Return the names of the policies that are not files."""
    return ("pilot", "random")


@click.command(cls=Command)
@click.argument("shell", type=click.Choice(SHELLS))
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print the script that completes commands, options and names in SHELL.

    After it is loaded, the Tab key completes commands, options, files, and the names of sims,
    policies and algorithms.
    """
    program = context.find_root().command
    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(program, {}, "mcaprl", "_MCAPRL_COMPLETE").source())

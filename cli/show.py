"""Output of commands on stdout, as JSON or tables."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import click

from mcaprl.files import json_text
from mcaprl.problem import Problem
from mcaprl.texts import printable

if TYPE_CHECKING:
    from rich.table import Table

    from mcaprl.api.replay import LiveAddress

_PIPE_WIDTH = 120


def echo(text: object, *, err: bool = False) -> None:
    """Print a line to stdout or stderr, with control characters escaped."""
    click.echo(printable(text).replace("\n", r"\n"), err=err)


def print_json(value: Any) -> None:
    """Print one JSON object to stdout; NaN and infinities become null."""
    # JSON allows DEL unescaped, but terminals treat it as a control character.
    click.echo(json_text(value).replace("\x7f", r"\u007f"))


def print_problems(problems: Iterable[Problem]) -> None:
    """Print one line for each problem to stdout."""
    for problem in problems:
        echo(problem)


def print_address(address: LiveAddress) -> None:
    """Print the addresses for viewers, and the path of the layout to import."""
    echo(f"open {address.app_url}")
    echo(f"or connect any viewer of the Foxglove protocol to {address.url}")
    echo(f"layout to import: {address.layout}")


def print_table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """Print a table to stdout: the first column left-aligned, the others right-aligned."""
    from rich.table import Table

    table = Table()
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right", overflow="fold")
    _print(table, title, rows)


def print_facts(title: str, facts: list[tuple[str, str]]) -> None:
    """Print names and values to stdout, one pair per line."""
    from rich.table import Table

    table = Table(show_header=False)
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    _print(table, title, facts)


def _print(table: Table, title: str, rows: Iterable[Iterable[str]]) -> None:
    from rich.console import Console
    from rich.text import Text

    table.title, table.title_style, table.title_justify = Text(printable(title)), "bold", "left"
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    # A file or a pipe has no width, and rich's default of 80 would break lines.
    is_terminal = sys.stdout is not None and sys.stdout.isatty()
    Console(width=None if is_terminal else _PIPE_WIDTH).print(table)

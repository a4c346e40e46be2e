"""Output of commands on stdout: JSON for programs, tables for people."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mcaprl.files import json_text
from mcaprl.problem import Problem

if TYPE_CHECKING:
    from mcaprl.api.replay import LiveAddress

_PIPE_WIDTH = 120


def print_json(value: Any) -> None:
    """Print one JSON object to stdout; NaN and infinities become null."""
    click.echo(json_text(value))


def print_problems(problems: Iterable[Problem]) -> None:
    """Print one line for each problem to stdout."""
    for problem in problems:
        click.echo(problem)


def print_address(address: LiveAddress) -> None:
    """Print where a viewer connects, and the layout that it imports."""
    click.echo(f"open {address.app_url}")
    click.echo(f"or connect any viewer of the Foxglove protocol to {address.url}")
    click.echo(f"layout to import: {address.layout}")


def print_table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """Print a table to stdout: the first column left-aligned, the others right-aligned."""
    table = Table(title=Text(title), title_justify="left", title_style="bold")
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    _print(table)


def print_facts(title: str, facts: list[tuple[str, str]]) -> None:
    """Print names and values to stdout, one pair per line."""
    table = Table(title=Text(title), title_justify="left", title_style="bold", show_header=False)
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for fact in facts:
        table.add_row(*map(Text, fact))
    _print(table)


def _print(table: Table) -> None:
    # A file or a pipe has no width, and rich's default of 80 would break lines.
    is_terminal = sys.stdout is not None and sys.stdout.isatty()
    Console(width=None if is_terminal else _PIPE_WIDTH).print(table)

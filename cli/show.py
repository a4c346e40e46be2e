"""What commands print: JSON on stdout, tables for people, progress on a terminal's stderr."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from mcaprl.files import json_text
from mcaprl.problem import Problem

_PIPE_WIDTH = 120


def counted(number: int, noun: str) -> str:
    """As `1 episode`, `2 episodes`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def print_json(value: Any) -> None:
    """Print one JSON object to stdout; NaN and infinities become null."""
    click.echo(json_text(value))


def print_problems(problems: Iterable[Problem]) -> None:
    """Print one line for each problem to stdout."""
    for problem in problems:
        click.echo(problem)


def print_table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """A table on stdout: the first column to the left, numbers to the right."""
    table = Table(title=Text(title), title_justify="left", title_style="bold")
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    _print(table)


def print_facts(title: str, facts: list[tuple[str, str]]) -> None:
    """Names and what they stand for, one a line, on stdout."""
    table = Table(title=Text(title), title_justify="left", title_style="bold", show_header=False)
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for fact in facts:
        table.add_row(*map(Text, fact))
    _print(table)


@contextmanager
def progress(description: str, total: int | None) -> Iterator[Any]:
    """A progress bar on stderr if that is a terminal; yields a function that advances it."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda amount=1: None
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(description, total=total)
        yield lambda amount=1: bar.advance(task, amount)


def size(count: float) -> str:
    """Bytes for people.

    >>> size(1536)
    '1.5 kB'
    """
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1024 or unit == "GB":
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    raise AssertionError("unreachable")


def _print(table: Table) -> None:
    # A file or a pipe has no width of its own; the usual guess of 80 breaks lines for nothing.
    is_terminal = sys.stdout is not None and sys.stdout.isatty()
    Console(width=None if is_terminal else _PIPE_WIDTH).print(table)

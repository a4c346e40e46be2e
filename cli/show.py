"""Output of commands on stdout, as JSON or tables."""

from __future__ import annotations

import ast
import json
import re
import shlex
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, TextIO

import click

from mcaprl.errors import Problem
from mcaprl.files import json_text
from mcaprl.settings import flag
from mcaprl.texts import counted, printable, shortened

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from mcaprl.api.replay import LiveAddress

_PIPE_WIDTH = 120
_MAX_ROWS = 40  # Number of rows of a wide table that are printed
_ARGUMENT = re.compile(r"""`([a-z]\w*)=('[^']*'|"[^"]*"|[^`]*)`""")
_OPTIONS = {
    "sim_options": "--env-arg",
    "sources": "--from",
    "duration_s": "--duration",
    "deadline_s": "--deadline",
}
"""Options whose names differ from those of the arguments."""


def echo(text: object, *, err: bool = False) -> None:
    """Print a line with control characters escaped, wrapped in a terminal; see `as_options`."""
    line = printable(as_options(str(text))).replace("\n", r"\n")
    if _is_terminal(sys.stderr if err else sys.stdout):
        line = "\n".join(_wrapped(line, shutil.get_terminal_size().columns)) or line
    click.echo(line, err=err)


def as_options(message: str) -> str:
    """Return a message in which arguments of Python functions are options of commands.

    >>> as_options("pass `append=True`, `to='npz'`, `max_steps=N` or `keys=['a', 'b']`, not `to=`")
    'pass --append, --to npz, --max-steps N or --keys a,b, not --to'
    >>> as_options("pass `sim_options={'observation': 'depth', 'continuous': False}`")
    'pass --observation depth --env-arg continuous=false'
    """
    return _ARGUMENT.sub(lambda found: _option(*found.groups()), message)


def _option(name: str, value: str) -> str:
    option = _OPTIONS.get(name, flag(name))
    try:
        parsed = ast.literal_eval(value)
    except (ValueError, SyntaxError):
        parsed = value
    if parsed is True or not value:
        return option
    if isinstance(parsed, dict):
        return " ".join(_env_option(key, each) for key, each in parsed.items())
    if isinstance(parsed, list):
        return f"{option} {','.join(map(str, parsed))}"
    return f"{option} {parsed if isinstance(parsed, str) else value}"


def _env_option(name: str, value: object) -> str:
    if name in ("observation", "rules", "actions") and isinstance(value, str):
        return f"--{name} {shlex.quote(value)}"
    return f"--env-arg {shlex.quote(f'{name}={json.dumps(value)}')}"


def _wrapped(line: str, width: int) -> list[str]:
    """Wrap a text without breaking words, and indent all lines but the first."""
    return textwrap.wrap(
        line, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )


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

    console = _console()
    cells = list(zip(columns, *rows, strict=True))
    table = Table()
    widths = _widths(cells, console.width - 3 * len(columns) - 1)
    for index, (column, width) in enumerate(zip(columns, widths, strict=True)):
        justify: Literal["left", "right"] = "left" if index == 0 else "right"
        table.add_column(column, justify=justify, overflow="fold", width=width)
    _print(console, table, title, rows)


def print_wide(
    title: str, columns: list[str], rows: list[list[str]], *, last: int = 0, width: int = 100
) -> None:
    """Print a table that may have many columns and rows; print nothing without rows."""
    # The first column and the `last` ones are always shown, others as far as they fit into `width`
    # or the terminal; the names of the rest follow.
    if not rows:
        return
    space = min(width, _console().width) - 1
    cells = [max(map(len, map(printable, each))) + 3 for each in zip(columns, *rows, strict=True)]
    kept = [0, *range(max(1, len(columns) - last), len(columns))]
    middle, used = list[int](), sum(cells[k] for k in kept)
    for k in range(1, len(columns) - last):
        used += cells[k]
        if used > space:
            break
        middle.append(k)
    shown = sorted({*kept, *middle})
    picked = [[row[k] for k in shown] for row in rows[:_MAX_ROWS]]
    print_table(title, [columns[k] for k in shown], picked)
    rest = [name for k, name in enumerate(columns) if k not in shown]
    if rest:
        echo(shortened(f"{counted(len(rest), 'more column')}: {', '.join(rest)}", width))
    if len(rows) > _MAX_ROWS:
        echo(f"{len(rows) - _MAX_ROWS} more rows")


def _widths(columns: Iterable[Sequence[str]], available: int) -> Sequence[int | None]:
    """Return the width of each column of texts, so that no word breaks; None if that fails."""
    # Space beyond the longest words goes first to the columns that need the least of it.
    from rich.cells import cell_len

    texts = [[printable(text) for text in column] for column in columns]
    widths = [max(cell_len(word) for text in one for word in text.split() or [""]) for one in texts]
    needs = [max(map(cell_len, one)) - width for one, width in zip(texts, widths, strict=True)]
    free = available - sum(widths)
    if free < 0:
        return [None] * len(widths)
    for need, index in sorted((need, index) for index, need in enumerate(needs)):
        widths[index] += min(need, free)
        free -= min(need, free)
    return widths


def print_facts(title: str, facts: list[tuple[str, str]], *, width: int = _PIPE_WIDTH) -> None:
    """Print names and values to stdout, one pair per line, in at most `width` characters."""
    from rich.table import Table

    table = Table(show_header=False)
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    console = _console()
    console.width = min(console.width, width) if not _is_terminal(sys.stdout) else console.width
    _print(console, table, title, facts)


def _print(console: Console, table: Table, title: str, rows: Iterable[Iterable[str]]) -> None:
    from rich.text import Text

    table.title, table.title_style, table.title_justify = Text(printable(title)), "bold", "left"
    for row in rows:
        table.add_row(*(Text(printable(as_options(cell))) for cell in row))
    console.print(table)


def _console() -> Console:
    from rich.console import Console

    # A file or a pipe has no width, and rich's default of 80 would break lines.
    return Console(width=None if _is_terminal(sys.stdout) else _PIPE_WIDTH)


def _is_terminal(stream: TextIO | None) -> bool:
    """Return whether the stream is a terminal. Programs without a console have no streams."""
    return stream is not None and stream.isatty()

"""Progress of long operations, reported to the caller or shown in a terminal."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Final

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from mcaprl.texts import printable

Advance = Callable[[int], None]
"""Function called with the amount of completed work."""
ProgressBar = Callable[[str, int | None], AbstractContextManager[Advance]]
"""Function that is called with a text and a total, and returns a context manager. The context
manager shows a progress bar, and yields an `Advance`."""
FIRST_LINE_S: Final = 5.0
"""Time until the first line of progress if stderr is not a terminal."""
LINE_INTERVAL_S: Final = 30.0
"""Time between two lines of progress if stderr is not a terminal."""


@contextmanager
def no_progress(description: str, total: int | None) -> Iterator[Advance]:
    """Show nothing."""
    yield lambda amount: None


@contextmanager
def terminal_bar(description: str, total: int | None) -> Iterator[Advance]:
    """Show a progress bar if stderr is a terminal; otherwise, print a line at long intervals."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _ProgressLines(printable(description), total).advance
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(printable(description), total=total)
        yield lambda amount: bar.advance(task, amount)


class _ProgressLines:
    """Progress that is printed to stderr line by line; short operations print nothing."""

    def __init__(self, description: str, total: int | None) -> None:
        self._description, self._total = description, total
        self._began = time.monotonic()
        self._next_s, self._done = FIRST_LINE_S, 0

    def advance(self, amount: int) -> None:
        self._done += amount
        elapsed_s = time.monotonic() - self._began
        if elapsed_s < self._next_s:
            return
        self._next_s = elapsed_s + LINE_INTERVAL_S
        text = f"{self._description}: {self._done}"
        if self._total is not None:
            left_s = elapsed_s * (self._total / max(self._done, 1) - 1)
            text += f" of {self._total}, about {max(left_s, 0):.0f} s left"
        print(text, file=sys.stderr, flush=True)


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of one seed, reported after its files are written.

    Attributes:
        seed: Seed of the run.
        done: Number of completed updates or steps.
        total: Total number of updates or steps.
        terms: Measured values, such as the loss.
    """

    seed: int
    done: int
    total: int
    terms: Mapping[str, float]


ProgressCallback = Callable[[TrainingProgress], None]
"""Function called repeatedly during training; an exception stops the training."""


@contextmanager
def terminal_progress(unit: str, term: str) -> Iterator[ProgressCallback]:
    """Show a progress bar for each seed on a terminal: rate, one term and remaining time.

    Args:
        unit: Unit of the total, such as `updates`.
        term: Name of the term that is shown, such as `loss`.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _: None
        return
    columns = (
        TextColumn("seed {task.fields[seed]}"),
        BarColumn(),
        TextColumn(f"{{task.completed}}/{{task.total}} {unit}, {{task.fields[rate]:.0f}}/s"),
        TextColumn(f"{term} {{task.fields[shown]:.4g}}"),
        TimeRemainingColumn(),
    )
    # Bar of each seed, and the time and progress at the seed's first report.
    started: dict[int, tuple[TaskID, float, int]] = {}
    with Progress(*columns, console=console) as bars:

        def show(now: TrainingProgress) -> None:
            if now.seed not in started:
                bar = bars.add_task("", total=now.total, seed=now.seed, rate=0.0, shown=math.nan)
                started[now.seed] = bar, time.perf_counter(), now.done
            bar, began, first = started[now.seed]
            rate = (now.done - first) / max(time.perf_counter() - began, 1e-9)
            shown = now.terms.get(term, math.nan)
            bars.update(bar, completed=now.done, rate=rate, shown=shown)

        yield show

"""Progress of long operations, reported to the caller or shown in a terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

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
"""Function of a description and a total that opens a progress bar and yields an `Advance`."""


@contextmanager
def no_progress(description: str, total: int | None) -> Iterator[Advance]:
    """Show nothing."""
    yield lambda amount: None


@contextmanager
def terminal_bar(description: str, total: int | None) -> Iterator[Advance]:
    """Show a progress bar if stderr is a terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda amount: None
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
    """Show a progress bar per seed with rate, one term and remaining time on a terminal.

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
    with Progress(*columns, console=console) as bars:
        yield _SeedBars(bars, term).show


class _SeedBars:
    """Progress bars, one per seed, created at the first report of the seed."""

    def __init__(self, bars: Progress, term: str) -> None:
        self._bars = bars
        self._term = term
        self._tasks: dict[int, TaskID] = {}
        self._started: dict[int, tuple[float, int]] = {}

    def show(self, now: TrainingProgress) -> None:
        if now.seed not in self._tasks:
            self._tasks[now.seed] = self._bars.add_task(
                "", total=now.total, seed=now.seed, rate=0.0, shown=math.nan
            )
            self._started[now.seed] = (time.perf_counter(), now.done)
        began, first = self._started[now.seed]
        elapsed_s = max(time.perf_counter() - began, 1e-9)
        self._bars.update(
            self._tasks[now.seed],
            completed=now.done,
            rate=(now.done - first) / elapsed_s,
            shown=now.terms.get(self._term, math.nan),
        )

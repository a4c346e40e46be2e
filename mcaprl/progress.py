"""Progress of training: values for a callback, and progress bars in a terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


@dataclass(frozen=True)
class TrainingProgress:
    """State of a run, reported after all files of that state are written.

    Attributes:
        seed: Seed of the run.
        done: Number of updates or steps so far.
        total: Number of updates or steps of the whole run.
        terms: Measured values by name, such as the loss.
    """

    seed: int
    done: int
    total: int
    terms: Mapping[str, float]


ProgressCallback = Callable[[TrainingProgress], None]
"""Callback that is called from time to time; an exception that it raises stops the training."""


@contextmanager
def terminal_progress(unit: str, term: str) -> Iterator[ProgressCallback]:
    """Show a bar for each seed with speed, one term and time left, if stderr is a terminal.

    Args:
        unit: Unit of `done` and `total`, such as `updates`.
        term: Name of the term to show, such as `loss`.
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
    """Progress bars; a bar is added when a seed first reports."""

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

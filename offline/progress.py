"""How far training has come: told to a callback, shown in a terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


@dataclass(frozen=True)
class TrainingProgress:
    """One sign of life, after the metrics and the checkpoint of that update are written.

    Attributes:
        seed: which run.
        update: updates done.
        updates: updates in all.
        terms: the loss terms of this update.
    """

    seed: int
    update: int
    updates: int
    terms: Mapping[str, float]


ProgressCallback = Callable[[TrainingProgress], None]
"""Called with each row of metrics; what it raises stops the training."""


@contextmanager
def terminal_progress() -> Iterator[ProgressCallback]:
    """A bar per seed with speed, loss and time left; silent where stderr is no terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _: None
        return
    columns = (
        TextColumn("seed {task.fields[seed]}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total} updates, {task.fields[rate]:.0f}/s"),
        TextColumn("loss {task.fields[loss]:.4g}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bars:
        yield _SeedBars(bars).show


class _SeedBars:
    """Adds a bar when a seed is first heard of."""

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self._tasks: dict[int, TaskID] = {}
        self._started: dict[int, tuple[float, int]] = {}

    def show(self, now: TrainingProgress) -> None:
        if now.seed not in self._tasks:
            self._tasks[now.seed] = self._bars.add_task(
                "", total=now.updates, seed=now.seed, rate=0.0, loss=0.0
            )
            self._started[now.seed] = (time.perf_counter(), now.update)
        began, first_update = self._started[now.seed]
        elapsed_s = max(time.perf_counter() - began, 1e-9)
        self._bars.update(
            self._tasks[now.seed],
            completed=now.update,
            rate=(now.update - first_update) / elapsed_s,
            loss=now.terms["loss"],
        )

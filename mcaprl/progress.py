"""Progress of long operations, reported to the caller or shown in a terminal."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mcaprl.texts import printable

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, TaskID

Advance = Callable[[int], None]
"""Function called with the amount of completed work."""
ProgressBar = Callable[[str, int | None], AbstractContextManager[Advance]]
"""Function that accepts a text and a total, and returns a context manager. The context manager
shows a progress bar, and yields an `Advance`."""
FIRST_LINE_S: Final = 5.0
"""Time until the first line of progress if stderr is not a terminal."""
LINE_INTERVAL_S: Final = 10.0
"""Shortest time between two lines of progress if stderr is not a terminal."""
LINE_INTERVAL_SHARE: Final = 0.1
"""Shortest time between two such lines as a share of the elapsed time."""
LEAST_SHARE: Final = 0.02
"""Share of the work from which on the remaining time is estimated before `FIRST_LINE_S`."""


@contextmanager
def no_progress(description: str, total: int | None) -> Iterator[Advance]:
    """Show nothing."""
    yield lambda amount: None


@contextmanager
def terminal_bar(description: str, total: int | None) -> Iterator[Advance]:
    """Show a progress bar if stderr is a terminal; otherwise, print a line at long intervals."""
    if not _stderr_is_terminal():
        yield _ProgressLines(printable(description), total).advance
        return
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    text = TextColumn("{task.description}", markup=False)
    with _bars(
        text, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), transient=True
    ) as bar:
        task = bar.add_task(printable(description), total=total)
        yield lambda amount: bar.advance(task, amount)


@contextmanager
def terminal_wait(description: str) -> Iterator[ProgressBar]:
    """Show that a command is working: a bar without a total, and the elapsed time.

    Yields:
        Function that hides this bar and opens another one, as `terminal_bar` does.
    """
    if not _stderr_is_terminal():
        yield terminal_bar
        return
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    text = TextColumn("{task.description}", markup=False)
    bar = _bars(text, BarColumn(), TimeElapsedColumn(), transient=True)
    with ExitStack() as shown:
        shown.enter_context(bar).add_task(printable(description), total=None)

        def opened(description: str, total: int | None) -> AbstractContextManager[Advance]:
            shown.close()
            return terminal_bar(description, total)

        yield opened


def _stderr_is_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


def _bars(*columns: ProgressColumn, transient: bool = False) -> Progress:
    """Return progress bars on stderr."""
    from rich.console import Console
    from rich.progress import Progress

    # While bars are shown, rich redirects stdout to stderr, above the bars. Do this only if stdout
    # is a terminal.
    redirects = sys.stdout is not None and sys.stdout.isatty()
    console = Console(stderr=True)
    return Progress(*columns, console=console, transient=transient, redirect_stdout=redirects)


class _ProgressLines:
    """Progress that is printed to stderr line by line; short operations print nothing."""

    def __init__(self, description: str, total: int | None) -> None:
        self._description, self._total = description, total
        self._lines, self._done = _LineTimes(), 0
        # Time and progress after the first unit, which may include a compilation.
        self._first: tuple[float, int] | None = None

    def advance(self, amount: int) -> None:
        self._done += amount
        if self._first is None:
            self._first = (time.monotonic(), self._done)
        if not self._lines.is_due():
            return
        text = f"{self._description}: {self._done}"
        if self._total is not None:
            text += f" of {self._total}{_text_of_time_left(*self._first, self._done, self._total)}"
        print(text, file=sys.stderr, flush=True)


class _LineTimes:
    """Moments at which lines of progress are printed: often at first, less often later."""

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._next_s = FIRST_LINE_S
        self.elapsed_s = 0.0

    def is_due(self) -> bool:
        """Return whether to print a line now."""
        self.elapsed_s = time.monotonic() - self._began
        if self.elapsed_s < self._next_s:
            return False
        self._next_s = self.elapsed_s + max(LINE_INTERVAL_S, LINE_INTERVAL_SHARE * self.elapsed_s)
        return True


def _text_of_time_left(began_s: float, first: int, done: int, total: int) -> str:
    """Return the time left at the speed since the first report; empty if it is too early for it."""
    elapsed_s = time.monotonic() - began_s
    measured = done - first
    if measured <= 0 or (elapsed_s < FIRST_LINE_S and measured < LEAST_SHARE * total):
        return ""
    return f", about {max(elapsed_s * (total - done) / measured, 0.0):.0f} s left"


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
def terminal_progress(unit: str, *terms: str) -> Iterator[ProgressCallback]:
    """Show a progress bar for each seed on a terminal: rate, one term and remaining time.

    If stderr is not a terminal, print a line about one seed at long intervals.
    """
    if not _stderr_is_terminal():
        yield _training_lines(unit, terms)
        return
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

    bars = _bars(
        TextColumn("seed {task.fields[seed]}"),
        BarColumn(),
        TextColumn(f"{{task.completed}}/{{task.total}} {unit}, {{task.fields[rate]:.0f}}/s"),
        TextColumn("{task.fields[shown]}"),
        TimeRemainingColumn(),
    )
    # For each seed: its bar, and the time and the progress at its first report.
    started: dict[int, tuple[TaskID, float, int]] = {}
    with ExitStack() as shown, ExitStack() as waiting:
        waiting.enter_context(terminal_wait("preparing"))

        def show(now: TrainingProgress) -> None:
            if not started:
                waiting.close()
                shown.enter_context(bars)
            if now.seed not in started:
                bar = bars.add_task("", total=now.total, seed=now.seed, rate=0.0, shown="")
                started[now.seed] = bar, time.perf_counter(), now.done
            bar, began, first = started[now.seed]
            rate = (now.done - first) / max(time.perf_counter() - began, 1e-9)
            bars.update(bar, completed=now.done, rate=rate, shown=_shown_term(now, terms))

        yield show


def _training_lines(unit: str, terms: Sequence[str]) -> ProgressCallback:
    """Return a callback that prints lines to stderr."""
    lines = _LineTimes()
    # Time and progress at the first report of each seed.
    started: dict[int, tuple[float, int]] = {}

    def show(now: TrainingProgress) -> None:
        began, first = started.setdefault(now.seed, (time.monotonic(), now.done))
        if not lines.is_due():
            return
        text = f"seed {now.seed}: {now.done} of {now.total} {unit}"
        if shown := _shown_term(now, terms):
            text += f", {shown}"
        text += _text_of_time_left(began, first, now.done, now.total)
        print(text, file=sys.stderr, flush=True)

    return show


def _shown_term(now: TrainingProgress, terms: Sequence[str]) -> str:
    """Return the first of the terms that has a value, as text; empty if none has."""
    for term in terms:
        if not math.isnan(value := now.terms.get(term, math.nan)):
            return f"{term.replace('_', ' ')} {value:.4g}"
    return ""

"""Progress of long operations, reported to the caller or shown in a terminal."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mcaprl.texts import printable

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, TaskID

Advance = Callable[[int], None]  # Function called with the amount of completed work
ProgressBar = Callable[[str, int | None], AbstractContextManager[Advance]]
"""Function that accepts a text and a total, and returns a context manager. The context manager
shows a progress bar, and yields an `Advance`."""
FIRST_LINE_S: Final = 5.0  # Time until the first line of progress if stderr is not a terminal
LINE_INTERVAL_S: Final = 10.0  # Time between two such lines
LEAST_SHARE: Final = 0.02
"""Share of the work from which on the remaining time is estimated before `FIRST_LINE_S`."""


@contextmanager
def no_progress(description: str, total: int | None) -> Iterator[Advance]:
    """Show nothing."""
    yield lambda amount: None


@contextmanager
def terminal_bar(description: str, total: int | None) -> Iterator[Advance]:
    """Show a progress bar if stderr is a terminal; otherwise, print a line every 10 s."""
    if not _stderr_is_terminal():
        work = Work(printable(description), total)
        with printed_lines(work.line):
            yield work.advance
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
    """Show that a command works: a bar without a total, and the time; yield what opens another."""
    # That one is as of `terminal_bar`, and hides this one until it ends.
    if not _stderr_is_terminal():
        with printed_lines(Work(printable(description), None).line):
            yield terminal_bar
        return
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    text = TextColumn("{task.description}", markup=False)
    with ExitStack() as shown:

        def wait() -> None:
            bar = _bars(text, BarColumn(), TimeElapsedColumn(), transient=True)
            shown.enter_context(bar).add_task(printable(description), total=None)

        @contextmanager
        def opened(description: str, total: int | None) -> Iterator[Advance]:
            shown.close()
            with terminal_bar(description, total) as advance:
                yield advance
            wait()

        wait()
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


class Work:
    """A long operation of `total` work (None: unknown), and the line that says how far it is."""

    def __init__(self, description: str, total: int | None) -> None:
        """Begin the operation."""
        self._description, self._total = description, total
        self._began_s, self._done = time.monotonic(), 0
        # Time and progress after the first unit, which may include a compilation.
        self._first: tuple[float, int] | None = None

    def advance(self, amount: int) -> None:
        """Add an amount of completed work."""
        self._done += amount
        if self._first is None:
            self._first = (time.monotonic(), self._done)

    def line(self) -> str:
        """Return the amount of completed work, or the elapsed time before the first unit."""
        if self._first is None:
            return f"{self._description}: {time.monotonic() - self._began_s:.0f} s"
        text = f"{self._description}: {self._done}"
        if self._total is not None:
            text += f" of {self._total}{_text_of_time_left(*self._first, self._done, self._total)}"
        return text


# Functions that return the lines of nested operations; the innermost one is shown.
_shown: list[Callable[[], str]] = []


@contextmanager
def printed_lines(line: Callable[[], str]) -> Iterator[None]:
    """Print what a function returns to stderr after 5 s and then every 10 s, by a thread."""
    # A unit of work, such as a compilation, may take minutes.
    ended = threading.Event()
    thread = threading.Thread(target=_print_lines, args=(ended,), daemon=True)
    is_outermost = not _shown
    _shown.append(line)
    if is_outermost:
        thread.start()
    try:
        yield
    finally:
        _shown.remove(line)
        ended.set()
        if is_outermost:
            thread.join()


def _print_lines(ended: threading.Event) -> None:
    pause_s = FIRST_LINE_S
    while not ended.wait(pause_s) and sys.stderr is not None:
        pause_s = LINE_INTERVAL_S
        for line in _shown[-1:]:
            _print(line())


def _print(line: str) -> None:
    # Nobody may read stderr.
    with suppress(OSError, ValueError):
        print(line, file=sys.stderr, flush=True)


def _text_of_time_left(began_s: float, first: int, done: int, total: int) -> str:
    """Return the time left at the speed since the first report; empty if it is too early for it."""
    elapsed_s = time.monotonic() - began_s
    measured = done - first
    if measured <= 0 or (elapsed_s < FIRST_LINE_S and measured < LEAST_SHARE * total):
        return ""
    return f", about {max(elapsed_s * (total - done) / measured, 0.0):.0f} s left"


class Pause(Exception):
    """Exception that a `ProgressCallback` raises to stop a training after a checkpoint."""


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of one seed, reported after its files are written.

    Attributes:
        seed: Seed of the run.
        done: Number of completed updates or steps.
        total: Total number of updates or steps.
        terms: Measured values, such as the loss; empty where a resumed training continues.
        activity: What is done while the training waits, such as `evaluating on 20 episodes`.
    """

    seed: int
    done: int
    total: int
    terms: Mapping[str, float]
    activity: str = ""


ProgressCallback = Callable[[TrainingProgress], None]
"""Function called repeatedly during training; an exception stops the training."""


@contextmanager
def terminal_progress(unit: str, *terms: str) -> Iterator[ProgressCallback]:
    """Show a progress bar for each seed on a terminal: rate, one term and remaining time."""
    # If stderr is not a terminal, print a line about the trained seeds every 10 s.
    if not _stderr_is_terminal():
        training = Training(unit, terms)
        with printed_lines(training.line):
            yield training.report
        return
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

    bars = _bars(
        TextColumn("seed {task.fields[seed]}"),
        BarColumn(),
        TextColumn(f"{{task.completed}}/{{task.total}} {unit}, {{task.fields[rate]:.0f}}/s"),
        TextColumn("{task.fields[shown]}"),
        TimeRemainingColumn(),
    )
    # For each seed: its bar, and the time and the progress at its first report of training.
    started: dict[int, TaskID] = {}
    first: dict[int, tuple[float, int]] = {}
    with ExitStack() as shown, ExitStack() as waiting:
        waiting.enter_context(terminal_wait("preparing"))

        def show(now: TrainingProgress) -> None:
            if not started:
                waiting.close()
                shown.enter_context(bars)
            if now.seed not in started:
                started[now.seed] = bars.add_task(
                    "", total=now.total, seed=now.seed, rate=0.0, shown=""
                )
            bar = started[now.seed]
            if resumed := _text_of_resumed(now, unit):
                bars.console.print(resumed, markup=False, highlight=False)
            bars.update(bar, completed=now.done, shown=now.activity or _shown_term(now, terms))
            if not now.activity:
                began, done = first.setdefault(now.seed, (time.perf_counter(), now.done))
                rate = (now.done - done) / max(time.perf_counter() - began, 1e-9)
                bars.update(bar, rate=rate)

        yield show


class Training:
    """The training of seeds in `unit`, and the line with progress and the first known term."""

    def __init__(self, unit: str, terms: Sequence[str]) -> None:
        """Begin the training."""
        self._unit, self._terms = unit, terms
        # What is done instead of training.
        self._activity: Work | None = Work("preparing", None)
        # Last report of each seed, and time and progress at its first one.
        self._last: dict[int, TrainingProgress] = {}
        self._first: dict[int, tuple[float, int]] = {}

    def report(self, now: TrainingProgress) -> None:
        """Accept the progress of a seed; print where it is resumed."""
        if resumed := _text_of_resumed(now, self._unit):
            _print(resumed)
        self._activity = Work(now.activity, None) if now.activity else None
        if now.activity:
            return
        self._first.setdefault(now.seed, (time.monotonic(), now.done))
        self._last[now.seed] = now

    def line(self) -> str:
        """Return the progress of the seeds that are trained in parallel with the last reported."""
        if self._activity is not None:
            return self._activity.line()
        last = list(self._last.values())
        now = next((each for each in last if each.done < each.total), last[-1])
        seeds = [str(each.seed) for each in last if each.done == now.done]
        text = f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {', '.join(seeds)}"
        text += f": {now.done} of {now.total} {self._unit}"
        if shown := _shown_term(now, self._terms):
            text += f", {shown}"
        return text + _text_of_time_left(*self._first[now.seed], now.done, now.total)


def _text_of_resumed(now: TrainingProgress, unit: str) -> str:
    if now.terms or now.activity:
        return ""
    return f"seed {now.seed}: resumed at {now.done} of {now.total} {unit}"


def _shown_term(now: TrainingProgress, terms: Sequence[str]) -> str:
    """Return the first of the terms that has a value, as text; empty if none has."""
    for term in terms:
        if not math.isnan(value := now.terms.get(term, math.nan)):
            return f"{term.replace('_', ' ')} {value:.4g}"
    return ""

"""Time the sides of a comparison in turns within one process.

The machine may do other work, so the measure is CPU time, and the best of several turns counts. The
sides take turns, so that a slow minute affects all of them. The results are ratios, because seconds
depend much more on the machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

OURS = "mcaprl"
# Libraries that handle one message at a time are timed on these fractions of a task. A turn then
# takes tenths of a second, so that each library has many turns and a disturbance affects only one.
SLOW_SHARE = 0.1
SLOWEST_SHARE = 0.01


@dataclass(frozen=True)
class Side:
    """One way to do a task.

    Attributes:
        name: Name of the library, and of the part that is used.
        run: Function that does the task once.
        share: Fraction of the task that `run` does. The measured time is divided by it. The
            fraction is below 1 for sides that would take minutes.
        floor: Name of a side whose time is subtracted, such as an environment without recorder.
    """

    name: str
    run: Callable[[], object]
    share: float = 1.0
    floor: str = ""


@dataclass
class Table:
    """A task, and the time of each side.

    Attributes:
        title: Name of the task.
        ratios: CPU time by side, relative to ours.
        missing: Sides that could not be measured, with the reason.
        goal: Goal in words.
        unit: Unit of the ratios.
    """

    title: str
    ratios: dict[str, float] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    goal: str = ""
    unit: str = "CPU time, ours = 1"

    def to_json(self) -> dict[str, Any]:
        """Return the attributes as a dict of JSON types."""
        return asdict(self)

    def to_markdown(self) -> str:
        """Return the title, goal and table as Markdown."""
        lines = [f"## {self.title}", "", *([f"Goal: {self.goal}.", ""] if self.goal else [])]
        lines += [f"| side | {self.unit} |", "|---|---|"]
        lines += [f"| {name} | {ratio:.3g} |" for name, ratio in self.ratios.items()]
        lines += [f"| {name} | not measured: {why} |" for name, why in self.missing.items()]
        return "\n".join([*lines, ""])


def compare(
    title: str,
    sides: Sequence[Side],
    *,
    goal: str = "",
    rounds: int = 5,
    ours: str = OURS,
    clock: Callable[[], float] = time.process_time,
    unit: str = "CPU time, ours = 1",
) -> Table:
    """Time sides in turns.

    Args:
        title: Name of the task.
        sides: Sides to time; one whose `run` raises ImportError is listed as missing.
        goal: Goal in words.
        rounds: Number of turns of each side.
        ours: Name of the side whose time is 1.
        clock: Function that returns the time in seconds.
        unit: Unit of the ratios, in words.
    """
    table, best = (
        Table(title, goal=goal, unit=unit),
        dict.fromkeys((side.name for side in sides), float("inf")),
    )
    for _ in range(rounds):
        for side in sides:
            if side.name in table.missing:
                continue
            start = clock()
            try:
                side.run()
            except ImportError as error:
                table.missing[side.name] = str(error)
                continue
            taken = (clock() - start) / side.share
            best[side.name] = min(best[side.name], taken)
    times = {
        side.name: best[side.name] - (best[side.floor] if side.floor else 0.0)
        for side in sides
        if side.name not in table.missing
    }
    table.ratios = {name: taken / times[ours] for name, taken in times.items()}
    print(table.to_markdown(), flush=True)
    return table


def cpu_s(run: Callable[[], object]) -> float:
    """Return the CPU time of a call, seconds."""
    start = time.process_time()
    run()
    return time.process_time() - start


def after(prepare: Callable[[], object], run: Callable[[], object]) -> Callable[[], object]:
    """Call `prepare`, and return `run`.

    If `prepare` raises an ImportError, the returned function raises it.
    """
    try:
        prepare()
    except ImportError as error:
        reason = str(error)

        def fail() -> object:
            raise ImportError(reason)

        return fail
    return run

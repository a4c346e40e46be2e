"""Comparisons whose sides are timed in turns within one process.

The machine may be busy with other things, so what counts is CPU time, the best of several turns,
and the sides take turns so that a slow minute hits them all. What is reported are ratios: seconds
depend on the machine, ratios much less.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

OURS = "mcaprl"
# Sides that work message by message do this share of the task, scaled up: a turn then takes some
# tenths of a second, so that each side has many turns and a disturbance affects only one.
SLOW_SHARE = 0.1
SLOWEST_SHARE = 0.01


@dataclass(frozen=True)
class Side:
    """One way to do a task.

    Attributes:
        name: of the library, and what of it.
        run: does the task once.
        share: how much of the task it does; the time is scaled up. For sides that would take
            minutes.
        floor: the name of a side whose time is taken off, as of an environment without recorder.
    """

    name: str
    run: Callable[[], object]
    share: float = 1.0
    floor: str = ""


@dataclass
class Table:
    """A task, and how long each side takes for it.

    Attributes:
        title: the task.
        ratios: CPU time by side, where ours takes 1.
        missing: sides that could not be measured, and why.
        goal: what we want to reach, in words.
        unit: what the ratios are of.
    """

    title: str
    ratios: dict[str, float] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    goal: str = ""
    unit: str = "CPU time, ours = 1"

    def to_json(self) -> dict[str, Any]:
        """Return the table as JSON values."""
        return asdict(self)

    def to_markdown(self) -> str:
        """Format the table as a section of a page."""
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
        title: the task.
        sides: who does it; one whose `run` raises ImportError is noted as missing.
        goal: what we want to reach, in words.
        rounds: turns of each side.
        ours: the side whose time is 1.
        clock: what measures it, in seconds.
        unit: what the ratios are of, in words.
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


def after(prepare: Callable[[], object], run: Callable[[], object]) -> Callable[[], object]:
    """Prepare a run; an ImportError is reported when the run is timed."""
    try:
        prepare()
    except ImportError as error:
        reason = str(error)

        def fail() -> object:
            raise ImportError(reason)

        return fail
    return run

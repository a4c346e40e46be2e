"""Metrics of a training run: `metrics.csv`, TensorBoard, images of the curves, and summaries."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from mcaprl.errors import ReportError, TrainingError
from mcaprl.files import write_atomically
from mcaprl.page import COLORS, Panel, save_panels
from mcaprl.runs import METRICS_NAME, Curve, RunSummary, read_curves, writing
from mcaprl.sims.evaluation.evaluate import mean_interval
from mcaprl.texts import counted


class ScalarsWriter:
    """Writer of scalars to CSV and TensorBoard, one row per call of `write`."""

    def __init__(self, path: Path, index: str, done: int, prefix: str = "") -> None:
        """Open both files; rows of a CSV file after `done` are those of a broken-off session."""
        # Imported here because a process that only handles summaries does not need torch.
        from torch.utils.tensorboard import SummaryWriter

        self._path, self._index, self._prefix = path, index, prefix
        self._rows = [row for row in _read(path) if _is_within(row.get(index, ""), done)]
        self._columns = list(dict.fromkeys(name for row in self._rows for name in row))
        self._rewrite()
        with writing(path):
            self._board = SummaryWriter(str(path.parent), purge_step=done + 1)

    def write_row(self, number: int, scalars: Mapping[str, float]) -> None:
        """Append the values after `number` updates or steps; names may differ between rows."""
        row = {self._index: str(number), **{name: str(value) for name, value in scalars.items()}}
        self._rows.append(row)
        new = [name for name in row if name not in self._columns]
        with writing(self._path):
            if new:
                self._columns += new
                self._rewrite()
            else:
                with self._path.open("a", newline="") as file:
                    self._writer(file).writerow(row)
            for name, value in scalars.items():
                self._board.add_scalar(f"{self._prefix}{name}", value, number)

    def close(self) -> None:
        """Close the files."""
        with writing(self._path):
            self._board.close()

    def _rewrite(self) -> None:
        """Replace the file; it gets a column for each name so far."""
        text = io.StringIO()
        writer = self._writer(text)
        if self._columns:
            writer.writeheader()
        writer.writerows(self._rows)
        write_atomically(self._path, text.getvalue().encode(), TrainingError)

    def _writer(self, file: TextIO) -> csv.DictWriter[str]:
        return csv.DictWriter(file, self._columns, lineterminator="\n")


class MetricsWriter(ScalarsWriter):
    """Writer of one row of a batch's terms per `write`: the same seed writes the same file."""

    def __init__(self, folder: Path, first_update: int) -> None:
        """Open both files in `folder`."""
        super().__init__(folder / METRICS_NAME, "update", first_update - 1, "train/")

    def write(self, update: int, learning_rate: float, terms: Mapping[str, float]) -> None:
        """Append the values of one update."""
        self.write_row(update, {"learning_rate": learning_rate, **terms})


@dataclass(frozen=True)
class OfflineSummary(RunSummary):
    """Outcome of training one seed offline.

    Attributes:
        terms: Loss terms of the last update; empty if no updates remained.
    """

    terms: dict[str, float]


def describe_seeds(summaries: Sequence[OfflineSummary]) -> list[str]:
    """Return a line for each seed, and a line with means and 95 % intervals over seeds."""
    lines = []
    for summary in summaries:
        done, total = summary.steps - summary.resumed_at, counted(summary.steps, "update")
        if not done:
            lines.append(f"{summary.folder}: finished before, with {total}")
            continue
        session = f" ({done} in this session)" if summary.resumed_at else ""
        rate = done / summary.seconds if summary.seconds else 0.0
        terms = ", ".join(f"{name} {value:.4g}" for name, value in summary.terms.items())
        lines.append(f"{summary.folder}: {total}{session}, {rate:.0f} per second; {terms}")
    finished = [summary.terms for summary in summaries if summary.terms]
    if len(finished) > 1:
        means = []
        for name in finished[0]:
            values = np.array([[terms[name]] for terms in finished])
            low, high = mean_interval(values)
            means.append(f"{name} {values.mean():.4g} [{low:.4g}, {high:.4g}]")
        lines.append(f"mean of {len(finished)} seeds [95 % interval]: {', '.join(means)}")
    return lines


def _read(path: Path) -> list[dict[str, str]]:
    """Return the rows of an earlier session, without empty values, and without cut rows."""
    if not path.exists():
        return []
    with writing(path), path.open(newline="", errors="replace") as file:
        rows = list(csv.DictReader(file))
    whole = (row for row in rows if None not in row and None not in row.values())
    return [{name: value for name, value in row.items() if value} for row in whole]


def _is_within(number: str, done: int) -> bool:
    return number.isascii() and number.isdecimal() and len(number) < 20 and int(number) <= done


CURVES_NAME = "curves.png"

_NOT_DRAWN = ("update", "learning_rate")
_LEARNED, _HELD_OUT = COLORS[:2]


def draw_curves(folder: Path) -> Path:
    """Write RUN/curves.png from the metrics of all seeds; return its path."""
    panels = curve_panels(folder)
    if not panels:
        raise ReportError(f"{folder} has no {METRICS_NAME} to draw: was the folder removed?")
    save_panels(folder / CURVES_NAME, panels)
    return folder / CURVES_NAME


def curve_panels(folder: Path) -> list[Panel]:
    """Return a panel for each term of the loss."""
    curves = read_curves(folder, METRICS_NAME, ["update"])
    names = [name for name in curves[0] if name not in _NOT_DRAWN] if curves else []
    return [
        Panel(name.replace("_", " "), partial(_draw, curves=curves, name=name), (4, 2.4))
        for name in names
    ]


def _draw(axes: Any, curves: list[Curve], name: str) -> None:
    color = _HELD_OUT if name.startswith("held_out_") else _LEARNED
    shortest = min((curve["update"] for curve in curves), key=len)
    # A line through one point is invisible.
    marker = "o" if len(shortest) == 1 else None
    for curve in curves:
        axes.plot(curve["update"], curve[name], color=color, lw=0.7, alpha=0.5, marker=marker)
    mean = np.mean([curve[name][: len(shortest)] for curve in curves], axis=0)
    axes.plot(shortest, mean, color=color, lw=1.8, marker=marker)
    axes.set_xlabel("updates" + (f"; thick: mean of {len(curves)} seeds" if curves[1:] else ""))

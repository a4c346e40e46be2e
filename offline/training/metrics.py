"""Metrics of a training run: `metrics.csv`, TensorBoard, images of the curves, and summaries."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.errors import ReportError, TrainingError
from mcaprl.figures import COLORS, Panel, save_panels
from mcaprl.files import write_atomically
from mcaprl.runs import METRICS_NAME, Curve, RunSummary, read_curves, writing
from mcaprl.sims.evaluation.statistics import mean_interval
from mcaprl.texts import counted


class MetricsWriter:
    """Writer of metrics to CSV and TensorBoard, one row per call.

    The CSV has the columns `update`, `learning_rate` and the algorithm's terms. Each value comes
    from one batch and is not a running average, so the same seed writes the same file.
    """

    def __init__(self, folder: Path, first_update: int) -> None:
        """Open both files in `folder`."""
        # Imported here because a process that only handles summaries does not need torch.
        from torch.utils.tensorboard import SummaryWriter

        self._path = path = folder / METRICS_NAME
        kept = _rows_before(path, first_update)
        write_atomically(path, "".join(kept).encode(), TrainingError)
        with writing(path):
            self._file = path.open("a", newline="")
            self._board = SummaryWriter(str(folder), purge_step=first_update)
        self._rows = csv.writer(self._file, lineterminator="\n")
        self._has_header = bool(kept)

    def write(self, update: int, learning_rate: float, terms: Mapping[str, float]) -> None:
        """Append the values of one update."""
        scalars = {"learning_rate": learning_rate, **terms}
        with writing(self._path):
            if not self._has_header:
                self._rows.writerow(["update", *scalars])
                self._has_header = True
            self._rows.writerow([update, *scalars.values()])
            self._file.flush()
            for name, value in scalars.items():
                self._board.add_scalar(f"train/{name}", value, update)

    def close(self) -> None:
        """Close both files."""
        with writing(self._path):
            try:
                self._file.close()
            finally:
                self._board.close()


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


def _rows_before(path: Path, update: int) -> list[str]:
    """Return the header and the rows of earlier updates, without damaged rows or cut ones."""
    if update == 1 or not path.exists():
        return []
    header, *rows = path.read_text(errors="replace").splitlines(keepends=True) or [""]
    whole = (row for row in rows if row.count(",") == header.count(","))
    numbered = ((row.split(",")[0], row) for row in whole)
    return [header, *(row for number, row in numbered if _is_before(number, update))]


def _is_before(number: str, update: int) -> bool:
    return number.isascii() and number.isdecimal() and len(number) < 20 and int(number) < update


CURVES_NAME = "curves.png"

_NOT_DRAWN = ("update", "learning_rate")
_LEARNED, _HELD_OUT = COLORS[:2]


def draw_curves(folder: Path) -> Path:
    """Write RUN/curves.png from the metrics of all seeds; return its path.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ReportError: There are no metrics, or the image cannot be written.
    """
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

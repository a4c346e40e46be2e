"""The curves of a run as a picture: one panel for each term, one line for each seed."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.figures import COLORS, new_figure, save_png
from mcaprl.offline.training.metrics import METRICS_NAME

CURVES_NAME = "curves.png"
Curve = dict[str, NDArray[np.float64]]

_COLUMNS = 3
_LEARNED, _HELD_OUT = COLORS[:2]


def draw_curves(folder: Path) -> Path:
    """Write RUN/curves.png from the metrics of all its seeds; thick lines are means over seeds.

    Returns:
        Its path.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ReportError: it cannot be written.
    """
    curves = read_curves(folder)
    names = _shown(curves)
    rows = -(-len(names) // _COLUMNS)
    figure, panels = new_figure((4 * _COLUMNS, 2.4 * rows), rows, _COLUMNS, grid=True)
    for panel in panels.flat[len(names) :]:
        panel.set_axis_off()
    for panel, name in zip(panels.flat, names, strict=False):
        _draw(panel, curves, name)
        panel.set_title(name.replace("_", " "))
    figure.supxlabel(_legend(curves))
    save_png(figure, folder / CURVES_NAME)
    return folder / CURVES_NAME


def curve_figures(folder: Path) -> list[tuple[str, Any]]:
    """The same as a small figure for each term, by its name; for pages.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    curves = read_curves(folder)
    found = []
    for name in _shown(curves):
        figure, axes = new_figure((4.4, 2.6))
        _draw(axes, curves, name)
        axes.set_xlabel(_legend(curves))
        found.append((name.replace("_", " "), figure))
    return found


def read_curves(folder: Path) -> list[Curve]:
    """Those of all seeds of a run; none if there are no metrics."""
    return [read_curve(path) for path in sorted(folder.glob(f"seed-*/{METRICS_NAME}"))]


def _shown(curves: list[Curve]) -> list[str]:
    return [name for name in curves[0] if name not in ("update", "learning_rate")] if curves else []


def _legend(curves: list[Curve]) -> str:
    return "updates" + ("" if len(curves) == 1 else f"; thick: mean of {len(curves)} seeds")


def _draw(axes: Any, curves: list[Curve], name: str) -> None:
    color = _HELD_OUT if name.startswith("held_out_") else _LEARNED
    shortest = min((curve["update"] for curve in curves), key=len)
    # A line through one point cannot be seen.
    marker = "o" if len(shortest) == 1 else None
    for curve in curves:
        axes.plot(curve["update"], curve[name], color=color, lw=0.7, alpha=0.5, marker=marker)
    mean = np.mean([curve[name][: len(shortest)] for curve in curves], axis=0)
    axes.plot(shortest, mean, color=color, lw=1.8, marker=marker)


def read_curve(path: Path) -> Curve:
    """The columns of a `metrics.csv`, by name."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}

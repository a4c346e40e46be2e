"""The curves of a run as a picture: one panel for each term, one line for each seed."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mcaprl.offline.metrics import METRICS_NAME

CURVES_NAME = "curves.png"
_COLUMNS = 3
_INK, _LINE, _HELD_OUT = "#1d2733", "#2f6fb7", "#d9622b"


def draw_curves(folder: Path) -> None:
    """Write RUN/curves.png from the metrics of all its seeds; thick lines are means over seeds."""
    curves = [read_curve(path) for path in sorted(folder.glob(f"seed-*/{METRICS_NAME}"))]
    names = [name for name in curves[0] if name not in ("update", "learning_rate")] if curves else []
    if not names:
        return
    rows = -(-len(names) // _COLUMNS)
    figure = Figure(figsize=(4 * _COLUMNS, 2.5 * rows), dpi=100, layout="constrained")
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for panel in panels[len(names) :]:
        panel.set_axis_off()
    for panel, name in zip(panels, names, strict=False):
        color = _HELD_OUT if name.startswith("held_out_") else _LINE
        for curve in curves:
            panel.plot(curve["update"], curve[name], color=color, lw=0.7, alpha=0.5)
        shortest = min((curve["update"] for curve in curves), key=len)
        mean = np.mean([curve[name][: len(shortest)] for curve in curves], axis=0)
        panel.plot(shortest, mean, color=color, lw=1.8)
        panel.set_title(name.replace("_", " "), loc="left", fontsize=10, color=_INK)
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelsize=8)
    figure.supxlabel(f"updates; thick: mean of {len(curves)} seeds", fontsize=9, color=_INK)
    figure.savefig(folder / CURVES_NAME, facecolor="white")


def read_curve(path: Path) -> dict[str, NDArray[np.float64]]:
    """The columns of a `metrics.csv`, by name."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]} if rows else {}

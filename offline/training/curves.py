"""Images of a run's curves: one panel for each term, one line for each seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.errors import ReportError
from mcaprl.figures import COLORS, new_figure, save_png
from mcaprl.runs import METRICS_NAME, Curve, read_curves

CURVES_NAME = "curves.png"

_COLUMNS = 3
_LEARNED, _HELD_OUT = COLORS[:2]


def draw_curves(folder: Path) -> Path:
    """Write RUN/curves.png from the metrics of all seeds. Thick lines are means over seeds.

    Returns:
        Path of the image.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ReportError: There are no metrics, or the image cannot be written.
    """
    curves = read_curves(folder, METRICS_NAME)
    names = _drawn_terms(curves)
    if not names:
        raise ReportError(f"{folder} has no {METRICS_NAME} to draw: was the folder removed?")
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
    """Return a title and a small figure for each term of the loss, for HTML pages.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    curves = read_curves(folder, METRICS_NAME)
    found = []
    for name in _drawn_terms(curves):
        figure, axes = new_figure((4.4, 2.6))
        _draw(axes, curves, name)
        axes.set_xlabel(_legend(curves))
        found.append((name.replace("_", " "), figure))
    return found


def _drawn_terms(curves: list[Curve]) -> list[str]:
    return [name for name in curves[0] if name not in ("update", "learning_rate")] if curves else []


def _legend(curves: list[Curve]) -> str:
    return "updates" + ("" if len(curves) == 1 else f"; thick: mean of {len(curves)} seeds")


def _draw(axes: Any, curves: list[Curve], name: str) -> None:
    color = _HELD_OUT if name.startswith("held_out_") else _LEARNED
    shortest = min((curve["update"] for curve in curves), key=len)
    # A line through one point is invisible.
    marker = "o" if len(shortest) == 1 else None
    for curve in curves:
        axes.plot(curve["update"], curve[name], color=color, lw=0.7, alpha=0.5, marker=marker)
    mean = np.mean([curve[name][: len(shortest)] for curve in curves], axis=0)
    axes.plot(shortest, mean, color=color, lw=1.8, marker=marker)

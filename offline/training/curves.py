"""Images of a run's curves: one panel for each term, one line for each seed."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.errors import ReportError
from mcaprl.figures import COLORS, Panel, save_panels
from mcaprl.runs import METRICS_NAME, Curve, read_curves

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

"""Learning curves: `curve.csv`, and an image of all seeds (needs the extra `report`)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import TrainingError
from mcaprl.files import read_json, write_atomically
from mcaprl.page import BACKGROUND, COLORS, INK, PALE, new_figure, save_png
from mcaprl.runs import CURVE_NAME, Curve, read_curves

IMAGE_NAME = "curve.png"
SCORES_NAME = "scores.json"
VALUES: Final = {
    "score": "score: random 0, pilot 1",
    "mean_return": "mean return",
    "mean_progress_m": "meters along the path per episode",
    "mean_length": "steps per episode",
}
"""Columns of a curve that can be drawn, with their axis labels."""


@dataclass(frozen=True)
class CurvePoint:
    """One evaluation during training, a row of `curve.csv`."""

    step: int  # Number of finished environment steps
    mean_return: float  # Mean return of the evaluation's episodes
    score: float  # Mean return, scaled so that random is 0 and pilot is 1; NaN without a pilot
    lowest_return: float
    highest_return: float
    mean_length: float  # Mean number of steps of an episode
    # Mean distance along the path or line in meters; NaN where the environment reports none.
    mean_progress_m: float
    best: bool  # Whether the mean return is the highest so far


@dataclass(frozen=True)
class RunCurve:
    """The evaluations of a run."""

    name: str
    seeds: tuple[Curve, ...]  # Columns of each seed's curve
    # Scores of the best checkpoint of each seed on new episodes, if known.
    finals: tuple[float, ...]


@dataclass(frozen=True)
class _Final:
    """Entry of a seed in `scores.json`."""

    score: float | None


@dataclass(frozen=True)
class _Finals:
    """What `read_run` reads of `scores.json`."""

    seeds: dict[str, _Final]


def write_curve(path: Path, points: Sequence[CurvePoint]) -> None:
    """Replace a `curve.csv` with all points so far."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow([field.name for field in fields(CurvePoint)])
    rows.writerows([*astuple(point)[:-1], int(point.best)] for point in points)
    write_atomically(path, text.getvalue().encode(), TrainingError)


def read_run(folder: Path) -> RunCurve:
    """Read the curves of all seeds of a run, finished or not."""
    seeds = tuple(read_curves(folder, CURVE_NAME, ["step", *VALUES]))
    if not seeds:
        raise TrainingError(f"{folder} has no curves: no seed-K/{CURVE_NAME}")
    return RunCurve(folder.name, seeds, _final_scores(folder / SCORES_NAME))


def draw_curves(path: Path, runs: Sequence[RunCurve], title: str, value: str | None = None) -> None:
    """Draw curves of runs: each seed, the median over the seeds, and their range."""
    # Dots on the right are scores of the best checkpoints on new episodes. `value` is a key of
    # `VALUES`, by default the score if it is known, else the mean return.
    save_png(curve_figure(runs, title, value), path)


def curve_figure(runs: Sequence[RunCurve], title: str, value: str | None = None) -> Any:
    """Return the image of `draw_curves` as a figure."""
    figure, axes = new_figure((7.2, 4.0))
    if value is None:
        scored = all(np.isfinite(seed["score"]).all() for run in runs for seed in run.seeds)
        value = "score" if scored else "mean_return"
    for run, color in zip(runs, COLORS, strict=False):
        _draw_run(axes, run, color, value)
    if value == "score":
        axes.axhline(1, color=INK, lw=1, ls="--", zorder=0)
        axes.axhline(0, color=PALE, lw=1, zorder=0)
    axes.set_ylabel(VALUES[value])
    dots = "; dots: best checkpoints on new episodes" if _has_finals(runs, value) else ""
    axes.set_xlabel(f"environment steps{dots}")
    axes.set_title(title)
    axes.legend(loc="best", frameon=False)
    return figure


def _final_scores(path: Path) -> tuple[float, ...]:
    if not path.exists():
        return ()
    found: _Finals = read_json(path, TrainingError, _Finals)
    return tuple(seed.score for seed in found.seeds.values() if seed.score is not None)


def _has_finals(runs: Sequence[RunCurve], value: str) -> bool:
    return value == "score" and any(run.finals for run in runs)


def _draw_run(axes: Any, run: RunCurve, color: str, value: str) -> None:
    steps, values = _on_common_steps(run, value)
    axes.plot(steps, values.T, color=color, lw=0.6, alpha=0.35)
    axes.fill_between(steps, values.min(0), values.max(0), color=color, alpha=0.15, lw=0)
    seeds = "1 seed" if len(values) == 1 else f"median and range of {len(values)} seeds"
    label = f"{run.name}: {seeds}"
    axes.plot(steps, np.median(values, axis=0), color=color, lw=2, label=label)
    if _has_finals([run], value):
        beyond = np.full(len(run.finals), steps[-1] * 1.04)
        axes.plot(beyond, run.finals, "o", color=color, mec=BACKGROUND, ms=6, clip_on=False)


def _on_common_steps(run: RunCurve, value: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the steps at which all seeds have values, and these values (seeds, steps)."""
    length = min(len(seed["step"]) for seed in run.seeds)
    return run.seeds[0]["step"][:length], np.array([seed[value][:length] for seed in run.seeds])

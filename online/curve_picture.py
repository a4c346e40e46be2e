"""The picture of learning curves: median and range over the seeds of runs. Extra: `report`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import TrainingError
from mcaprl.figures import COLORS, INK, PALE, new_figure, save_png
from mcaprl.online.curve import CURVE_NAME, CurvePoint, read_curve

PICTURE_NAME = "curve.png"
SCORES_NAME = "scores.json"
VALUES: Final = {
    "score": "score: random 0, pilot 1",
    "mean_return": "mean return",
    "mean_progress_m": "metres along the path in an episode",
    "mean_length": "steps of an episode",
}
"""What of a curve can be drawn, and how the axis is labelled."""


@dataclass(frozen=True)
class RunCurve:
    """What a run's folder says of its learning.

    Attributes:
        name: of the folder.
        seeds: the evaluations of each seed.
        finals: each seed's score of its best checkpoint on fresh episodes; those that are known.
    """

    name: str
    seeds: tuple[tuple[CurvePoint, ...], ...]
    finals: tuple[float, ...]


def read_run(folder: Path) -> RunCurve:
    """Read the curves of all seeds of a run, finished or not.

    Raises:
        TrainingError: it has none, or they cannot be read.
    """
    paths = sorted(folder.glob(f"seed-*/{CURVE_NAME}"))
    seeds = tuple(tuple(read_curve(path)) for path in paths)
    if not seeds:
        raise TrainingError(f"{folder} has no curves: no seed-K/{CURVE_NAME}")
    return RunCurve(folder.name, seeds, _final_scores(folder / SCORES_NAME))


def _final_scores(path: Path) -> tuple[float, ...]:
    if not path.exists():
        return ()
    try:
        seeds = json.loads(path.read_text())["seeds"].values()
        return tuple(seed["score"] for seed in seeds if seed["score"] is not None)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise TrainingError(f"cannot read the scores in {path}: {error}") from error


def curve_picture(
    path: Path, runs: Sequence[RunCurve], title: str, value: str | None = None
) -> None:
    """Draw curves of runs: each seed, the median over them, and their range.

    Dots at the right of scores are the best checkpoints on fresh episodes.

    Args:
        path: of the PNG to write.
        runs: to be compared.
        title: over the picture.
        value: a key of `VALUES`; None is the score where there is one, else the mean return.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ReportError: it cannot be written.
    """
    save_png(curve_figure(runs, title, value), path)


def curve_figure(runs: Sequence[RunCurve], title: str, value: str | None = None) -> Any:
    """The same as a figure."""
    figure, axes = new_figure((7.2, 4.0))
    if value is None:
        scored = all(np.isfinite(p.score) for run in runs for seed in run.seeds for p in seed)
        value = "score" if scored else "mean_return"
    for run, color in zip(runs, COLORS, strict=False):
        _draw_run(axes, run, color, value)
    if value == "score":
        axes.axhline(1, color=INK, lw=1, ls="--", zorder=0)
        axes.axhline(0, color=PALE, lw=1, zorder=0)
    axes.set_ylabel(VALUES[value])
    dots = "; dots: best checkpoints on fresh episodes" if _has_finals(runs, value) else ""
    axes.set_xlabel(f"environment steps{dots}")
    axes.set_title(title)
    axes.legend(loc="best", frameon=False)
    return figure


def _has_finals(runs: Sequence[RunCurve], value: str) -> bool:
    return value == "score" and any(run.finals for run in runs)


def _draw_run(axes: Any, run: RunCurve, color: str, value: str) -> None:
    steps, values = _on_common_steps(run, value)
    axes.plot(steps, values.T, color=color, lw=0.6, alpha=0.35)
    axes.fill_between(steps, values.min(0), values.max(0), color=color, alpha=0.15, lw=0)
    label = f"{run.name}: median and range of {len(values)} seeds"
    axes.plot(steps, np.median(values, axis=0), color=color, lw=2, label=label)
    if _has_finals([run], value):
        beyond = np.full(len(run.finals), steps[-1] * 1.04)
        axes.plot(beyond, run.finals, "o", color=color, mec="white", ms=6, clip_on=False)


def _on_common_steps(run: RunCurve, value: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The steps that all seeds have reached, and (seeds, steps) what was measured there."""
    length = min(len(points) for points in run.seeds)
    steps = np.array([point.step for point in run.seeds[0][:length]])
    values = [[getattr(point, value) for point in seed[:length]] for seed in run.seeds]
    return steps, np.array(values)

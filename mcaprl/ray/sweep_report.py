"""Results of a sweep as a table, an image and a page."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.errors import ReportError
from mcaprl.figures import COLORS, new_figure, save_png
from mcaprl.files import write_atomically
from mcaprl.page import PAGE_NAME, Figure, Section, Table, write_page
from mcaprl.ray.sweep import TrialResult
from mcaprl.ray.sweep_file import SweepPlan
from mcaprl.texts import counted

TABLE_NAME, IMAGE_NAME = "sweep.csv", "sweep.png"
_MOST_NAMES = 12


def table_of(results: Sequence[TrialResult]) -> Table:
    """Return a table with a row for each trial. `score` is the mean over the seeds."""
    varied = list(dict.fromkeys(name for one in results for name in one.trial.varied))
    columns = ["trial", *varied, "score", "lowest", "highest", "estimator", "updates", "status"]
    rows = []
    for one in results:
        settings = [_text(one.trial.varied.get(name, "")) for name in varied]
        score = ["", "", "", ""]
        updates = 0
        if one.scores:
            last = one.scores[-1]
            numbers = (last.mean, min(last.values), max(last.values))
            name = last.estimator if last.trusted else f"{last.estimator}, not trusted"
            score, updates = [*(f"{value:.3f}" for value in numbers), name], last.updates
        rows.append([one.trial.name, *settings, *score, str(updates), one.status])
    return Table(columns, rows)


def write_table(path: Path, table: Table) -> None:
    """Write a table as CSV."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(table.rows)
    write_atomically(path, text.getvalue().encode(), ReportError)


def sweep_figure(results: Sequence[TrialResult]) -> Any:
    """Draw the score of each trial over its updates. A dot marks the end of a trial."""
    figure, axes = new_figure((8, 4.5))
    shown = [one for one in results if one.scores]
    algos = list(dict.fromkeys(one.trial.algo for one in results))
    for rank, one in enumerate(shown):
        color = COLORS[algos.index(one.trial.algo) % len(COLORS)]
        updates = [score.updates for score in one.scores]
        means = [score.mean for score in one.scores]
        axes.plot(updates, means, color=color, lw=2.2 if rank == 0 else 1, alpha=0.85)
        axes.plot(updates[-1:], means[-1:], "o", color=color, ms=6 if rank == 0 else 4)
    for number, algo in enumerate(algos):
        axes.plot([], [], color=COLORS[number % len(COLORS)], label=algo)
    if len(shown) <= _MOST_NAMES:
        _name_ends(axes, shown)
    axes.set_xlabel("updates; thick: the best trial")
    axes.set_ylabel("off-policy score")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _name_ends(axes: Any, shown: Sequence[TrialResult]) -> None:
    """Write the names of the trials beside their last scores, without overlaps."""
    low, high = axes.get_ylim()
    step, above = (high - low) / 28, np.inf
    for one in sorted(shown, key=lambda one: -one.scores[-1].mean):
        last = one.scores[-1]
        place = min(last.mean, above - step)
        axes.annotate(
            one.trial.name, (last.updates, place), (7, 0), textcoords="offset points", va="center"
        ).set_fontsize(7.5)
        above = place
    axes.set_xlim(right=axes.get_xlim()[1] * 1.12)


def write_sweep(results: Sequence[TrialResult], plan: SweepPlan, out: Path) -> Table:
    """Write `sweep.csv`, `sweep.png` and `index.html` to a folder; return the table."""
    table = table_of(results)
    write_table(out / TABLE_NAME, table)
    figure = sweep_figure(results)
    save_png(figure, out / IMAGE_NAME)
    score = plan.score
    text = (
        f"The score is the off-policy estimate of the discounted return (gamma {score.gamma:g}) of"
        f" the trained policies with {score.epsilon:.0%} random actions, on {score.fraction:.0%}"
        " of the episodes, which no policy has learned from. Lowest and highest are those of the"
        " seeds. The best of many scores is too high by chance: evaluate its policies in the sim,"
        " or on other logs."
    )
    lead = (
        f"{counted(len(results), 'trial')} with {counted(plan.seeds, 'seed')} each; best:"
        f" {results[0].trial.name}."
    )
    drawn = Figure.of("Off-policy score during training", figure)
    sections = [
        Section("Scores", figures=[drawn]),
        Section("Trials", text=text, table=table),
    ]
    write_page(out / PAGE_NAME, "Sweep", lead, sections)
    return table


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else f"{value}"

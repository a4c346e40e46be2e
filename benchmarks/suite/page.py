"""Tables and figures of docs/benchmark.md, from the files of the finished cells."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.page import write_section
from benchmarks.suite import statistics
from benchmarks.suite.learners import RIVAL
from benchmarks.suite.tasks import HERE, TASKS
from mcaprl.sims import interquartile_mean

RESULTS: Final = HERE / "results"
DOCS: Final = HERE.parent.parent / "docs"
Cell = dict[str, Any]
Cells = dict[tuple[str, str, str], Cell]
"""Finished cells by task, kind and learner."""


def cell_path(task: str, kind: str, learner: str) -> Path:
    """Return the file of a cell."""
    return RESULTS / task.replace(" ", "-") / f"{kind}-{learner}.json"


def read_cells(folder: Path = RESULTS) -> Cells:
    """Return all finished cells."""
    cells = [json.loads(path.read_text()) for path in sorted(folder.rglob("*.json"))]
    return {(cell["task"], cell["kind"], cell["learner"]): cell for cell in cells}


def write(cells: Cells, docs: Path = DOCS) -> None:
    """Write the generated sections of the page, and its figure."""
    page = docs / "benchmark.md"
    write_section("benchmark-cells", "\n\n".join(_tables(cells)), page)
    write_section("benchmark-statistics", summaries(cells), page)
    write_section("benchmark-rivals", rivals(cells), page)
    draw(cells, docs / "images" / "benchmark.png")


def _tables(cells: Cells) -> list[str]:
    """Return a table of scores for each task, and of the tasks without a cell only the name."""
    tables, missing = [], []
    for name, task in TASKS.items():
        own = {key[1:]: cell for key, cell in cells.items() if key[0] == name}
        if not own:
            missing.append(f"{name} ({task.tier})")
            continue
        learners = list(dict.fromkeys(learner for _, learner in own))
        learners.sort(key=lambda one: (one.startswith(RIVAL), one))
        minutes = sum(cell["cpu_s"] for cell in own.values()) / 60
        lines = [f"**{name}** (tier {task.tier}; {minutes:.1f} CPU minutes)", ""]
        lines += [f"| log (behavior) | {' | '.join(learners)} |", "|---|" + "---|" * len(learners)]
        for kind in dict.fromkeys(kind for kind, _ in own):
            row = {learner: own[kind, learner] for learner in learners if (kind, learner) in own}
            behavior = next(iter(row.values()))["behavior"]
            texts = [cell_text(row[one]) if one in row else "-" for one in learners]
            lines.append(f"| {kind} ({behavior:.2f}) | {' | '.join(texts)} |")
        tables.append("\n".join(lines))
    return [*tables, f"Not measured yet: {', '.join(missing)}."] if missing else tables


def cell_text(cell: Cell) -> str:
    """Return the IQM of a cell's seeds, and the smallest and largest score."""
    scores = np.array(cell["scores"])
    middle = float(interquartile_mean(scores[:, None]))
    return f"{middle:.2f} ({scores.min():.2f} to {scores.max():.2f})"


def common(cells: Cells, learners: Sequence[str]) -> list[NDArray[np.float64]]:
    """Return scores (N, M) of each learner on the M logs that all of them have."""
    logs = [{key[:2] for key in cells if key[2] == learner} for learner in learners]
    shared = sorted(set.intersection(*logs)) if logs else []
    count = min((len(cells[*log, one]["scores"]) for log in shared for one in learners), default=0)
    return [
        np.array([cells[*log, learner]["scores"][:count] for log in shared]).T
        for learner in learners
    ]


def groups(cells: Cells) -> dict[str, Cells]:
    """Return the cells by tier and kind of actions, which have different learners."""
    found: dict[str, Cells] = {}
    for key, cell in sorted(cells.items(), key=lambda item: (item[1]["box"], item[1]["tier"])):
        title = f"{cell['tier']}, {'Box' if cell['box'] else 'discrete'}"
        found.setdefault(title, {})[key] = cell
    return found


def complete(cells: Cells) -> list[str]:
    """Return the learners that have a cell for each log of these cells."""
    logs = {key[:2] for key in cells}
    found = dict.fromkeys(learner for _, _, learner in cells)
    return [one for one in found if all((*log, one) in cells for log in logs)]


def summaries(cells: Cells) -> str:
    """Return a row for each learner of a group: IQM over logs and seeds, and CPU time."""
    lines = ["| tier, actions | learner | logs | IQM | 95 % interval | CPU s of a seed |"]
    lines.append("|---|" + "---|" * 5)
    for title, own in groups(cells).items():
        learners = complete(own)
        for learner, scores in zip(learners, common(own, learners), strict=True):
            low, high = statistics.interval(scores)
            seconds = [c["cpu_s"] / len(c["scores"]) for k, c in own.items() if k[2] == learner]
            lines.append(
                f"| {title} | {learner} | {scores.shape[1]} | {interquartile_mean(scores):.2f} |"
                f" {low:.2f} to {high:.2f} | {np.mean(seconds):.1f} |"
            )
    return "\n".join(lines)


def rivals(cells: Cells) -> str:
    """Return a table that compares each algorithm here with that of d3rlpy."""
    lines = [
        "| tier, actions | algorithm | logs | IQM here | d3rlpy | difference, 95 % interval |"
        " probability of improvement |",
        "|---|" + "---|" * 6,
    ]
    for title, own in groups(cells).items():
        for rival in dict.fromkeys(key[2] for key in own if key[2].startswith(RIVAL)):
            name = rival.removeprefix(RIVAL)
            ours, theirs = common(own, [name, rival])
            if not ours.size:
                continue
            random = np.random.default_rng(0)
            samples = [statistics.stratified_samples(each, random) for each in (ours, theirs)]
            low, high = np.percentile(
                interquartile_mean(samples[0]) - interquartile_mean(samples[1]), [2.5, 97.5]
            )
            first, second = (float(interquartile_mean(each)) for each in (ours, theirs))
            least, most = statistics.improvement_interval(ours, theirs)
            lines.append(
                f"| {title} | {name} | {ours.shape[1]} | {first:.2f} | {second:.2f} |"
                f" {first - second:+.2f} ({low:+.2f} to {high:+.2f}) |"
                f" {statistics.improvement(ours, theirs):.2f} ({least:.2f} to {most:.2f}) |"
            )
    return "\n".join(lines)


def draw(cells: Cells, path: Path) -> None:
    """Draw the performance profiles of each group."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    thresholds = np.linspace(-0.1, 1.2, 131)
    parts = groups(cells)
    figure, axes = pyplot.subplots(1, len(parts), figsize=(5 * len(parts), 3.6), squeeze=False)
    for axis, (title, own) in zip(axes[0], parts.items(), strict=True):
        learners = complete(own)
        for learner, scores in zip(learners, common(own, learners), strict=True):
            line = "--" if learner.startswith(RIVAL) else "-"
            axis.plot(thresholds, statistics.profile(scores, thresholds), line, label=learner)
        axis.set(title=title, xlabel="score", ylabel="share of runs above", ylim=(0, 1))
        axis.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=100, metadata={"Software": None})
    pyplot.close(figure)

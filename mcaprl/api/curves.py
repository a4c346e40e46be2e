"""Learning curves of runs, as figures of a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mcaprl.page import Figure


def learning_curves(names: Sequence[str]) -> list[Figure]:
    """Return figures of those policies that are a run folder or the folder of a seed.

    Online runs are compared in one figure; an offline run has one figure for each term of its loss.
    """
    folders = dict.fromkeys(
        found for name in names if (found := _run_folder(Path(name))) is not None
    )
    online = [folder for folder in folders if any(folder.glob("seed-*/curve.csv"))]
    figures = []
    if online:
        from mcaprl.online.curves import curve_figure, read_run

        runs = [read_run(folder) for folder in online]
        figures.append(Figure.of("Evaluations while learning", curve_figure(runs, "")))
    for folder in folders:
        if folder in online:
            continue
        from mcaprl.offline.training.curves import curve_figures

        figures += [
            Figure.of(f"{folder.name}: {term}", drawn) for term, drawn in curve_figures(folder)
        ]
    return figures


def _run_folder(path: Path) -> Path | None:
    """Return the run folder of a run, of a seed, or of a file of a seed."""
    of_seed = [seed.parent for seed in (path, path.parent) if seed.name.startswith("seed-")]
    for folder in (path, *of_seed):
        if any(any(folder.glob(f"seed-*/{name}")) for name in ("curve.csv", "metrics.csv")):
            return folder
    return None

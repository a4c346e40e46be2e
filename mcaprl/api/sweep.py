"""Training with many settings on a Ray cluster."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcaprl.api.ranges import ClusterOptions
from mcaprl.errors import MissingExtraError
from mcaprl.progress import ProgressBar, no_progress
from mcaprl.recorder.source import Data

if TYPE_CHECKING:
    from mcaprl.page import Table
    from mcaprl.ray.sweep import TrialResult


@dataclass(frozen=True)
class Sweep:
    """Result of `sweep`.

    Attributes:
        out: Folder with `sweep.csv`, `sweep.png`, the page `index.html`, and the run folder of
            each trial.
        results: Outcome of each trial, best score first.
        table: Table of the results, as texts.
    """

    out: Path
    results: tuple[TrialResult, ...]
    table: Table


def sweep(
    data: Data,
    out: str | Path,
    plan: str | Path | Mapping[str, Any],
    *,
    workers: int | None = None,
    address: str | None = None,
    resume: bool = False,
    progress: ProgressBar = no_progress,
) -> Sweep:
    """Train with each combination of algorithms and settings of a sweep file, on Ray workers.

    All seeds of a combination are one trial, which one worker trains. Trials with low off-policy
    scores are stopped early. The scores use episodes that are kept from training.

    Args:
        data: File, folder, glob or URL of logs, or several of them, as for `train`.
        out: Folder to create, which all workers see.
        plan: Sweep file in YAML or JSON, or a mapping of the same form; see docs/ray.md.
        workers: Largest number of trials at a time; default: number of CPUs of the cluster.
        address: Address of a Ray cluster, `HOST:PORT` or `auto`; default: RAY_ADDRESS, else a
            local cluster for this call.
        resume: Whether to continue the sweep in `out`.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: The sweep file has a mistake.
        UnknownNameError: There is no such algorithm.
        OutputExistsError: `out` exists.
        LogError: The logs cannot be read, or have fewer than three episodes.
        TrainingError: All trials failed, or `out` has another sweep.
        ClusterError: The Ray cluster cannot be used.
        MissingExtraError: Ray or the packages of the `offline` extra are not installed.
    """
    from mcaprl.ray.sweep import read_plan, sweep_on_ray, table_of, write_sweep

    on_cluster = ClusterOptions(True, workers, address)
    on_cluster.check()
    wanted, folder = read_plan(plan), Path(out)
    with progress("trials", len(wanted.trials)) as advance, on_cluster.connected():
        results = sweep_on_ray(
            data, wanted, folder.absolute(), workers=workers, resume=resume, advance=advance
        )
    with suppress(MissingExtraError):
        write_sweep(results, wanted, folder)
    return Sweep(folder, tuple(results), table_of(results))

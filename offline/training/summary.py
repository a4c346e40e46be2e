"""How training went: a summary of each seed, and what to print of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mcaprl.sims.evaluation.statistics import bootstrap_interval


@dataclass(frozen=True)
class RunSummary:
    """How the training of one seed ended.

    Attributes:
        folder: with the policy, RUN/seed-K.
        algo: the algorithm's name.
        seed: K.
        updates: done in all.
        resumed_at: updates that an earlier session had done; 0 for a fresh start.
        seconds: wall time of this session, shared with the seeds that learned beside it.
        terms: the last update's loss terms; empty if there was nothing left to do.
    """

    folder: Path
    algo: str
    seed: int
    updates: int
    resumed_at: int
    seconds: float
    terms: dict[str, float]


def describe_seeds(summaries: Sequence[RunSummary]) -> list[str]:
    """A line for each seed, and one with means and 95 % intervals over seeds."""
    lines = []
    for summary in summaries:
        done = summary.updates - summary.resumed_at
        rate = done / summary.seconds if summary.seconds else 0.0
        terms = ", ".join(f"{name} {value:.4g}" for name, value in summary.terms.items())
        lines.append(f"{summary.folder}: {done} updates, {rate:.0f} a second; {terms}")
    finished = [summary.terms for summary in summaries if summary.terms]
    if len(finished) > 1:
        shown = []
        for name in finished[0]:
            values = np.array([[terms[name]] for terms in finished])
            low, high = bootstrap_interval(values)
            shown.append(f"{name} {values.mean():.4g} [{low:.4g}, {high:.4g}]")
        lines.append(f"mean of {len(finished)} seeds [95 % interval]: {', '.join(shown)}")
    return lines

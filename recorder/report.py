"""A picture of a dataset: how good, how long, which actions, and why it ended. Extra: `report`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.errors import ReportError, import_extra
from mcaprl.recorder.dataset import Dataset

_INK, _BAR = "#1d2733", "#2f6fb7"
_BINS = 30


def dataset_picture(path: Path, dataset: Dataset, title: str) -> None:
    """Write a PNG with histograms of returns and lengths, and counts of actions and ends.

    Args:
        path: of the PNG; folders above it are made.
        dataset: to be shown.
        title: over the picture.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ReportError: the file cannot be written.
    """
    figure = import_extra("matplotlib.figure", "report").Figure(figsize=(9, 6.5), dpi=130)
    (returns, lengths), (actions, ends) = figure.subplots(2, 2)
    statistics = dataset.statistics
    mean = statistics.mean_return
    _histogram(returns, statistics.returns, f"return of an episode (mean {mean:.4g})")
    _histogram(lengths, statistics.lengths, "steps of an episode")
    names = dataset.action_names
    taken = {names.get(value, str(value)): n for value, n in statistics.action_counts.items()}
    _bars(actions, taken, "actions")
    _bars(ends, statistics.ends, "ends of episodes")
    figure.suptitle(title, x=0.02, ha="left", color=_INK)
    figure.tight_layout()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, facecolor="white")
    except OSError as error:
        raise ReportError(f"cannot write {path}: {error.strerror}") from error


def _histogram(axes: Any, values: np.ndarray[Any, Any], label: str) -> None:
    axes.hist(values[np.isfinite(values)], bins=_BINS, color=_BAR)
    axes.set_xlabel(label)
    axes.set_ylabel("episodes")
    axes.yaxis.get_major_locator().set_params(integer=True)
    axes.spines[["top", "right"]].set_visible(False)


def _bars(axes: Any, counts: Mapping[str, int], label: str) -> None:
    if not counts:
        axes.set_axis_off()
        axes.text(0.5, 0.5, f"{label}: continuous", ha="center", color=_INK)
        return
    axes.barh(list(counts), list(counts.values()), color=_BAR, height=0.7)
    axes.set_ylim(max(len(counts), 3) - 0.5, -0.5)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_xlabel(label)
    axes.spines[["top", "right"]].set_visible(False)

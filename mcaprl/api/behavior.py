"""Estimates of the probabilities with which the actions of a log were chosen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mcaprl.api.ranges import check_least
from mcaprl.api.train import torch_threads
from mcaprl.progress import ProgressBar, no_progress
from mcaprl.recorder.source import Data, opened

if TYPE_CHECKING:
    from mcaprl.offline.estimate.behavior import BehaviorEstimate


def estimate_behavior(
    data: Data,
    *,
    folds: int = 5,
    updates: int = 2_000,
    seed: int = 0,
    clip_actions: bool = False,
    threads: int = 1,
    progress: ProgressBar = no_progress,
) -> BehaviorEstimate:
    """Estimate the probability of each logged action under the policy that took it.

    Most robots do not log these probabilities, but estimators with importance weights need them.
    The episodes are split into folds. For each fold, a classifier is trained on most episodes of
    the other folds and calibrated on the rest of them. The classifier then predicts the actions of
    the fold. For the actions of a Box, a mixture of normal distributions takes its place, and the
    estimates are densities.

    Args:
        data: Dataset, file, folder or glob of logs, or several of them.
        folds: Number of folds of the episodes; the actions of each fold are predicted by a
            classifier trained on the other folds.
        updates: Number of gradient steps for each fold.
        seed: Seed of the folds and of the networks.
        clip_actions: Whether logged actions outside a Box are clipped to its bounds instead of
            being an error.
        threads: Number of threads of PyTorch and of the reader.
        progress: Function that opens a progress bar.

    Returns:
        The dataset with the estimates, which are marked as estimates, and their calibration.

    Raises:
        SpaceError: The actions are neither discrete nor floats of a Box.
        UsageError: There are too few episodes.
        LogError: The logs cannot be read.
    """
    from mcaprl.offline.estimate import behavior

    check_least(1, updates=updates, threads=threads)
    check_least(2, folds=folds)
    dataset = opened(data, threads=threads)
    text = f"estimating {dataset.behavior_field.name} in {folds} folds"
    with torch_threads(threads), progress(text, folds * updates) as advance:
        return behavior.estimate_behavior(
            dataset,
            folds=folds,
            updates=updates,
            seed=seed,
            clip_actions=clip_actions,
            on_update=lambda: advance(1),
        )

"""Comparison of logs with the sims that they were recorded in."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from mcaprl.api.environments import check_episode, sim_of
from mcaprl.progress import ProgressBar, no_progress
from mcaprl.recorder.dataset.open import open_logs
from mcaprl.recorder.viewer.verify import Verification
from mcaprl.recorder.viewer.verify import verify as verify_dataset


def verify(
    file: str | Path,
    *,
    episode: int | None = None,
    sim: str | None = None,
    trust_env: bool = False,
    progress: ProgressBar = no_progress,
) -> Verification:
    """Repeat the logged actions in the sim, and compare each step until one differs.

    Args:
        file: Path of the log.
        episode: Index of the only episode to compare; None for all.
        sim: Short name or Gymnasium id to use instead of the logged one.
        trust_env: Whether to import the module that the logged id names, and to pass the logged
            arguments to any environment.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: The log has no such episode, or no environment id.
        LogError: The log cannot be read, or the sim fails on a logged action.
        SpaceError: The spaces of the sim and the log differ.
    """
    path = Path(file)
    dataset = open_logs(path)
    check_episode(dataset, episode, path)
    with (
        closing(sim_of(dataset, path, sim, trust_env=trust_env)) as env,
        progress("stepping", len(dataset)) as advance,
    ):
        return verify_dataset(
            dataset, env, only=episode, on_frame=lambda _, step: advance(min(step, 1))
        )

"""Environments: with the options that commands have, or as a log names them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym

from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.sims import make_sim


def all_options(
    observation: str | None, rules: str | None, others: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return the arguments of a sim without those that are None.

    >>> all_options("depth", None, {"road": "racetrack-v0"})
    {'observation': 'depth', 'road': 'racetrack-v0'}
    """
    named = {"observation": observation, "rules": rules}
    return {name: value for name, value in named.items() if value is not None} | dict(others or {})


def sim_of(
    dataset: Dataset, path: Path, sim: str | None = None, **others: Any
) -> gym.Env[Any, Any]:
    """Make the environment in which a log was recorded.

    Args:
        dataset: Dataset of the log.
        path: Path of the log.
        sim: Short name or Gymnasium id that replaces the log's.
        **others: Arguments added to the log's.

    Raises:
        UsageError: The log has no environment id, or the environment cannot be made.
    """
    name = sim or dataset.env_id
    if not name:
        raise UsageError(f"{path} has no environment id: pass --sim")
    return make_sim(name, **{**dataset.env_kwargs, **others})


def check_episode(dataset: Dataset, episode: int | None, path: Path) -> None:
    """Check that a log has an episode.

    Raises:
        UsageError: It has fewer episodes.
    """
    last = len(dataset.episodes) - 1
    if episode is not None and not 0 <= episode <= last:
        raise UsageError(f"--episode {episode}: {path} has episodes 0 to {last}")

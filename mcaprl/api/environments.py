"""Environments from the options of commands or the metadata of logs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym

from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.sims import SIMS, make_sim
from mcaprl.texts import shortened

_MAX_SHOWN = 200


def all_options(
    observation: str | None, rules: str | None, others: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return the arguments of a sim, except arguments that are None.

    >>> all_options("depth", None, {"road": "racetrack-v0"})
    {'observation': 'depth', 'road': 'racetrack-v0'}
    """
    named = {"observation": observation, "rules": rules}
    return {name: value for name, value in named.items() if value is not None} | dict(others or {})


def sim_of(
    dataset: Dataset,
    path: Path,
    sim: str | None = None,
    *,
    trust_env: bool = False,
    **others: Any,
) -> gym.Env[Any, Any]:
    """Make the environment in which a log was recorded.

    Args:
        dataset: Dataset of the log.
        path: Path of the log.
        sim: Short name or Gymnasium id to use instead of the logged one.
        trust_env: Whether to import the module that the logged id names, and to pass the logged
            arguments to environments other than sims of `SIMS`.
        **others: Additional arguments of the environment.

    Raises:
        UsageError: The log has no environment id, its environment needs `trust_env`, or the
            environment cannot be made.
    """
    name = sim or dataset.env_id
    if not name:
        raise UsageError(f"{path} has no environment id: pass --sim")
    if not trust_env:
        _check_needs_no_trust(dataset, path, sim)
    return make_sim(name, **{**dataset.env_kwargs, **others})


def _check_needs_no_trust(dataset: Dataset, path: Path, sim: str | None) -> None:
    """Raise an error if making the environment of the log would need `trust_env`."""
    if sim is None and ":" in dataset.env_id:
        module = dataset.env_id.partition(":")[0]
        raise UsageError(
            f"{path} names the environment {dataset.env_id}, so the module {module} would be"
            f" imported: if you trust the log, pass --trust-env (trust_env=True in Python) or --sim"
            f" {dataset.env_id}"
        )
    name = sim or dataset.env_id
    if dataset.env_kwargs and SIMS.find(SIMS.get(name, name), loads=":" not in name) is None:
        arguments = ", ".join(f"{key}={value!r}" for key, value in dataset.env_kwargs.items())
        raise UsageError(
            f"{path} names arguments of {name}: {shortened(arguments, _MAX_SHOWN)}; if you trust"
            " the log, pass --trust-env (trust_env=True in Python)"
        )


def check_episode(dataset: Dataset, episode: int | None, path: Path) -> None:
    """Check that a log has an episode with this index, or that the index is None.

    Raises:
        UsageError: The log has fewer episodes.
    """
    last = len(dataset.episodes) - 1
    if episode is not None and not 0 <= episode <= last:
        raise UsageError(f"--episode {episode}: {path} has episodes 0 to {last}")

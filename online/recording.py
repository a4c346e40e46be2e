"""Logs of training: their paths, and those of an earlier session that are continued."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

from gymnasium.vector import VectorEnv
from mcap.writer import MCAP0_MAGIC

from mcaprl.errors import LogError, NoStepsError, NotMcapError, OutputExistsError, UsageError
from mcaprl.files import check_target
from mcaprl.recorder.edit.piece import FinishedLog, filter_log
from mcaprl.recorder.record.vector_wrapper import RecordVecMcap
from mcaprl.recorder.repair.recover import recover_log


def log_paths(record: Path, seeds: range, resume: bool) -> dict[int, Path]:
    """Return the log of each seed: `record` if it ends in .mcap, else `record`/seed-K.mcap."""
    if len(seeds) > 1 and record.suffix == ".mcap":
        raise UsageError(
            f"{len(seeds)} seeds write one log each: choose a folder; {record} is a file name"
        )
    paths = {seed: record / f"seed-{seed}.mcap" for seed in seeds}
    if record.suffix == ".mcap":
        paths = {seeds[0]: record}
    taken = [path for path in paths.values() if path.exists()]
    if taken and not resume:
        raise OutputExistsError(f"{taken[0]} exists: choose another path to record to")
    return paths


def recorded(
    env: VectorEnv[Any, Any, Any], path: Path, *, algo: str, seed: int, episodes: int | None = None
) -> RecordVecMcap:
    """Wrap a batch of environments to record each step of training."""
    # An existing log keeps `episodes`, -1 for all; None makes a new log. An unfinished log is
    # recovered first. The files before the recovery and before the cut are kept beside the log.

    def wrap(append: bool) -> RecordVecMcap:
        return RecordVecMcap(env, path, policy=algo, policy_version=0, seed=seed, append=append)

    if episodes is None or not path.exists():
        return wrap(append=False)
    try:
        count = len(FinishedLog(path).lengths)
    except LogError:
        if not _recover(path):
            return wrap(append=False)
        count = len(FinishedLog(path).lengths)
    if 0 <= episodes < count:
        _cut(path, episodes)
    return wrap(append=path.exists())


def _recover(path: Path) -> bool:
    """Recover an unfinished log; return False if it has no whole episode, and is moved away."""
    whole, damaged = (path.with_name(f"{path.name}.{kind}") for kind in ("whole", "damaged"))
    try:
        recover_log(path, whole, overwrite=True)
    except (NoStepsError, NotMcapError):
        # The recorder was killed before its first episode ended.
        with path.open("rb") as file:
            if not MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC))):
                raise
        check_target(damaged, overwrite=True)
        os.replace(path, damaged)
        return False
    _keep(path, damaged)
    os.replace(whole, path)
    return True


def _cut(path: Path, episodes: int) -> None:
    """Remove the episodes after the first ones from a log."""
    uncut = path.with_name(f"{path.name}.uncut")
    _keep(path, uncut)
    if episodes:
        filter_log(f"episode < {episodes}", uncut, path, overwrite=True)
    else:
        path.unlink()


def _keep(path: Path, kept: Path) -> None:
    """Link or copy a file to a second path, so that the first path can be replaced atomically."""
    check_target(kept, overwrite=True)
    kept.unlink(missing_ok=True)
    try:
        os.link(path, kept)
    except OSError:
        # Some file systems do not support links.
        shutil.copyfile(path, kept)

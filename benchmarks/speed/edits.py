"""Time joining, filtering and splitting logs, compared with copying the same files."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import mcaprl
from benchmarks.measure import Side, Table, compare
from benchmarks.speed.workloads import vectors

_TRANSITIONS = 1_750_000
_COPY = "copy of the files"


def tables(folder: Path) -> list[Table]:
    """Compare the time of each command with that of copying the same files.

    The commands and the copies sync their output to disk.
    """
    log, parts, out = folder / "edited.mcap", folder / "parts", folder / "edits"
    vectors(_TRANSITIONS).save(log)
    episodes = len(mcaprl.open(log, columns=()).episodes)
    mcaprl.split(log, parts, episodes=episodes // 2)
    halves = sorted(parts.iterdir())
    size = f"{log.stat().st_size / 1e6:,.0f} MB"
    found = [
        _table(
            f"Joining two logs, {size}",
            out,
            halves,
            lambda: mcaprl.merge(halves, out / "log.mcap"),
        ),
        _table(
            f"Filtering a log, {size}: keep all episodes but one",
            out,
            [log],
            lambda: mcaprl.filter("episode != 700", log, out / "log.mcap"),
        ),
        _table(
            f"Splitting a log, {size}, into two",
            out,
            [log],
            lambda: mcaprl.split(log, out / "parts", episodes=episodes // 2),
        ),
    ]
    shutil.rmtree(parts)
    log.unlink()
    return found


def _table(title: str, out: Path, files: Sequence[Path], edit: Callable[[], object]) -> Table:
    def fresh(run: Callable[[], object]) -> Callable[[], object]:
        return lambda: (_empty(out), run())

    return compare(
        title,
        [Side("mcaprl", fresh(edit)), Side(_COPY, fresh(lambda: _copy(files, out)))],
        goal="at least half of the speed of a copy",
        clock=time.perf_counter,
        unit="time, ours = 1",
    )


def _empty(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()


def _copy(files: Sequence[Path], folder: Path) -> None:
    for file in files:
        target = folder / file.name
        shutil.copyfile(file, target)
        with target.open("rb+") as copied:
            os.fsync(copied.fileno())

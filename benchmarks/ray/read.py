"""Compare the read tasks of `mcaprl.ray.read` with those of `ray.data.read_mcap`.

    python -m benchmarks.ray.read

This process runs the tasks that Ray's workers would run, and measures the CPU time. The tasks of
`read_mcap` return the bytes of messages. The benchmark then decodes the bytes in the fastest
correct way, as one array of all messages, and compares the values with those of
`mcaprl.ray.read`.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mcaprl
import mcaprl.ray
from benchmarks.measure import OURS, Side, compare
from benchmarks.speed.workloads import ACTION, EPISODE_STEPS, OBSERVATION, vectors
from mcaprl.recorder import STEP_TOPIC, message_dtype, step_schema

# The tasks of read_mcap are timed on a part of the rows, and their time is scaled up.
TRANSITIONS, FEW = 400_000, 100_000
COLUMNS = ("observation", "action", "reward", "terminated", "truncated", "behavior_prob")
GOAL = "rows per CPU second at least 50 times those of read_mcap"


def main() -> None:
    """Print the ratios."""
    with tempfile.TemporaryDirectory() as folder:
        path, few = Path(folder) / "log.mcap", Path(folder) / "few.mcap"
        vectors(TRANSITIONS).save(path)
        vectors(FEW).save(few)
        # `_tasks` connects to a local cluster, which the data sources of Ray need.
        ours, whole = _tasks(path, COLUMNS), _tasks(path, None)
        _check(_decoded(few, include_metadata=False), few)
        compare(
            f"Read tasks of Ray Data: {TRANSITIONS:,} transitions of 19 float32",
            [
                Side(OURS, lambda: _run(ours, path)),
                Side("mcaprl, with next observations and times", lambda: _run(whole, path)),
                Side("mcaprl.open, without Ray", lambda: mcaprl.open(path)),
                Side("read_mcap, decoded", lambda: _decoded(few), FEW / TRANSITIONS),
                Side(
                    "read_mcap without metadata, decoded",
                    lambda: _decoded(few, include_metadata=False),
                    FEW / TRANSITIONS,
                ),
                Side(
                    "read_mcap without metadata, as bytes",
                    lambda: _bytes(few, include_metadata=False),
                    FEW / TRANSITIONS,
                ),
            ],
            goal=GOAL,
            rounds=3,
        )


def _tasks(path: Path, columns: Any) -> list[Any]:
    rows = mcaprl.ray.read(path, columns=columns)
    (source,) = rows._logical_plan.sources()
    tasks: list[Any] = source.datasource.get_read_tasks(-1)
    return tasks


def _run(tasks: list[Any], path: Path) -> None:
    # A worker keeps an unchanged log open between tasks. Here, each task opens the log again.
    os.utime(path)
    blocks = [block for task in tasks for block in task()]
    assert sum(map(len, blocks)) == TRANSITIONS


def _bytes(path: Path, **options: Any) -> list[Any]:
    from ray.data._internal.datasource.mcap_datasource import MCAPDatasource

    source = MCAPDatasource([os.fspath(path)], topics={STEP_TOPIC}, **options)
    blocks = [block for task in source.get_read_tasks(1) for block in task()]
    assert sum(map(len, blocks)) == FEW + FEW // EPISODE_STEPS
    return blocks


def _decoded(path: Path, **options: Any) -> dict[str, NDArray[Any]]:
    dtype = message_dtype(step_schema(OBSERVATION, ACTION)[1])
    found = []
    for block in _bytes(path, **options):
        data = b"".join(block["data"].to_pylist())
        rows = np.frombuffer(data, dtype)
        found.append(rows[rows["final"] == 0])
    rows = np.concatenate(found)
    return {name: np.ascontiguousarray(rows[name]) for name in COLUMNS}


def _check(theirs: dict[str, NDArray[Any]], path: Path) -> None:
    data = mcaprl.open(path)
    assert np.array_equal(theirs["observation"], data.observations)
    assert np.array_equal(theirs["action"].ravel(), data.actions)
    assert np.array_equal(theirs["reward"], data.rewards)


if __name__ == "__main__":
    main()

"""Compare the recording time of two Ray workers with that of two plain processes.

    python -m benchmarks.ray_record

Both record the same episodes. Wall time is measured, because several processes work; the start of
the Ray cluster is not included. On a busy machine, repeat the comparison.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import mcaprl
import mcaprl.ray
from benchmarks.measure import OURS, Side, compare

EPISODES, WORKERS, SHARDS = 100, 2, 8


def main() -> None:
    """Print the ratio."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # The first call starts a cluster, and later calls use the same cluster.
        _record(folder / "envs", envs=WORKERS)
        mcaprl.ray.read(folder / "envs")
        compare(
            f"Recording of {EPISODES} episodes of lane by {WORKERS} processors",
            [
                Side(OURS, lambda: _record(folder / "envs", envs=WORKERS)),
                Side(
                    "mcaprl on Ray",
                    lambda: _record(folder / "ray", ray=True, workers=WORKERS, shards=SHARDS),
                ),
            ],
            goal="at most 1.18 times the time of plain processes, an efficiency of .85",
            rounds=3,
            clock=time.perf_counter,
            unit="time, plain processes = 1",
        )


def _record(folder: Path, **options: Any) -> None:
    mcaprl.record("lane", folder, episodes=EPISODES, overwrite=True, **options)


if __name__ == "__main__":
    main()

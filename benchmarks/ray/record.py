"""Compare the recording time of two Ray workers with that of two plain processes.

    python -m benchmarks.ray.record

Both record the same episodes. CPU time counts all processes: ours, the workers and, for Ray, those
of the cluster. Wall time is meaningful only on an idle machine. The start of the Ray cluster is not
included, but the start of the workers and of the plain processes is.
"""

from __future__ import annotations

import os
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import mcaprl
import mcaprl.ray
from benchmarks.measure import Table

EPISODES, WORKERS, SHARDS, ROUNDS = 100, 2, 8, 2
PLAIN = "plain processes"
GOAL = "at most 1.18 times the time of plain processes, an efficiency of .85"


def main() -> None:
    """Print the ratios between the best times of both sides in several turns."""
    best: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # The first call starts a cluster, which later calls use.
        _record(folder / "envs", envs=WORKERS)
        mcaprl.ray.read(folder / "envs")
        sides: dict[str, dict[str, Any]] = {
            PLAIN: {"envs": WORKERS},
            "Ray workers": {"ray": True, "workers": WORKERS, "shards": SHARDS},
        }
        for _ in range(ROUNDS):
            for side, options in sides.items():
                cpu_s, wall_s = _cpu_s(), time.perf_counter()
                _record(folder / side, **options)
                taken = _cpu_s() - cpu_s, time.perf_counter() - wall_s
                best[side] = [min(pair) for pair in zip(taken, best.get(side, taken), strict=True)]
    for k, unit in enumerate(("CPU time", "wall time")):
        ratios = {side: times[k] / best[PLAIN][k] for side, times in best.items()}
        title = f"Recording of {EPISODES} episodes of lane by {WORKERS} processors"
        print(Table(title, ratios, goal=GOAL, unit=f"{unit}, plain processes = 1").to_markdown())


def _record(folder: Path, **options: Any) -> None:
    mcaprl.record("lane", folder, episodes=EPISODES, overwrite=True, **options)


def _cpu_s() -> float:
    """Return the CPU time of this process and its descendants, including those that have ended."""
    total, found = 0, [os.getpid()]
    while found:
        process = Path(f"/proc/{found.pop()}")
        # A process may end meanwhile.
        with suppress(OSError):
            # utime, stime, cutime and cstime follow the name in parentheses; see proc(5).
            fields = (process / "stat").read_text().rpartition(")")[2].split()
            total += sum(map(int, fields[11:15]))
            for task in (process / "task").iterdir():
                found += map(int, (task / "children").read_text().split())
    return total / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()

"""Measure how time and memory grow with the size of a log; each size has its own process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from benchmarks.measure import Table
from benchmarks.speed.workloads import vectors

_READ = """
import json, sys, time, tracemalloc
import mcaprl
path, best = sys.argv[1], {}
tasks = {
    "seconds": lambda: mcaprl.open(path),
    "check": lambda: mcaprl.check(path),
    "recover": lambda: mcaprl.recover(path, path + ".recovered.mcap", overwrite=True),
}
assert mcaprl.check(path).ok
for _ in range(5):
    for name, run in tasks.items():
        start = time.process_time()
        run()
        best[name] = min(best.get(name, float("inf")), time.process_time() - start)
tracemalloc.start()
data = mcaprl.open(path)
kept, peak = tracemalloc.get_traced_memory()
print(json.dumps({**best, "kept": kept, "peak": peak}))
"""


def tables(folder: Path, sizes: tuple[int, ...]) -> list[Table]:
    """Measure the time and memory to read, check and recover logs with these numbers of steps."""
    found = {}
    for size in sizes:
        path = folder / "growth.mcap"
        vectors(size).save(path, overwrite=True)
        command = [sys.executable, "-c", _READ, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        found[size] = json.loads(done.stdout)
        found[size]["bytes"] = path.stat().st_size
        path.unlink()
        path.with_name(f"{path.name}.recovered.mcap").unlink()
    per_step = {size: row["seconds"] / size for size, row in found.items()}
    middle = per_step[sizes[len(sizes) // 2]]
    time = Table(
        "Reading logs of several sizes",
        {f"{size:,} transitions": per_step[size] / middle for size in sizes},
        goal="linear: the same time per transition at each size",
        unit=f"CPU time per transition, {sizes[len(sizes) // 2]:,} transitions = 1",
    )
    memory = Table(
        "Memory while reading logs of several sizes",
        {f"{size:,} transitions": found[size]["peak"] / found[size]["kept"] for size in sizes},
        goal="the dataset and a few chunks",
        unit="peak memory, the finished dataset = 1",
    )
    checking = Table(
        "Checking logs of several sizes",
        {_size(size, row): row["check"] / row["seconds"] for size, row in found.items()},
        goal="a check of more than a gigabyte takes as long as reading",
        unit="CPU time, reading the same log = 1",
    )
    recovering = Table(
        "Recovering logs of several sizes",
        {_size(size, row): row["recover"] / row["seconds"] for size, row in found.items()},
        goal="linear, like reading: recovery reads, compresses and checks",
        unit="CPU time, reading the same log = 1",
    )
    every = [time, checking, recovering, memory]
    for table in every:
        print(table.to_markdown(), flush=True)
    return every


def _size(transitions: int, row: dict[str, float]) -> str:
    return f"{transitions:,} transitions, {row['bytes'] / 1e6:,.0f} MB"

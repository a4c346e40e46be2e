"""How time and memory grow with the log: each size is read in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from benchmarks.measure import Table
from benchmarks.workloads import vectors

_READ = """
import json, sys, time, tracemalloc
import mcaprl
path, best = sys.argv[1], float("inf")
mcaprl.open(path, episodes=0)
for _ in range(3):
    start = time.process_time()
    mcaprl.open(path)
    best = min(best, time.process_time() - start)
from mcaprl.recorder.check import check_log
start = time.process_time()
assert check_log(path) == []
check = time.process_time() - start
from mcaprl.recorder.recover import recover_log
start = time.process_time()
recover_log(path, path + ".recovered.mcap")
recover = time.process_time() - start
tracemalloc.start()
data = mcaprl.open(path)
kept, peak = tracemalloc.get_traced_memory()
told = {"seconds": best, "check": check, "recover": recover, "kept": kept, "peak": peak}
print(json.dumps(told))
"""


def tables(folder: Path, sizes: tuple[int, ...]) -> list[Table]:
    """Read logs of several sizes, and tell what a transition costs in each."""
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
    per_step = {size: told["seconds"] / size for size, told in found.items()}
    middle = per_step[sizes[len(sizes) // 2]]
    time = Table(
        "Reading logs of several sizes",
        {f"{size:,} transitions": per_step[size] / middle for size in sizes},
        goal="linear: a transition costs the same in each",
        unit=f"CPU time per transition, of {sizes[len(sizes) // 2]:,} = 1",
    )
    memory = Table(
        "Memory while reading them",
        {f"{size:,} transitions": found[size]["peak"] / found[size]["kept"] for size in sizes},
        goal="the dataset and a few chunks",
        unit="peak of memory while reading, the finished dataset = 1",
    )
    checking = Table(
        "Checking them",
        {_size(size, told): told["check"] / told["seconds"] for size, told in found.items()},
        goal="a check of a good gigabyte runs at reading speed",
        unit="CPU time, reading the same log = 1",
    )
    recovering = Table(
        "Recovering them",
        {_size(size, told): told["recover"] / told["seconds"] for size, told in found.items()},
        goal="linear, as reading is: what is recovered is read, packed and checked",
        unit="CPU time, reading the same log = 1",
    )
    every = [time, checking, recovering, memory]
    for table in every:
        print(table.to_markdown(), flush=True)
    return every


def _size(transitions: int, told: dict[str, float]) -> str:
    return f"{transitions:,} transitions, {told['bytes'] / 1e6:,.0f} MB"

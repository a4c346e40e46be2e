"""Measure the way from a log to a policy for logs of several sizes, also larger than the memory.

    python -m benchmarks.speed.whole_way FOLDER [--largest 100000000] [--larger-than-memory]

A log of 1,000,000 transitions of the lane sim is recorded; larger sizes are folders of its copies.
For each size, a new process opens the logs and trains with CQL. `--larger-than-memory` also trains
on images that take 1.2 times the free memory, and on a small log of images. FOLDER needs as much
space on the disk.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path

import mcaprl
from benchmarks.measure import Table
from benchmarks.speed.workloads import IMAGE_STEPS, images

RECORDED = 1_000_000
LARGER = 1.2
"""Size of the images, as a multiple of the free memory."""
_LEARN = """
import json, sys, threading, time, warnings
from pathlib import Path
import torch
import mcaprl
from mcaprl.offline import CQLConfig, train

torch.set_num_threads(1)
# `train` warns that 2,000 updates are too few to learn.
warnings.simplefilter("ignore")
path, out, storage, settings = sys.argv[1], Path(sys.argv[2]), sys.argv[3], json.loads(sys.argv[4])
peak = 0

def memory():
    # Mapped pages of files do not count, because the system can take them back.
    status = Path("/proc/self/status").read_text()
    return int(status.split("RssAnon:")[1].split()[0]) * 1024

def watch():
    global peak
    while True:
        peak = max(peak, memory())
        time.sleep(0.01)

times = []
report = lambda now: times.append(time.perf_counter())
config = CQLConfig(log_interval=50, held_out=0.0, **settings)
threading.Thread(target=watch, daemon=True).start()
before, begin = memory(), time.perf_counter()
data = mcaprl.open(path, images=storage)
opened = time.perf_counter()
train(data, config, out, progress=report)
rate = (len(times) - 1) * 50 / (times[-1] - times[0])
print(json.dumps({
    "opening": opened - begin, "start": times[0] - 50 / rate - opened, "updates_s": rate,
    "peak": peak - before,
}))
"""


def learn(path: Path, folder: Path, storage: str = "auto", **settings: object) -> dict[str, float]:
    """Train on logs in a new process, and return its times in s, rate and peak memory in bytes."""
    out = folder / "run"
    arguments = [str(path), str(out), storage, json.dumps(settings)]
    done = subprocess.run(
        [sys.executable, "-c", _LEARN, *arguments], stdout=subprocess.PIPE, check=True
    )
    shutil.rmtree(out)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def copies(path: Path, count: int, folder: Path) -> Path:
    """Fill a folder with copies of a log. `mcaprl.open` reads it like one long log."""
    folder.mkdir()
    for k in range(count):
        shutil.copyfile(path, folder / f"{k:04}.mcap")
    return folder


def vector_tables(folder: Path, largest: int) -> list[Table]:
    """Measure logs of vectors, from 1,000,000 transitions to `largest` in powers of ten."""
    path = folder / "recorded.mcap"
    mcaprl.record("lane", path, epsilon=0.2, steps=RECORDED, scene=False)
    found, size = dict[int, dict[str, float]](), RECORDED
    while size <= largest:
        logs = copies(path, size // RECORDED, folder / "logs")
        found[size] = learn(logs, folder, updates=2_000)
        shutil.rmtree(logs)
        size *= 10
    path.unlink()
    first = found[RECORDED]
    titles = {"opening": "Opening logs", "start": "Time before the first update of CQL on logs"}
    tables = [
        Table(
            f"{title} of several sizes",
            {
                f"{size:,} transitions": row[part] / size / first[part] * RECORDED
                for size, row in found.items()
            },
            unit=f"time per transition, {RECORDED:,} transitions = 1",
        )
        for part, title in titles.items()
    ]
    tables.append(
        Table(
            "Training with CQL on logs of several sizes",
            {
                f"{size:,} transitions": first["updates_s"] / row["updates_s"]
                for size, row in found.items()
            },
            unit=f"time of an update, {RECORDED:,} transitions = 1",
        )
    )
    tables.append(
        Table(
            "Memory from a log to a policy at several sizes",
            {f"{size:,} transitions": row["peak"] / size for size, row in found.items()},
            unit="peak bytes per transition, whose observation has 48 bytes",
        )
    )
    return tables


def image_table(folder: Path) -> Table:
    """Compare a log of images that is larger than the free memory with one in memory."""
    path = folder / "images.mcap"
    images(IMAGE_STEPS).save(path, compression="none")
    lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    free = int(lines["MemAvailable"].split()[0]) * 1024
    large = copies(path, int(LARGER * free / path.stat().st_size) + 1, folder / "large")
    settings = {"updates": 500, "batch_size": 64}
    found = {
        "images in memory": learn(path, folder, "memory", **settings),
        "images on disk": learn(path, folder, "mapped", **settings),
        f"images on disk, {LARGER} times the free memory": learn(
            large, folder, "mapped", **settings
        ),
    }
    path.unlink()
    shutil.rmtree(large)
    first = found["images in memory"]
    return Table(
        "Training with CQL on images",
        {name: first["updates_s"] / row["updates_s"] for name, row in found.items()},
        goal="an update on a log larger than the memory takes at most twice the time",
        unit="time of an update, images in memory = 1",
    )


def main() -> None:
    """Measure the requested sizes, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder for the logs, which are deleted")
    parser.add_argument(
        "--largest", type=int, default=10 * RECORDED, help="transitions of the largest logs"
    )
    parser.add_argument(
        "--larger-than-memory", action="store_true", help="also train on images on disk"
    )
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    tables = vector_tables(given.folder, given.largest)
    if given.larger_than_memory:
        tables.append(image_table(given.folder))
    print("\n".join(table.to_markdown() for table in tables))


if __name__ == "__main__":
    main()

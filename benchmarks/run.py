"""Run the benchmarks, and write results.json and docs/speed.md: `make bench`."""

from __future__ import annotations

import argparse
import json
import platform
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from benchmarks.measure import Table
from benchmarks.speed import bags, camera, edits, formats, growth, logs, sims, video
from benchmarks.speed.workloads import IMAGE_STEPS
from mcaprl.files import write_json

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results.json"
PARTS = ["logs", "bags", "camera", "edits", "formats", "growth", "sims", "video"]
LIBRARIES = (
    "numpy",
    "zstandard",
    "mcap",
    "mcap-ros2-support",
    "foxglove-sdk",
    "rosbags",
    "rerun-sdk",
    "pillow",
    "minari",
    "h5py",
    "pyarrow",
    "highway-env",
    "av",
    "mcap-frames",
    "torchcodec",
)
_PAGE = """\
# Speed

`make bench` measures these tables and writes this page. All sides of a table run in one process,
in turns, on the same data, in one thread. The measure is CPU time, the best of several turns.
Seconds depend on the machine, so the tables contain ratios only. Each table includes lower
limits: a copy in memory; plain decompression of the same chunks by zstd, each into the buffer of
the previous chunk; and the minimum of any reader, which maps the file, decompresses it and checks
the CRCs. A reader also copies the columns into new memory; the rows `memcpy of ...`
measure this copy.

The ratios depend on the machine, too. The tables of logs and bags are from a machine with slow
memory. In three runs on it, rerun's reader took 5.1 to 5.6 times our time for the log of vectors.
On a faster machine, foxglove-sdk took 5.2 times our time for writing, and 1.8 times for recording.

foxglove-sdk writes files and does not read them.

Videos: a mapping decodes with PyAV, too, but converts frames with one converter for all; PyAV's
users call the methods of each frame. Of the rest of our time, most is reading the messages and
finding lost packets. rerun 0.41 and Daft 0.7.26 read the packets of a video topic in Python, and do
not decode them. The decoder of LeRobot's datasets is torchcodec, which reads MP4 files, not MCAP.

A missed goal stays in its table. What limits us, as far as these tables and profiles show it:

- Writing beside foxglove-sdk: compression takes 72 % of our time, and a copy of the records takes a
  fifth. A writer that did nothing else would be 4.3 times as fast as foxglove-sdk. The rest of our
  time is the CRCs and the system calls that write the file.
- Logs of images: the minimum of any reader and the copy of the images into new memory take three
  quarters of our time or more, and plain zstd 55 to 64 % (three runs). A reader that did nothing
  else would reach 72 to 76 %. Chunks of 200 images instead of 100 would save 7 % of the time, but a
  viewer that shows one image would decompress twice as much.
- Logs of other writers: a reader that only decompresses the chunks, checks their CRCs and copies
  the fields by the same compiled code reaches .72 to .75 of plain zstd's speed (in three runs, in
  which ours reached .61 to .64). The goal leaves 2 to 6 % of the time to find the order of the
  records and the ends of the episodes, among others; ours takes 13 to 18 %.
- A single episode: decompressing its chunk is an eighth of the time. The rest is Python code that
  finds out what the log contains and where, in many short functions. A script that knows all of
  this, and only finds the chunk, decompresses, checks and copies it, takes a fifth of the time.
  Parsing the metadata, the schemas and the channels takes an eighth. Together, this is the goal,
  and leaves nothing for finding and validating the episode, and for the objects of the dataset. In
  three runs, Minari's HDF5 took .99 to 1.08 times our time for one of 1,000 episodes.
- Two threads: a seventh of our time is spent in one thread, on the file's index, the order of the
  records and the ends of the episodes. A quarter is the copy, which takes up to 1.5 times as long
  if two threads write to new memory at the same time. Both together limit two threads to 1.6 times
  the speed of one.
- Recording one environment: assigning the values to NumPy arrays, without writing them, takes 47 to
  54 % of our time (nine runs), and compression a tenth. The rest is the messages, CRCs and indexes
  at the end of an episode. In two runs, a recorder that checks no types, shapes and states took
  75 % of our time, which is just enough to be twice as fast as foxglove-sdk.
- Recording 256 environments: the rows `least work of a recorder` only keep the arrays of each step,
  and copy, compress and write the records of the episodes that ended in it. In three runs, this
  alone added 8 to 12 % to CartPole, 4 to 6 % to random actions in the powerline sim, and twice the
  time of stepping to the lane sim. In short episodes, merging the chunks would add 3 to 5 %. Where
  episodes are long, as in Pendulum and in the powerline sim without changes, the least work leaves
  up to 4 % of the time of stepping for everything else. In the medians of 8 to 14 pairs of runs,
  recording added 3 to 7 % to Pendulum, and 5 to 7 % to the powerline sim. In short episodes, most
  steps write a chunk of messages and a chunk of records. In a profile of CartPole, we spend a
  quarter of the time that we add on compressing, indexing and writing chunks, a fifth on encoding
  five messages for each episode, a seventh on merging the chunks, and an eighth on copying rows.
- A batch of 1,024 cars: three fifths of the time is the compiled step. Nearly half of that is the
  motion, which has a division and three square roots in each of five substeps. The infos take a
  seventh, a third of it the array of reasons, and starting the cars whose episodes ended a ninth.
  The rest are about 20 calls of NumPy on arrays of 1,024 values.
- Depth images: drawing takes half of the time, downsampling two fifths, and encoding a twelfth.
  Drawing is limited by its short rows of pixels, 15 in the median; sums over columns are near the
  throughput of scalar instructions.

```sh
make bench
```

"""


def main() -> None:
    """Run the requested benchmarks, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--transitions", type=int, default=1_000_000, help="size of the vector log")
    parser.add_argument("--largest", type=int, default=10_000_000, help="size of the largest log")
    parser.add_argument(
        "--only", choices=PARTS, nargs="+", default=PARTS, help="parts to run; the others are kept"
    )
    arguments = parser.parse_args()
    sizes = tuple(size for size in (10**4, 10**5, 10**6, 10**7) if size <= arguments.largest)
    tables = {} if arguments.only == PARTS else _last_tables()
    with tempfile.TemporaryDirectory() as name:
        folder, found = Path(name), []
        if "logs" in arguments.only:
            found += logs.tables(folder, arguments.transitions)
        if "bags" in arguments.only:
            found += bags.tables(folder)
        if "camera" in arguments.only:
            found += camera.tables(folder)
        if "edits" in arguments.only:
            found += edits.tables(folder)
        if "formats" in arguments.only:
            found += formats.tables(folder)
        if "growth" in arguments.only:
            found += growth.tables(folder, sizes)
        if "sims" in arguments.only:
            found += sims.tables()
        if "video" in arguments.only:
            found += video.tables(folder)
    tables |= {table.title: table for table in found}
    write_results(list(tables.values()), arguments.transitions)


def _last_tables() -> dict[str, Table]:
    """Return the tables of the last run, by title."""
    results = json.loads(RESULTS.read_text())
    return {table["title"]: Table(**table) for table in results["tables"]}


def write_results(tables: list[Table], transitions: int) -> None:
    """Write results.json and docs/speed.md."""
    results = {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "transitions": transitions,
        "versions": {name: _version(name) for name in LIBRARIES},
        "tables": [table.to_json() for table in tables],
    }
    write_json(RESULTS, results)
    versions = ", ".join(f"{name} {_version(name)}" for name in LIBRARIES)
    about = (
        f"The log of vectors has {transitions:,} transitions of 19 float32 in episodes of 1,000;"
        f" that of images {IMAGE_STEPS:,} of 84x84. Python {platform.python_version()},"
        f" {versions}.\n\n"
    )
    page = _PAGE + about + "\n".join(table.to_markdown() for table in tables)
    (ROOT / "docs" / "speed.md").write_text(page)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "(not installed)"


if __name__ == "__main__":
    main()

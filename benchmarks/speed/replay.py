"""Measure the chunks and indexes of long logs, and the memory that our player needs for a seek.

    python benchmarks/speed/replay.py

Creates two logs in a temporary folder: one of a million steps without a scene, and one of an hour
of the lane sim with a scene.
"""

from __future__ import annotations

import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np

import mcaprl
from mcaprl.recorder import McapReader, Player, Track
from mcaprl.sims import make_pilot, make_sim

STEPS, EPISODE = 1_000_000, 1_000
HOUR_S, STEPS_PER_S = 3600, 4
JUMPS = 20


def main() -> None:
    """Create the logs, seek in each, and print a table."""
    print("| log | steps | MB | chunks | largest chunk, MB | index, MB | memory for a seek, MB |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, make in (("a million steps", _million), ("an hour with scene", _hour)):
            path = Path(folder) / "log.mcap"
            path.unlink(missing_ok=True)
            steps = make(path)
            # Measure each row in a separate process, because creating the log also takes memory.
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                print(f"| {name} | {steps} | {pool.submit(_row, path).result()} |", flush=True)


def _million(path: Path) -> int:
    random = np.random.default_rng(0)
    frames = random.standard_normal((STEPS + 1, 12), np.float32)
    ends = np.arange(1, STEPS + 1) % EPISODE == 0
    mcaprl.Dataset.from_arrays(
        observations=frames[:-1],
        actions=random.integers(6, size=STEPS),
        rewards=random.standard_normal(STEPS),
        terminated=ends,
        truncated=np.zeros(STEPS, bool),
        next_observations=frames[1:],
    ).save(path)
    return STEPS


def _hour(path: Path) -> int:
    env = make_sim("lane")
    pilot, steps = make_pilot(env), 0
    with closing(mcaprl.RecordMcap(env, path)) as recorder:
        while steps < HOUR_S * STEPS_PER_S:
            observation, _ = recorder.reset(seed=steps)
            over = False
            while not over:
                step = recorder.step(pilot.act(observation[None])[0])
                observation, over = step[0], step[2] or step[3]
                steps += 1
    return steps


def _row(path: Path) -> str:
    before = _peak_mb()
    reader = McapReader(path)
    player = Player([Track(reader)])
    random = np.random.default_rng(1)
    for share in random.random(JUMPS):
        player.seek(player.start_ns + int(share * (player.end_ns - player.start_ns)))
        player.current_messages()
        player.playing = True
        player.advance(1.0)
    largest = max(chunk.uncompressed_size for chunk in reader.chunks)
    index = sum(chunk.message_index_length for chunk in reader.chunks)
    numbers = [path.stat().st_size / 2**20, largest / 2**20, index / 2**20, _peak_mb() - before]
    size, chunk, indexes, memory = (f"{number:.1f}" for number in numbers)
    return f"{size} | {len(reader.chunks)} | {chunk} | {indexes} | {memory}"


def _peak_mb() -> float:
    # Do not use ru_maxrss, which a child process inherits from its parent.
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


if __name__ == "__main__":
    main()

"""Measure reading short episodes, single episodes, logs of other writers, and image logs."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

import mcaprl
from benchmarks.measure import OURS, SLOW_SHARE, SLOWEST_SHARE, Side, Table, after, compare
from benchmarks.speed import limits, rivals
from benchmarks.speed.limits import LEAST_WORK, PLAIN
from benchmarks.speed.workloads import (
    EPISODE_STEPS,
    IMAGE_STEPS,
    Constant,
    images,
    run_env,
    vectors,
)
from mcaprl.recorder import STEP_TOPIC, message_dtype

DEPTH = rivals.DEPTH


def tables(
    folder: Path, log: Path, data: mcaprl.Dataset, minari: rivals.MinariFolder
) -> list[Table]:
    """Return all tables.

    The benchmarks write their files to `folder`. `log` is a log of the transitions in `data`.
    """
    return [
        _short_episodes(folder),
        _episode(folder, log, data, minari),
        _interleaved(folder, data),
        *_images(folder, minari),
    ]


def _short_episodes(folder: Path) -> Table:
    """Measure reading a recording in which each episode has its own chunk of `/rl/step`."""
    path, steps = folder / "short.mcap", 20
    run_env(mcaprl.RecordMcap(Constant(steps), path), 1000, steps)
    return compare(
        f"Reading a recording of 1,000 episodes of {steps} steps",
        [
            Side(OURS, lambda: mcaprl.open(path)),
            Side(PLAIN, limits.plain(path)),
            Side("checking it", lambda: mcaprl.check(path)),
            Side("mcap + mcap-ros2-support", lambda: rivals.read_mcap(path)),
        ],
    )


def _episode(folder: Path, log: Path, data: mcaprl.Dataset, minari: rivals.MinariFolder) -> Table:
    """Measure reading one episode. Other readers select it by time, by row or by number."""
    episodes = mcaprl.open(log, columns=[]).episodes
    number = len(episodes) // 2
    start, stop = (int(episodes[number].log_time_ns[row]) for row in (0, -1))
    rows = slice(number * EPISODE_STEPS, (number + 1) * EPISODE_STEPS)
    table, part = folder / "table.h5", vectors(int(len(data) * SLOW_SHARE))
    fewer = folder / "fewer.mcap"
    part.save(fewer)
    one, times = data.episodes[number].observations, {"start_ns": start, "stop_ns": stop}
    return compare(
        f"Reading one episode of {len(episodes)}",
        [
            Side(OURS, lambda: mcaprl.open(log, episodes=number)),
            Side("plain zstd of the episode's chunks", limits.plain(log, **times)),
            Side(f"{LEAST_WORK}, the episode's chunks", limits.least(log, **times)),
            Side("memcpy of the episode's observations", lambda: [one.copy()]),
            Side(
                "mcap + mcap-ros2-support, by time",
                lambda: rivals.read_mcap(log, span_ns=(start, stop + 1)),
            ),
            Side("rosbags, by time", lambda: rivals.read_rosbags(log, span_ns=(start, stop + 1))),
            Side("h5py, gzip 1, by rows", lambda: rivals.read_h5py(table, rows)),
            Side(
                f"{OURS}, one of {len(part.episodes)} episodes",
                lambda: mcaprl.open(fewer, episodes=len(part.episodes) // 2),
            ),
            *(
                Side(
                    f"Minari, {kind}, one of {len(part.episodes)} episodes",
                    partial(minari.read, minari.name(part, kind), [len(part.episodes) // 2]),
                )
                for kind in ("hdf5", "arrow")
            ),
        ],
        goal="40 times mcap's reader",
        rounds=20,
    )


def _interleaved(folder: Path, data: mcaprl.Dataset) -> Table:
    path, small = folder / "interleaved.mcap", folder / "small-interleaved.mcap"
    encoded = _with_episodes(rivals.messages(data))
    rivals.write_interleaved(encoded, path)
    rivals.write_interleaved(encoded[: int(len(encoded) * SLOWEST_SHARE)], small)
    del encoded
    columns = rivals.columns_of(mcaprl.open(path))
    return compare(
        "Reading another writer's log, topics interleaved",
        [
            Side(OURS, lambda: mcaprl.open(path)),
            Side(PLAIN, limits.plain(path)),
            Side(LEAST_WORK, limits.least(path)),
            Side("memcpy of the columns", lambda: [c.copy() for c in columns.values()]),
            Side("checking it", lambda: mcaprl.check(path)),
            Side("mcap + mcap-ros2-support", lambda: rivals.read_mcap(small), SLOWEST_SHARE),
            Side("rosbags", lambda: rivals.read_rosbags(small), SLOWEST_SHARE),
        ],
        goal="70 % of plain zstd's speed",
        rounds=8,
    )


def _images(folder: Path, minari: rivals.MinariFolder) -> list[Table]:
    packed, plain, small = (folder / f"{name}.mcap" for name in ("images", "plain", "few-images"))
    hdf5, npz = folder / "images.h5", folder / "images.npz"
    data, part = images(IMAGE_STEPS), images(int(IMAGE_STEPS * SLOW_SHARE))
    depth = data.observations["depth"]
    data.save(packed)
    data.save(plain, compression="none")
    part.save(small)
    others = [
        Side(name, after(partial(write, part, path), partial(read, path)), SLOW_SHARE)
        for name, write, read, path in (
            ("h5py, gzip 1", rivals.write_h5py, rivals.read_h5py, hdf5),
            ("npz, compressed", rivals.write_npz, rivals.read_npz, npz),
        )
    ]
    others += [
        Side(
            f"Minari, {kind}",
            after(partial(minari.write, part, kind), partial(minari.read, minari.name(part, kind))),
            SLOW_SHARE,
        )
        for kind in ("hdf5", "arrow")
    ]
    reading = compare(
        "Reading a log of images and vectors into memory",
        [
            Side(OURS, lambda: mcaprl.open(packed, images="memory")),
            Side(PLAIN, limits.plain(packed, STEP_TOPIC, DEPTH)),
            Side(LEAST_WORK, limits.least(packed, STEP_TOPIC, DEPTH)),
            Side("memcpy of the images", lambda: [depth.copy()]),
            Side(f"{OURS}, vectors alone", lambda: mcaprl.open(packed, columns=["state"])),
            Side(
                "mcap + mcap-ros2-support",
                lambda: rivals.read_mcap(small, rivals.IMAGE_FIELDS),
                SLOW_SHARE,
            ),
            Side("rosbags", lambda: rivals.read_rosbags(small, rivals.IMAGE_FIELDS), SLOW_SHARE),
            *others,
        ],
        goal="85 % of plain zstd's speed; vectors alone 30 times cheaper",
        rounds=8,
    )
    memory = mcaprl.open(packed, images="memory", columns=["depth"])
    mapped = mcaprl.open(plain, images="mapped", columns=["depth"])
    batches = np.random.default_rng(0).integers(len(data), size=(200, 256))
    frames = memory.observations["depth"]
    drawing = compare(
        "Random batches of 256 transitions with images, warm",
        [
            Side(f"{OURS}, on disk", lambda: [mapped.batch(rows) for rows in batches]),
            Side(f"{OURS}, in memory", lambda: [memory.batch(rows) for rows in batches]),
            Side("NumPy, one array in memory", lambda: [(frames[r], frames[r]) for r in batches]),
        ],
        goal="300,000 transitions per second on disk; NumPy's speed is the limit",
        ours=f"{OURS}, on disk",
    )
    return [reading, drawing]


def _with_episodes(encoded: list[bytes]) -> list[bytes]:
    """Set the episode and step in prebuilt messages, so that they form complete episodes."""
    dtype = message_dtype(rivals.TEXT)
    assert dtype is not None
    rows = np.frombuffer(b"".join(encoded), dtype).copy()
    number = np.arange(len(rows))
    rows["episode"], rows["step"] = np.divmod(number, EPISODE_STEPS + 1)
    rows["final"] = rows["step"] == EPISODE_STEPS
    size, buffer = (
        rows.itemsize,
        rows[: len(rows) // (EPISODE_STEPS + 1) * (EPISODE_STEPS + 1)].tobytes(),
    )
    return [buffer[start : start + size] for start in range(0, len(buffer), size)]

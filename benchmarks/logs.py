"""Recording, writing and reading logs."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import mcaprl
from benchmarks import rivals
from benchmarks.measure import OURS, Side, Table, compare
from benchmarks.workloads import EPISODE_STEPS, Constant, images, run_env, vectors
from mcaprl.recorder.check import check_log
from mcaprl.recorder.log_writer import STEP_TOPIC
from mcaprl.recorder.recover import recover_log
from mcaprl.recorder.schema import message_dtype

# Sides that go message by message do this share of it, and are scaled up: a turn of each takes some
# tenths of a second, so that all have many, and a disturbance spoils but one.
SLOW_SHARE = 0.1
SLOWEST_SHARE = 0.01
IMAGE_STEPS = 20_000
PLAIN = "plain zstd of the same chunks"
LEAST_WORK = "likewise from the file into new memory, CRCs checked"
DEPTH = "/rl/observation/depth"


def tables(folder: Path, transitions: int) -> list[Table]:
    """Measure everything about logs, with files in `folder`."""
    data = vectors(transitions)
    part = vectors(int(transitions * SLOW_SHARE))
    encoded = rivals.messages(part)
    minari = rivals.MinariFolder(folder / "minari")
    log = folder / "log.mcap"
    data.save(log)
    return [
        _recording(folder, encoded, minari),
        _writing(folder, log, data, part, encoded, minari),
        _reading(folder, log, data, part, minari),
        _space(folder, log, data),
        _threads(log),
        _short_episodes(folder),
        _episode(log),
        _interleaved(folder, data),
        *_images(folder),
        _checking(folder, log),
    ]


def _recording(folder: Path, encoded: list[bytes], minari: rivals.MinariFolder) -> Table:
    episodes, bare = 100, "the environment alone"
    messages = (encoded * (1 + episodes * EPISODE_STEPS // len(encoded)))[
        : episodes * EPISODE_STEPS
    ]
    scratch = folder / "recorded.mcap"

    def record() -> None:
        run_env(mcaprl.RecordMcap(Constant(), scratch, overwrite=True), episodes)

    table = compare(
        "Recording: CPU time that is added to each step of an environment",
        [
            Side(bare, lambda: rivals.record_bare(episodes)),
            Side(OURS, record, floor=bare),
            Side(
                "mcap's Writer, messages ready-made", lambda: rivals.write_mcap(messages, scratch)
            ),
            Side(
                "foxglove-sdk, messages ready-made",
                lambda: rivals.write_foxglove(messages, scratch),
            ),
            Side(
                "rosbags' Writer, messages ready-made",
                lambda: rivals.write_rosbags(messages, folder / "bag"),
            ),
            Side(
                "Minari's DataCollector, HDF5",
                lambda: minari.record(10, "hdf5"),
                share=10 / episodes,
                floor=bare,
            ),
            Side(
                "Minari's DataCollector, Arrow",
                lambda: minari.record(10, "arrow"),
                share=10 / episodes,
                floor=bare,
            ),
        ],
        goal="4 times less than mcap's Writer, 2 than foxglove-sdk, 15 than Minari's DataCollector",
        rounds=12,
    )
    table.ratios.pop(bare)
    return table


def _writing(
    folder: Path,
    log: Path,
    data: mcaprl.Dataset,
    part: mcaprl.Dataset,
    encoded: list[bytes],
    minari: rivals.MinariFolder,
) -> Table:
    scratch = folder / "written"
    chunks = rivals.raw_chunks(log, STEP_TOPIC)
    return compare(
        "Writing transitions that are in memory",
        [
            Side(OURS, lambda: data.save(folder / "written.mcap", overwrite=True)),
            Side("plain zstd 1 of the same chunks", lambda: rivals.level_1_chunks(chunks)),
            Side("memcpy of the same chunks", lambda: [bytearray(chunk) for chunk in chunks]),
            Side(
                "mcap's Writer, messages ready-made",
                lambda: rivals.write_mcap(encoded, scratch),
                SLOW_SHARE,
            ),
            Side(
                "foxglove-sdk, messages ready-made",
                lambda: rivals.write_foxglove(encoded, scratch),
                SLOW_SHARE,
            ),
            Side(
                "rosbags' Writer, messages ready-made",
                lambda: rivals.write_rosbags(encoded, folder / "bag"),
                SLOW_SHARE,
            ),
            Side("Minari, HDF5", lambda: minari.write(part, "hdf5"), SLOW_SHARE),
            Side("Minari, Arrow", lambda: minari.write(part, "arrow"), SLOW_SHARE),
            Side("h5py, gzip 1", lambda: rivals.write_h5py(part, scratch), SLOW_SHARE),
            Side("Parquet, zstd 1", lambda: rivals.write_parquet(data, scratch)),
            Side(
                "npz, compressed",
                lambda: rivals.write_npz(part, folder / "written.npz"),
                SLOW_SHARE,
            ),
        ],
        goal="10 times mcap's Writer, 5 times foxglove-sdk",
        rounds=16,
    )


def _reading(
    folder: Path,
    log: Path,
    data: mcaprl.Dataset,
    part: mcaprl.Dataset,
    minari: rivals.MinariFolder,
) -> Table:
    small = folder / "small.mcap"
    vectors(int(len(data) * SLOWEST_SHARE)).save(small)
    hdf5, parquet, npz = folder / "table.h5", folder / "table.parquet", folder / "table.npz"
    sides = [
        Side(OURS, lambda: mcaprl.open(log)),
        Side(PLAIN, _plain(log)),
        Side(LEAST_WORK, _least_work(log)),
        Side("plain zstd of the same records, packed by its level 1", _plain_level_1(log)),
        Side("memcpy of the columns", lambda: [c.copy() for c in rivals.columns_of(data).values()]),
        Side("mcap + mcap-ros2-support", lambda: rivals.read_mcap(small), SLOWEST_SHARE),
        Side("rosbags", lambda: rivals.read_rosbags(small), SLOWEST_SHARE),
    ]
    # A table format is read only where it can be written.
    for name, write, read, path in (
        ("h5py, gzip 1", rivals.write_h5py, rivals.read_h5py, hdf5),
        ("Parquet, zstd 1", rivals.write_parquet, rivals.read_parquet, parquet),
        ("npz, compressed", rivals.write_npz, rivals.read_npz, npz),
    ):
        sides.append(Side(name, _after(partial(write, data, path), partial(read, path))))
    for kind in ("hdf5", "arrow"):
        write_part = partial(minari.write, part, kind)
        read_part = partial(minari.read, f"bench/write-{kind}-v0")
        sides.append(Side(f"Minari, {kind}", _after(write_part, read_part), SLOW_SHARE))
    return compare(
        "Reading a log of vectors into columns, CRCs checked",
        sides,
        goal="70 % of plain zstd's speed at level 1, 100 times mcap + mcap-ros2-support, 5 times"
        " Minari",
        rounds=8,
    )


def _space(folder: Path, log: Path, data: mcaprl.Dataset) -> Table:
    """What files of the same transitions take; a log has times and counters besides."""
    table = Table("Space that the transitions take", unit="bytes, ours = 1")
    ours = log.stat().st_size
    for compression in ("lz4", "none"):
        other = folder / f"{compression}.mcap"
        data.save(other, compression=compression)
        table.ratios[f"{OURS}, {compression}"] = other.stat().st_size / ours
        other.unlink()
    chunks = rivals.raw_chunks(log, STEP_TOPIC)
    rest = ours - sum(map(len, rivals.compressed_chunks(log, (STEP_TOPIC,))))
    by_level_1 = rest + sum(map(len, rivals.level_1_chunks(chunks)))
    table.ratios[f"{OURS}, if packed by zstd's level 1"] = by_level_1 / ours
    for name, write, path in (
        ("h5py, gzip 1", rivals.write_h5py, folder / "table.h5"),
        ("Parquet, zstd 1", rivals.write_parquet, folder / "table.parquet"),
        ("npz, compressed", rivals.write_npz, folder / "table.npz"),
    ):
        try:
            write(data, path)
        except ImportError as error:
            table.missing[name] = str(error)
            continue
        table.ratios[name] = path.stat().st_size / ours
    columns = sum(column.nbytes for column in rivals.columns_of(data).values())
    table.ratios = {OURS: 1.0, **table.ratios, "the columns in memory": columns / ours}
    print(table.to_markdown(), flush=True)
    return table


def _threads(log: Path) -> Table:
    """By the clock on the wall: threads take no less CPU time."""
    return compare(
        "Reading that log with several threads",
        [
            Side(OURS, lambda: mcaprl.open(log)),
            Side(f"{OURS}, 2 threads", lambda: mcaprl.open(log, threads=2)),
            Side(f"{OURS}, 4 threads", lambda: mcaprl.open(log, threads=4)),
            Side("check", lambda: check_log(log)),
            Side("check, 2 threads", lambda: check_log(log, threads=2)),
        ],
        clock=time.perf_counter,
        unit=f"time that passes on {os.cpu_count()} cores, ours with one thread = 1",
    )


def _short_episodes(folder: Path) -> Table:
    """As recorded: a chunk of `/rl/step`, and others, for each episode."""
    path, steps = folder / "short.mcap", 20
    run_env(mcaprl.RecordMcap(Constant(steps), path), 1000, steps)
    return compare(
        f"Reading a recording of 1,000 episodes of {steps} steps",
        [
            Side(OURS, lambda: mcaprl.open(path)),
            Side(PLAIN, _plain(path)),
            Side("checking it", lambda: check_log(path)),
            Side("mcap + mcap-ros2-support", lambda: rivals.read_mcap(path)),
        ],
    )


def _checking(folder: Path, log: Path) -> Table:
    """Checking and recovering are reading, and, of the latter, writing."""
    out = folder / "recovered.mcap"
    return compare(
        "Checking and recovering the log of vectors",
        [
            Side(OURS, lambda: check_log(log)),
            Side("reading it into columns", lambda: mcaprl.open(log)),
            Side(PLAIN, _plain(log)),
            Side("recovering it", lambda: recover_log(log, out, overwrite=True)),
        ],
        goal="a check takes as long as reading",
        rounds=3,
    )


def _episode(log: Path) -> Table:
    episodes = mcaprl.open(log, columns=[]).episodes
    number = len(episodes) // 2
    start, stop = (int(episodes[number].log_time_ns[row]) for row in (0, -1))
    return compare(
        f"Reading one episode of {len(episodes)}",
        [
            Side(OURS, lambda: mcaprl.open(log, episodes=number)),
            Side("plain zstd of its chunks", _plain(log, start_ns=start, stop_ns=stop)),
            Side(
                "mcap + mcap-ros2-support, by time", lambda: rivals.read_mcap(log, start, stop + 1)
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
    return compare(
        "Reading another writer's log, topics interleaved",
        [
            Side(OURS, lambda: mcaprl.open(path)),
            Side(PLAIN, _plain(path)),
            Side(LEAST_WORK, _least_work(path)),
            Side("checking it", lambda: check_log(path)),
            Side("mcap + mcap-ros2-support", lambda: rivals.read_mcap(small), SLOWEST_SHARE),
        ],
        goal="70 % of plain zstd's speed",
        rounds=8,
    )


def _images(folder: Path) -> list[Table]:
    packed, plain = folder / "images.mcap", folder / "plain.mcap"
    data = images(IMAGE_STEPS)
    pictures = data.observations["depth"]
    data.save(packed)
    data.save(plain, compression="none")
    reading = compare(
        "Reading a log of images and vectors into memory",
        [
            Side(OURS, lambda: mcaprl.open(packed, images="memory")),
            Side(PLAIN, _plain(packed, STEP_TOPIC, DEPTH)),
            Side(LEAST_WORK, _least_work(packed, STEP_TOPIC, DEPTH)),
            Side("memcpy of the pictures", lambda: [pictures.copy()]),
            Side(f"{OURS}, vectors alone", lambda: mcaprl.open(packed, columns=["state"])),
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
        goal="300,000 transitions a second on disk; NumPy's speed is the limit",
        ours=f"{OURS}, on disk",
    )
    return [reading, drawing]


def _plain(path: Path, *topics: str, **times: int) -> Callable[[], None]:
    """Plain decompression of a log's chunks, by default those of `/rl/step`."""
    chunks = rivals.compressed_chunks(path, topics or (STEP_TOPIC,), **times)
    return lambda: rivals.plain_zstd(chunks)


def _least_work(path: Path, *topics: str) -> Callable[[], object]:
    """What a reader of columns cannot do without."""
    headers = rivals.chunk_headers(path, topics or (STEP_TOPIC,))
    return lambda: rivals.least_work(path, headers)


def _plain_level_1(path: Path) -> Callable[[], None]:
    """Plain decompression of the records of `/rl/step`, as zstd packs them by itself."""
    chunks = rivals.level_1_chunks(rivals.raw_chunks(path, STEP_TOPIC))
    return lambda: rivals.plain_zstd(chunks)


def _with_episodes(encoded: list[bytes]) -> list[bytes]:
    """Number the ready-made messages, so that they are whole episodes."""
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


def _after(prepare: Callable[[], object], run: Callable[[], object]) -> Callable[[], object]:
    """A run that needs something prepared; an ImportError there is told when it runs."""
    try:
        prepare()
    except ImportError as error:
        reason = str(error)

        def fail() -> object:
            raise ImportError(reason)

        return fail
    return run

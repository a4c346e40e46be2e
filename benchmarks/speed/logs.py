"""Measure writing and reading logs, and the other benchmarks of logs."""

from __future__ import annotations

import os
import time
from functools import partial
from pathlib import Path

import mcaprl
from benchmarks.measure import OURS, SLOW_SHARE, SLOWEST_SHARE, Side, Table, after, compare
from benchmarks.speed import limits, loading, log_parts, recording, rivals
from benchmarks.speed.limits import LEAST_WORK, PLAIN
from benchmarks.speed.workloads import vectors
from mcaprl.recorder import STEP_TOPIC, Compressors


def tables(folder: Path, transitions: int) -> list[Table]:
    """Return all tables about logs; files are written to `folder`."""
    data = vectors(transitions)
    part = vectors(int(transitions * SLOW_SHARE))
    encoded = rivals.messages(part)
    minari = rivals.MinariFolder(folder / "minari")
    log = folder / "log.mcap"
    data.save(log)
    return [
        recording.one(folder, encoded, minari),
        recording.many(folder),
        _writing(folder, log, data, part, encoded, minari),
        _reading(folder, log, data, part, minari),
        _space(folder, log, data),
        _threads(log, data),
        *log_parts.tables(folder, log, data, minari),
        _checking(folder, log),
        loading.table(log, data),
    ]


def _writing(
    folder: Path,
    log: Path,
    data: mcaprl.Dataset,
    part: mcaprl.Dataset,
    encoded: list[bytes],
    minari: rivals.MinariFolder,
) -> Table:
    scratch = folder / "written"
    chunks, compressors = limits.raw_chunks(log, STEP_TOPIC), Compressors("zstd")
    return compare(
        "Writing transitions from memory",
        [
            Side(OURS, lambda: data.save(folder / "written.mcap", overwrite=True)),
            Side(
                "compression of the same chunks alone",
                lambda: [compressors.short(chunk) for chunk in chunks],
            ),
            Side("memcpy of the same chunks", lambda: [bytearray(chunk) for chunk in chunks]),
            Side(
                "mcap's Writer, prebuilt messages",
                lambda: rivals.write_mcap(encoded, scratch),
                SLOW_SHARE,
            ),
            Side(
                "foxglove-sdk, prebuilt messages",
                lambda: rivals.write_foxglove(encoded, scratch),
                SLOW_SHARE,
            ),
            Side(
                "rosbags' Writer, prebuilt messages",
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
        Side(PLAIN, limits.plain(log)),
        Side(LEAST_WORK, limits.least(log)),
        Side("plain zstd of the same records, compressed at level 1", limits.plain_level_1(log)),
        Side("memcpy of the columns", lambda: [c.copy() for c in rivals.columns_of(data).values()]),
        Side("mcap + mcap-ros2-support", lambda: rivals.read_mcap(small), SLOWEST_SHARE),
        Side("rosbags", lambda: rivals.read_rosbags(small), SLOWEST_SHARE),
        Side(
            "rerun's McapReader",
            lambda: rivals.read_rerun(log, STEP_TOPIC, rivals.VECTOR_FIELDS[STEP_TOPIC]),
        ),
    ]
    # A table format can be read only after it was written.
    for name, write, read, path in (
        ("h5py, gzip 1", rivals.write_h5py, rivals.read_h5py, hdf5),
        ("Parquet, zstd 1", rivals.write_parquet, rivals.read_parquet, parquet),
        ("npz, compressed", rivals.write_npz, rivals.read_npz, npz),
    ):
        sides.append(Side(name, after(partial(write, data, path), partial(read, path))))
    for kind in ("hdf5", "arrow"):
        write_part = partial(minari.write, part, kind)
        read_part = partial(minari.read, minari.name(part, kind))
        sides.append(Side(f"Minari, {kind}", after(write_part, read_part), SLOW_SHARE))
    return compare(
        "Reading a log of vectors into columns, CRCs checked",
        sides,
        goal="70 % of plain zstd's speed at level 1, 100 times mcap + mcap-ros2-support, 5 times"
        " Minari and rerun",
        rounds=8,
    )


def _space(folder: Path, log: Path, data: mcaprl.Dataset) -> Table:
    """Measure file sizes for the same transitions. Only the log also stores times and counters."""
    table = Table("File size", unit="bytes, ours = 1")
    ours = log.stat().st_size
    for compression in ("lz4", "none"):
        other = folder / f"{compression}.mcap"
        data.save(other, compression=compression)
        table.ratios[f"{OURS}, {compression}"] = other.stat().st_size / ours
        other.unlink()
    chunks = limits.raw_chunks(log, STEP_TOPIC)
    rest = ours - sum(map(len, limits.compressed_chunks(log, (STEP_TOPIC,))))
    by_level_1 = rest + sum(map(len, limits.level_1_chunks(chunks)))
    table.ratios[f"{OURS}, compressed at zstd level 1"] = by_level_1 / ours
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


def _threads(log: Path, data: mcaprl.Dataset) -> Table:
    """Measure the wall-clock time of reading and checking with several threads.

    Threads do not reduce the CPU time.
    """
    columns = list(rivals.columns_of(data).values())
    return compare(
        "Reading the log of vectors with several threads",
        [
            Side(OURS, lambda: mcaprl.open(log)),
            Side(f"{OURS}, 2 threads", lambda: mcaprl.open(log, threads=2)),
            Side(f"{OURS}, 4 threads", lambda: mcaprl.open(log, threads=4)),
            Side("check", lambda: mcaprl.check(log)),
            Side("check, 2 threads", lambda: mcaprl.check(log, threads=2)),
            *(
                Side(
                    f"{LEAST_WORK}, columns copied, {what}",
                    limits.least_copied(log, columns, count),
                )
                for count, what in ((1, "1 thread"), (2, "2 threads"))
            ),
        ],
        goal="1.7 times as fast with two threads",
        rounds=12,
        clock=time.perf_counter,
        unit=f"wall-clock time on {os.cpu_count()} cores, ours with one thread = 1",
    )


def _checking(folder: Path, log: Path) -> Table:
    """Measure the time to check a log, to read it, and to recover it.

    A check reads the log. A recovery also writes a new log.
    """
    out = folder / "recovered.mcap"
    return compare(
        "Checking and recovering the log of vectors",
        [
            Side(OURS, lambda: mcaprl.check(log)),
            Side("reading the log into columns", lambda: mcaprl.open(log)),
            Side(PLAIN, limits.plain(log)),
            Side("recovering it", lambda: mcaprl.recover(log, out, overwrite=True)),
        ],
        goal="a check takes as long as reading",
        rounds=3,
    )

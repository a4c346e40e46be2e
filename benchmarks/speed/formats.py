"""Measure conversions to and from datasets of other tools.

Times are relative to the functions of those tools.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import mcaprl
from benchmarks.measure import OURS, Side, Table, after, compare
from benchmarks.speed import rivals
from benchmarks.speed.workloads import vectors

TRANSITIONS = 100_000
# Libraries that handle one transition at a time are timed on this fraction of the task.
SHARE = 0.05


def tables(folder: Path) -> list[Table]:
    """Measure each format; the benchmarks write their files to `folder`."""
    data, log = vectors(TRANSITIONS), folder / "part.mcap"
    data.save(log)
    minari = rivals.MinariFolder(folder / "minari")
    return [
        *_minari(folder, data, minari),
        *_parquet(folder, data),
        *_npz(folder, data),
        *_hdf5(folder, data),
        _d3rlpy(folder, log),
        _sb3(data),
    ]


def _minari(folder: Path, data: mcaprl.Dataset, minari: rivals.MinariFolder) -> list[Table]:
    ours = folder / "ours-v0"
    return [
        compare(
            "Writing a Minari dataset, HDF5",
            [
                Side(OURS, lambda: data.to_minari(ours, overwrite=True)),
                Side("Minari", lambda: minari.write(data, "hdf5")),
            ],
            rounds=3,
        ),
        compare(
            "Reading a Minari dataset, HDF5, to arrays",
            [
                Side(OURS, lambda: mcaprl.Dataset.from_minari(ours)),
                Side(
                    "Minari",
                    after(
                        lambda: minari.write(data, "hdf5"),
                        lambda: minari.read(minari.name(data, "hdf5")),
                    ),
                ),
            ],
            rounds=3,
        ),
    ]


def _parquet(folder: Path, data: mcaprl.Dataset) -> list[Table]:
    ours, theirs = folder / "ours-parquet", folder / "theirs.parquet"
    return [
        compare(
            "Writing Parquet",
            [
                Side(OURS, lambda: data.to_parquet(ours, overwrite=True)),
                Side("pandas, a column for each element", lambda: _write_pandas(data, theirs)),
            ],
            rounds=3,
        ),
        compare(
            "Reading Parquet to arrays",
            [
                Side(OURS, lambda: mcaprl.Dataset.from_parquet(ours)),
                Side("pandas, a column for each element", lambda: _read_pandas(theirs)),
            ],
            rounds=3,
        ),
    ]


def _write_pandas(data: mcaprl.Dataset, path: Path) -> None:
    import pandas

    columns = {f"observation_{k}": data.observations[:, k] for k in range(data.frames.shape[1])}
    columns |= {f"next_{k}": data.next_observations[:, k] for k in range(data.frames.shape[1])}
    names = ("actions", "rewards", "terminated", "truncated")
    columns |= {name: getattr(data, name) for name in names}
    pandas.DataFrame(columns).to_parquet(path)


def _read_pandas(path: Path) -> list[Any]:
    import pandas

    frame = pandas.read_parquet(path)
    parts = [[one for one in frame if one.startswith(begin)] for begin in ("observation_", "next_")]
    return [frame[names].to_numpy() for names in parts]


def _npz(folder: Path, data: mcaprl.Dataset) -> list[Table]:
    ours, theirs = folder / "ours.npz", folder / "theirs.npz"
    names = ("observations", "next_observations", "actions", "rewards", "terminated", "truncated")
    arrays = {name: getattr(data, name) for name in names}
    return [
        compare(
            "Writing npz",
            [
                Side(OURS, lambda: data.to_npz(ours, overwrite=True)),
                Side("np.savez with both observations", lambda: np.savez(theirs, **arrays)),
            ],
            rounds=3,
        ),
        compare(
            "Reading npz",
            [
                Side(OURS, lambda: mcaprl.Dataset.from_npz(ours)),
                Side("np.load with both observations", lambda: dict(np.load(theirs))),
            ],
            rounds=3,
        ),
    ]


def _hdf5(folder: Path, data: mcaprl.Dataset) -> list[Table]:
    ours, theirs = folder / "ours.hdf5", folder / "theirs.hdf5"
    return [
        compare(
            "Writing D4RL's HDF5",
            [
                Side(OURS, lambda: data.to_hdf5(ours, overwrite=True)),
                Side("h5py, the arrays alone", lambda: _write_h5py(data, theirs)),
            ],
            rounds=3,
        ),
        compare(
            "Reading D4RL's HDF5",
            [
                Side(OURS, lambda: mcaprl.Dataset.from_hdf5(ours)),
                Side("h5py, the arrays alone", lambda: _read_h5py(theirs)),
            ],
            rounds=3,
        ),
    ]


def _write_h5py(data: mcaprl.Dataset, path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for name in ("observations", "next_observations", "actions", "rewards", "terminated"):
            file[name] = getattr(data, name)


def _read_h5py(path: Path) -> list[Any]:
    import h5py

    with h5py.File(path) as file:
        return [file[name][()] for name in file]


def _d3rlpy(folder: Path, log: Path) -> Table:
    path = folder / "buffer.h5"
    mcaprl.convert(log, path, overwrite=True)
    return compare(
        "Reading d3rlpy's file",
        [
            Side(OURS, lambda: mcaprl.open(path)),
            Side("d3rlpy's ReplayBuffer.load", lambda: _load_d3rlpy(path)),
        ],
        rounds=3,
    )


def _load_d3rlpy(path: Path) -> None:
    import d3rlpy

    with path.open("rb") as file:
        d3rlpy.dataset.ReplayBuffer.load(file, d3rlpy.dataset.InfiniteBuffer())


def _sb3(data: mcaprl.Dataset) -> Table:
    return compare(
        "Filling Stable-Baselines3's ReplayBuffer",
        [
            Side(OURS, lambda: data.to_sb3()),
            Side("ReplayBuffer.add for each transition", lambda: _add_each(data), SHARE),
        ],
        rounds=3,
    )


def _add_each(data: mcaprl.Dataset) -> None:
    from stable_baselines3.common.buffers import ReplayBuffer

    count = round(SHARE * len(data))
    space, actions = data.observation_space, data.action_space
    buffer = ReplayBuffer(len(data), space, actions, handle_timeout_termination=True)
    observations, following = data.observations[:count], data.next_observations[:count]
    done = data.terminated | data.truncated
    for k in range(count):
        info = {"TimeLimit.truncated": bool(data.truncated[k])}
        buffer.add(observations[k], following[k], data.actions[k], data.rewards[k], done[k], [info])

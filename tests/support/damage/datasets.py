"""Small datasets of other tools in each form."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import mcaprl
from mcaprl import Dataset


def dataset() -> Dataset:
    """Return three episodes of 4, 3 and 2 steps; the second one is truncated."""
    rows = np.arange(10, dtype=np.float32)[:, None] * np.ones(2, np.float32)
    return Dataset.from_arrays(
        observations=rows[:9],
        next_observations=rows[1:],
        actions=np.arange(9) % 3,
        rewards=np.arange(9.0),
        terminated=np.isin(np.arange(9), (3, 8)),
        truncated=np.arange(9) == 6,
    )


def write_all(folder: Path) -> dict[str, tuple[str, Path]]:
    """Write the dataset in each form; return the name of the format and the path of each form."""
    import h5py

    data = dataset()
    found: dict[str, tuple[str, Path]] = {}
    for form, name in (
        ("npz", "own.npz"),
        ("hdf5", "own.hdf5"),
        ("d3rlpy", "own.h5"),
        ("minari", "own-v0"),
        ("parquet", "parquet"),
        ("lerobot", "lerobot"),
    ):
        mcaprl.convert(_log(data, folder), folder / name, to=form)
        found[form] = form, folder / name
    shutil.copytree(folder / "own-v0", folder / "theirs-v0")
    _edit_json(folder / "theirs-v0/data/metadata.json", lambda found: found.pop("mcaprl"))
    found["minari of others"] = "minari", folder / "theirs-v0"
    shutil.copytree(folder / "lerobot", folder / "their_lerobot")
    shutil.rmtree(folder / "their_lerobot/meta/mcaprl")
    found["lerobot of others"] = "lerobot", folder / "their_lerobot"
    flat: dict[str, Any] = {
        "observations": data.observations,
        "actions": data.actions.astype(np.int32),
        "rewards": data.rewards,
        "terminals": data.terminated,
        "episode_terminals": data.terminated | data.truncated,
    }
    np.savez_compressed(folder / "theirs.npz", allow_pickle=False, **flat)
    found["npz of others"] = "npz", folder / "theirs.npz"
    for form, name, more in (
        ("hdf5 of others", "theirs.hdf5", {"infos/names": np.array([b"a"] * 9)}),
        ("d3rlpy 1", "theirs.h5", {"discrete_action": True, "version": "1.0"}),
    ):
        with h5py.File(folder / name, "w") as file:
            for key, values in (flat | more).items():
                is_large = key == "observations"
                file.create_dataset(key, data=values, **({"compression": 4} if is_large else {}))
        found[form] = form.split()[0], folder / name
    with h5py.File(folder / "demos.hdf5", "w") as file:
        for index in range(2):
            group = file.create_group(f"data/demo_{index}")
            group["obs/x"], group["actions"] = data.observations[:4], np.zeros((4, 2))
            group["rewards"], group["dones"] = np.zeros(4), np.array([0, 0, 0, index])
    found["robomimic"] = "hdf5", folder / "demos.hdf5"
    return found


def _log(data: Dataset, folder: Path) -> Path:
    path = folder / "log.mcap"
    data.save(path, overwrite=True)
    return path


def _edit_json(path: Path, change: Callable[[Any], Any]) -> None:
    found = json.loads(path.read_text())
    change(found)
    path.write_text(json.dumps(found))

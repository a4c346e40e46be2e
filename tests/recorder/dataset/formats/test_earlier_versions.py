"""Datasets that version 0.1.0 wrote: they are read as any dataset of the other tool.

Version 0.1.0 also wrote a second copy of the log's metadata into these files, which is not read.
"""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl import Dataset
from tests.support.paths import GOLDEN

for _package in ("h5py", "pyarrow"):
    pytest.importorskip(_package, reason="needs the extras interop and tables")


def _opened(name: str, folder: Path) -> tuple[Dataset, str]:
    source = GOLDEN / "datasets" / name
    copy = folder / name
    shutil.copytree(source, copy) if source.is_dir() else shutil.copy(source, copy)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return mcaprl.open(copy), " ".join(str(warning.message) for warning in caught)


@pytest.mark.parametrize(
    ("name", "rows", "said"),
    [
        ("toy.npz", [0, 1, 2, 3, 10, 11, 12], "not read: missing_infos/car.speed"),
        ("toy.hdf5", [0, 1, 2, 3, 10, 11, 12], ""),
        ("toy-v0", [0, 1, 2, 3, 10, 11, 12], ""),
        ("parquet", [0, 1, 2, 3, 10, 11, 12], ""),
        # d3rlpy has no final observation of a terminated episode.
        ("toy.h5", [0, 1, 2, 2, 10, 11, 12], ""),
        # LeRobot has no observation after the last action.
        ("lerobot", [0, 1, 2, 2, 10, 11], "is not stored for 1 other episode"),
    ],
)
def test_transitions_are_read(name: str, rows: list[int], said: str, tmp_path: Path) -> None:
    found, warned = _opened(name, tmp_path)
    assert found.frames.tolist() == [[row, -row / 4] for row in rows]
    steps = [0, 1, 2, 0, 1][: len(rows) - 2]
    assert found.rewards.tolist() == [step / 2 for step in steps]
    assert found.actions.tolist() == [step % 2 for step in steps]
    assert np.flatnonzero(found.terminated).tolist() == [2]
    assert np.flatnonzero(found.truncated).tolist() == [len(steps) - 1]
    assert (said in warned) if said else not warned
    has_space = name in ("toy-v0", "parquet")
    assert found.action_space == spaces.Discrete(3 if has_space else 2)


def test_facts_are_read_where_the_other_tool_has_a_place_for_them(tmp_path: Path) -> None:
    found = {path.name: _opened(path.name, tmp_path)[0] for path in (GOLDEN / "datasets").iterdir()}
    for name in ("toy.npz", "parquet"):
        assert found[name].episodes[1].log_time_ns.tolist() == [
            10**18 + row * 10**8 for row in (10, 11, 12)
        ]
    for name in ("toy-v0", "parquet"):
        assert found[name].env_id == "Toy-v0"
        assert [e.summary.seed for e in found[name].episodes] == [7, 8]
        assert [e.summary.options for e in found[name].episodes] == ['{"start": 1}', '{"start": 2}']
    rows = [0, 1, 2, 3, 10, 11, 12]
    for name in ("toy.npz", "toy-v0", "parquet"):
        assert found[name].infos["lap"].tolist() == rows
    assert found["toy.hdf5"].infos["lap"].tolist() == [0, 1, 2, None, 10, 11, None]
    assert found["lerobot"].infos["lap"].tolist() == [None, 1, 2, 3, None, 11]
    assert found["parquet"].episodes[0].summary.reason == "goal"
    for name in ("parquet", "lerobot"):
        assert set(found[name].behavior_probs) == {0.25}

"""Infos in Minari datasets, HDF5 files and NumPy archives."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import SpaceError
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.format.metadata import LogMetadata
from tests.conftest import need
from tests.recorder.dataset.formats.minari_sets import Cameras, collect

h5py = pytest.importorskip("h5py", reason="needs the extra interop")

_MISSING = np.array([True, False, True, True, False])
# Rows of two episodes: the first has two steps, and the second has one step.
_INFOS: dict[str, Any] = {
    "speed": np.ma.MaskedArray([0.5, np.nan, -0.0, 1, 2], np.zeros(5, bool)),
    "pose.xy": np.ma.MaskedArray(np.arange(10, dtype=np.float32).reshape(5, 2)),
    "count": np.ma.MaskedArray([1, 2, 3, 4, 2**60]),
    "episode.l": np.ma.MaskedArray([0, 3, 0, 0, 1], _MISSING),
    "episode.r": np.ma.MaskedArray([0, 0.25, 0, 0, np.nan], _MISSING),
    "won": np.ma.MaskedArray([False, True, False, False, False], _MISSING),
    "lane": np.ma.MaskedArray(["", "left", "x", "right", "ü"], np.arange(5) < 1),
    "late": np.ma.MaskedArray([0, 0, 0, 7, 8], np.arange(5) < 3, dtype=np.int16),
}


def _two_episodes(infos: dict[str, Any]) -> Dataset:
    metadata = LogMetadata(spaces.Box(-9, 9, (1,), np.float32), spaces.Discrete(2))
    episodes = [
        EpisodeArrays(
            observations=np.arange(count + 1, dtype=np.float32)[:, None],
            actions=np.zeros(count, np.int64),
            rewards=np.ones(count),
            terminated=True,
            truncated=False,
            infos={name: values[rows] for name, values in infos.items()},
        )
        for count, rows in ((2, slice(0, 3)), (1, slice(3, 5)))
    ]
    return dataset_of(episodes, metadata, "test")


def _same(found: Any, expected: Any) -> None:
    missing = np.ma.getmaskarray(expected)
    np.testing.assert_array_equal(np.ma.getmaskarray(found), missing)
    np.testing.assert_array_equal(np.ma.getdata(found)[~missing], np.ma.getdata(expected)[~missing])
    assert expected.dtype.kind == "U" or found.dtype == expected.dtype


def _filled(values: Any) -> NDArray[Any]:
    """Return an info as formats without missing values store it."""
    if values.dtype.kind == "U":
        return np.asarray(values.filled(""))
    has_all = not np.ma.getmaskarray(values).any()
    return np.asarray(values.data if has_all else values.astype(np.float64).filled(np.nan))


@pytest.mark.parametrize(
    ("form", "name"), [("minari", "toy-v0"), ("hdf5", "toy.hdf5"), ("npz", "toy.npz")]
)
def test_infos_come_back_with_nan_where_there_was_none(
    tmp_path: Path, form: str, name: str
) -> None:
    data = _two_episodes(_INFOS)
    lost = getattr(data, f"to_{form}")(tmp_path / name)
    assert ("infos of final observations" in " ".join(lost)) == (form == "hdf5")
    found = mcaprl.open(tmp_path / name)
    assert set(found.infos) == set(_INFOS)
    # D4RL has a row for each step: there are none of the final observations.
    missing = np.isin(np.arange(5), (2, 4)) & (form == "hdf5")
    for key, values in _INFOS.items():
        is_missing = missing | ((np.arange(5) < 3) & (form == "minari") & (key == "late"))
        rows = found.infos[key]
        row_mask = np.ma.getmaskarray(rows).reshape(5, -1).any(axis=1)
        np.testing.assert_array_equal(row_mask, is_missing)
        expected = _filled(values)
        np.testing.assert_array_equal(rows.data[~is_missing], expected[~is_missing])


def test_minari_loads_infos_with_nan_where_there_was_none(tmp_path: Path) -> None:
    need(importlib.util.find_spec("minari") is not None, "minari")
    from minari import MinariDataset

    _two_episodes(_INFOS).to_minari(tmp_path / "toy-v0")
    first, second = MinariDataset(tmp_path / "toy-v0/data")
    np.testing.assert_array_equal(first.infos["episode"]["l"], [np.nan, 3, np.nan])
    np.testing.assert_array_equal(second.infos["episode"]["r"], [np.nan, np.nan])
    assert first.infos["pose"]["xy"].tolist() == [[0, 1], [2, 3], [4, 5]]
    assert (first.infos["count"].dtype, second.infos["count"].tolist()) == (np.int64, [4, 2**60])
    assert [text.decode() for text in second.infos["lane"]] == ["right", "ü"]
    assert "late" not in first.infos


@pytest.mark.parametrize("form", ["hdf5", "arrow", "parquet"])
def test_infos_that_minari_collects_are_those_of_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    need(importlib.util.find_spec("jax") is not None, "minari[create]")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    collect(Cameras(), "infos-v0", log=tmp_path / "log.mcap", data_format=form, infos=True)
    log, found = mcaprl.open(tmp_path / "log.mcap"), mcaprl.open("minari:infos-v0")
    steps = np.concatenate([np.arange(count + 1) for count in (5, 3, 4)])
    expected: dict[str, Any] = {
        "battery": 1 - steps / 8,
        "pose.xy": np.stack([steps, -steps], 1).astype(np.float32),
        "late": steps > 2,
    }
    for data in (found, log):
        assert set(data.infos) == set(expected)
        for name, values in expected.items():
            _same(data.infos[name], np.ma.MaskedArray(values))
    # A dataset that is written from the log has the infos that Minari collected.
    log.to_minari("minari:again-v0")
    for name, values in mcaprl.open("minari:again-v0").infos.items():
        _same(values, found.infos[name])


def test_infos_that_differ_between_episodes_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "toy-v0"
    _two_episodes(_INFOS).to_minari(path)
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        del file["episode_1/infos/pose/xy"]
        file["episode_1/infos/pose/xy"] = np.zeros((2, 3), np.float32)
        del file["episode_0/infos/speed"]
        file["episode_0/infos/speed"] = np.zeros(7)
    with pytest.warns(UserWarning, match=r"left out: pose.xy, speed$"):
        found = mcaprl.open(path)
    assert set(found.infos) == set(_INFOS) - {"pose.xy", "speed"}


@pytest.mark.parametrize(
    ("form", "name", "infos", "message"),
    [
        ("minari", "toy-v0", {"a.b": np.ma.zeros(5), "a": np.ma.zeros(5)}, "'a' is left out"),
        ("npz", "toy.npz", {"a/b": np.ma.zeros(5)}, "its name is not valid in an archive"),
        ("minari", "toy-v0", {"a/b": np.ma.zeros(5)}, "its name is not valid in HDF5"),
        ("hdf5", "toy.hdf5", {"a..b": np.ma.zeros(5)}, "its name is not valid in HDF5"),
        ("npz", "toy.npz", {"z": np.ma.zeros(5, complex)}, "values of dtype complex128"),
        ("npz", "toy.npz", {"z": np.ma.MaskedArray([2**60] * 5, _MISSING)}, "too large for floats"),
        ("hdf5", "toy.hdf5", {"t": np.ma.MaskedArray(["a\0b"] * 5)}, "a text is not UTF-8"),
    ],
)
def test_other_infos_are_refused_or_left_out(
    tmp_path: Path, form: str, name: str, infos: Any, message: str
) -> None:
    write = getattr(_two_episodes(infos), f"to_{form}")
    with pytest.raises(SpaceError, match=message):
        write(tmp_path / name)
    assert message in write(tmp_path / name, lossy=True)[0]


@pytest.mark.parametrize("with_next", [True, False])
def test_infos_of_d4rl_belong_to_the_observations(tmp_path: Path, with_next: bool) -> None:
    with h5py.File(tmp_path / "their.hdf5", "w") as file:
        file["observations"] = np.arange(4.0)[:, None]
        if with_next:
            file["next_observations"] = np.arange(1, 5.0)[:, None]
        file["actions"] = np.zeros((4, 1))
        file["rewards"] = np.zeros(4)
        file["terminals"] = np.array([0, 1, 0, 0], bool)
        file["timeouts"] = np.array([0, 0, 0, 1], bool)
        file["infos/sim/qpos"] = np.arange(8).reshape(4, 2)
        file["infos/goal"] = np.zeros(3)
    rows: list[Any]
    if with_next:
        with pytest.warns(UserWarning, match="not read: infos/goal$"):
            found = mcaprl.open(tmp_path / "their.hdf5")
        rows = [[0, 1], [2, 3], None, [4, 5], [6, 7], None]
    else:
        with (
            pytest.warns(UserWarning, match="no next_observations"),
            pytest.warns(UserWarning, match="not read: infos/goal$"),
        ):
            found = mcaprl.open(tmp_path / "their.hdf5")
        rows = [[0, 1], [2, 3], None, [4, 5], [6, 7]]
    assert set(found.infos) == {"sim.qpos"}
    assert found.infos["sim.qpos"].tolist() == [
        [None, None] if row is None else row for row in rows
    ]

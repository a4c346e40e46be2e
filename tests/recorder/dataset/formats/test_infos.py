"""Infos in Minari datasets, HDF5 files and NumPy archives."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from mcaprl import Dataset
from mcaprl.errors import SpaceError
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.dataset.formats.minari.reader import read_episodes
from mcaprl.recorder.format.metadata import LogMetadata
from tests.conftest import need
from tests.recorder.dataset.formats.minari_sets import Cameras, collect

h5py = pytest.importorskip("h5py", reason="needs the extra interop")

_ROOM = "mcaprl.recorder.dataset.formats"
_WRITERS = {"minari": f"{_ROOM}.minari.writer", "hdf5": f"{_ROOM}.hdf5", "npz": f"{_ROOM}.npz"}
_READERS = {**_WRITERS, "minari": f"{_ROOM}.minari.reader"}
_MISSING = np.array([True, False, True, True, False])
# Rows of two episodes with two and one steps.
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


def _two_episodes() -> Dataset:
    metadata = LogMetadata(spaces.Box(-9, 9, (1,), np.float32), spaces.Discrete(2))
    episodes = [
        EpisodeArrays(
            observations=np.arange(count + 1, dtype=np.float32)[:, None],
            actions=np.zeros(count, np.int64),
            rewards=np.ones(count),
            terminated=True,
            truncated=False,
        )
        for count in (2, 1)
    ]
    return dataset_of(episodes, metadata, "test")


def _same(found: Any, expected: Any) -> None:
    missing = np.ma.getmaskarray(expected)
    np.testing.assert_array_equal(np.ma.getmaskarray(found), missing)
    np.testing.assert_array_equal(np.ma.getdata(found)[~missing], np.ma.getdata(expected)[~missing])
    assert expected.dtype.kind == "U" or found.dtype == expected.dtype


def _written(
    form: str, path: Path, monkeypatch: pytest.MonkeyPatch, infos: Any, **options: Any
) -> list[str]:
    monkeypatch.setattr(f"{_WRITERS[form]}.infos_of", lambda dataset: infos)
    lost: list[str] = getattr(_two_episodes(), f"to_{form}")(path, **options)
    return lost


@pytest.mark.parametrize(
    ("form", "name"), [("minari", "toy-v0"), ("hdf5", "toy.hdf5"), ("npz", "toy.npz")]
)
def test_infos_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str, name: str
) -> None:
    assert _written(form, tmp_path / name, monkeypatch, _INFOS) == []
    read: list[EpisodeArrays] = []

    def spy(episodes: list[EpisodeArrays], *more: Any) -> Dataset:
        read.extend(episodes)
        return dataset_of(episodes, *more)

    monkeypatch.setattr(f"{_READERS[form]}.dataset_of", spy)
    getattr(Dataset, f"from_{form}")(tmp_path / name)
    for episode, rows in zip(read, (slice(0, 3), slice(3, 5)), strict=True):
        for key, values in _INFOS.items():
            if key in episode.infos:
                _same(episode.infos[key], values[rows])
            else:
                assert np.ma.getmaskarray(values[rows]).all()


def test_minari_loads_infos_with_nan_where_there_was_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    need(importlib.util.find_spec("minari") is not None, "minari")
    from minari import MinariDataset

    _written("minari", tmp_path / "toy-v0", monkeypatch, _INFOS)
    first, second = MinariDataset(tmp_path / "toy-v0/data")
    np.testing.assert_array_equal(first.infos["episode"]["l"], [np.nan, 3, np.nan])
    np.testing.assert_array_equal(second.infos["episode"]["r"], [np.nan, np.nan])
    assert first.infos["pose"]["xy"].tolist() == [[0, 1], [2, 3], [4, 5]]
    assert (first.infos["count"].dtype, second.infos["count"].tolist()) == (np.int64, [4, 2**60])
    assert [text.decode() for text in second.infos["lane"]] == ["right", "ü"]
    assert "late" not in first.infos


@pytest.mark.parametrize("form", ["hdf5", "arrow", "parquet"])
def test_infos_that_minari_collects_are_those_of_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    need(importlib.util.find_spec("jax") is not None, "minari[create]")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    collect(Cameras(), "infos-v0", data_format=form, infos=True)
    _, episodes = read_episodes(tmp_path / "infos-v0")
    assert [len(episode.rewards) for episode in episodes] == [5, 3, 4]
    for episode in episodes:
        steps = np.arange(len(episode.rewards) + 1)
        assert set(episode.infos) == {"battery", "pose.xy", "late"}
        assert episode.infos["battery"].tolist() == (1 - steps / 8).tolist()
        assert episode.infos["pose.xy"].tolist() == np.stack([steps, -steps], 1).tolist()
        assert episode.infos["pose.xy"].dtype == np.float32
        assert episode.infos["late"].tolist() == (steps > 2).tolist()
        assert not any(np.ma.getmaskarray(values).any() for values in episode.infos.values())


@pytest.mark.parametrize(
    ("form", "name", "infos", "message"),
    [
        ("minari", "toy-v0", {"a.b": np.ma.zeros(5), "a": np.ma.zeros(5)}, "'a' is left out"),
        ("minari", "toy-v0", {"a/b": np.ma.zeros(5)}, "HDF5 cannot hold its name"),
        ("hdf5", "toy.hdf5", {"a..b": np.ma.zeros(5)}, "HDF5 cannot hold its name"),
        ("npz", "toy.npz", {"z": np.ma.zeros(5, complex)}, "its values are complex128"),
        ("npz", "toy.npz", {"z": np.ma.MaskedArray([2**60] * 5, _MISSING)}, "too large for floats"),
        ("hdf5", "toy.hdf5", {"t": np.ma.MaskedArray(["a\0b"] * 5)}, "a text is not UTF-8"),
    ],
)
def test_other_infos_are_refused_or_left_out(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    form: str,
    name: str,
    infos: Any,
    message: str,
) -> None:
    with pytest.raises(SpaceError, match=message):
        _written(form, tmp_path / name, monkeypatch, infos)
    (sentence,) = _written(form, tmp_path / name, monkeypatch, infos, lossy=True)
    assert message in sentence


def test_infos_of_d4rl_belong_to_the_observations(tmp_path: Path) -> None:
    from mcaprl.recorder.dataset.formats import flat

    found = flat._info_rows({"qpos": np.arange(8.0).reshape(4, 2)}, 1, 3, 3)
    assert found["qpos"].tolist() == [[2, 3], [4, 5], [None, None]]

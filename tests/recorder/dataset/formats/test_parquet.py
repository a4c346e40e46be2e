"""Parquet files and Arrow tables, read back here and by pandas, polars and DuckDB."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import LogError, SpaceError
from mcaprl.recorder.dataset.formats import parquet as ours
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.format.metadata import LogMetadata
from tests.conftest import need
from tests.support.strategies import transitions

pa = pytest.importorskip("pyarrow", reason="needs the extra tables")
pytest.importorskip("pyarrow.compute")
pq = pytest.importorskip("pyarrow.parquet")

_SPACE = spaces.Dict(
    {
        "camera": spaces.Box(0, 255, (8, 9, 3), np.uint8),
        "state": spaces.Box(-np.inf, np.inf, (2,), np.float32),
        "gear": spaces.Discrete(5, start=-1),
    }
)


def _observations(first: int, count: int) -> dict[str, Any]:
    values = np.arange(first, first + count)
    return {
        "camera": np.broadcast_to(values[:, None, None, None], (count, 8, 9, 3)).astype(np.uint8),
        "state": np.stack([values, values / 4], axis=1).astype(np.float32),
        "gear": values % 5 - 1,
    }


def _recorded() -> Dataset:
    """Return a terminated episode of three steps and a truncated episode of two steps."""
    metadata = LogMetadata(_SPACE, spaces.Box(-1, 1, (2, 2), np.float64), env_id="Car-v0", seed="4")
    first = EpisodeArrays(
        observations=_observations(0, 4),
        actions=np.linspace(-1, 1, 12).reshape(3, 2, 2),
        rewards=np.array([0.1, -1, 2]),
        terminated=True,
        truncated=False,
        behavior_probs=np.array([0.25, np.nan, 1], np.float32),
        times_ns=np.array([5, 6, 7, 9]),
        summary={"reason": "goal", "seed": 2**64 - 2, "policy": "random", "epsilon": 0.5},
    )
    second = EpisodeArrays(
        observations=_observations(10, 3),
        actions=np.zeros((2, 2, 2)),
        rewards=np.array([0, 0.25]),
        terminated=False,
        truncated=True,
        times_ns=np.array([20, 21, 23]),
        summary={"reason": "time", "options": '{"track": 2}'},
    )
    return dataset_of([first, second], metadata, "test")


def _vectors(
    episodes: int = 2, length: int = 3, infos: list[dict[str, Any]] | None = None
) -> Dataset:
    """Return episodes with vector observations; observation k of the whole dataset is (k, -k).

    Args:
        episodes: Number of episodes.
        length: Number of transitions of an episode.
        infos: Infos of each episode; None marks a missing row. If given, they determine the number
            and lengths of the episodes.
    """
    parts: list[EpisodeArrays] = []
    first = 0
    for info in infos or [{}] * episodes:
        count = len(next(iter(info.values()))) if info else length + 1
        frames, steps = np.arange(first, first + count), np.arange(count - 1)
        episode = EpisodeArrays(
            observations=np.stack([frames, -frames], axis=1).astype(np.float32),
            actions=(steps + first) % 3,
            rewards=(steps + first - len(parts)) / 2,
            terminated=True,
            truncated=False,
            behavior_probs=np.full(count - 1, 0.5, np.float32),
            infos={name: _masked(values) for name, values in info.items()},
        )
        parts.append(episode)
        first += count
    metadata = LogMetadata(spaces.Box(-np.inf, np.inf, (2,), np.float32), spaces.Discrete(3))
    return dataset_of(parts, metadata, "test")


def _masked(values: list[Any]) -> Any:
    present = [value for value in values if value is not None]
    zero = np.zeros_like(np.asarray(present))[0] if present else False
    every = np.array([zero if value is None else value for value in values])
    is_missing = np.array([value is None for value in values])
    mask = np.broadcast_to(is_missing.reshape(-1, *[1] * (every.ndim - 1)), every.shape)
    return np.ma.MaskedArray(every, mask)


def _same(first: Dataset, second: Dataset) -> None:
    assert second.fingerprint == first.fingerprint
    assert second.metadata == first.metadata
    assert repr([e.summary for e in second.episodes]) == repr([e.summary for e in first.episodes])
    for one, other in zip(first.episodes, second.episodes, strict=True):
        np.testing.assert_array_equal(other.log_time_ns, one.log_time_ns)


def test_everything_comes_back(tmp_path: Path) -> None:
    dataset = _recorded()
    assert dataset.to_parquet(tmp_path / "out") == []
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [
        "episodes.parquet",
        "transitions.parquet",
    ]
    found = mcaprl.open(tmp_path / "out")
    _same(dataset, found)
    assert [e.summary.seed for e in found.episodes] == [2**64 - 2, None]
    assert [e.summary.reason for e in found.episodes] == ["goal", "time"]
    np.testing.assert_array_equal(found.episodes[1].next_observations["state"][-1], [12, 3])


@settings(max_examples=60)
@given(transitions())
def test_all_spaces_and_bits_come_back(arguments: dict[str, Any]) -> None:
    dataset = Dataset.from_arrays(**arguments)
    with TemporaryDirectory() as folder:
        dataset.to_parquet(Path(folder) / "out")
        _same(dataset, Dataset.from_parquet(Path(folder) / "out"))


def test_infos_of_steps_and_resets_come_back(tmp_path: Path) -> None:
    infos: list[dict[str, Any]] = [
        {"speed": [1.5, None, -2, 0], "lap": [None, 1, 2, None], "near": [True, None, False, True]},
        {"speed": [None, 0.5], "place": [[1, 2], None], "why": [None, "ß"], "near": [None, None]},
    ]
    dataset = _vectors(infos=infos)
    dataset.to_parquet(tmp_path / "out")
    found = mcaprl.open(tmp_path / "out")
    _same(dataset, found)
    assert list(found.infos) == ["speed", "lap", "near", "place", "why"]
    for name, info in dataset.infos.items():
        assert found.infos[name].dtype == info.dtype
        assert found.infos[name].tolist() == info.tolist()
    assert found.infos["lap"].tolist() == [None, 1, 2, None, None, None]
    steps = pq.read_table(tmp_path / "out/transitions.parquet")
    assert steps["info.speed"].to_pylist() == [None, -2, 0, 0.5]
    assert steps["info.place"].to_pylist() == [None] * 4
    resets = pq.read_table(tmp_path / "out/episodes.parquet")
    assert resets["reset_info.place"].to_pylist() == [None, [1, 2]]
    assert resets["reset_info.near"].to_pylist() == [True, None]
    assert dataset.to_arrow()["info.why"].to_pylist() == [None, None, None, "ß"]


def test_a_null_inside_the_list_of_an_info_is_refused(tmp_path: Path) -> None:
    _vectors(infos=[{"place": [[1, 2], [3, 4]]}]).to_parquet(tmp_path / "out")
    path = tmp_path / "out/transitions.parquet"
    table = pq.read_table(path)
    field = table.schema.field("info.place")
    place = table.schema.get_field_index("info.place")
    values = [[3, None], *table["info.place"].to_pylist()[1:]]
    pq.write_table(table.set_column(place, field, pa.array(values, field.type)), path)
    with pytest.raises(LogError, match=r"info\.place is damaged: a list has nulls"):
        mcaprl.open(tmp_path / "out")


def test_infos_that_a_table_cannot_hold_are_refused(tmp_path: Path) -> None:
    for value, message in (
        (1j, "the info 'x' has complex128"),
        ("\ud800", "a text that is not UTF-8"),
    ):
        dataset = _vectors(infos=[{"x": [value, value], "y": [1, None]}])
        with pytest.raises(SpaceError, match=message):
            dataset.to_arrow()
        with pytest.raises(SpaceError, match=rf"{message}.*pass `lossy=True`"):
            dataset.to_parquet(tmp_path / "out")
        (lost,) = dataset.to_parquet(tmp_path / "out", lossy=True, overwrite=True)
        assert lost.startswith("the info 'x' has")
        assert mcaprl.open(tmp_path / "out").infos["y"].tolist() == [1, None]
        shutil.rmtree(tmp_path / "out")


def test_blocks_of_episodes_and_rows_are_one_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ours, "_BLOCK_BYTES", 100)
    dataset = _vectors(episodes=9, length=4)
    dataset.to_parquet(tmp_path / "out")
    _same(dataset, mcaprl.open(tmp_path / "out"))
    assert pq.ParquetFile(tmp_path / "out/transitions.parquet").num_row_groups > 9


def test_a_part_of_the_observations(tmp_path: Path) -> None:
    _recorded().save(tmp_path / "log.mcap")
    for columns in (["state"], []):
        dataset = mcaprl.open(tmp_path / "log.mcap", columns=columns)
        dataset.to_parquet(tmp_path / "out", overwrite=True)
        _same(dataset, mcaprl.open(tmp_path / "out"))


def test_a_row_is_a_transition_and_lists_have_their_shape(tmp_path: Path) -> None:
    _recorded().to_parquet(tmp_path / "out")
    table = pq.read_table(tmp_path / "out/transitions.parquet")
    assert table["observation_state"].to_pylist()[2:4] == [[2, 0.5], [10, 2.5]]
    assert table["next_observation_state"].to_pylist()[2:4] == [[3, 0.75], [11, 2.75]]
    assert table["observation_gear"].to_pylist() == [-1, 0, 1, -1, 0]
    assert table["action"].to_pylist()[0] == pytest.approx([-1, -9 / 11, -7 / 11, -5 / 11])
    assert table["step"].to_pylist() == [0, 1, 2, 0, 1]
    shapes = {field.name: (field.metadata or {}).get(b"shape") for field in table.schema}
    assert shapes["observation_camera"] == b"[8, 9, 3]"
    assert shapes["action"] == b"[2, 2]"
    assert shapes["observation_gear"] is None
    metadata = json.loads(table.schema.metadata[b"mcaprl.dataset"])
    assert json.loads(metadata["action_space"])["shape"] == [2, 2]
    episodes = pq.read_table(tmp_path / "out/episodes.parquet")
    assert episodes["final_observation_state"].to_pylist() == [[3, 0.75], [12, 3]]
    assert episodes["final_log_time_ns"].to_pylist() == [9, 23]
    assert episodes["options"].to_pylist() == ["", '{"track": 2}']


def test_next_observations_are_left_out_on_request(tmp_path: Path) -> None:
    dataset = _recorded()
    dataset.to_parquet(tmp_path / "out", next_observations=False)
    names = pq.read_schema(tmp_path / "out/transitions.parquet").names
    assert "observation_camera" in names
    assert not [name for name in names if name.startswith("next_")]
    _same(dataset, mcaprl.open(tmp_path / "out"))


def test_the_table_shares_memory_with_the_dataset() -> None:
    dataset = _vectors(episodes=2, length=5000)
    table = dataset.to_arrow(tensors="lists")
    for name, array, first in (
        ("reward", dataset.rewards, 0),
        ("action", dataset.actions, 0),
        ("behavior_prob", dataset.behavior_probs, 0),
        ("observation", dataset.frames, 0),
        ("next_observation", dataset.frames, 1),
    ):
        chunk = table[name].chunk(0)
        values = chunk.flatten() if pa.types.is_nested(chunk.type) else chunk
        shift = values.offset * values.type.bit_width // 8
        assert values.buffers()[1].address + shift == array[first:].ctypes.data, name
    # Each episode is a separate chunk, because its final frame is not in the column.
    assert [len(chunk) for chunk in table["observation"].chunks] == [5000, 5000]
    np.testing.assert_array_equal(
        table["next_observation"].combine_chunks().flatten().to_numpy().reshape(-1, 2),
        dataset.next_observations,
    )


def test_short_episodes_are_one_chunk() -> None:
    table = _vectors().to_arrow(tensors="lists")
    assert table["observation"].num_chunks == 1
    assert table["observation"].to_pylist() == [[0, 0], [1, -1], [2, -2], [4, -4], [5, -5], [6, -6]]


def test_columns_of_elements_are_the_default() -> None:
    table = _recorded().to_arrow()
    assert table["observation_state.1"].to_pylist() == [0, 0.25, 0.5, 2.5, 2.75]
    assert table["action.3"].type == pa.float64()
    with pytest.raises(mcaprl.McaprlError, match="did you mean lists"):
        _recorded().to_arrow(tensors="list")  # type: ignore[arg-type]


def test_keys_that_give_the_same_name_are_numbered(tmp_path: Path) -> None:
    image = spaces.Box(0, 255, (8, 9), np.uint8)
    space = spaces.Dict({"a": image, "observation": spaces.Dict({"a": image})})
    values = np.full((2, 8, 9), 1, np.uint8)
    dataset = Dataset.from_arrays(
        observations={"a": values, "observation": {"a": 2 * values}},
        next_observations={"a": values, "observation": {"a": 2 * values}},
        actions=np.zeros(2, int),
        rewards=np.zeros(2),
        terminated=[False, True],
        truncated=[False, False],
        observation_space=space,
        action_space=spaces.Discrete(2),
    )
    dataset.to_parquet(tmp_path / "out")
    _same(dataset, mcaprl.open(tmp_path / "out"))


def test_pandas_reads_it(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    dataset = _vectors()
    dataset.to_parquet(tmp_path / "out")
    steps = pandas.read_parquet(tmp_path / "out/transitions.parquet")
    np.testing.assert_array_equal(np.stack(steps["next_observation"]), dataset.next_observations)
    assert steps.groupby("episode")["reward"].sum().tolist() == [1.5, 6.0]
    episodes = pandas.read_parquet(tmp_path / "out/episodes.parquet")
    assert episodes["total_reward"].tolist() == [1.5, 6.0]


def test_polars_reads_it(tmp_path: Path) -> None:
    polars = _imported("polars")
    dataset = _recorded()
    dataset.to_parquet(tmp_path / "out")
    steps = polars.read_parquet(tmp_path / "out/transitions.parquet")
    camera = steps["observation_camera"].to_numpy().reshape(-1, 8, 9, 3)
    np.testing.assert_array_equal(camera, dataset.observations["camera"])
    assert steps.schema["observation_state"] == polars.Array(polars.Float32, 2)
    joined = steps.join(polars.read_parquet(tmp_path / "out/episodes.parquet"), on="episode")
    assert joined.filter(polars.col("reason") == "time")["reward"].to_list() == [0, 0.25]
    assert polars.from_arrow(dataset.to_arrow(tensors="lists"))["reward"].to_list()[0] == 0.1


def test_duckdb_reads_it(tmp_path: Path) -> None:
    duckdb = _imported("duckdb")
    _recorded().to_parquet(tmp_path / "out")
    rows = duckdb.sql(
        f"""select e.reason, count(*), sum(t.reward), max(t.next_observation_state[2])
        from '{tmp_path}/out/transitions.parquet' t
        join '{tmp_path}/out/episodes.parquet' e using (episode)
        group by all order by all"""
    ).fetchall()
    assert rows == [("goal", 3, pytest.approx(1.1), 0.75), ("time", 2, 0.25, 3)]
    connection = duckdb.connect()
    connection.register("steps", _vectors().to_arrow(tensors="lists"))
    assert connection.sql("select sum(observation[1]) from steps").fetchall() == [(18,)]


def test_polars_writes_it_back_with_the_metadata_missing(tmp_path: Path) -> None:
    polars = _imported("polars")
    _vectors().to_parquet(tmp_path / "out")
    path = tmp_path / "out/transitions.parquet"
    polars.read_parquet(path).write_parquet(path)
    with pytest.raises(LogError, match=r"transitions\.parquet has no metadata 'mcaprl\.dataset'"):
        mcaprl.open(tmp_path / "out")


def test_episodes_that_another_tool_removed(tmp_path: Path) -> None:
    dataset = _recorded()
    dataset.to_parquet(tmp_path / "out")
    steps, episodes = tmp_path / "out/transitions.parquet", tmp_path / "out/episodes.parquet"
    _filter(steps, "episode", 1)
    with pytest.raises(LogError, match="contain different or reordered steps"):
        mcaprl.open(tmp_path / "out")
    _filter(episodes, "episode", 1)
    assert mcaprl.open(tmp_path / "out").fingerprint == (
        dataset.filter(lambda episode: episode.index == 1).fingerprint
    )
    _filter(steps, "step", 1)
    with pytest.raises(LogError, match="contain different or reordered steps"):
        mcaprl.open(tmp_path / "out")


def test_a_damaged_file_is_refused_or_read_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "out/transitions.parquet"
    dataset = _vectors(episodes=3, length=20)
    dataset.to_parquet(path.parent)
    content, refused = path.read_bytes(), 0
    for place in range(0, len(content), 29):
        path.write_bytes(content[:place] + bytes([content[place] ^ 255]) + content[place + 1 :])
        try:
            _same(dataset, mcaprl.open(path.parent))
        except mcaprl.McaprlError:
            refused += 1
    assert refused > len(content) / 29 / 3
    path.write_bytes(content[:-20])
    with pytest.raises(LogError, match=r"transitions\.parquet cannot be read"):
        mcaprl.open(path.parent)


def test_columns_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "out/transitions.parquet"
    _vectors().to_parquet(path.parent)
    table = pq.read_table(path)

    def replaced(name: str, values: Any) -> None:
        pq.write_table(table.set_column(table.column_names.index(name), name, values), path)

    pq.write_table(table.drop_columns("observation"), path)
    with pytest.raises(LogError, match="has no column 'observation'"):
        mcaprl.open(path.parent)
    replaced("observation", pa.array(np.zeros(6)))
    with pytest.raises(SpaceError, match="observation is double, expected rows of shape"):
        mcaprl.open(path.parent)
    replaced("action", pa.array(np.full(6, 0.5)))
    with pytest.raises(SpaceError, match="action is float64 and cannot be converted exactly"):
        mcaprl.open(path.parent)
    replaced("action", pa.array(["left"] * 6))
    with pytest.raises(SpaceError, match="action is string, expected numbers"):
        mcaprl.open(path.parent)
    replaced("reward", pa.array([None] * 6, pa.float64()))
    with pytest.raises(LogError, match="reward has nulls"):
        mcaprl.open(path.parent)
    pq.write_table(table.replace_schema_metadata({"mcaprl.dataset": "[]"}), path)
    with pytest.raises(LogError, match=r"metadata 'mcaprl\.dataset'"):
        mcaprl.open(path.parent)


def _filter(path: Path, column: str, value: int) -> None:
    table = pq.read_table(path)
    pq.write_table(table.filter(pa.compute.equal(table[column], value)), path)


def _imported(name: str) -> Any:
    try:
        return __import__(name)
    except ImportError:
        need(False, f"{name} is not installed")

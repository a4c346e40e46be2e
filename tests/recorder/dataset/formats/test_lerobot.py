"""LeRobot datasets: written and read here, and exchanged with LeRobot in both directions."""

from __future__ import annotations

import json
import re
import shutil
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import assume, given, settings
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.offline.algorithms.config import BoxBCConfig
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.recorder.dataset.formats import lerobot_writer
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.dataset.formats.lerobot_features import Feature
from mcaprl.recorder.dataset.formats.lerobot_writer import QUANTILES, describe, pooled, sampled
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import leaves_of
from tests.support.lerobot.environment import run_lerobot
from tests.support.recordings import assert_same_bits
from tests.support.strategies import transitions
from tests.support.transitions import is_plain

pa = pytest.importorskip("pyarrow", reason="needs the extra tables")
parquet = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("PIL", reason="needs Pillow")

_GOLDEN = Path(__file__).parents[3] / "golden"
_CAMERAS = spaces.Dict(
    {
        "state": spaces.Box(-np.inf, np.inf, (2,), np.float32),
        "front": spaces.Box(0, 255, (16, 20, 3), np.uint8),
        "gray": spaces.Box(0, 255, (8, 9, 1), np.uint8),
        "arm": spaces.Dict({"depth": spaces.Box(0, np.inf, (9, 8), np.float32)}),
    }
)


def _observation(value: int) -> dict[str, Any]:
    depth = np.full((9, 8), value / 3, np.float32)
    depth[0, 0] = np.inf
    rising = np.broadcast_to(np.arange(16, dtype=np.uint8)[:, None, None], (16, 20, 3))
    return {
        "state": np.array([value, -value / 4], np.float32),
        "front": 8 * rising + np.uint8(value),
        "gray": np.full((8, 9, 1), 10 * value, np.uint8),
        "arm": {"depth": depth},
    }


def _stacked(values: list[Any]) -> Any:
    if isinstance(values[0], dict):
        return {key: _stacked([value[key] for value in values]) for key in values[0]}
    return np.stack(values)


def _cameras(step_ns: int = 100_000_000) -> Dataset:
    """Return a terminated episode of three steps and a truncated episode of two steps."""
    metadata = LogMetadata(
        _CAMERAS, spaces.Discrete(4), env_id="Arm-v0", step_duration_ns=step_ns, seed="9"
    )
    first = EpisodeArrays(
        observations=_stacked([_observation(value) for value in range(4)]),
        actions=np.array([0, 3, 1]),
        rewards=np.array([0.5, -1, 2]),
        terminated=True,
        truncated=False,
        behavior_probs=np.array([0.25, np.nan, 1], np.float32),
        times_ns=np.array([5, 6, 7, 8]) * step_ns,
        summary={"reason": "goal", "seed": 3, "policy": "random", "epsilon": 0.5},
    )
    second = EpisodeArrays(
        observations=_stacked([_observation(value) for value in range(10, 13)]),
        actions=np.array([2, 2]),
        rewards=np.array([0, 0.25]),
        terminated=False,
        truncated=True,
        times_ns=np.array([20, 21, 23]) * step_ns,
        summary={"reason": "time", "options": '{"task": "turn"}'},
    )
    return dataset_of([first, second], metadata, "test")


def _same_steps(first: Dataset, second: Dataset) -> None:
    """Check that LeRobot's frames come back.

    A terminated episode repeats its last observation; others lose their last transition.
    """
    lasts = np.cumsum(first.episode_lengths) - 1
    is_kept = np.ones(len(first), bool)
    is_kept[lasts] = first.terminated[lasts]
    kept = first.episode_lengths - ~first.terminated[lasts]
    assert second.episode_lengths.tolist() == kept[kept > 0].tolist()
    is_index = second.actions.ndim == 1
    shape, dtype = second.actions.shape[1:], np.int64 if is_index else first.actions.dtype
    actions = first.actions[is_kept].reshape(-1, *shape)
    assert_same_bits(second.actions, actions.astype(dtype))
    for name in ("rewards", "behavior"):
        assert_same_bits(getattr(second, name), getattr(first, name)[is_kept])
    assert second.terminated.tolist() == first.terminated[is_kept].tolist()
    assert (
        second.truncated[np.cumsum(second.episode_lengths) - 1].tolist()
        == (
            ~first.terminated[lasts][kept > 0]
            | (first.terminated & first.truncated)[lasts][kept > 0]
        ).tolist()
    )


def _same_frames(first: Dataset, second: Dataset) -> None:
    """Check the observations of all steps, leaf by leaf; images have a last axis of channels."""
    lasts = np.cumsum(first.episode_lengths) - 1
    is_kept = np.ones(len(first), bool)
    is_kept[lasts] = first.terminated[lasts]
    mine, theirs = leaves_of(first.observation_space), leaves_of(second.observation_space)
    for leaf, other in zip(mine, theirs, strict=True):
        rows = leaf.of(first.frames)[first.frame_of_step][is_kept]
        found = other.of(second.frames)[second.frame_of_step]
        assert_same_bits(found, rows.reshape(found.shape))


def test_all_frames_come_back_and_the_rest_is_said(tmp_path: Path) -> None:
    dataset = _cameras()
    assert dataset.to_lerobot(tmp_path / "out") == [
        "not written: the observation after the last action; mcaprl reads 1 episode that did not"
        " terminate without the last transition",
        "lerobot has no place for spaces, times, environment, policy names, seeds and reset"
        " options, end reasons, final observations after a termination, other metadata: a log"
        " keeps them",
    ]
    found, said = _opened(tmp_path / "out")
    assert [text.partition(" episode")[0] for text in said] == [
        "the final observation is not stored for 1 terminated",
        "the observation after the last action is not stored for 1 other",
    ]
    _same_steps(dataset, found)
    keys = {"state": "state", "front": "front", "gray": "gray", "arm.depth": "depth"}
    assert set(found.frames) == set(keys)
    for key in ("state", "front", "gray"):
        # The last observation before the termination is repeated, and the truncated episode ends
        # with the observation of its last frame.
        assert_same_bits(found.frames[key], dataset.frames[key][[0, 1, 2, 2, 4, 5]])
    depth = found.frames["arm.depth"][..., 0]
    assert_same_bits(depth, dataset.frames["arm"]["depth"][[0, 1, 2, 2, 4, 5]])
    assert [e.summary.options for e in found.episodes] == [
        '{"task": "Arm-v0"}',
        '{"task": "turn"}',
    ]


@settings(max_examples=40)
@given(transitions())
def test_all_spaces_and_values_come_back(arguments: dict[str, Any]) -> None:
    dataset = Dataset.from_arrays(**arguments)
    assume(is_plain(dataset) or dataset.actions.dtype.kind in "iu")
    assume(np.isfinite(dataset.rewards).all())
    unsigned = [dataset.actions, *dataset._transitions.frames]
    assume(all((np.asarray(a) < 2**63).all() for a in unsigned if a.dtype == np.uint64))
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        dataset.to_lerobot(Path(folder) / "out")
        if not dataset.terminated.any() and (dataset.episode_lengths == 1).all():
            with pytest.raises(LogError, match="has no transitions"):
                Dataset.from_lerobot(Path(folder) / "out")
            return
        found = Dataset.from_lerobot(Path(folder) / "out")
    _same_steps(dataset, found)
    _same_frames(dataset, found)


def _infos() -> dict[str, Any]:
    """Return infos of three steps: some have missing rows, and one exists only at the reset."""
    everywhere = np.ma.MaskedArray([0, 1, 2, 3], [True, False, False, False])
    at_end = np.ma.MaskedArray([0, 0, 0, 1.5], [True, True, True, False])
    texts = np.ma.MaskedArray(["", "a", "", "longer"], [True, False, False, False])
    at_reset = np.ma.MaskedArray(np.arange(24, dtype=np.int16).reshape(4, 2, 3), True)
    at_reset[0] = np.arange(6).reshape(2, 3)
    flags = np.ma.MaskedArray([[True, False]] * 4, False)
    return {
        "lap": everywhere,
        "episode.r": at_end,
        "says": texts,
        "map": at_reset,
        "an image/x": flags,
    }


def test_numbers_of_every_step_are_features_and_other_infos_are_named(tmp_path: Path) -> None:
    first = EpisodeArrays(
        observations=np.arange(4),
        actions=np.zeros(3, int),
        rewards=np.zeros(3),
        terminated=True,
        truncated=False,
        infos=_infos(),
    )
    metadata = LogMetadata(spaces.Discrete(4), spaces.Discrete(1))
    dataset = dataset_of([first, first], metadata, "test")
    assert dataset.to_lerobot(tmp_path / "out")[0] == (
        "not written: the infos episode.r, map, says; LeRobot has a place for numbers of every step"
    )
    with pytest.warns(UserWarning, match="the last observation is repeated"):
        found = Dataset.from_lerobot(tmp_path / "out").infos
    assert found["lap"].tolist() == [None, 1, 2, 3] * 2
    # LeRobot has no place for the infos of a reset.
    none, flags = [None, None], [True, False]
    assert found["an_img_x"].tolist() == [none, flags, flags, flags] * 2
    assert len(found) == 2
    table = parquet.read_table(tmp_path / "out/data/chunk-000/file-000.parquet")
    columns = [name for name in table.column_names if name.startswith("complementary_info.")]
    assert columns == ["complementary_info.lap", "complementary_info.an_img_x"]
    assert table["complementary_info.lap"].to_pylist() == [1, 2, 3] * 2
    assert table["complementary_info.an_img_x"].to_pylist() == [[True, False]] * 6


def test_the_files_have_lerobots_names_types_and_numbers(tmp_path: Path) -> None:
    out = tmp_path / "out"
    _cameras().to_lerobot(out)
    info = json.loads((out / "meta/info.json").read_text())
    facts = ("codebase_version", "fps", "total_episodes", "total_frames", "splits")
    assert [info[fact] for fact in facts] == ["v3.0", 10, 2, 5, {"train": "0:2"}]
    shapes = {name: (f["dtype"], f["shape"]) for name, f in info["features"].items()}
    assert shapes == {
        "observation.state": ("float32", [2]),
        "observation.images.front": ("image", [16, 20, 3]),
        "observation.images.gray": ("image", [8, 9, 1]),
        "observation.images.arm.depth": ("image", [9, 8, 1]),
        "action": ("int64", [1]),
        "next.reward": ("float32", [1]),
        "next.done": ("bool", [1]),
        "next.truncated": ("bool", [1]),
        "complementary_info.behavior_prob": ("float32", [1]),
        "timestamp": ("float32", [1]),
        "frame_index": ("int64", [1]),
        "episode_index": ("int64", [1]),
        "index": ("int64", [1]),
        "task_index": ("int64", [1]),
    }
    depth = info["features"]["observation.images.arm.depth"]["info"]
    assert depth == {"is_depth_map": True, "depth_unit": "m"}
    file = parquet.ParquetFile(out / "data/chunk-000/file-000.parquet")
    table = file.read()
    assert file.num_row_groups == 2
    assert table.column_names == list(shapes)
    assert table["observation.state"].type == pa.list_(pa.float32(), 2)
    assert table["next.done"].to_pylist() == [False, False, True, False, False]
    assert table["next.truncated"].to_pylist() == [False, False, False, False, True]
    assert table["frame_index"].to_pylist() == [0, 1, 2, 0, 1]
    assert table["task_index"].to_pylist() == [0, 0, 0, 1, 1]
    np.testing.assert_allclose(table["timestamp"].to_numpy(), [0, 0.1, 0.2, 0, 0.1], rtol=1e-7)
    episodes = parquet.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    keys = ("length", "tasks", "dataset_from_index", "dataset_to_index")
    assert [[row[key] for key in keys] for row in episodes] == [
        [3, ["Arm-v0"], 0, 3],
        [2, ["turn"], 3, 5],
    ]
    # The rewards of the first episode are 0.5, -1 and 2. Their mean is 0.5, and their variance is
    # (0 + 2.25 + 2.25) / 3.
    assert episodes[0]["stats/next.reward/mean"] == [0.5]
    assert episodes[0]["stats/next.reward/std"] == [np.sqrt(1.5)]
    assert episodes[0]["stats/next.reward/q50"] == [0.5]
    # The gray images have the values 0, 10 and 20.
    assert episodes[0]["stats/observation.images.gray/mean"] == [[[pytest.approx(10 / 255)]]]


def test_pandas_finds_the_tasks_as_the_index(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    _cameras().to_lerobot(tmp_path / "out")
    tasks = pandas.read_parquet(tmp_path / "out/meta/tasks.parquet")
    assert tasks.index.name == "task"
    assert tasks["task_index"].to_dict() == {"Arm-v0": 0, "turn": 1}


def test_statistics_of_vectors_images_and_all_episodes() -> None:
    vector = Feature("action", "float32", (2,))
    first = describe(vector, np.array([[0, 1], [2, 5]], np.float32))
    assert {name: array.tolist() for name, array in first.items()} == {
        "min": [0, 1],
        "max": [2, 5],
        "mean": [1, 3],
        "std": [1, 2],
        "count": [2],
        "q01": pytest.approx([0.02, 1.04]),
        "q10": pytest.approx([0.2, 1.4]),
        "q50": [1, 3],
        "q90": pytest.approx([1.8, 4.6]),
        "q99": pytest.approx([1.98, 4.96]),
    }
    second = describe(vector, np.array([[4, 3]] * 2, np.float32))
    both = pooled([first, second])
    # The first elements of the vectors are 0, 2, 4 and 4. Their mean is 2.5, and their variance is
    # (6.25 + 0.25 + 2.25 + 2.25) / 4.
    assert (both["mean"][0], both["std"][0]) == (2.5, pytest.approx(np.sqrt(2.75)))
    assert (both["min"][0], both["max"][0], both["count"][0]) == (0, 4, 4)
    assert both["q50"][0] == 2.5
    image = Feature("observation.image", "image", (1, 2, 3))
    pixels = np.array([[[[0, 51, 255], [255, 51, 255]]]], np.uint8)
    found = describe(image, pixels)
    assert found["mean"].shape == (3, 1, 1)
    np.testing.assert_allclose(found["mean"].ravel(), [0.5, 0.2, 1])
    assert found["max"].ravel().tolist() == [1, 0.2, 1]
    assert sampled(image, 3).tolist() == [0, 1, 2]
    assert len(sampled(image, 5000)) == 100
    assert sampled(image, 5000)[[0, -1]].tolist() == [0, 4999]
    assert len(sampled(Feature("depth", "image", (480, 640, 1), is_depth=True), 5000)) == 13


@given(arrays(np.uint8, (3, 4, 5, 2)))
def test_statistics_of_images_are_those_of_their_pixels(pixels: NDArray[np.uint8]) -> None:
    found = describe(Feature("observation.image", "image", (4, 5, 2)), pixels)
    rows = pixels.reshape(-1, 2) / 255
    assert found["count"].tolist() == [3]
    expected = {"mean": rows.mean(0), "std": rows.std(0), "min": rows.min(0), "max": rows.max(0)}
    expected |= {name: np.quantile(rows, share, axis=0) for name, share in QUANTILES.items()}
    for name, values in expected.items():
        np.testing.assert_allclose(found[name].ravel(), values, atol=1e-12)


def test_a_file_ends_at_its_size_and_a_folder_at_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot_writer, "MAX_FILE_BYTES", 1)
    monkeypatch.setattr(lerobot_writer, "CHUNK_FILES", 2)
    dataset = Dataset.concatenate([_cameras(), _cameras()])
    dataset.to_lerobot(tmp_path / "out")
    files = sorted(str(p.relative_to(tmp_path / "out")) for p in tmp_path.glob("out/data/*/*"))
    assert files == [
        f"data/chunk-00{chunk}/file-00{number}.parquet" for chunk in (0, 1) for number in (0, 1)
    ]
    table = parquet.read_table(tmp_path / "out/meta/episodes/chunk-000/file-000.parquet")
    assert table["data/chunk_index"].to_pylist() == [0, 0, 1, 1]
    assert table["data/file_index"].to_pylist() == [0, 1, 0, 1]
    with pytest.warns(UserWarning, match="is not stored for 2"):
        _same_steps(dataset, Dataset.from_lerobot(tmp_path / "out"))


@pytest.mark.parametrize(
    ("step_ns", "fps"), [(80_000_000, 12.5), (33_333_333, 30), (16_666_667, 60), (10**9, 1)]
)
def test_the_rate_is_whole_where_the_steps_allow_it(
    tmp_path: Path, step_ns: int, fps: float
) -> None:
    _cameras(step_ns).to_lerobot(tmp_path / "out")
    found = json.loads((tmp_path / "out/meta/info.json").read_text())["fps"]
    assert (found, isinstance(found, int)) == (fps, fps != 12.5)
    with pytest.warns(UserWarning, match="is not stored for 1"):
        data = Dataset.from_lerobot(tmp_path / "out")
    assert abs(int(data.metadata["step_duration_ns"]) - step_ns) <= 1


def test_rewards_that_32_bits_change_are_stored_in_64(tmp_path: Path) -> None:
    dataset = Dataset.from_arrays(
        observations=np.zeros((1, 2), np.float32),
        next_observations=np.ones((1, 2), np.float32),
        actions=np.zeros((1, 3), np.float32),
        rewards=[0.1],
        terminated=[True],
        truncated=[False],
    )
    dataset.to_lerobot(tmp_path / "out")
    table = parquet.read_table(tmp_path / "out/data/chunk-000/file-000.parquet")
    assert table["next.reward"].to_pylist() == [0.1]
    with pytest.warns(UserWarning, match="the last observation is repeated"):
        _same_steps(dataset, Dataset.from_lerobot(tmp_path / "out"))


def test_video_changes_pixels_and_so_needs_leave(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="needs the extra video")
    dataset = _cameras()
    with pytest.raises(SpaceError, match=r"observation.images.front is compressed as video"):
        dataset.to_lerobot(tmp_path / "out", video=True)
    assert not (tmp_path / "out").exists()
    lost = dataset.to_lerobot(tmp_path / "out", video=True, lossy=True)
    assert [sentence.split()[0] for sentence in lost[:2]] == [
        "observation.images.front",
        "observation.images.gray",
    ]
    found, _ = _opened(tmp_path / "out")
    rows = [0, 1, 2, 2, 4, 5]
    for key in ("front", "gray"):
        # In a video, a gray image has three equal channels.
        difference = np.abs(found.frames[key].astype(int) - dataset.frames[key][rows])
        assert difference.max() <= 8
    assert_same_bits(found.frames["arm.depth"][..., 0], dataset.frames["arm"]["depth"][rows])
    assert_same_bits(found.rewards, dataset.rewards[[0, 1, 2, 3]])


def test_what_lerobot_cannot_hold_is_refused_by_name_or_flattened(tmp_path: Path) -> None:
    def one(values: NDArray[Any]) -> Dataset:
        return Dataset.from_arrays(
            observations=values,
            next_observations=values,
            actions=[0],
            rewards=[0],
            terminated=[True],
            truncated=[False],
        )

    with pytest.raises(SpaceError, match=r"observation.state has values of 2\^63 or more"):
        one(np.full((1, 2), 2**63, np.uint64)).to_lerobot(tmp_path / "out", lossy=True)
    many = one(np.arange(2, dtype=np.float32).reshape(1, 1, 1, 1, 1, 1, 2))
    with pytest.raises(SpaceError, match=r"observation.state of shape \(1, 1, 1, 1, 1, 2\)"):
        many.to_lerobot(tmp_path / "out")
    assert "is flattened" in many.to_lerobot(tmp_path / "out", lossy=True)[0]
    with pytest.warns(UserWarning, match="the last observation is repeated"):
        _same_frames(many, Dataset.from_lerobot(tmp_path / "out"))


def _golden(kind: str) -> tuple[Dataset, list[str]]:
    return _opened(_GOLDEN / f"lerobot-{kind}")


def _opened(path: Path) -> tuple[Dataset, list[str]]:
    """Open a dataset, and return it with the texts of the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dataset = mcaprl.open(path)
    return dataset, [str(warning.message).removeprefix(f"{path}: ") for warning in caught]


def test_a_dataset_of_lerobots_writer_with_rewards_and_images() -> None:
    dataset, said = _golden("image")
    assert [text.partition(" episode")[0] for text in said] == [
        "'next.done' may also mean truncation, because there is no feature 'next.truncated'; it is"
        " read as termination",
        "the final observation is not stored for 1 terminated",
        "the observation after the last action is not stored for 1 other",
    ]
    space = dataset.observation_space
    assert isinstance(space, spaces.Dict)
    assert {key: part.shape for key, part in space.items()} == {
        "state": (2,),
        "front": (32, 48, 3),
        "wrist": (32, 32, 3),
    }
    assert dataset.episode_lengths.tolist() == [4, 2]
    # The observation of the terminal frame is repeated as the final observation. In the truncated
    # episode, the last frame is the final observation.
    assert dataset.frames["front"][:, 5, 7, 1].tolist() == [0, 40, 80, 120, 120, 1, 41, 81]
    assert dataset.frames["wrist"][:, 0, 0, 0].tolist() == [0, 30, 60, 90, 90, 100, 130, 160]
    assert dataset.frames["state"][-3:].tolist() == [[1, 0], [1, 0.25], [1, 0.5]]
    assert dataset.actions.shape == (6, 2, 3)
    assert dataset.actions[4].tolist() == [[10, 11, 12], [13, 14, 15]]
    assert dataset.rewards.tolist() == [0, 1, 2, 3, 0.5, 1.5]
    assert dataset.terminated.tolist() == [False, False, False, True, False, False]
    assert dataset.truncated.tolist() == [False, False, False, False, False, True]
    assert np.isnan(dataset.behavior_log_probs).all()
    assert [e.summary.options for e in dataset.episodes] == [
        '{"task": "lift the cube"}',
        '{"task": "drop the cube"}',
    ]
    penalties = dataset.infos["discrete_penalty"]
    assert penalties.tolist() == [None, 0, -0.5, -1, -1.5, None, 0, -0.5]
    times = [episode.log_time_ns.tolist() for episode in dataset.episodes]
    assert times == [[k * 10**8 for k in range(5)], [k * 10**8 for k in (5, 6, 7)]]


def test_a_dataset_of_lerobots_writer_with_videos_and_without_rewards() -> None:
    pytest.importorskip("av", reason="needs the extra video")
    dataset, said = _golden("video")
    assert said[0] == "there is no feature 'next.reward': all rewards are NaN"
    assert len(said) == 2
    assert dataset.episode_lengths.tolist() == [3, 2]
    front = dataset.frames["front"][:, 16, 24].astype(int)
    expected = np.array([0, 40, 80, 120, 1, 41, 81])
    assert np.abs(front - expected[:, None]).max() <= 3
    assert np.isnan(dataset.rewards).all()
    assert dataset.truncated.tolist() == [False, False, True, False, True]


def test_lerobots_names_and_values_survive_a_way_through_a_log(tmp_path: Path) -> None:
    dataset, _ = _golden("image")
    dataset.save(tmp_path / "log.mcap")
    mcaprl.convert(tmp_path / "log.mcap", tmp_path / "out", to="lerobot")
    found = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    golden = json.loads((_GOLDEN / "lerobot-image/meta/info.json").read_text())["features"]
    for name in ("observation.state", "observation.images.front", "observation.images.wrist"):
        assert (found[name]["dtype"], found[name]["shape"]) == (
            golden[name]["dtype"],
            golden[name]["shape"],
        )
    tasks = parquet.read_table(tmp_path / "out/meta/tasks.parquet")
    assert tasks["task"].to_pylist() == ["lift the cube", "drop the cube"]


def _edited(path: Path, edit: Any) -> None:
    """Replace the table in the data file by `edit(table)`."""
    file = path / "data/chunk-000/file-000.parquet"
    parquet.write_table(edit(parquet.read_table(file)), file)


def _with(table: Any, name: str, values: Any) -> Any:
    return table.set_column(table.column_names.index(name), name, values)


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """Return the folder of a written dataset."""
    _cameras().to_lerobot(tmp_path / "out")
    return tmp_path / "out"


def test_a_done_frame_in_the_middle_ends_an_episode(written: Path) -> None:
    _edited(written, lambda t: _with(t, "next.done", pa.array([True, False, False, False, False])))
    with pytest.warns(UserWarning, match="is not stored for 2 other episodes"):
        dataset = Dataset.from_lerobot(written)
    # The next observation of the done frame is the observation of the following frame.
    assert dataset.episode_lengths.tolist() == [1, 1, 1]
    assert dataset.frames["state"][:, 0].tolist() == [0, 1, 1, 2, 10, 11]
    assert dataset.terminated.tolist() == [True, False, False]
    assert dataset.actions.tolist() == [0, 3, 2]
    assert dataset.behavior_probs[0] == 0.25


def test_irregular_timestamps_become_times(written: Path) -> None:
    times = pa.array([0, 0.1, 0.35, 0, 0.1], pa.float32())
    _edited(written, lambda t: _with(t, "timestamp", times))
    with pytest.warns(UserWarning, match="is not stored for 1"):
        dataset = Dataset.from_lerobot(written)
    found = dataset.episodes[0].log_time_ns / 1e9
    np.testing.assert_allclose(found, [0, 0.1, 0.35, 0.45], rtol=1e-6)


def test_features_without_numbers_are_left_out_and_named(written: Path) -> None:
    info = json.loads((written / "meta/info.json").read_text())
    text = {"dtype": "string", "shape": [1], "names": None}
    info["features"] |= {"observation.says": text, "subtask": text}
    (written / "meta/info.json").write_text(json.dumps(info))
    dataset, said = _opened(written)
    assert "the feature 'observation.says' of type string is left out" in said
    assert "the feature 'subtask' of type string is left out" in said
    assert isinstance(dataset.observation_space, spaces.Dict)
    assert "says" not in dataset.observation_space.spaces


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: _set_info(p, codebase_version="v2.1"), "version v2.1; convert it to v3.0"),
        (lambda p: _set_info(p, fps=0), "fps is 0"),
        (lambda p: _set_info(p, features={}), "no feature 'observation"),
        (lambda p: (p / "meta/info.json").write_text("{}"), "damaged LeRobot dataset: KeyError"),
        (lambda p: shutil.rmtree(p / "data"), "no column 'episode_index'"),
        (lambda p: shutil.rmtree(p / "meta/episodes"), "no table of episodes"),
        (lambda p: _edited(p, lambda t: t.slice(0, 4)), "do not agree"),
        (lambda p: _edited(p, lambda t: t.drop_columns(["action"])), "no column 'action'"),
        (
            lambda p: _edited(p, lambda t: _with(t, "action", pa.array([None, 1, 2, 3, 1]))),
            "action has missing values",
        ),
        (
            lambda p: _edited(p, lambda t: _with(t, "action", pa.array(["a"] * 5))),
            "action has values of type string",
        ),
        (
            lambda p: _edited(p, lambda t: _with(t, "observation.images.front", _broken(t))),
            "an image of observation.images.front is damaged",
        ),
        (lambda p: (p / "data/chunk-000/file-000.parquet").write_bytes(b"PAR1"), "damaged"),
        (lambda p: _rename(p, "observation.state", "observation/state"), "slash in its name"),
    ],
)
def test_damage_is_named(written: Path, damage: Any, message: str) -> None:
    damage(written)
    with pytest.raises(LogError, match=message):
        Dataset.from_lerobot(written)


def test_a_changed_byte_of_the_data_is_found(written: Path) -> None:
    file = written / "data/chunk-000/file-000.parquet"
    content = bytearray(file.read_bytes())
    # The byte is in the first page, which has the states of the first episode.
    content[content.index(np.float32(-0.25).tobytes())] ^= 1
    file.write_bytes(content)
    with pytest.raises(LogError, match="CRC"):
        Dataset.from_lerobot(written)


def test_videos_in_several_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("av", reason="needs the extra video")
    monkeypatch.setattr(lerobot_writer, "MAX_VIDEO_BYTES", 1)
    dataset = Dataset.concatenate([_cameras(), _cameras()])
    dataset.to_lerobot(tmp_path / "out", video=True, lossy=True)
    # The encoder delays some images, so a file can contain more than one episode.
    assert len(list((tmp_path / "out/videos/observation.images.front/chunk-000").iterdir())) > 1
    found, _ = _opened(tmp_path / "out")
    rows = [0, 1, 2, 2, 4, 5, 7, 8, 9, 9, 11, 12]
    difference = np.abs(found.frames["gray"].astype(int) - dataset.frames["gray"][rows])
    assert difference.max() <= 8


def _set_info(path: Path, **changes: Any) -> None:
    info = json.loads((path / "meta/info.json").read_text())
    (path / "meta/info.json").write_text(json.dumps(info | changes))


def _rename(path: Path, old: str, new: str) -> None:
    text = (path / "meta/info.json").read_text()
    (path / "meta/info.json").write_text(text.replace(old, new))


def _broken(table: Any) -> Any:
    rows = table["observation.images.front"].to_pylist()
    rows[1]["bytes"] = rows[1]["bytes"][:40]
    return pa.array(rows, table["observation.images.front"].type)


def test_lerobot_reads_what_we_write(written: Path, tmp_path: Path) -> None:
    run_lerobot("read", written, tmp_path / "items.npz", folder=tmp_path)
    dataset = _cameras()
    with np.load(tmp_path / "items.npz", allow_pickle=False) as items:
        steps = dataset.frame_of_step
        np.testing.assert_array_equal(items["observation.state"], dataset.observations["state"])
        for key in ("front", "gray"):
            pixels = np.moveaxis(items[f"observation.images.{key}"], 1, -1) * 255
            np.testing.assert_allclose(pixels, dataset.frames[key][steps], atol=1e-4)
        depth = items["observation.images.arm.depth"]
        assert depth.dtype == np.float32
        np.testing.assert_array_equal(depth[:, 0], dataset.frames["arm"]["depth"][steps])
        assert items["action"].tolist() == [0, 3, 1, 2, 2]
        assert items["next.reward"].tolist() == [0.5, -1, 2, 0, 0.25]
        assert items["next.done"].tolist() == [False, False, True, False, False]
        assert items["next.truncated"].tolist() == [False, False, False, False, True]
        np.testing.assert_array_equal(
            items["complementary_info.behavior_prob"], dataset.behavior_probs
        )
        assert items["task"].tolist() == ["Arm-v0"] * 3 + ["turn"] * 2
        assert items["lengths"].tolist() == [3, 2]
        assert items["fps"] == 10
        assert items["stats/next.reward/mean"].tolist() == [pytest.approx(1.75 / 5)]
        assert items["stats/observation.images.front/q99"].shape == (3, 1, 1)


def test_lerobot_finds_the_images_of_our_videos(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="needs the extra video")
    dataset = _cameras()
    dataset.to_lerobot(tmp_path / "out", video=True, lossy=True)
    run_lerobot("read", tmp_path / "out", tmp_path / "items.npz", folder=tmp_path)
    found = _opened(tmp_path / "out")[0].observations["front"]
    with np.load(tmp_path / "items.npz", allow_pickle=False) as items:
        # The last frame of the truncated episode is only an observation.
        pixels = np.moveaxis(items["observation.images.front"][:4], 1, -1) * 255
        np.testing.assert_allclose(pixels, found, atol=1e-4)


def test_a_log_is_read_like_its_dataset(tmp_path: Path, written: Path) -> None:
    """Items of a log equal those that LeRobot reads from the converted log, bit for bit."""
    _cameras().save(tmp_path / "log.mcap")
    run_lerobot("same", tmp_path / "log.mcap", written, folder=tmp_path)


def test_items_of_an_episode_are_padded_by_its_ends() -> None:
    data = _cameras()
    steps = {"action": [-0.1, 0.0, 0.3], "observation.images.gray": [0.1]}
    items = data.as_lerobot(episodes=[1], delta_timestamps=steps, image_transforms=torch.neg)
    assert (len(items), items.num_episodes, items.meta.total_frames) == (2, 1, 5)
    first = items[0]
    # The actions of the episode are 2 and 2, those before it 0, 3 and 1.
    assert first["action"].tolist() == [2, 2, 2]
    assert first["action_is_pad"].tolist() == [True, False, True]
    # The image of the second frame has the value 110.
    np.testing.assert_allclose(first["observation.images.gray"], np.full((1, 1, 8, 9), -110 / 255))
    assert first["observation.images.arm.depth"].isinf().any()
    assert (first["index"].item(), first["frame_index"].item(), first["task"]) == (3, 0, "turn")
    assert items[-1]["index"].item() == 4
    with pytest.raises(IndexError):
        items[2]
    with pytest.raises(AttributeError, match="no 'motors'"):
        _ = items.meta.motors


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"episodes": [2]}, "there is no episode 2, but 2 episodes"),
        ({"delta_timestamps": {"torque": [0.0]}}, "has 'torque'; the features are observation.im"),
        (
            {"delta_timestamps": {"action": [0.0, 0.05]}},
            "'action' has 0.05 s, which is no multiple",
        ),
    ],
)
def test_options_that_do_not_fit_are_named(options: dict[str, Any], text: str) -> None:
    with pytest.raises(UsageError, match=re.escape(text)):
        _cameras().as_lerobot(**options)


def test_lerobot_merges_what_we_write(tmp_path: Path) -> None:
    space = spaces.Dict({key: _CAMERAS[key] for key in ("state", "front")})
    values = _stacked([_observation(value) for value in range(4)])
    episode = EpisodeArrays(
        observations={key: values[key] for key in ("state", "front")},
        actions=np.arange(6, dtype=np.float32).reshape(3, 2),
        rewards=np.array([1.0, 2, 4]),
        terminated=True,
        truncated=False,
    )
    metadata = LogMetadata(space, spaces.Box(-np.inf, np.inf, (2,), np.float32))
    dataset_of([episode], metadata, "test").to_lerobot(tmp_path / "out")
    run_lerobot("merge", tmp_path / "out", tmp_path / "merged", folder=tmp_path)
    with pytest.warns(UserWarning, match="is not stored for 2 terminated episodes"):
        merged = Dataset.from_lerobot(tmp_path / "merged")
    assert merged.rewards.tolist() == [1, 2, 4, 1, 2, 4]
    np.testing.assert_array_equal(merged.observations["front"][3:], values["front"][:3])
    assert merged.terminated.tolist() == [False, False, True] * 2
    assert merged.actions[-1].tolist() == [4, 5]


def test_rates_and_tasks() -> None:
    metadata = LogMetadata(spaces.Discrete(2), spaces.Discrete(2))
    assert lerobot_writer.task_of("", metadata) == "act"
    assert lerobot_writer.task_of("[1]", metadata) == "act"
    assert lerobot_writer.task_of('{"task": "lift"}', metadata) == "lift"
    assert lerobot_writer.frames_per_second(33_333_333) == 30


@pytest.mark.filterwarnings("ignore:.*the final observation is not stored")
def test_lerobot_has_the_same_chunks(tmp_path: Path) -> None:
    """Chunks, their padding, and relative actions are those of our training."""
    random = np.random.default_rng(0)
    ends = np.isin(np.arange(12), [5, 8, 11])
    seen = random.uniform(-1, 1, (12, 3)).astype(np.float32)
    data = Dataset.from_arrays(
        observations=seen,
        next_observations=np.concatenate([seen[1:], seen[-1:]]),
        actions=random.uniform(-4, 4, (12, 2)).astype(np.float32),
        rewards=np.ones(12),
        terminated=ends,
        truncated=np.zeros(12, bool),
        observation_space=spaces.Box(-1, 1, (3,), np.float32),
        action_space=spaces.Box(-4, 4, (2,), np.float32),
    ).with_relative_actions({1: 2})
    data.save(tmp_path / "log.mcap")
    notes = mcaprl.open(tmp_path / "log.mcap").to_lerobot(tmp_path / "written")
    assert any("which observations the actions are relative to" in note for note in notes)
    run_lerobot("chunks", tmp_path / "written", tmp_path / "items.npz", folder=tmp_path)
    items = np.load(tmp_path / "items.npz")
    buffer = TransitionBuffer.from_dataset(data, BoxBCConfig(chunk=4).packing)
    rows = torch.arange(12)
    actions, exist = buffer.chunks(rows)
    np.testing.assert_array_equal(items["action_is_pad"], ~exist.numpy())
    np.testing.assert_allclose(items["action"], 4 * actions.numpy(), atol=1e-6)
    # The difference of LeRobot's chunk and state is ours, and so are its ranges.
    relative = buffer.relative
    assert relative is not None
    numbers = relative.numbers(actions, buffer.batch(rows).observations.vector).double()
    scaled = relative.low + (numbers + 1) / 2 * (relative.high - relative.low)
    theirs = items["action"][:, :, 1] - items["observation.state"][:, None, 2]
    np.testing.assert_allclose(4 * scaled[:, :, 1].numpy(), theirs, atol=1e-5)
    own = theirs[exist.numpy()]
    steps = np.broadcast_to(np.arange(4), exist.shape)[exist.numpy()]
    for step in range(4):
        found = own[steps == step]
        np.testing.assert_allclose(4 * float(relative.low[step, 1]), found.min(), atol=1e-5)
        np.testing.assert_allclose(4 * float(relative.high[step, 1]), found.max(), atol=1e-5)
    again = mcaprl.open(tmp_path / "written")
    assert again.relative_to == ()
    np.testing.assert_array_equal(again.actions, data.actions)

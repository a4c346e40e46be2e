"""Minari datasets: written by Minari and read here, and written here and read by Minari."""

from __future__ import annotations

import importlib.util
import json
import sys
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import assume, given, settings

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import LogError, MissingExtraError, OutputExistsError, SpaceError, UsageError
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.dataset.formats.minari_metadata import local_path, space_to_text
from mcaprl.recorder.format.metadata import LogMetadata
from tests.conftest import need
from tests.recorder.dataset.formats.minari_sets import Cameras, collect
from tests.support.paths import GOLDEN
from tests.support.recordings import assert_same_bits
from tests.support.strategies import transitions
from tests.support.transitions import same_transitions

h5py = pytest.importorskip("h5py", reason="needs the extra interop")

_HAS_MINARI = all(importlib.util.find_spec(name) for name in ("minari", "jax", "pyarrow"))
_FORMS = ["hdf5", "arrow", "parquet"]
# Options of each reset, by environment.
_OPTIONS: dict[str, list[dict[str, Any] | None]] = {
    "mcaprl/LaneKeeping-v0": [None, {"pose": [1.0, 0.5, 0.25]}, {"pose": [2.0, 0.0, 0.0]}],
    "CartPole-v1": [None, {"low": -0.01, "high": 0.02}, None],
    "cameras": [None, {"limit": 3}, {"limit": 4, "task": "turn"}],
}


@pytest.fixture(autouse=True)
def _datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))


@pytest.fixture
def minari() -> Any:
    need(_HAS_MINARI, "minari[create,hdf5,arrow]")
    import minari

    return minari


def _same_tree(first: Any, second: Any) -> None:
    """Check that arrays, or nested dicts of arrays, have equal dtypes, shapes and bits."""
    if isinstance(first, dict):
        assert set(first) == set(second)
        for key, part in first.items():
            _same_tree(part, second[key])
        return
    assert_same_bits(first, second)


def _same_transitions(ours: Dataset, theirs: Any) -> None:
    """Check that each episode of a MinariDataset equals the episode in `ours`, bit for bit."""
    assert len(ours.episodes) == len(theirs)
    for index, episode in enumerate(theirs):
        own = ours.episodes[index]
        frames = slice(
            *(ours.episode_lengths[:index].sum() + index + np.array([0, own.length + 1]))
        )
        _same_tree(_rows(ours.frames, frames), episode.observations)
        _same_tree(own.actions, episode.actions)
        _same_tree(own.rewards, episode.rewards)
        _same_tree(own.terminated, episode.terminations)
        _same_tree(own.truncated, episode.truncations)


def _rows(tree: Any, rows: slice) -> Any:
    if isinstance(tree, dict):
        return {key: _rows(part, rows) for key, part in tree.items()}
    return tree[rows]


def _summaries(data: Dataset, *names: str) -> list[tuple[Any, ...]]:
    return [tuple(getattr(episode.summary, name) for name in names) for episode in data.episodes]


def _vector(**fields: Any) -> Dataset:
    """Return a terminated episode of two steps, and an episode of one step without an end flag."""
    metadata = LogMetadata(
        spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(3, start=-1), env_id="Toy-v0"
    )
    first = EpisodeArrays(
        observations=np.array([[0, 1], [0.5, 0], [1, 1]], np.float32),
        actions=np.array([-1, 1]),
        rewards=np.array([0.1, 2]),
        terminated=True,
        truncated=False,
        behavior_probs=np.array([0.25, np.nan], np.float32),
        times_ns=np.array([5, 6, 8]) * 10**9,
        summary={"reason": "goal", "seed": 7, "policy": "pid", "epsilon": 0.5, **fields},
    )
    second = EpisodeArrays(
        observations=np.zeros((2, 2), np.float32),
        actions=np.array([0]),
        rewards=np.array([-0.0]),
        terminated=False,
        truncated=False,
        times_ns=np.array([20, 21]) * 10**9,
    )
    return dataset_of([first, second], metadata, "test")


@pytest.mark.parametrize("form", _FORMS)
@pytest.mark.parametrize("env_id", list(_OPTIONS))
def test_a_collected_dataset_equals_the_log_of_the_same_episodes(
    minari: Any, tmp_path: Path, env_id: str, form: str
) -> None:
    env = Cameras() if env_id == "cameras" else gym.make(env_id, max_episode_steps=30)
    options = _OPTIONS[env_id]
    path = tmp_path / "log.mcap"
    collect(env, "drive/part/collected-v2", log=path, data_format=form, options=options)
    log = mcaprl.open(tmp_path / "log.mcap")
    found = mcaprl.open("minari:drive/part/collected-v2")
    assert found.fingerprint == log.fingerprint
    fields = ("length", "total_reward", "terminated", "truncated", "seed")
    assert _summaries(found, *fields) == _summaries(log, *fields)
    assert [seed for *_, seed in _summaries(found, *fields)] == [3, 4, 5]
    assert [json.loads(text or "null") for (text,) in _summaries(found, "options")] == options
    assert (found.env_id, found.env_kwargs) == (log.env_id, log.env_kwargs)
    assert found.metadata["policy"] == "random"
    # A log keeps the description of the dataset, and writes it to a new Minari dataset.
    found.save(tmp_path / "kept.mcap")
    mcaprl.open(tmp_path / "kept.mcap").to_minari("minari:drive/again-v0")
    about = json.loads((tmp_path / "sets/drive/again-v0/data/metadata.json").read_bytes())
    assert about["description"] == "Test data."
    assert about["author_email"] == json.loads(found.metadata["about"])["author_email"]
    facts = mcaprl.info("minari:drive/part/collected-v2")
    assert (facts.steps, facts.env_id) == (len(log), log.env_id)


@pytest.mark.parametrize("kind", ["lane", "cameras"])
def test_minari_loads_what_is_written(minari: Any, tmp_path: Path, kind: str) -> None:
    env = Cameras() if kind == "cameras" else gym.make("mcaprl/LaneKeeping-v0", max_episode_steps=9)
    options = _OPTIONS["cameras" if kind == "cameras" else "mcaprl/LaneKeeping-v0"]
    collect(env, "made-v0", log=tmp_path / "log.mcap", options=options)
    log = mcaprl.open(tmp_path / "log.mcap")
    (sentence,) = log.to_minari("minari:a/b/written-v1")
    assert sentence.startswith("minari has no place for times, ")
    loaded = minari.load_dataset("a/b/written-v1")
    _same_transitions(log, loaded)
    assert (loaded.observation_space, loaded.action_space) == (
        log.observation_space,
        log.action_space,
    )
    assert (loaded.total_episodes, loaded.total_steps) == (3, len(log))
    assert [m["seed"] for m in loaded.storage.get_episode_metadata([0, 1, 2])] == [3, 4, 5]
    if kind == "cameras":
        (attributes,) = loaded.storage.get_episode_metadata([1])
        assert attributes["options"] == {"limit": 3}
    assert "observations" in repr(loaded[0])
    assert "a/b/written-v1" in minari.list_local_datasets()
    assert minari.namespace.list_local_namespaces() == ["a", "a/b"]
    if kind == "lane":
        assert loaded.recover_environment().spec.id == "mcaprl/LaneKeeping-v0"
    back = mcaprl.open("minari:a/b/written-v1")
    assert back.fingerprint == log.fingerprint
    assert (back.env_id, back.env_kwargs) == (log.env_id, log.env_kwargs)
    fields = ("length", "total_reward", "terminated", "truncated", "seed", "options")
    assert _summaries(back, *fields) == _summaries(log, *fields)


def test_minari_appends_splits_and_combines_what_is_written(minari: Any) -> None:
    data = _vector()
    data.to_minari("minari:one-v0")
    data.to_minari("minari:two-v0")
    loaded = minari.load_dataset("one-v0")
    buffer = minari.data_collector.EpisodeBuffer(
        observations=np.ones((2, 2), np.float32),
        actions=np.array([1]),
        rewards=np.array([3.0]),
        terminations=np.array([True]),
        truncations=np.array([False]),
        infos={},
    )
    loaded.update_dataset_from_buffer([buffer])
    assert [len(part) for part in minari.split_dataset(loaded, [1, 2], seed=0)] == [1, 2]
    found = mcaprl.open("minari:one-v0")
    assert found.rewards.tolist() == [0.1, 2, -0.0, 3]
    assert _summaries(found, "reason") == [("terminated",), ("",), ("terminated",)]
    minari.combine_datasets([loaded, minari.load_dataset("two-v0")], "both-v0")
    assert mcaprl.open("minari:both-v0").rewards.tolist() == [0.1, 2, -0.0, 3, 0.1, 2, -0.0]


@pytest.mark.parametrize("seed", [0, 2**63 - 1, 2**63, 2**64 - 2])
def test_seeds_that_minari_draws_by_itself_are_kept(
    minari: Any, tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("secrets.randbits", lambda bits: seed)
    collect(Cameras(), "drawn-v0", log=tmp_path / "log.mcap", seeded=False)
    log, found = mcaprl.open(tmp_path / "log.mcap"), mcaprl.open("minari:drawn-v0")
    assert found.fingerprint == log.fingerprint
    assert _summaries(found, "seed") == _summaries(log, "seed") == [(seed,)] * 3
    found.save(tmp_path / "saved.mcap")
    mcaprl.open(tmp_path / "saved.mcap").to_minari("minari:again-v0")
    assert _summaries(mcaprl.open("minari:again-v0"), "seed") == [(seed,)] * 3
    assert found.to_arrow("episodes")["seed"].to_pylist() == [seed] * 3


def test_what_minari_has_no_place_for_is_said(tmp_path: Path) -> None:
    data = _vector(options='{"start": {"x": 0.5, "name": "a b"}, "lanes": [1, 2], "on": true}')
    assert data.to_minari(tmp_path / "toy-v0") == [
        "minari has no place for times, behavior_prob, policy names, end reasons: a log keeps them"
    ]
    found = Dataset.from_minari(tmp_path / "toy-v0")
    same_transitions(found, data, probs=False)
    assert found.observation_space == data.observation_space
    assert found.action_space == data.action_space
    assert found.env_id == "Toy-v0"
    fields = ("terminated", "truncated", "seed")
    assert _summaries(found, *fields) == [(True, False, 7), (False, False, None)]
    options = [json.loads(text or "null") for (text,) in _summaries(found, "options")]
    assert options == [{"start": {"x": 0.5, "name": "a b"}, "lanes": [1, 2], "on": True}, None]
    assert found.sources == (tmp_path / "toy-v0",)
    with h5py.File(tmp_path / "toy-v0/data/main_data.hdf5") as file:
        attributes = dict(file["episode_0"].attrs)
    assert (attributes["options/start/x"], attributes["options/start/name"]) == (0.5, "a b")
    assert attributes["options/lanes"].tolist() == [1, 2]
    assert attributes["seed"] == 7


@settings(max_examples=30)
@given(given_arrays=transitions())
def test_any_dataset_comes_back(given_arrays: dict[str, Any]) -> None:
    # Minari has no place for the choice of the actions.
    arrays = {k: v for k, v in given_arrays.items() if not k.startswith("behavior")}
    data = Dataset.from_arrays(**arrays)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "any-v0"
        assume(np.isfinite(data.rewards).all())
        assume(data.actions.dtype.kind != "f" or np.isfinite(data.actions).all())
        renamed = data.to_minari(path, lossy=True)
        found = mcaprl.open(path)
        assert bool(renamed) == _has_odd_keys(data.observation_space)
        _same_tree(_arrays(found.frames), _arrays(data.frames))
        if not renamed:
            assert found.fingerprint == data.fingerprint
            if _HAS_MINARI:
                from minari import MinariDataset

                _same_transitions(data, MinariDataset(path / "data"))


def _has_odd_keys(space: spaces.Space[Any]) -> bool:
    keys = list(space.spaces) if isinstance(space, spaces.Dict) else []
    return any(set(key) & {"/", "\0"} or not key.strip(".") for key in keys)


def _arrays(tree: Any) -> Any:
    """Return the arrays of a flat dict, with numbers instead of the keys."""
    return dict(enumerate(tree.values())) if isinstance(tree, dict) else tree


def test_keys_that_hdf5_cannot_hold_are_refused_or_renamed(tmp_path: Path) -> None:
    space = spaces.Dict({"a/b": spaces.Box(0, 1, (), np.float32), "a_b": spaces.Discrete(2)})
    data = Dataset.from_arrays(
        observations={"a/b": np.zeros(1, np.float32), "a_b": np.ones(1, np.int64)},
        next_observations={"a/b": np.ones(1, np.float32), "a_b": np.zeros(1, np.int64)},
        actions=np.zeros(1, np.int64),
        rewards=np.zeros(1),
        terminated=[True],
        truncated=[False],
        observation_space=space,
        action_space=spaces.Discrete(2),
    )
    with pytest.raises(SpaceError, match=r"the key 'a/b' is renamed.*`lossy=True`"):
        data.to_minari(tmp_path / "odd-v0")
    assert not (tmp_path / "odd-v0").exists()
    (sentence,) = data.to_minari(tmp_path / "odd-v0", lossy=True)
    assert "'a/b'" in sentence
    frames = mcaprl.open(tmp_path / "odd-v0").frames
    assert frames["a_b_"].tolist() == [0, 1]
    assert frames["a_b"].tolist() == [1, 0]


def test_options_that_hdf5_cannot_hold_are_refused_or_left_out(tmp_path: Path) -> None:
    data = _vector(options='{"goal": null, "x": 1}')
    with pytest.raises(SpaceError, match="the reset option 'goal' is left out"):
        data.to_minari(tmp_path / "odd-v0")
    assert "'goal'" in data.to_minari(tmp_path / "odd-v0", lossy=True)[0]
    assert mcaprl.open(tmp_path / "odd-v0").episodes[0].summary.options == '{"x": 1}'


@pytest.mark.parametrize("form", _FORMS)
def test_jpeg_is_decoded_as_minari_does_and_reported(
    minari: Any, tmp_path: Path, form: str
) -> None:
    made = collect(Cameras(), "jpeg-v0", jpeg=True, data_format=form)
    with pytest.warns(UserWarning, match="front, gray is stored as JPEG"):
        found = mcaprl.open("minari:jpeg-v0")
    _same_transitions(found, made)
    assert found.frames["front"].shape == (15, 32, 40, 3)
    # Old versions of Minari always used JPEG, but did not store this in the metadata.
    metadata = tmp_path / "sets/jpeg-v0/data/metadata.json"
    raw = json.loads(metadata.read_text())
    del raw["jpeg_encoding"]
    metadata.write_text(json.dumps(raw))
    with pytest.warns(UserWarning, match="JPEG"):
        assert mcaprl.open("minari:jpeg-v0").fingerprint == found.fingerprint


@pytest.mark.parametrize("form", ["arrow", "parquet"])
def test_long_episodes_of_the_arrow_form_are_whole(minari: Any, form: str) -> None:
    count = 40_000
    observations = np.arange(count + 1, dtype=np.float32)[:, None]
    flags = np.arange(count) == count - 1
    buffer = minari.data_collector.EpisodeBuffer(
        seed=1,
        observations=observations,
        actions=np.arange(count) % 3,
        rewards=np.arange(count) / 2,
        terminations=flags,
        truncations=np.zeros(count, bool),
        infos={"k": np.arange(count + 1)[:, None].tolist()},
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        minari.create_dataset_from_buffers(
            "long-v0",
            [buffer, buffer],
            observation_space=spaces.Box(0, np.inf, (1,), np.float32),
            action_space=spaces.Discrete(3),
            data_format=form,
            jpeg_encoding=False,
        )
    found = mcaprl.open("minari:long-v0")
    assert found.episode_lengths.tolist() == [count, count]
    np.testing.assert_array_equal(found.frames, np.tile(observations, (2, 1)))
    np.testing.assert_array_equal(found.rewards, np.tile(np.arange(count) / 2, 2))
    assert np.flatnonzero(found.terminated).tolist() == [count - 1, 2 * count - 1]


@pytest.mark.parametrize("form", _FORMS)
def test_tuple_observations_become_a_dict(minari: Any, form: str) -> None:
    part = spaces.Dict({"y": spaces.Discrete(4)})
    space = spaces.Tuple([spaces.Box(0, 9, (2,), np.float32), part])
    buffer = minari.data_collector.EpisodeBuffer(
        observations=(np.array([[1, 2], [3, 4]], np.float32), {"y": np.array([3, 0])}),
        actions=np.array([1]),
        rewards=np.array([0.5]),
        terminations=np.array([False]),
        truncations=np.array([True]),
        infos={},
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        minari.create_dataset_from_buffers(
            "tuple-v0",
            [buffer],
            observation_space=space,
            action_space=spaces.Discrete(2),
            data_format=form,
        )
    with pytest.warns(UserWarning, match="Tuple observations are read as Dict"):
        found = mcaprl.open("minari:tuple-v0")
    assert found.frames["0"].tolist() == [[1, 2], [3, 4]]
    assert found.frames["1"]["y"].tolist() == [3, 0]
    assert found.truncated.tolist() == [True]


def _episode(
    minari: Any, form: str, action_space: spaces.Space[Any], actions: Any, *, text: bool = False
) -> Path:
    """Create a dataset of one episode of two steps; its observation may contain a text."""
    space = spaces.Dict({"x": spaces.Box(0, 9, (1,), np.float32)})
    observations: dict[str, Any] = {"x": np.array([[1], [2], [3]], np.float32)}
    if text:
        space = spaces.Dict({"mission": spaces.Text(9), **space.spaces})
        observations = {"mission": ["go"] * 3, **observations}
    buffer = minari.data_collector.EpisodeBuffer(
        observations=observations,
        actions=actions,
        rewards=np.array([0.5, 1]),
        terminations=np.array([False, True]),
        truncations=np.array([False, False]),
        infos={},
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        minari.create_dataset_from_buffers(
            "text-v0",
            [buffer],
            observation_space=space,
            action_space=action_space,
            data_format=form,
        )
    return local_path("text-v0")


@pytest.mark.parametrize("form", _FORMS)
def test_texts_are_refused_or_left_out(minari: Any, form: str, tmp_path: Path) -> None:
    path = _episode(minari, form, spaces.Discrete(2), np.array([1, 0]), text=True)
    message = r"observation\['mission'\] is a Text space; .*`lossy=True` .* leave it out"
    with pytest.raises(SpaceError, match=message):
        mcaprl.open(path)
    for read in (mcaprl.open, Dataset.from_minari):
        with pytest.warns(UserWarning, match=r"\['mission'\] is a Text space, which is left out"):
            found = read(path, lossy=True)
        assert found.frames["x"].tolist() == [[1], [2], [3]]
        assert isinstance(found.observation_space, spaces.Dict)
        assert list(found.observation_space) == ["x"]
    with pytest.warns(UserWarning, match="left out"):
        mcaprl.convert(path, tmp_path / "log.mcap", lossy=True)
    assert mcaprl.open(tmp_path / "log.mcap").actions.tolist() == [1, 0]


@pytest.mark.parametrize("form", _FORMS)
def test_parts_of_an_action_are_refused_or_joined(minari: Any, form: str) -> None:
    arm, turn = spaces.Box(-1, 2, (2,), np.float32), spaces.Box(-3, 3, (1,), np.float32)
    path = _episode(
        minari,
        form,
        spaces.Dict({"arm": arm, "say": spaces.Text(4), "turn": turn}),
        {
            "arm": np.array([[1, 2], [-1, 0]], np.float32),
            "say": ["a", "b"],
            "turn": np.array([[3], [-3]], np.float32),
        },
    )
    with pytest.raises(
        SpaceError, match=r"action is a Dict space; .*`lossy=True` to join its parts"
    ):
        mcaprl.open(path)
    with (
        pytest.warns(UserWarning, match="the parts arm, turn of the action are joined"),
        pytest.warns(UserWarning, match=r"action\['say'\] is a Text space, which is left out"),
    ):
        found = mcaprl.open(path, lossy=True)
    assert found.actions.tolist() == [[1, 2, 3], [-1, 0, -3]]
    assert found.action_space == spaces.Box(
        np.array([-1, -1, -3], np.float32), np.array([2, 2, 3], np.float32)
    )


@pytest.mark.parametrize("form", _FORMS)
def test_discrete_parts_of_an_action_are_joined(minari: Any, form: str) -> None:
    action_space = spaces.Tuple([spaces.Discrete(3), spaces.Discrete(2, start=5)])
    path = _episode(minari, form, action_space, (np.array([0, 2]), np.array([5, 6])))
    with pytest.warns(UserWarning, match="the parts 0, 1 of the action are joined"):
        found = mcaprl.open(path, lossy=True)
    assert found.actions.tolist() == [[0, 5], [2, 6]]
    assert found.action_space == spaces.MultiDiscrete([3, 2], start=[0, 5])


def test_parts_of_different_kinds_are_not_joined(tmp_path: Path) -> None:
    _vector().to_minari(tmp_path / "toy-v0")
    parts = [spaces.Discrete(2), spaces.Box(0, 1, (1,))]
    text = json.dumps({"type": "Tuple", "subspaces": [json.loads(space_to_text(s)) for s in parts]})
    _change(tmp_path / "toy-v0", action_space=text)
    with pytest.raises(
        SpaceError, match="parts of the action are Discrete, Box; only parts of one"
    ):
        mcaprl.open(tmp_path / "toy-v0", lossy=True)
    _change(tmp_path / "toy-v0", observation_space='{"type": "Text"}')
    with pytest.raises(SpaceError, match="nothing is left of the observation"):
        mcaprl.open(tmp_path / "toy-v0", lossy=True)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("terminations", [0.0, 0.3], "episode 1: terminations are not flags: row 1 is 0.3"),
        ("truncations", [0, 2], "episode 1: truncations are not flags: row 1 is 2"),
        ("rewards", [0.0, np.nan], "episode 1: rewards: row 1 is nan, which is not finite"),
        ("rewards", [b"1", b"2"], "episode 1: rewards has dtype"),
        ("actions", [0, 7], r"episode 1: actions: row 1 is 7, which is outside of Discrete"),
        ("actions", [0, -1], r"episode 1: actions: row 1 is -1, which is outside of Discrete"),
    ],
)
def test_impossible_values_of_other_writers_are_refused(
    tmp_path: Path, name: str, values: Any, message: str
) -> None:
    steps = Dataset.from_arrays(
        observations=np.arange(4.0)[:, None],
        next_observations=np.arange(1, 5.0)[:, None],
        actions=np.array([0, 1, 0, 1]),
        rewards=np.zeros(4),
        terminated=[False, True, False, True],
        truncated=[False] * 4,
    )
    path = tmp_path / "toy-v0"
    steps.to_minari(path)
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        del file[f"episode_1/{name}"]
        file[f"episode_1/{name}"] = np.array(values)
    with pytest.raises(SpaceError, match=message):
        mcaprl.open(path)


def test_members_that_are_not_read_are_named(tmp_path: Path) -> None:
    path = tmp_path / "toy-v0"
    _vector().to_minari(path)
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        file["episode_0/costs"] = np.zeros(3)
        file["episode_9/rewards"] = np.zeros(3)
    with pytest.warns(UserWarning, match="not read: episode_9, episode_<i>/costs$"):
        mcaprl.open(path)


@pytest.mark.parametrize(
    ("role", "plain", "message"),
    [
        ("observation", {"type": "Text", "max_length": 3}, "observation is a Text space"),
        (
            "observation",
            {"type": "Dict", "subspaces": {"a": {"type": "Graph"}}},
            "observation\\['a'\\] is a Graph space",
        ),
        ("action", {"type": "Tuple", "subspaces": []}, "action is a Tuple space"),
        ("action", {"type": "Dict", "subspaces": {}}, "action is a Dict space"),
        ("action", {"type": "Box"}, "not a description of a space"),
        ("action", [1], "not a description of a space"),
    ],
)
def test_spaces_that_a_log_cannot_hold_are_refused_by_name(
    tmp_path: Path, role: str, plain: Any, message: str
) -> None:
    _vector().to_minari(tmp_path / "toy-v0")
    _change(tmp_path / "toy-v0", **{f"{role}_space": json.dumps(plain)})
    with pytest.raises(SpaceError, match=message):
        mcaprl.open(tmp_path / "toy-v0")


def _change(path: Path, **fields: Any) -> None:
    """Replace fields of the metadata. If the new value is None, remove the field."""
    file = path / "data/metadata.json"
    raw = {**json.loads(file.read_text()), **fields}
    file.write_text(json.dumps({key: value for key, value in raw.items() if value is not None}))


def test_old_datasets_have_the_spaces_of_their_environment(tmp_path: Path) -> None:
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), tmp_path / "log.mcap")
    env.reset(seed=0)
    env.step(0)
    env.close()
    log = mcaprl.open(tmp_path / "log.mcap")
    path = tmp_path / "cart-v0"
    log.to_minari(path)
    _change(path, observation_space=None, action_space=None, data_format=None)
    assert mcaprl.open(path).fingerprint == log.fingerprint
    _change(path, env_spec='{"id": "Other-v0"}')
    with pytest.raises(SpaceError, match="'Other-v0' is not registered"):
        mcaprl.open(path)


@pytest.mark.parametrize("name", ["drive", "drive-v", "../drive-v0", "a//b-v0", "/a-v0"])
def test_ids_without_a_version_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="version, such as"):
        _vector().to_minari(f"minari:{name}")
    assert not (tmp_path / "sets").exists()


def test_folders_are_named_with_a_version_and_replaced_on_request(tmp_path: Path) -> None:
    data = _vector()
    with pytest.raises(UsageError, match="ends with its version, such as toy-v0"):
        data.to_minari(tmp_path / "toy")
    data.to_minari(tmp_path / "toy-v0")
    with pytest.raises(OutputExistsError):
        data.to_minari(tmp_path / "toy-v0")
    data.to_minari(tmp_path / "toy-v0", overwrite=True)
    # Minari's own classes expect the path of the folder `data`.
    same_transitions(mcaprl.open(tmp_path / "toy-v0/data"), data, probs=False)


def test_damaged_datasets_give_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "toy-v0"
    main = path / "data/main_data.hdf5"

    def fails(message: str) -> None:
        with pytest.raises(LogError, match=message) as caught:
            mcaprl.open(path, format="minari")
        assert "\n" not in str(caught.value)

    with pytest.raises(LogError, match="no such file or folder"):
        mcaprl.open("minari:none/there-v0")
    _vector().to_minari(path)
    _change(path, total_episodes=3)
    fails("episode_2 is missing")
    _change(path, total_episodes=2, data_format="zarr")
    fails("unknown data format 'zarr'")
    _change(path, data_format="arrow")
    fails("has no .arrow file")
    _change(path, data_format="hdf5")
    with h5py.File(main, "a") as file:
        file["episode_0/terminations"][0] = True
    fails("episode 0 has steps after terminations at step 0")
    with h5py.File(main, "a") as file:
        file["episode_0/terminations"][0] = False
        del file["episode_0/rewards"]
        file["episode_0"].create_dataset("rewards", (10**12,), np.float64, chunks=True)
    fails("only 0 bytes are stored")
    with h5py.File(main, "a") as file:
        del file["episode_0/rewards"]
        file["episode_0/rewards"] = h5py.ExternalLink("other.hdf5", "/rewards")
    fails("stored in another file")
    main.write_bytes(main.read_bytes()[:900])
    fails("not a readable HDF5 file")
    (path / "data/metadata.json").write_text("{")
    fails("metadata.json cannot be read")


def test_without_h5py_nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = mcaprl.open(GOLDEN / "lane-1.mcap")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingExtraError, match=r"h5py is not installed: .*mcaprl\[interop\]"):
        data.to_minari(tmp_path / "collect-v0", lossy=True)
    assert not list(tmp_path.iterdir())

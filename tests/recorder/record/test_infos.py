"""Recorded infos: round trips, keys that appear late, appending, rotation, and refused values."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import mcaprl
from mcaprl.errors import SpaceError
from mcaprl.recorder.columns.reader import McapReader


class Infos(gym.Env[Any, Any]):
    """Environment that returns the given infos, one for each observation of an episode."""

    observation_space = spaces.Box(0, 100, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, *infos: dict[str, Any]) -> None:
        self.infos, self.step_number = infos, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.step_number = 0
        return np.zeros(1, np.float32), self.infos[0]

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.step_number += 1
        is_last = self.step_number == len(self.infos) - 1
        observation = np.full(1, self.step_number, np.float32)
        return observation, 1.0, is_last, False, self.infos[self.step_number]


def record(path: Path, *infos: dict[str, Any], episodes: int = 1, **options: Any) -> mcaprl.Dataset:
    env = mcaprl.RecordMcap(Infos(*infos), path, **{"infos": True, **options})
    for _ in range(episodes):
        env.reset()
        for _ in infos[1:]:
            env.step(0)
    env.close()
    return mcaprl.open(path if path.exists() else path.parent)


def test_infos_come_back(log_path: Path) -> None:
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    first = {"speed": 1.5, "lane": "left", "ok": True, "count": 3, "pose": {"xy": array}}
    second = {"speed": -0.0, "lane": "ü", "ok": False, "count": 2**60, "pose": {"xy": array + 1}}
    found = record(log_path, first, second).infos
    assert sorted(found) == ["count", "lane", "ok", "pose.xy", "speed"]
    assert found["speed"].tolist() == [1.5, -0.0]
    assert found["lane"].tolist() == ["left", "ü"]
    assert found["ok"].tolist() == [True, False]
    assert found["ok"].dtype == bool
    assert found["count"].tolist() == [3, 2**60]
    assert found["pose.xy"].shape == (2, 2, 3)
    assert found["pose.xy"].dtype == np.float32
    assert (found["pose.xy"][1] == array + 1).all()
    assert not mcaprl.check(log_path).problems


def test_statistics_of_episodes_are_present_at_ends_only(log_path: Path) -> None:
    env = gym.wrappers.RecordEpisodeStatistics(gym.make("CartPole-v1", max_episode_steps=5))
    recorded = mcaprl.RecordMcap(env, log_path, infos=["episode"])
    expected = []
    for seed in range(3):
        recorded.reset(seed=seed)
        done = False
        while not done:
            *_, terminated, truncated, info = recorded.step(0)
            done = terminated or truncated
        expected.append(info["episode"])
    recorded.close()
    data = mcaprl.open(log_path)
    assert sorted(data.infos) == ["episode.l", "episode.r", "episode.t"]
    for name in ("r", "l", "t"):
        column = data.infos[f"episode.{name}"]
        assert column.compressed().tolist() == [one[name] for one in expected]
        ends = np.cumsum(data.episode_lengths + 1) - 1
        assert np.flatnonzero(~np.ma.getmaskarray(column)).tolist() == ends.tolist()
    assert data.episodes[1].infos["episode.r"][-1] == expected[1]["r"]


def test_ros_decoders_read_the_topics(log_path: Path) -> None:
    record(log_path, {"speed": 1.5, "at": np.array([1, 2], np.int16)}, {"lane": "left"})
    with log_path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = {
            channel.topic: (schema.name, message.data)
            for schema, channel, _, message in reader.iter_decoded_messages()
            if schema is not None and channel.topic.startswith("/rl/info/")
        }
    assert found["/rl/info/speed"] == ("std_msgs/msg/Float64", 1.5)
    assert found["/rl/info/lane"] == ("std_msgs/msg/String", "left")
    name, values = found["/rl/info/at"]
    assert (name, list(values)) == ("mcaprl_msgs/msg/InfoInt16x2", [1, 2])


def test_infos_are_off_unless_wanted(tmp_path: Path) -> None:
    assert record(tmp_path / "off.mcap", {"a": 1}, {"a": 2}, infos=False).infos == {}
    some = record(tmp_path / "some.mcap", {"a": 1, "ab": 2}, {"b": {"c": 3}}, infos=["a", "b"])
    assert sorted(some.infos) == ["a", "b.c"]


def test_a_single_name_selects_one_info(log_path: Path) -> None:
    data = record(log_path, {"a": 1, "speed": 2.0}, {"a": 3, "speed": 4.0}, infos="speed")
    assert {name: values.tolist() for name, values in data.infos.items()} == {"speed": [2.0, 4.0]}


def test_values_that_a_log_cannot_store_are_named_once(log_path: Path) -> None:
    infos: tuple[dict[str, Any], ...] = ({"set": {1}, "n": 1}, {"set": {2}, "n": "text"})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        data = record(log_path, *infos, episodes=2)
    assert data.infos == {}
    assert [str(one.message).split(":")[0] for one in caught] == [
        "the info 'set' is not recorded",
        "the info 'n' is not recorded",
    ]


def test_a_value_of_another_type_is_left_out(log_path: Path) -> None:
    env = Infos({"n": 1}, {"n": 2})
    recorded = mcaprl.RecordMcap(env, log_path, infos=True)
    recorded.reset()
    recorded.step(0)
    env.infos = ({"n": "text"}, {"n": "text"})
    recorded.reset()
    with pytest.warns(UserWarning, match="its values are text, but earlier values are int64"):
        recorded.step(0)
    recorded.close()
    assert mcaprl.open(log_path).infos["n"].tolist() == [1, 2, None, None]


class Changing(Infos):
    """Environment that returns the same list as info in each step, and changes it in place."""

    def __init__(self) -> None:
        super().__init__({"at": [0, 0]}, {}, {})

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.infos[0]["at"][1] += 1
        return *super().step(action)[:4], self.infos[0]


def test_lists_are_copied_before_the_environment_changes_them(log_path: Path) -> None:
    env = mcaprl.RecordMcap(Changing(), log_path, infos=True)
    env.reset()
    for _ in range(2):
        env.step(0)
    env.close()
    assert mcaprl.open(log_path).infos["at"].tolist() == [[0, 0], [0, 1], [0, 2]]


def test_numbers_of_several_types_are_stored_if_they_are_exact(log_path: Path) -> None:
    nan = float("nan")
    found = record(log_path, {"a": np.uint8(3), "b": 1}, {"a": -5, "b": 0.5}, {"b": nan}).infos
    assert found["a"].tolist() == [3, -5, None]
    assert found["b"].dtype == np.float64
    assert found["b"].tolist()[:2] == [1, 0.5]
    assert np.isnan(found["b"][2])


@pytest.mark.parametrize(
    "infos",
    [
        ({"x": 2**60 + 1}, {"x": 0.5}),
        ({"x": np.array([2**60 + 1])}, {"x": np.array([0.5])}),
        ({"x": True}, {"x": 1}),
        ({"x": np.zeros(0)}, {"x": np.zeros(0)}),
        ({"x": np.zeros(2)}, {"x": np.zeros(3)}),
        ({"x": ["two", "texts"]}, {}),
        ({"x": None}, {"x": 1}),
        ({"x": 2**70}, {}),
        ({"x": 1j}, {}),
    ],
)
def test_values_that_a_log_would_change_are_refused(log_path: Path, infos: Any) -> None:
    with pytest.warns(UserWarning, match="the info 'x' is not recorded: a log stores flags"):
        assert record(log_path, *infos).infos == {}


def test_the_warning_comes_after_the_episode_is_on_disk(log_path: Path) -> None:
    env = mcaprl.RecordMcap(Infos({"x": None, "y": 1}, {"y": 2}), log_path, infos=True)
    env.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning, match="the info 'x' is not recorded"):
            env.step(0)
    env.close()
    assert mcaprl.open(log_path).infos["y"].tolist() == [1, 2]


def test_two_entries_of_one_name_are_refused(log_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"the info 'a\.b' is not recorded: two entries"):
        assert record(log_path, {"a.b": 1, "a": {"b": 2}}, {"a": {"b": 3}}).infos == {}


def test_similar_names_stay_apart_in_any_order(log_path: Path) -> None:
    record(log_path, {"a b": 1}, {"a b": 2})
    data = record(log_path, {"a_b": 3, "a-b": 4, "a.b": 5}, {"a b": 6, "a/b": 7}, append=True)
    assert {name: info.tolist() for name, info in data.infos.items()} == {
        "a b": [1, 2, None, 6],
        "a_b": [None, None, 3, None],
        "a-b": [None, None, 4, None],
        "a.b": [None, None, 5, None],
        "a/b": [None, None, None, 7],
    }


@pytest.mark.parametrize(
    ("first", "second", "kept"),
    [
        (1, 2.0, [2, 2]),
        (1, 0.5, [None, None]),
        (0.5, 2**60 + 1, [None, None]),
        (1, "text", [None, None]),
        ("text", "longer text", ["longer text"] * 2),
        (np.zeros((2, 3)), np.zeros((3, 2)), [[[None] * 3] * 2] * 2),
    ],
)
def test_appended_infos_have_the_type_of_the_log(
    log_path: Path, first: Any, second: Any, kept: list[Any]
) -> None:
    record(log_path, {"a": first}, {"a": first})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        data = record(log_path, {"a": second}, {"a": second}, append=True)
    assert data.infos["a"].tolist()[2:] == kept
    warned = ["the info 'a' is not recorded"] if np.ma.getmaskarray(data.infos["a"]).any() else []
    assert [str(one.message).split(":")[0] for one in caught] == warned


def test_appended_and_rotated_recordings_have_their_infos(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    record(path, {"a": 1}, {"a": 2})
    data = record(path, {"b": 0.5}, {"a": 3, "b": 1.5}, append=True)
    assert data.infos["a"].tolist() == [1, 2, None, 3]
    assert data.infos["b"].tolist() == [None, None, 0.5, 1.5]
    (tmp_path / "parts").mkdir()
    parts = record(
        tmp_path / "parts" / "log.mcap", {"a": 1}, {"a": 2}, episodes=20, max_file_bytes=4_000
    )
    assert len(list((tmp_path / "parts").glob("*.mcap"))) > 1
    assert parts.infos["a"].tolist() == [1, 2] * 20


def test_an_interrupted_episode_keeps_the_infos_of_its_steps(log_path: Path) -> None:
    env = mcaprl.RecordMcap(Infos({"a": 0}, {"a": 1}, {"a": 2}, {"a": 3}), log_path, infos=True)
    env.reset()
    env.step(0)
    env.reset()
    env.step(1)
    env.step(1)
    env.close()
    assert mcaprl.open(log_path).infos["a"].tolist() == [0, 1, 0, 1, 2]


def test_a_killed_recording_has_the_infos_of_its_episodes(tmp_path: Path) -> None:
    path, killed = tmp_path / "log.mcap", tmp_path / "killed.mcap"
    env = mcaprl.RecordMcap(Infos({"a": 0}, {"a": 1}, {"a": 2, "end": 0.5}), path, infos=True)
    sizes = []
    for _ in range(3):
        env.reset()
        env.step(0)
        env.step(0)
        sizes.append(path.stat().st_size)
    env.reset()
    env.step(0)
    content = path.read_bytes()
    env.close()
    # At the last length, the file contains the infos of the third episode, but not its steps.
    for episodes, length in ((3, sizes[2]), (2, sizes[1]), (2, sizes[2] - 100)):
        killed.write_bytes(content[:length])
        with pytest.warns(UserWarning, match=f"finished episodes read: {episodes}"):
            read = mcaprl.open(killed)
        out = tmp_path / f"recovered-{length}.mcap"
        mcaprl.recover(killed, out)
        for found in (read.infos, mcaprl.open(out).infos):
            assert found["a"].tolist() == [0, 1, 2] * episodes
            assert found["end"].tolist() == [None, None, 0.5] * episodes


@given(rows=st.lists(st.one_of(st.none(), st.floats(allow_nan=False)), min_size=2, max_size=9))
def test_saved_infos_are_equal(rows: list[float | None], tmp_path_factory: Any) -> None:
    path = tmp_path_factory.mktemp("infos") / "log.mcap"
    data = record(path, *({} if row is None else {"x": row} for row in rows))
    again_path = path.with_name("again.mcap")
    data.save(again_path)
    for each in (data, mcaprl.open(again_path)):
        if any(row is not None for row in rows):
            assert each.infos["x"].tolist() == rows
        else:
            assert each.infos == {}


def test_datasets_keep_infos_when_divided_and_joined(tmp_path: Path) -> None:
    first = record(tmp_path / "a.mcap", {"a": 1}, {"a": 2}, episodes=3)
    second = record(tmp_path / "b.mcap", {"b": "x"}, {"b": "yy"})
    both = mcaprl.Dataset.concatenate([first, second])
    assert both.infos["a"].tolist() == [1, 2, 1, 2, 1, 2, None, None]
    assert both.infos["b"].tolist() == [None] * 6 + ["x", "yy"]
    kept = both.filter(lambda episode: episode.index in (0, 3))
    assert kept.infos["b"].tolist() == [None, None, "x", "yy"]
    odd = record(tmp_path / "c.mcap", {"a": "text"}, {"a": "text"})
    with pytest.raises(SpaceError, match="the info 'a' differs"):
        mcaprl.Dataset.concatenate([first, odd])
    large = record(tmp_path / "d.mcap", {"a": 2**60 + 1}, {"a": 0})
    half = record(tmp_path / "e.mcap", {"a": 0.5}, {"a": 1.5})
    assert mcaprl.Dataset.concatenate([first, half]).infos["a"].tolist()[-3:] == [2, 0.5, 1.5]
    with pytest.raises(SpaceError, match="the info 'a' has integers that float64 cannot hold"):
        mcaprl.Dataset.concatenate([large, half])


def test_the_record_function_records_infos(log_path: Path) -> None:
    mcaprl.record("lane", log_path, policy="random", episodes=2, seed=1, infos=True)
    data = mcaprl.open(log_path)
    assert {"lateral_offset_m", "speed_m_s", "progress_m"} <= set(data.infos)
    # Only the last step of each episode has a reason.
    assert data.infos["reason"].compressed().tolist() == [one.reason for one in data.episodes]
    speed = data.observation_names.index("speed")
    assert np.abs(data.infos["speed_m_s"] - 30 * data.frames[:, speed]).max() < 1e-5


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_vector_environments_record_the_infos_of_each_episode(log_path: Path, mode: str) -> None:
    def make() -> gym.Env[Any, Any]:
        env = gym.make("CartPole-v1", max_episode_steps=4)
        return gym.wrappers.RecordEpisodeStatistics(env)

    envs = gym.vector.SyncVectorEnv([make, make], autoreset_mode=gym.vector.AutoresetMode(mode))
    recorded = mcaprl.RecordVecMcap(envs, log_path, infos=True)
    recorded.reset(seed=0)
    for _ in range(14):
        recorded.step(np.array([0, 1]))
    recorded.close()
    data = mcaprl.open(log_path)
    finished = [one for one in data.episodes if one.reason != "interrupted"]
    assert len(finished) >= 4
    for episode in finished:
        returns = episode.infos["episode.r"]
        assert np.flatnonzero(~np.ma.getmaskarray(returns)).tolist() == [episode.length]
        assert returns[-1] == episode.total_reward
        assert episode.infos["episode.l"][-1] == episode.length


def test_infos_of_other_lengths_are_those_of_each_environment(log_path: Path) -> None:
    """A custom vector environment may return values that are not arrays over its environments."""

    class Shared(gym.vector.VectorWrapper):
        """Vector environment with infos of all environments together."""

        def step(self, actions: Any) -> Any:
            *found, infos = self.env.step(actions)
            return *found, {**infos, "rate": [0.5], "matrix": np.eye(3)}

    envs = gym.make_vec("CartPole-v1", 2, vectorization_mode="sync", max_episode_steps=3)
    recorded = mcaprl.RecordVecMcap(Shared(envs), log_path, infos=True)
    recorded.reset(seed=0)
    for _ in range(3):
        recorded.step(np.array([0, 1]))
    recorded.close()
    for episode in mcaprl.open(log_path).episodes:
        assert episode.infos["matrix"][1:].tolist() == [np.eye(3).tolist()] * 3
        assert episode.infos["rate"][1:].tolist() == [[0.5]] * 3


def test_infos_of_an_episode_may_be_larger_than_a_chunk(log_path: Path) -> None:
    big = np.arange(300_000, dtype=np.uint8)
    found = record(log_path, *({"image": big + k, "count": k} for k in range(10)))
    assert found.infos["count"].tolist() == list(range(10))
    assert all((found.infos["image"][k] == big + k).all() for k in range(10))
    reader = McapReader(log_path)
    assert max(chunk.uncompressed_size for chunk in reader.chunks) < 2**21


def test_vector_environments_that_are_reset_by_hand_record_infos(log_path: Path) -> None:
    disabled = gym.vector.AutoresetMode.DISABLED
    envs = gym.vector.SyncVectorEnv(
        [lambda: Infos({"a": 0}, {"b": "x"}), lambda: Infos({"a": 5}, {"a": 6}, {"a": 7})],
        autoreset_mode=disabled,
    )
    recorded = mcaprl.RecordVecMcap(envs, log_path, infos=True)
    recorded.reset()
    recorded.step(np.array([0, 0]))
    recorded.reset(options={"reset_mask": np.array([True, False])})
    recorded.step(np.array([0, 0]))
    recorded.close()
    data = mcaprl.open(log_path)
    found = [(one.infos["a"].tolist(), one.infos["b"].tolist()) for one in data.episodes]
    assert found == [
        ([0, None], [None, "x"]),
        ([0, None], [None, "x"]),
        ([5, 6, 7], [None, None, None]),
    ]

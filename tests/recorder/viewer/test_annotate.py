"""Annotation: copies of logs to which outputs of policies, or a scene, are added."""

from __future__ import annotations

import json
import math
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.base_policy import BasePolicy
from mcaprl.cli import run
from mcaprl.errors import LogError, PolicyError, UsageError
from mcaprl.offline.estimate.values import (
    gamma_of_run,
    half_ranges,
    normalized_entropy,
    td_errors,
    value_columns,
)
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.topic import Topic
from mcaprl.recorder.record.layout import LAYOUT_NAME
from mcaprl.recorder.viewer.annotate import (
    annotated_copy,
    attached_layout,
    layout_of_log,
    values_topics,
)
from mcaprl.recorder.viewer.surprises import moments_of
from mcaprl.sims import make_sim
from tests.support.layouts import check_layout

VALUES = np.array([[1.0, 3.0], [2.0, 0.0], [4.0, 4.0], [0.0, 8.0]], np.float32)
FIELDS = ("q", "value", "advantage", "td_error", "entropy", "policy_action", "agrees")


class Table(BasePolicy):
    """Policy with Q-values for an episode's four observations, with probabilities, or both."""

    name = "table"

    def __init__(self, has_values: bool = True, is_greedy: bool = True) -> None:
        self._has_values, self._is_greedy = has_values, has_values and is_greedy

    def q_values(self, observations: Any) -> Any:
        if not self._has_values:
            raise PolicyError("no values")
        return VALUES[observations[:, 0].astype(int)]

    def action_probabilities(self, observations: Any) -> Any:
        if self._is_greedy:
            return np.eye(2, dtype=np.float32)[VALUES.argmax(1)]
        return np.array([[0.75, 0.25], [0.0, 1.0], [0.5, 0.5], [1.0, 0.0]], np.float32)


class Elsewhere(gym.Wrapper[Any, Any, Any, Any]):
    """Environment that ignores the requested start."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(seed=99, options=options)


@pytest.fixture
def episode() -> Any:
    places = np.arange(4.0, dtype=np.float32)[:, None]
    data = mcaprl.Dataset.from_arrays(
        observations=places[:3],
        actions=np.array([0, 0, 1]),
        rewards=np.array([1.0, -1.0, 2.0]),
        terminated=np.array([False, False, True]),
        truncated=np.zeros(3, bool),
        next_observations=places[1:],
    )
    return data.episodes[0]


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    """Record two short episodes of the lane sim without a scene."""
    path = tmp_path / "plain.mcap"
    command = ["record", "lane", "--episodes", "2", "--policy", "random", "--no-scene"]
    assert run([*command, "--out", str(path)]) == 0
    return path


def test_values_by_hand(episode: Any) -> None:
    """A TD error is the reward, plus gamma times the next value, minus the Q of the action.

    With gamma 0.5, the errors are 1 + 0.5*2 - 1, -1 + 0.5*4 - 2 and, at the end, 2 + 0 - 4.
    """
    found = value_columns(Table(), episode, spaces.Discrete(2), 0.5)
    assert found["q"].tolist() == VALUES[:3].tolist()
    assert found["value"].tolist() == [3.0, 2.0, 4.0]
    assert found["advantage"].tolist() == [-2.0, 0.0, 0.0]
    assert found["td_error"].tolist() == [1.0, -1.0, -2.0]
    assert found["policy_action"].tolist() == [1, 0, 0]
    assert found["agrees"].tolist() == [False, True, False]
    odds = 1 / (1 + math.exp(-2))
    assert found["preference"][0].tolist() == pytest.approx([1 - odds, odds])
    assert found["entropy"][2] == pytest.approx(1.0)


def test_a_truncated_episode_is_bootstrapped() -> None:
    actions, rewards = np.zeros(1, np.int64), np.zeros(1)
    q = np.array([[0.0], [10.0]], np.float32)
    for terminated, error in ((True, 0.0), (False, 9.0)):
        assert td_errors(q, actions, rewards, np.array([terminated]), 0.9).tolist() == [error]
    assert td_errors(q, actions, rewards, np.array([False]), 0.0).tolist() == [0.0]


def test_a_policy_without_values_has_an_entropy(episode: Any) -> None:
    found = value_columns(Table(has_values=False), episode, spaces.Discrete(2), 0.9)
    for name in ("q", "value", "advantage", "td_error"):
        assert np.isnan(found[name]).all()
    certain = -(0.75 * math.log2(0.75) + 0.25 * math.log2(0.25))
    assert found["entropy"].tolist() == pytest.approx([certain, 0.0, 1.0])
    assert found["policy_action"].tolist() == [0, 1, 0]


def test_a_policy_that_does_not_act_by_its_values_keeps_its_actions(episode: Any) -> None:
    """IQL, for example, has Q-values, but selects actions by its probabilities."""
    found = value_columns(Table(is_greedy=False), episode, spaces.Discrete(2), 0.5)
    assert found["q"].tolist() == VALUES[:3].tolist()
    assert found["policy_action"].tolist() == [0, 1, 0]
    assert found["agrees"].tolist() == [True, False, False]
    assert found["preference"].tolist() == [[0.75, 0.25], [0, 1], [0.5, 0.5]]


def test_actions_with_an_offset_and_single_actions(episode: Any) -> None:
    vars(episode)["actions"] = episode.actions - 1
    found = value_columns(Table(), episode, spaces.Discrete(2, start=-1), 0.5)
    assert found["policy_action"].tolist() == [0, -1, -1]
    assert found["agrees"].tolist() == [False, True, False]
    assert normalized_entropy(np.ones((2, 1), np.float32)).tolist() == [0.0, 0.0]


class Line(BasePolicy):
    """Policy whose command is half of the observation, with Q(s, a) = s - a^2 summed over a."""

    name = "line"

    def __init__(self, has_values: bool = True) -> None:
        self._has_values = has_values

    def act(self, observations: Any) -> Any:
        return np.repeat(observations / 2, 2, axis=1)

    def action_values(self, observations: Any, actions: Any) -> Any:
        if not self._has_values:
            raise PolicyError("no values")
        return observations[:, 0] - np.square(actions).sum(1)

    def log_prob(self, observations: Any, actions: Any) -> Any:
        if not self._has_values:
            raise PolicyError("no densities")
        return np.full(len(actions), -1.5)


COMMANDS = spaces.Box(np.array([-1, 0], np.float32), np.array([1, 4], np.float32))


@pytest.fixture
def commanded() -> mcaprl.Dataset:
    places = np.arange(4.0, dtype=np.float32)[:, None]
    return mcaprl.Dataset.from_arrays(
        observations=places[:3],
        actions=np.array([[0, 0], [1, 2], [-1, 1]], np.float32),
        rewards=np.array([1.0, -1.0, 2.0]),
        terminated=np.array([False, False, True]),
        truncated=np.zeros(3, bool),
        next_observations=places[1:],
        action_space=COMMANDS,
    )


def test_values_of_commands_by_hand(commanded: mcaprl.Dataset) -> None:
    """The policy's commands are (0, 0), (.5, .5), (1, 1) and, at the end, (1.5, 1.5).

    Q of the log is 0, 1 - 5 and 2 - 2, Q of the policy 0, .5, 0 and -1.5. The TD errors with gamma
    .5 are 1 + .5*.5 - 0, -1 + .5*0 + 4 and 2 - 0. The halves of the ranges are 1 and 2.
    """
    found = value_columns(Line(), commanded.episodes[0], COMMANDS, 0.5)
    assert found["policy_action"].tolist() == [[0, 0], [0.5, 0.5], [1, 1]]
    assert found["difference"].tolist() == [[0, 0], [-0.5, -1.5], [2, 0]]
    assert found["q"].tolist() == [0.0, -4.0, 0.0]
    assert found["value"].tolist() == [0.0, 0.5, 0.0]
    assert found["advantage"].tolist() == [0.0, -4.5, 0.0]
    assert found["td_error"].tolist() == [1.25, 3.0, 2.0]
    means = [0.0, (0.5**2 + 0.75**2) / 2, 2.0]
    assert found["distance"].tolist() == pytest.approx(np.sqrt(means).tolist())
    assert found["log_prob"].tolist() == [-1.5] * 3


def test_a_policy_without_values_has_commands_and_distances(commanded: mcaprl.Dataset) -> None:
    found = value_columns(Line(has_values=False), commanded.episodes[0], COMMANDS, 0.5)
    for name in ("q", "value", "advantage", "td_error", "log_prob"):
        assert np.isnan(found[name]).all()
    assert found["distance"][2] == pytest.approx(math.sqrt(2))


def test_ranges_of_unbounded_commands_are_those_of_the_log() -> None:
    actions = np.array([[0.0, 3.0], [4.0, 3.0]])
    unbounded = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    assert half_ranges(unbounded, actions).tolist() == [2.0, 1.0]
    half = spaces.Box(np.array([0.0, -np.inf]), np.array([np.inf, 5.0]), dtype=np.float64)
    assert half_ranges(half, actions).tolist() == [2.0, 1.0]


def test_annotated_commands_are_logged_and_the_farthest_are_listed(
    commanded: mcaprl.Dataset, tmp_path: Path
) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "annotated.mcap"
    commanded.save(log)
    episode = mcaprl.open(log).episodes[0]
    with annotated_copy(log, out) as copy:
        copy.add_values(
            "/rl/values",
            [(episode.log_time_ns[:-1], value_columns(Line(), episode, COMMANDS, 0.5))],
        )
    columns = Topic(McapReader(out), "/rl/values").read(["policy_action", "value", "log_prob"])
    assert columns["policy_action"].tolist() == [[0, 0], [0.5, 0.5], [1, 1]]
    assert columns["value"].tolist() == [0.0, 0.5, 0.0]
    found = [(one.kind, one.step, round(one.value, 3)) for one in moments_of(out)]
    assert found[:3] == [("td_error", 1, 3.0), ("td_error", 2, 2.0), ("td_error", 0, 1.25)]
    assert found[3:] == [("disagreement", 2, 1.414), ("disagreement", 1, 0.637)]
    shown = check_layout(out)["configById"]
    assert shown["Gauge!action action[1]"]["maxValue"] == 4
    plotted = [series["value"] for series in shown["Plot!action"]["paths"]]
    assert plotted[2:] == ["/rl/values.policy_action[0]", "/rl/values.policy_action[1]"]
    assert "Plot!values difference" in shown


def test_gamma_is_read_from_the_run(tmp_path: Path) -> None:
    (tmp_path / "seed-0").mkdir()
    assert gamma_of_run(tmp_path / "seed-0") == 0.97
    (tmp_path / "config.json").write_text(json.dumps({"config": {"gamma": 0.5}}))
    assert gamma_of_run(tmp_path / "seed-0") == gamma_of_run(tmp_path) == 0.5


def test_annotating_keeps_all_messages_and_adds_values(plain: Path, tmp_path: Path) -> None:
    out = tmp_path / "out" / "annotated.mcap"
    data = mcaprl.open(plain)
    columns = [
        (
            episode.log_time_ns[:-1],
            {
                "q": np.full((episode.length, 6), episode.index, np.float32),
                "td_error": np.arange(episode.length, dtype=np.float32),
                "advantage": -np.arange(episode.length, dtype=np.float32),
                "agrees": np.arange(episode.length) % 2 == 0,
            },
        )
        for episode in data.episodes
    ]
    with annotated_copy(plain, out) as copy:
        copy.add_values("/rl/values", columns)
    assert mcaprl.open(out).fingerprint == data.fingerprint
    old, new = McapReader(plain), McapReader(out)
    even = np.concatenate([each["agrees"] for _, each in columns]).mean()
    for layout in (attached_layout(new), layout_of_log(new)):
        title = layout["configById"]["StateTransitions!values"]["foxglovePanelTitle"]
        assert title == f"values: agrees with {even:.0%} of the actions of the log"
    assert new.metadata == old.metadata
    assert new.complete
    head = old.summary_start - 13
    assert bytes(new.view[:head]) == bytes(old.view[:head]), "the log is not touched"
    topic = Topic(new, "/rl/values")
    times = np.concatenate([episode.log_time_ns[:-1] for episode in data.episodes])
    assert topic.times.tolist() == times.tolist()
    assert topic.read(("q",))["q"][-1].tolist() == [1.0] * 6
    assert set(topic.fields) >= set(FIELDS)
    check_layout(out)
    worst, *_, odd = moments_of(out)[::5]
    lengths = [episode.length for episode in data.episodes]
    longest = int(np.argmax(lengths))
    assert (worst.kind, worst.episode, worst.step) == ("td_error", longest, lengths[longest] - 1)
    assert worst.time_ns == data.episodes[longest].log_time_ns[-2]
    assert (odd.kind, odd.step % 2) == ("disagreement", 1)


def test_an_error_leaves_no_partial_copy(plain: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    with pytest.raises(ZeroDivisionError), annotated_copy(plain, out):
        raise ZeroDivisionError
    assert not out.exists()
    plain.write_bytes(plain.read_bytes()[:-40])
    with pytest.raises(LogError, match="recover"), annotated_copy(plain, out):
        pass
    assert not out.exists()


def test_a_scene_can_be_added_later(plain: Path, tmp_path: Path) -> None:
    """The added messages equal the messages of a recording with a scene."""
    out, full = tmp_path / "out.mcap", tmp_path / "full.mcap"
    assert run(["annotate", str(plain), "--scene", "--out", str(out)]) == 0
    start_ns = int(mcaprl.open(plain).episodes[0].log_time_ns[0])
    data = mcaprl.open(plain)
    with closing(mcaprl.RecordMcap(make_sim("lane"), full, start_time_ns=start_ns)) as env:
        for episode in data.episodes:
            env.reset(seed=episode.seed)
            for action in episode.actions:
                env.step(int(action))
    readers = McapReader(out), McapReader(full)
    for topic in ("/scene", "/scene/static", "/tf", "/tf_static", "/telemetry"):
        added, recorded = ([*reader.messages(reader.channels_of(topic)[0])] for reader in readers)
        assert added == recorded, topic
    assert len(Topic(readers[0], "/rosout")) == 2 * len(data.episodes)
    check_layout(out)
    layout = json.loads(readers[0].attachment(LAYOUT_NAME) or b"")
    assert layout["configById"]["3D!scene"]["followTf"] == "car"


def test_a_different_sim_adds_no_scene(plain: Path, tmp_path: Path) -> None:
    data, out = mcaprl.open(plain), tmp_path / "out.mcap"
    other = Elsewhere(make_sim("lane"))
    reason = "no scene was added, since the replay differs: episode 0"
    with pytest.raises(LogError, match=reason), annotated_copy(plain, out) as copy:
        copy.add_scene(data, other, camera=False)
    assert not out.exists()


def test_topics_of_several_policies() -> None:
    assert values_topics(["cql"]) == {"cql": "/rl/values"}
    assert values_topics(["7 up", "A/b", "a_b"]) == {
        "7 up": "/rl/values/policy_7_up",
        "A/b": "/rl/values/a_b",
        "a_b": "/rl/values/a_b_b",
    }


def test_commands(
    plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    near = ["--gamma", "0.5", "--target-interval", "1"]
    for algo, settings in (("cql", near), ("bc", [])):
        train = ["train-offline", str(plain), "--algo", algo, "--updates", "3", *settings]
        assert run([*train, "--out", algo]) == 0
    both = [
        "annotate",
        str(plain),
        "--policy",
        "cql",
        "--policy",
        "bc",
        "--scene",
        "--out",
        "a.mcap",
    ]
    assert run(both) == 0
    check_layout(Path("a.mcap"))
    capsys.readouterr()
    assert run(["check", "a.mcap"]) == 0
    assert run(["info", "a.mcap"]) == 0
    printed = capsys.readouterr().out
    assert "/rl/values/cql td_error" in printed
    assert "/rl/values/bc disagreement" in printed
    for wrong, why in (
        (["annotate", str(plain), "--out", "b.mcap"], "--camera h264, or a log with labels"),
        (
            ["annotate", str(plain), "--policy", "pilot", "--out", "b.mcap"],
            "no network to evaluate",
        ),
        (["annotate", "a.mcap", "--scene", "--out", "b.mcap"], "already has /scene"),
        (["annotate", str(plain), "--policy", "dqn", "--out", "b.mcap"], "unknown policy 'dqn'"),
        (both, "a.mcap exists"),
    ):
        assert run(wrong) == 2
        assert why in capsys.readouterr().err
    assert not Path("b.mcap").exists()


def test_layouts_of_annotated_logs_refer_to_paths_in_the_log(tmp_path: Path) -> None:
    path, out = tmp_path / "lane.mcap", tmp_path / "annotated.mcap"
    with closing(mcaprl.RecordMcap(make_sim("lane"), path, camera=True)) as env:
        env.reset(seed=0)
        for _ in range(4):
            env.step(1)
    (episode,) = mcaprl.open(path).episodes
    columns: dict[str, Any] = {name: np.zeros((4, 6), np.float32) for name in ("q", "preference")}
    columns |= {name: np.zeros(4) for name in ("value", "advantage", "td_error", "entropy")}
    columns |= {"policy_action": np.zeros(4, np.int64), "agrees": np.ones(4, bool)}
    with annotated_copy(path, out) as copy:
        for topic in ("/rl/values/a", "/rl/values/b"):
            copy.add_values(topic, [(episode.log_time_ns[:-1], columns)])
    layout = check_layout(out)
    tabs = layout["configById"]["Tab!policies"]["tabs"]
    assert [tab["title"] for tab in tabs] == ["values/a", "values/b"]
    title = layout["configById"]["Plot!values/a now"]["foxglovePanelTitle"]
    assert title == "values/a: Q of each action now"


def test_a_video_can_be_added_later(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The added images equal those of a recording with video, byte for byte."""
    logs = [tmp_path / f"{name}.mcap" for name in ("plain", "added", "recorded")]
    for path, camera in ((logs[0], False), (logs[2], "h264")):
        env = gym.make("CartPole-v1", render_mode="rgb_array" if camera else None)
        with closing(mcaprl.RecordMcap(env, path, camera=camera, start_time_ns=10**9)) as recorder:
            for seed in (1, 2):
                recorder.reset(seed=seed)
                while not any(recorder.step(0)[2:4]):
                    pass
    assert run(["annotate", str(logs[0]), "--camera", "h264", "--out", str(logs[1])]) == 0
    assert f"{logs[1]}: the video of 2 episodes, " in capsys.readouterr().out
    readers = [McapReader(path) for path in logs]
    added, recorded = (
        [*reader.messages(reader.channels_of("/camera/image")[0])] for reader in readers[1:]
    )
    assert added == recorded
    assert len(added) > 10
    layout = json.loads(readers[1].attachment(LAYOUT_NAME) or b"")
    image = layout["configById"]["Image!rendered"]["imageMode"]
    assert image["imageTopic"] == "/camera/image"
    check_layout(logs[1])
    with pytest.raises(UsageError, match="already has /camera/image"):
        mcaprl.annotate(logs[1], tmp_path / "again.mcap", camera="h264")
    with pytest.raises(UsageError, match="must be True, False or h264, not 'vp9'"):
        mcaprl.annotate(logs[0], tmp_path / "other.mcap", camera="vp9")

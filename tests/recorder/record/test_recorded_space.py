"""Observations that a log stores in another form, or in part."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import mcaprl
from mcaprl.errors import SpaceError, UnknownNameError, UsageError
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import observation_leaves, space_from_json
from mcaprl.recorder.record.recordable import recorded_like, recorded_space
from tests.support.recordings import ScriptedEnv

PAIR = spaces.Tuple(
    [
        spaces.Box(0, 9, (2,), np.float32),
        spaces.Dict({"y": spaces.Discrete(4), "t": spaces.Tuple([spaces.Discrete(3)])}),
    ]
)


LIST = spaces.Sequence(spaces.Discrete(3))


class MissionSpace(spaces.Space[str]):
    """A space of texts that is not one of Gymnasium's, like MiniGrid's."""

    def __init__(self) -> None:
        super().__init__(dtype=str)

    def sample(self, *_: Any, **__: Any) -> str:
        return "get the key"

    def contains(self, x: Any) -> bool:
        return isinstance(x, str)


class Grid(gym.Env[Any, Any]):
    """An environment with the observations of MiniGrid."""

    observation_space = spaces.Dict(
        {
            "image": spaces.Box(0, 255, (7, 7, 3), np.uint8),
            "direction": spaces.Discrete(4),
            "mission": MissionSpace(),
        }
    )
    action_space = spaces.Discrete(7)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._turn = int(self.np_random.integers(4))
        return self._see(), {}

    def step(self, action: Any) -> Any:
        self._turn = (self._turn + int(action)) % 4
        return self._see(), 0.5, self._turn == 3, False, {}

    def _see(self) -> dict[str, Any]:
        image = np.full((7, 7, 3), self._turn, np.uint8)
        return {"image": image, "direction": self._turn, "mission": "get the key"}


def pair(x: float, y: int, t: int) -> Any:
    return (np.array([x, x + 1], np.float32), {"y": y, "t": (t,)})


def test_tuples_are_recorded_as_dicts(log_path: Path) -> None:
    rows = [(pair(1, 0, 2), 0.0, False, False), (pair(3, 3, 1), 1.5, True, False)]
    env = mcaprl.RecordMcap(ScriptedEnv(PAIR, spaces.Discrete(2), [rows]), log_path)
    with closing(env):
        assert env.observation_space is PAIR
        assert env.reset()[0] is rows[0][0]
        assert env.step(0)[0] is rows[1][0]
    data = mcaprl.open(log_path)
    assert data.observation_space == spaces.Dict(
        {
            "0": spaces.Box(0, 9, (2,), np.float32),
            "1": spaces.Dict(
                {"y": spaces.Discrete(4), "t": spaces.Dict({"0": spaces.Discrete(3)})}
            ),
        }
    )
    assert data.frames["0"].tolist() == [[1, 2], [3, 4]]
    assert data.frames["1"]["y"].tolist() == [0, 3]
    assert data.frames["1"]["t"]["0"].tolist() == [2, 1]


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_tuples_of_vector_environments(tmp_path: Path, mode: AutoresetMode) -> None:
    rows = [(pair(1, 0, 2), 0.0, False, False), (pair(3, 3, 1), 1.5, True, False)]
    envs = SyncVectorEnv(
        [lambda: ScriptedEnv(PAIR, spaces.Discrete(2), [rows] * 3)] * 2, autoreset_mode=mode
    )
    path = tmp_path / "log.mcap"
    with closing(mcaprl.RecordVecMcap(envs, path, keys=["1", "0"])) as env:
        env.reset()
        observation = env.step(np.array([0, 1]))[0]
        assert isinstance(observation, tuple)
    data = mcaprl.open(path)
    assert data.frames["0"].tolist() == [[1, 2], [3, 4]] * 2
    assert data.frames["1"]["t"]["0"].tolist() == [2, 1] * 2


def test_keys_select_the_recorded_parts(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(Grid(), log_path, keys=["image", "direction"])) as env:
        observation, _ = env.reset(seed=1)
        assert observation["mission"] == "get the key"
        env.step(1)
    data = mcaprl.open(log_path)
    assert list(data.frames) == ["direction", "image"]
    assert (data.frames["image"] == data.frames["direction"][:, None, None, None]).all()


@pytest.mark.parametrize(("infos", "names"), [(False, []), ("turn", ["turn"]), (True, ["turn"])])
def test_texts_are_recorded_as_infos(
    log_path: Path, infos: Any, names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        Grid, "step", lambda self, action: (self._see(), 0.0, action == 2, False, {"turn": 3})
    )
    with closing(mcaprl.RecordMcap(Grid(), log_path, infos=infos)) as env:
        for _ in range(2):
            assert env.reset(seed=1)[0]["mission"] == "get the key"
            env.step(1)
            env.step(2)
    data = mcaprl.open(log_path)
    assert list(data.frames) == ["direction", "image"]
    assert data.observation_space == spaces.Dict(
        {key: part for key, part in Grid.observation_space.items() if key != "mission"}
    )
    assert sorted(data.infos) == ["observation.mission", *names]
    assert data.infos["observation.mission"].tolist() == ["get the key"] * 6


def test_texts_that_are_not_wanted_or_the_only_part(log_path: Path) -> None:
    with pytest.raises(SpaceError, match=r"observation\['mission'\] is a MissionSpace space"):
        recorded_space(Grid.observation_space, ["mission"])
    with pytest.raises(SpaceError, match="observation is a Text space"):
        recorded_space(spaces.Text(5))
    assert recorded_space(Grid.observation_space, ["image"]).texts == {}
    nested = spaces.Dict({"a": spaces.Tuple([spaces.Discrete(2), spaces.Text(9)])})
    assert recorded_space(nested).texts == {"observation.a.1": ("a", 1)}
    assert recorded_space(nested).space == spaces.Dict(
        {"a": spaces.Dict({"0": spaces.Discrete(2)})}
    )


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_texts_of_vector_environments(
    log_path: Path, mode: AutoresetMode, monkeypatch: pytest.MonkeyPatch
) -> None:
    def see(self: Grid) -> dict[str, Any]:
        image = np.zeros((7, 7, 3), np.uint8)
        return {"image": image, "direction": self._turn, "mission": f"turn {self._turn}"}

    monkeypatch.setattr(Grid, "_see", see)
    envs = SyncVectorEnv([Grid] * 2, autoreset_mode=mode)
    with closing(mcaprl.RecordVecMcap(envs, log_path)) as env:
        env.reset(seed=[1, 4])
        ended = np.zeros(2, bool)
        for action in (1, 1, 1, 1, 1, 1, 1):
            if mode is AutoresetMode.DISABLED and ended.any():
                env.reset(options={"reset_mask": ended})
            ended = env.step(np.array([action, 2]))[2]
    data = mcaprl.open(log_path)
    assert len(data.episodes) > 2
    # The text of each row is that of the observation in it, also at the end of an episode.
    found = data.infos["observation.mission"].tolist()
    assert found == [f"turn {each}" for each in data.frames["direction"]]


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_keys_of_vector_environments(log_path: Path, mode: AutoresetMode) -> None:
    envs = SyncVectorEnv([Grid] * 2, autoreset_mode=mode)
    with closing(mcaprl.RecordVecMcap(envs, log_path, keys=["direction"])) as env:
        env.reset(seed=0)
        for _ in range(9):
            over = np.logical_or(*env.step(np.array([1, 1]))[2:4])
            if mode is AutoresetMode.DISABLED and over.any():
                env.reset(options={"reset_mask": over})
    data = mcaprl.open(log_path)
    ends = [episode.next_observations["direction"][-1] for episode in data.episodes[:-2]]
    assert ends == [3] * len(ends)
    for episode in data.episodes:
        turns = np.append(
            episode.observations["direction"], episode.next_observations["direction"][-1:]
        )
        assert (np.diff(turns) % 4 == 1).all()


def test_logs_of_a_part_are_verified(log_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gym.register("Grid-v0", cast(Any, Grid), disable_env_checker=True)
    try:
        with closing(mcaprl.RecordMcap(gym.make("Grid-v0"), log_path, keys=["direction"])) as env:
            for seed in range(3):
                env.reset(seed=seed)
                env.step(2)
        found = mcaprl.verify(log_path)
        assert (found.episodes, found.steps, found.difference) == (3, 3, None)
        monkeypatch.setattr(Grid, "_see", lambda self: {"direction": 0, "mission": ""})
        assert mcaprl.verify(log_path).difference is not None
        monkeypatch.setattr(Grid, "observation_space", spaces.Dict({"other": spaces.Discrete(4)}))
        with pytest.raises(SpaceError, match="the log has observation_space"):
            mcaprl.verify(log_path)
    finally:
        gym.registry.pop("Grid-v0")


def test_logs_of_tuples_are_verified(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(gym.make("Blackjack-v1"), log_path)) as env:
        for seed in range(5):
            env.reset(seed=seed)
            env.step(0)
    assert list(mcaprl.open(log_path).frames) == ["0", "1", "2"]
    found = mcaprl.verify(log_path, trust_env=True)
    assert (found.episodes, found.difference) == (5, None)


@pytest.mark.parametrize(
    ("space", "keys", "error", "message"),
    [
        (PAIR, ["2"], UnknownNameError, "unknown key of the observation '2': .*0, 1/t/0, 1/y"),
        (PAIR, [], UsageError, "keys is empty"),
        (PAIR[0], ["0"], UsageError, "keys select parts of a Dict or Tuple"),
        (spaces.Text(3), None, SpaceError, "Text space.*; convert it with a TransformObservation"),
        (spaces.Tuple([spaces.Text(3)]), None, SpaceError, r"\['0'\] is a Text.*no part"),
        (
            spaces.Dict({"a": spaces.Dict({"b": LIST, "c": spaces.Discrete(3)})}),
            ["a"],
            SpaceError,
            r"observation\['a'\]\['b'\] is a Sequence space.*keys=\['a/c'\]",
        ),
    ],
)
def test_keys_that_cannot_be_recorded_are_refused(
    log_path: Path, space: Any, keys: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        mcaprl.RecordMcap(ScriptedEnv(space, spaces.Discrete(2), []), log_path, keys=keys)
    assert not log_path.exists()


def test_the_recorded_part_of_an_observation() -> None:
    recorded = recorded_space(PAIR, ["1"])
    assert recorded.of(pair(1, 3, 2)) == {"1": {"y": 3, "t": {"0": 2}}}
    assert recorded_like(PAIR, recorded.space).space == recorded.space
    plain = spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Discrete(3)})
    assert recorded_space(plain).space is plain


@pytest.mark.parametrize("key", [0, ("a", 1), None, 1.5])
@pytest.mark.parametrize("vector", [False, True])
@pytest.mark.parametrize("nested", [False, True])
def test_keys_must_be_texts(log_path: Path, key: Any, vector: bool, nested: bool) -> None:
    space: spaces.Space[Any] = spaces.Dict({key: spaces.Discrete(2)})
    space = spaces.Dict({"inner": space}) if nested else space
    log_path.write_bytes(b"kept")
    place = r"observation\['inner'\] has" if nested else "observation has"

    def make() -> gym.Env[Any, Any]:
        return ScriptedEnv(space, spaces.Discrete(2), [])

    env: Any = SyncVectorEnv([make]) if vector else make()
    wrapper: Any = mcaprl.RecordVecMcap if vector else mcaprl.RecordMcap
    message = rf"keys of a Dict must be texts: {place} the key .*rename them.*TransformObservation"
    with pytest.raises(SpaceError, match=message):
        wrapper(env, log_path, overwrite=True)
    assert log_path.read_bytes() == b"kept"


def test_arrays_with_other_keys_are_refused() -> None:
    with pytest.raises(SpaceError, match="keys of a Dict must be texts"):
        mcaprl.Dataset.from_arrays(
            observations={0: np.zeros((2, 1)), 1: np.zeros((2, 1))},
            next_observations={0: np.zeros((2, 1)), 1: np.zeros((2, 1))},
            actions=np.array([0, 1]),
            rewards=np.zeros(2),
            terminated=np.array([False, True]),
            truncated=np.array([False, False]),
        )


def test_old_logs_with_other_keys_are_read_with_texts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = spaces.Dict({"0": spaces.Discrete(3), "('a', 1)": spaces.Discrete(5)})
    first, second = {"0": 1, "('a', 1)": 4}, {"0": 2, "('a', 1)": 3}
    rows = [(first, 0.0, False, False), (second, 1.0, True, False)]
    discrete = {"type": "Discrete", "n": 3, "start": 0}
    old = [[0, discrete], [["a", 1], {**discrete, "n": 5}]]
    plain = LogMetadata.to_strings
    with monkeypatch.context() as patch:
        text = json.dumps({"type": "Dict", "spaces": old})
        patch.setattr(
            LogMetadata, "to_strings", lambda self: {**plain(self), "observation_space": text}
        )
        log = tmp_path / "log.mcap"
        env = mcaprl.RecordMcap(ScriptedEnv(space, spaces.Discrete(2), [rows]), log)
        with closing(env):
            env.reset()
            env.step(1)
    data = mcaprl.open(log)
    assert data.frames["0"].tolist() == [1, 2]
    assert data.frames["('a', 1)"].tolist() == [4, 3]
    data.save(tmp_path / "copy.mcap")
    data.to_npz(tmp_path / "data.npz")
    assert mcaprl.open(tmp_path / "copy.mcap").fingerprint == data.fingerprint
    same = json.dumps({"type": "Dict", "spaces": [[0, discrete], ["0", discrete]]})
    with pytest.raises(SpaceError, match="not a description of a space"):
        space_from_json(same)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Text(4),
        spaces.Tuple([spaces.Discrete(2)]),
        spaces.Dict(cast(Any, {0: spaces.Discrete(2)})),
    ],
)
def test_actions_that_cannot_be_recorded_are_refused(log_path: Path, space: Any) -> None:
    env = ScriptedEnv(spaces.Discrete(2), space, [])
    kind = type(space).__name__
    with pytest.raises(SpaceError, match=f"action is a {kind} space.*TransformAction wrapper"):
        mcaprl.RecordMcap(env, log_path)
    assert observation_leaves(env.observation_space)


def test_vector_rewards_are_refused(log_path: Path) -> None:
    rows: Any = [(0, 0.0, False, False), (1, np.array([1.0, 2.0]), False, False)]
    env = ScriptedEnv(spaces.Discrete(2), spaces.Discrete(2), [rows])
    with closing(mcaprl.RecordMcap(env, log_path)) as recorder:
        recorder.reset()
        with pytest.raises(SpaceError, match=r"reward is array.*single number; combine"):
            recorder.step(0)

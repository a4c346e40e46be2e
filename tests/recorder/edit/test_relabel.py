"""Tests of rewards from expressions, beside loops over episodes."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import UnknownNameError, UsageError


class Walk(gym.Env[Any, Any]):
    """Moves by the first number of the action; the info has the effort."""

    observation_space = spaces.Box(-9, 9, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    observation_names = ("place", "step")

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self._place, self._step = 0.0, 0
        return self._observation(), {"effort": 0.0}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._place += float(action[0])
        self._step += 1
        over = self._step == 3
        return self._observation(), 1.0, over, False, {"effort": float(abs(action[1]))}

    def _observation(self) -> Any:
        return np.array([self._place, self._step], np.float32)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "walk.mcap"
    with closing(mcaprl.RecordMcap(Walk(), path, infos=True)) as env:
        for seed in range(2):
            env.reset(seed=seed)
            for step in range(3):
                env.step(np.array([0.5 + seed, -0.25 * step], np.float32))
    return path


@pytest.mark.parametrize(
    ("reward", "expected"),
    [
        ("reward", [1, 1, 1, 1, 1, 1]),
        # The last transition of an episode leads to its last observation, not to the next episode.
        ("next(place) - place", [0.5, 0.5, 0.5, 1.5, 1.5, 1.5]),
        ("observation[1]", [0, 1, 2, 0, 1, 2]),
        ("10 if terminated else -abs(action[1])", [0, -0.25, 10, 0, -0.25, 10]),
        ("next(effort)", [0, 0.25, 0.5, 0, 0.25, 0.5]),
        ("2", [2] * 6),
    ],
)
def test_rewards_are_those_of_the_expression(
    log: Path, tmp_path: Path, reward: str, expected: list[float]
) -> None:
    found = mcaprl.relabel(log, tmp_path / "new.mcap", reward=reward)
    new, old = mcaprl.open(tmp_path / "new.mcap"), mcaprl.open(log)
    assert new.rewards.tolist() == found.rewards.tolist() == expected
    assert [e.total_reward for e in new.episodes] == [sum(expected[:3]), sum(expected[3:])]
    for name in ("actions", "terminated", "observations", "next_observations"):
        np.testing.assert_array_equal(getattr(new, name), getattr(old, name))
    # An object does as well as a name.
    assert mcaprl.relabel(old, tmp_path / "same.mcap", reward=reward).rewards.tolist() == expected


def test_wrong_rewards_write_nothing(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new.mcap"
    with pytest.raises(UnknownNameError, match=r"'plaice'.*place"):
        mcaprl.relabel(log, out, reward="plaice")
    with pytest.raises(UsageError, match=r"is inf in transition 0, .* in 2 of 6 transitions"):
        mcaprl.relabel(log, out, reward="1 / step")
    with pytest.raises(UsageError, match="one number for each row"):
        mcaprl.relabel(log, out, reward="action")
    assert run(["relabel", str(log), str(out), "--reward", "__import__('os')"]) == 2
    assert not out.exists()
    assert run(["relabel", str(log), str(out), "--reward", "3 * reward"]) == 0
    assert "2 episodes, 6 steps, mean return 9" in capsys.readouterr().out
    assert run(["relabel", str(log), str(out), "--reward", "reward"]) == 2


def test_parts_of_a_dict_and_numbered_actions_have_names(tmp_path: Path) -> None:
    class Rooms(gym.Env[Any, Any]):
        observation_space = spaces.Dict(
            {"room": spaces.Discrete(4), "speed": spaces.Box(0, 9, (2,), np.float32)}
        )
        action_space = spaces.Discrete(2)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
            self._k = 0
            return self._seen(), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            self._k += 1
            return self._seen(), 0.0, False, self._k == 3, {}

        def _seen(self) -> Any:
            return {"room": self._k, "speed": np.array([self._k, 2 * self._k], np.float32)}

    path = tmp_path / "rooms.mcap"
    with closing(mcaprl.RecordMcap(Rooms(), path)) as env:
        env.reset(seed=0)
        for action in (0, 1, 1):
            env.step(action)
    found = mcaprl.relabel(
        path, tmp_path / "new.mcap", reward="room[0] + 10 * speed[1] + 100 * action"
    )
    assert found.rewards.tolist() == [0, 121, 142]

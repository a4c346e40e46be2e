"""Results of environments that do not conform to Gymnasium's interface."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.errors import SpaceError
from mcaprl.sims.evaluation.rollout import EpsilonGreedy, rollout


class Returning(gym.Env[Any, Any]):
    """Environment with episodes of two steps, which returns a given reward and reason."""

    observation_space = spaces.Discrete(3)
    action_space = spaces.Discrete(2)

    def __init__(self, reward: Any, reason: str = "") -> None:
        self._reward, self._reason, self._steps = reward, reason, 0

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        self._steps = 0
        return 0, {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self._steps += 1
        return self._steps, self._reward, self._steps == 2, False, {"reason": self._reason}


def play(env: gym.Env[Any, Any]) -> None:
    env.reset()
    env.step(0)
    env.step(1)


@pytest.mark.parametrize("reward", [np.array([1.5]), np.array(1.5), np.float32(1.5), [1.5]])
def test_rewards_of_one_number_are_stored(log_path: Path, reward: Any) -> None:
    with closing(mcaprl.RecordMcap(Returning(reward), log_path)) as env:
        play(env)
    assert mcaprl.open(log_path).rewards.tolist() == [1.5, 1.5]


def test_rollouts_accept_rewards_of_one_number(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(Returning(np.array([1.5])), log_path)) as env:
        (result,) = rollout(env, EpsilonGreedy(None, 1.0, env.action_space), seed=0, episodes=1)
    assert result.total_reward == 3.0


@pytest.mark.parametrize("reward", [None, np.array([1.0, 2.0]), "1", np.array([]), {}])
def test_other_rewards_are_one_clear_error(log_path: Path, reward: Any) -> None:
    with closing(mcaprl.RecordMcap(Returning(reward), log_path)) as env:
        env.reset()
        with pytest.raises(SpaceError, match="the reward is"):
            env.step(0)


def test_texts_that_utf_8_cannot_encode_are_stored_escaped(log_path: Path) -> None:
    env = Returning(1.0, reason="crash \ud800")
    with closing(mcaprl.RecordMcap(env, log_path, policy="runs/\udcff")) as recorder:
        play(recorder)
    (episode,) = mcaprl.open(log_path).episodes
    assert (episode.reason, episode.policy) == (r"crash \ud800", r"runs/\udcff")
    assert mcaprl.check(log_path).ok


def test_a_name_of_nul_characters_is_not_lost(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with closing(mcaprl.RecordMcap(gym.make("CartPole-v1"), path, policy="a\0")) as env:
        env.reset(seed=0)
        while not any(env.step(0)[2:4]):
            pass
    (episode,) = mcaprl.open(path).episodes
    assert episode.policy == "a\ufffd"


def test_an_info_that_is_not_a_dict_does_not_change_the_end(log_path: Path) -> None:
    """The episode is recorded up to the transition before the error."""

    class WithoutInfo(gym.Wrapper[Any, Any, Any, Any]):
        """Environment that returns None instead of an info."""

        def step(self, action: Any) -> tuple[Any, Any, bool, bool, Any]:
            return *self.env.step(action)[:4], None

    with closing(mcaprl.RecordMcap(WithoutInfo(Returning(1.0)), log_path)) as env:
        env.reset()
        env.step(0)
        with pytest.raises(AttributeError):
            env.step(0)
    (episode,) = mcaprl.open(log_path).episodes
    assert (episode.length, episode.reason) == (1, "interrupted")

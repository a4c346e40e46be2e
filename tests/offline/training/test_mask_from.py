"""Tests of action masks from infos and from other parts of the observation."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import PolicyError, SpaceError, UnknownNameError
from mcaprl.offline.policy import read_policy

SHORT: dict[str, Any] = {"updates": 300, "hidden": (16,), "gamma": 0.0, "target_interval": 20}
SIM = "Forbidden-v0"
MASK = "info:rules.legal"


class Forbidden(gym.Env[Any, Any]):
    """Three actions, of which one is forbidden in each step; the mask is an info or an observation.

    The reward of action k is k. Episodes have four steps. A forbidden action is an error.
    """

    action_space = spaces.Discrete(3, start=5)

    def __init__(self, as_info: bool = True) -> None:
        self.as_info = as_info
        box = spaces.Box(0, 1, (3,), np.float32)
        parts = {"robot": spaces.Dict({"legal": spaces.MultiBinary(3)}), "x": box}
        self.observation_space = box if as_info else spaces.Dict(parts)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = 4
        return self._next()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.legal[action - 5]
        self.left -= 1
        observation, info = self._next()
        return observation, float(action - 5), self.left == 0, False, info

    def _next(self) -> tuple[Any, dict[str, Any]]:
        self.legal = np.ones(3, np.int8)
        self.legal[self.np_random.integers(3)] = 0
        shown = self.np_random.random(3).astype(np.float32)
        if not self.as_info:
            return {"robot": {"legal": self.legal.copy()}, "x": shown}, {}
        # A terminal state needs no mask.
        return shown, {"rules": {"legal": self.legal.copy()}} if self.left else {}


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    gym.register(SIM, lambda **options: Forbidden(**options))
    yield
    del gym.registry[SIM]


def record(path: Path, *, as_info: bool = True, episodes: int = 50) -> Path:
    """Record random allowed actions."""
    env = gym.make(SIM, as_info=as_info)
    inner: Any = env.unwrapped
    random = np.random.default_rng(0)
    with mcaprl.RecordMcap(env, path, infos=True) as recorder:
        for episode in range(episodes):
            recorder.reset(seed=episode)
            ended = False
            while not ended:
                legal = np.flatnonzero(inner.legal)
                ended = recorder.step(5 + random.choice(legal))[2]
    return path


def test_masks_of_infos_forbid_actions_in_training_and_evaluation(tmp_path: Path) -> None:
    log, out = record(tmp_path / "log.mcap"), tmp_path / "run"
    mcaprl.train(log, out, algo="cql", alpha=0.0, learning_rate=1e-2, mask_from=MASK, **SHORT)
    policy = read_policy(out / "seed-0")
    assert policy.mask_from == "info:rules.legal"
    assert policy.env_observation_space == spaces.Box(0, 1, (3,), np.float32)
    shown = np.zeros((2, 3), np.float32)
    seen = {"observation": shown, "action_mask": np.array([[1, 1, 0], [0, 1, 1]], np.int8)}
    # The largest allowed action earns most.
    assert policy.act(seen).tolist() == [6, 7]
    assert np.isneginf(policy.q_values(seen)).tolist() == [
        [False, False, True],
        [True, False, False],
    ]
    # The environment asserts that actions are allowed; random actions use the mask, too.
    found = mcaprl.evaluate(str(out), SIM, episodes=6, trust_env=True)
    best = next(one for one in found.policies if one.policy == "run")
    expected = []
    for result in best.results[0]:
        env = Forbidden()
        env.reset(seed=result.seed)
        total = 0.0
        for _ in range(4):
            total += env.step(5 + int(np.flatnonzero(env.legal).max()))[1]
        expected.append(total)
    assert [result.total_reward for result in best.results[0]] == expected
    again, options = tmp_path / "again.mcap", {"as_info": True}
    mcaprl.record(SIM, again, policy=str(out), epsilon=0.5, episodes=10, sim_options=options)
    # Two actions are allowed in each state: a random one has 0.5 / 2.
    assert set(mcaprl.open(again).behavior_probs.tolist()) == {0.25, 0.75}


def test_a_key_of_the_observation_is_a_source(tmp_path: Path) -> None:
    log, out = record(tmp_path / "log.mcap", as_info=False), tmp_path / "run"
    mcaprl.train(log, out, algo="bc", updates=20, hidden=(8,), mask_from="robot/legal")
    found = mcaprl.evaluate(str(out), SIM, episodes=3, sim_options={"as_info": False})
    assert {"run", "random"} <= {one.policy for one in found.policies}


def test_masked_data_are_estimated_and_resumed(tmp_path: Path) -> None:
    log, out = record(tmp_path / "log.mcap"), tmp_path / "run"
    given = ["--algo", "cql", "--hidden", "8", "--gamma", "0", "--target-interval", "5"]
    command = ["train-offline", str(log), "--out", str(out)]
    asked = ["--mask-from", "info:rules.legal", "--updates", "20"]
    assert run([*command, *given, *asked]) == 0
    with pytest.warns(UserWarning, match="the learning rate decayed over 20 updates"):
        (again,) = mcaprl.train(log, out, resume=True, updates=30)
    assert again.steps == 30
    data = mcaprl.open(log)
    with pytest.raises(PolicyError, match=r'pass with_action_mask\("info:rules\.legal"\)'):
        mcaprl.estimate(str(out), data, updates=20)
    masked = data.with_action_mask("info:rules.legal")
    flags = data.infos["rules.legal"].filled(1)
    np.testing.assert_array_equal(masked.frames["action_mask"], flags)
    np.testing.assert_array_equal(masked.frames["observation"], data.frames)
    assert mcaprl.estimate(str(out), masked, updates=20, gamma=0.0).estimates


def test_auto_uses_masks(tmp_path: Path) -> None:
    log = record(tmp_path / "log.mcap")
    given: dict[str, Any] = {**SHORT, "updates": 40, "gamma": 0.5, "target_interval": 5}
    (summary,) = mcaprl.train(
        log, tmp_path / "run", algo="auto", model_updates=40, mask_from="info:rules.legal", **given
    )
    assert read_policy(summary.folder).mask_from == "info:rules.legal"


def test_wrong_sources_are_one_line(tmp_path: Path) -> None:
    data = mcaprl.open(record(tmp_path / "log.mcap", episodes=3))
    with pytest.raises(UnknownNameError, match=r"unknown info 'legal'"):
        data.with_action_mask("info:legal")
    with pytest.raises(UnknownNameError, match="unknown part of the observation 'legal'"):
        data.with_action_mask("legal")
    masked = data.with_action_mask("info:rules.legal")
    with pytest.raises(SpaceError, match="already have a part action_mask: omit mask_from"):
        masked.with_action_mask("info:rules.legal")
    inside = mcaprl.open(record(tmp_path / "key.mcap", as_info=False, episodes=3))
    with pytest.raises(SpaceError, match=r"x is no action mask: expected one flag \(0 or 1\)"):
        inside.with_action_mask("x")
    with pytest.raises(PolicyError, match=r"the environment's info has no rules\.legal, which"):
        mcaprl.evaluate(
            "random", SIM, episodes=1, mask_from="info:rules.legal", sim_options={"as_info": False}
        )


def test_a_missing_mask_is_named(tmp_path: Path) -> None:
    class Forgetful(Forbidden):
        def _next(self) -> tuple[Any, dict[str, Any]]:
            observation, info = super()._next()
            return observation, info if self.left == 4 else {}

    env = Forgetful()
    with mcaprl.RecordMcap(env, tmp_path / "log.mcap", infos=True) as recorder:
        recorder.reset(seed=0)
        for _ in range(4):
            recorder.step(5 + int(np.flatnonzero(env.legal)[0]))
    with pytest.raises(SpaceError, match=r"no info rules\.legal with frame 1: it must return one"):
        mcaprl.open(tmp_path / "log.mcap").with_action_mask("info:rules.legal")

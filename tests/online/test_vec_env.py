"""Tests that the adapter from batched environments to SB3 acts like SB3's `DummyVecEnv`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from mcaprl.online.sb3 import BatchedVecEnv
from mcaprl.sims import SIMS, make_sim, make_sims
from mcaprl.sims.evaluation.rollout import episode_seed

COUNT = 3


def batched(name: str) -> BatchedVecEnv:
    return BatchedVecEnv(make_sims(name, COUNT, autoreset_mode="SameStep"))


def batched_cartpole() -> BatchedVecEnv:
    envs = SyncVectorEnv([short_cartpole] * COUNT, autoreset_mode=AutoresetMode.SAME_STEP)
    return BatchedVecEnv(envs)


def dummy(one: Any, seed: int) -> DummyVecEnv:
    """Return SB3's `DummyVecEnv`, whose environments have the same seeds as ours."""
    env = DummyVecEnv([lambda: Monitor(one()) for _ in range(COUNT)])
    env._seeds = [episode_seed(seed, i) for i in range(COUNT)]
    return env


def short_cartpole() -> gym.Env[Any, Any]:
    """Return CartPole with a short time limit, so that episodes end by falling or by the limit."""
    return gym.make("CartPole-v1", max_episode_steps=12)


@pytest.mark.parametrize(
    ("several", "one"),
    [
        (batched_cartpole, short_cartpole),
        *((partial(batched, name), partial(make_sim, name)) for name in SIMS),
    ],
    ids=["cartpole", *SIMS],
)
def test_it_equals_sb3s_own_environment(several: Callable[[], BatchedVecEnv], one: Any) -> None:
    ours, theirs = several(), dummy(one, 5)
    ours.seed(5)
    np.testing.assert_array_equal(np.asarray(ours.reset()), np.asarray(theirs.reset()))
    random = np.random.default_rng(0)
    ends = 0
    for _ in range(400):
        actions = random.integers(2, size=COUNT)
        mine: Any = ours.step(actions)
        other: Any = theirs.step(actions)
        for a, b in zip(mine[:3], other[:3], strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        for done, a, b in zip(mine[2], mine[3], other[3], strict=True):
            if done:
                ends += 1
                np.testing.assert_array_equal(a["terminal_observation"], b["terminal_observation"])
                assert a["TimeLimit.truncated"] == b["TimeLimit.truncated"]
                assert a["episode"]["l"] == b["episode"]["l"]
                assert a["episode"]["r"] == pytest.approx(b["episode"]["r"], abs=1e-5)
                assert a.get("reason") == b.get("reason")
            else:
                assert a == {}
    assert ends > 2
    ours.close()
    theirs.close()


def test_termination_and_truncation_are_distinguished() -> None:
    env = batched_cartpole()
    env.reset()
    random = np.random.default_rng(0)
    flags = set()
    for _ in range(200):
        *_, dones, infos = env.step(random.integers(2, size=COUNT))
        flags |= {infos[i]["TimeLimit.truncated"] for i in np.flatnonzero(dones)}
    assert flags == {False, True}


def test_the_same_seed_gives_the_same_starts_and_another_does_not() -> None:
    env = batched("lane")
    starts = []
    for seed in (1, 1, 2):
        env.seed(seed)
        starts.append(np.asarray(env.reset()).tobytes())
    assert starts[0] == starts[1] != starts[2]


def test_without_a_new_seed_episodes_differ() -> None:
    env = batched("lane")
    env.seed(1)
    assert np.asarray(env.reset()).tobytes() != np.asarray(env.reset()).tobytes()


def test_attributes_are_those_of_the_batch() -> None:
    env = batched("lane")
    assert env.get_attr("num_envs") == [COUNT] * COUNT
    assert env.get_attr("num_envs", [0]) == [COUNT]
    assert env.render_mode is None
    assert env.env_is_wrapped(Monitor) == [False] * COUNT
    env.set_attr("note", 1)
    assert env.env_method("reset")[0][0].shape == (COUNT, 12)
    assert env.get_attr("note") == [1] * COUNT

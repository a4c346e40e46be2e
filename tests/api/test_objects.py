"""Tests of environments and policies that are given as objects, and of runs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import mcaprl
from mcaprl.base_policy import BasePolicy, RandomPolicy, as_policy
from mcaprl.errors import PolicyError, UsageError
from mcaprl.sims.evaluation.evaluate import make_pilot

SMALL: dict[str, Any] = {"algo": "bc", "updates": 5, "batch_size": 8, "hidden": (4,)}


class Balance:
    """A policy of another package, which pushes to the side to which the pole falls."""

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        return (observations[:, 2] > 0).astype(np.int64)


@pytest.fixture
def run(tmp_path: Path) -> Any:
    mcaprl.record("CartPole-v1", tmp_path / "log.mcap", policy="random", episodes=4, seed=1)
    return mcaprl.train(tmp_path / "log.mcap", tmp_path / "run", seeds=2, **SMALL)


def test_a_run_is_the_list_of_its_summaries(run: Any, tmp_path: Path) -> None:
    assert [summary.seed for summary in run] == [0, 1]
    assert run == run.summaries == list(run)
    assert run.folder == tmp_path / "run"
    assert isinstance(run, mcaprl.Run)
    assert run.policy.name == run.policies[0].name == "run/seed-0"
    assert run.policy is run.policy
    assert mcaprl.load_policy(run).name == run.policy.name


def test_a_policy_is_not_loaded_before_it_is_needed(tmp_path: Path) -> None:
    run: Any = mcaprl.Run(tmp_path, [])
    with pytest.raises(PolicyError, match="has no policy"):
        _ = run.policy


def test_objects_are_evaluated_as_names_are(run: Any) -> None:
    by_name = mcaprl.evaluate(str(run.folder), "CartPole-v1", episodes=3)
    env = gym.make("CartPole-v1")
    by_object = mcaprl.evaluate(run, env, episodes=3)
    assert by_object.to_json() == by_name.to_json()
    first = mcaprl.evaluate([run.policy, run.policy], env, episodes=3).policies
    assert [one.policy for one in first] == ["run/seed-0", "run/seed-0-2", "random"]
    returns = by_name.policies[0].returns[0]
    assert first[0].returns.tolist() == first[1].returns.tolist() == [returns.tolist()]
    env.reset()
    env.step(0)  # raises if the environment was closed


def test_policies_of_other_packages_are_evaluated_and_recorded(tmp_path: Path) -> None:
    env = gym.make("CartPole-v1")
    balance, random = mcaprl.evaluate(Balance(), env, episodes=20).policies
    assert balance.policy == "Balance"
    assert balance.mean_return > 1.3 * random.mean_return
    recording = mcaprl.record(env, tmp_path / "log.mcap", policy=Balance(), episodes=2, seed=3)
    log = mcaprl.open(tmp_path / "log.mcap")
    assert log.actions.tolist() == Balance().act(log.observations).tolist()
    assert recording.steps == len(log)
    assert log.episodes[0].policy == "Balance"
    # Whether its actions are random is unknown.
    assert np.isnan(log.behavior_probs).all()
    balance_: Any = Balance()
    balance_.is_deterministic = True
    mcaprl.record(env, tmp_path / "b.mcap", policy=balance_, epsilon=0.5, steps=60, seed=3)
    assert set(mcaprl.open(tmp_path / "b.mcap").behavior_probs.tolist()) == {0.25, 0.75}


class Swing:
    """A stochastic policy of Pendulum: torques from a normal distribution of width 0.1."""

    is_deterministic = False

    def act(self, observations: Any) -> Any:
        drawn = np.random.default_rng(len(observations)).normal(0, 0.1, (len(observations), 1))
        return drawn.astype(np.float32)

    def log_prob(self, observations: Any, actions: Any) -> Any:
        return -((actions[:, 0] / 0.1) ** 2) / 2 - math.log(0.1 * math.sqrt(2 * math.pi))


def test_densities_of_policies_of_other_packages_are_recorded(tmp_path: Path) -> None:
    swing: Any = Swing()
    mcaprl.record("Pendulum-v1", tmp_path / "log.mcap", policy=swing, steps=30, seed=3)
    log = mcaprl.open(tmp_path / "log.mcap")
    expected = swing.log_prob(log.observations, log.actions.astype(np.float64))
    np.testing.assert_allclose(log.behavior_log_probs, expected, rtol=1e-6)
    assert expected.max() > 0, "a density may be above 1"
    swing.is_deterministic = True
    mcaprl.record("Pendulum-v1", tmp_path / "b.mcap", policy=swing, steps=30, seed=3)
    assert np.isnan(mcaprl.open(tmp_path / "b.mcap").behavior_log_probs).all()


def test_a_pilot_records_the_same_steps_as_its_name(tmp_path: Path) -> None:
    env = mcaprl.make_sim("lane")
    pilot = make_pilot(env)
    mcaprl.record(env, tmp_path / "a.mcap", policy=pilot, steps=20, seed=2)
    mcaprl.record("lane", tmp_path / "b.mcap", policy="pilot", steps=20, seed=2)
    one, other = (mcaprl.open(tmp_path / name) for name in ("a.mcap", "b.mcap"))
    np.testing.assert_array_equal(one.observations, other.observations)
    np.testing.assert_array_equal(one.behavior_probs, other.behavior_probs)
    assert one.env_id == other.env_id
    seen = one.observations[:1]
    action = pilot.act(seen)
    assert pilot.log_prob(seen, action).tolist() == [0]
    assert pilot.log_prob(seen, 1 - np.minimum(action, 1)).tolist() == [-math.inf]
    assert pilot.scores(seen) is None


def test_a_random_policy_takes_allowed_actions() -> None:
    policy = RandomPolicy(gym.spaces.Discrete(3, start=4))
    seen = {"action_mask": np.array([[1, 0, 1], [0, 1, 0]]), "x": np.zeros((2, 1))}
    assert policy.action_probabilities(seen).tolist() == [[0.5, 0, 0.5], [0, 1, 0]]
    drawn = np.array([policy.act(seen) for _ in range(50)])
    assert {*drawn[:, 0]} == {4, 6}
    assert {*drawn[:, 1]} == {5}
    assert {*policy.act(np.zeros((100, 2)))} == {4, 5, 6}
    assert policy.log_prob(np.zeros((1, 2)), np.array([5])).tolist() == [math.log(1 / 3)]
    for wanted in (policy.q_values, BasePolicy().action_probabilities):
        with pytest.raises(PolicyError, match="has no"):
            wanted(seen)


@pytest.mark.parametrize(
    ("sim", "policy", "options", "message"),
    [
        ("CartPole-v1", object(), {}, "is not a policy: pass a name, a path, or an object"),
        (gym.make_vec("CartPole-v1"), "random", {}, "is not a single environment"),
        (gym.make("CartPole-v1"), "random", {"rules": "classic"}, "rules: arguments are for a sim"),
        ("CartPole-v1", Balance(), {"ray": True}, "several processes need names"),
        (gym.make("CartPole-v1"), "random", {"ray": True}, "several processes need names"),
    ],
)
def test_objects_that_cannot_be_used_are_refused(
    tmp_path: Path, sim: Any, policy: Any, options: Any, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        mcaprl.evaluate(policy, sim, episodes=1, **options)
    out = tmp_path / "log"
    with pytest.raises(UsageError, match=message):
        mcaprl.record(sim, out, policy=policy, episodes=1, **options)
    assert not out.exists()


def test_members_of_other_policies_are_kept() -> None:
    class Stacking:
        name, frame_stack, begun = "stacking", 2, 0

        def begin(self) -> None:
            self.begun += 1

        def act(self, observations: Any) -> Any:
            return observations

    other = Stacking()
    policy = as_policy(other)
    policy.begin()
    assert (policy.name, policy.frame_stack, other.begun) == ("stacking", 2, 1)
    assert policy.act([3]) == [3]
    assert as_policy(policy) is policy

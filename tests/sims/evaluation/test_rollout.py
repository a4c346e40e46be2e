"""Tests of rollouts and scores: seeds, probabilities and intervals."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy
from mcaprl.errors import PolicyError
from mcaprl.sims.drawing.scene import Shape
from mcaprl.sims.evaluation.evaluate import evaluate, improvements, normalize
from mcaprl.sims.evaluation.report import evaluation_page
from mcaprl.sims.evaluation.rollout import EpsilonGreedy, check_fit, episode_seed, rollout


class AlwaysLeft:
    name = "left"

    def act(self, observations: Any) -> NDArray[Any]:
        return np.zeros(len(observations), np.int64)


@pytest.fixture
def env() -> gym.Env[Any, Any]:
    return gym.make("CartPole-v1")


def test_probabilities_by_hand(env: gym.Env[Any, Any]) -> None:
    behavior = EpsilonGreedy(AlwaysLeft(), 0.2, env.action_space)
    behavior.begin(3)
    drawn = [behavior.choose(np.zeros(4, np.float32)) for _ in range(4000)]
    assert {probability for action, probability in drawn if action == 0} == {0.2 / 2 + 0.8}
    assert {probability for action, probability in drawn if action == 1} == {0.1}
    assert np.mean([action for action, _ in drawn]) == pytest.approx(0.1, abs=0.02)


def test_random_policy_has_equal_probabilities(env: gym.Env[Any, Any]) -> None:
    behavior = EpsilonGreedy(None, 0.0, env.action_space)
    assert behavior.epsilon == 1.0
    assert {behavior.choose(np.zeros(4))[1] for _ in range(50)} == {0.5}


def test_random_actions_are_allowed_ones() -> None:
    behavior = EpsilonGreedy(AlwaysLeft(), 0.4, spaces.Discrete(4, start=0))
    behavior.begin(0)
    for mask, chances in (
        ([1, 0, 1, 0], {0: 0.8, 2: 0.2}),
        ([0, 1, 1, 0], {0: 0.6, 1: 0.2, 2: 0.2}),
    ):
        seen = {"action_mask": np.array(mask, np.int8), "x": np.zeros(4, np.float32)}
        drawn = dict(behavior.choose(seen) for _ in range(200))
        assert drawn == pytest.approx(chances)


class AlwaysOn:
    name = "on"

    def act(self, observations: Any) -> NDArray[Any]:
        return np.ones((len(observations["x"]), 2), np.int8)


def test_joint_actions_have_joint_probabilities() -> None:
    behavior = EpsilonGreedy(AlwaysOn(), 0.4, spaces.MultiBinary(2))
    behavior.begin(0)
    seen: dict[str, Any] = {"x": np.zeros(1)}
    drawn = [behavior.choose(seen) for _ in range(200)]
    assert {(*action.tolist(), round(chance, 9)) for action, chance in drawn} == {
        (0, 0, 0.1),
        (0, 1, 0.1),
        (1, 0, 0.1),
        (1, 1, 0.7),
    }
    # A mask of the four joint actions forbids (0, 1) and (1, 0).
    seen["action_mask"] = np.array([1, 0, 0, 1], np.int8)
    masked = [behavior.choose(seen) for _ in range(200)]
    assert {(*action.tolist(), round(chance, 9)) for action, chance in masked} == {
        (0, 0, 0.2),
        (1, 1, 0.8),
    }
    # A mask of another form, such as one flag for each value of an element, is left to the policy.
    seen["action_mask"] = np.array([1, 0, 0, 1, 1], np.int8)
    assert {round(behavior.choose(seen)[1], 9) for _ in range(200)} == {0.1, 0.7}


def test_the_probability_in_a_very_large_space_is_unknown() -> None:
    behavior = EpsilonGreedy(None, 1.0, spaces.MultiBinary(2000))
    action, probability = behavior.choose(np.zeros(3))
    assert action.shape == (2000,)
    assert math.isnan(probability)


class Uniform(BasePolicy):
    """A stochastic policy that is uniform from 0 to 1."""

    is_deterministic = False

    def act(self, observations: Any) -> NDArray[Any]:
        return np.full((len(observations), 1), 0.5, np.float32)

    def log_prob(self, observations: Any, actions: NDArray[Any]) -> NDArray[Any]:
        with np.errstate(divide="ignore"):
            found: NDArray[Any] = np.log(((actions >= 0) & (actions <= 1)).astype(float))[:, 0]
        return found


def test_the_density_of_a_random_command_is_uniform() -> None:
    env = gym.make("Pendulum-v1")  # torques from -2 to 2
    for behavior in (
        EpsilonGreedy(None, 0.0, env.action_space),
        EpsilonGreedy(Uniform(), 1.0, env.action_space),
    ):
        action, log_density = behavior.choose(np.zeros(3))
        assert env.action_space.contains(action)
        assert log_density == pytest.approx(-math.log(4))
    box = spaces.Box(np.array([0, -1], np.float32), np.array([0.5, 7], np.float32))
    assert EpsilonGreedy(None, 1.0, box).choose(np.zeros(3))[1] == pytest.approx(-math.log(4))


def test_the_density_of_an_exploring_policy_is_that_of_the_mixture() -> None:
    space = spaces.Box(-2, 2, (1,), np.float32)
    behavior = EpsilonGreedy(Uniform(), 0.2, space)
    drawn = [behavior.choose(np.zeros(3)) for _ in range(100)]
    assert {action.item() for action, _ in drawn} > {0.5}
    for action, log_density in drawn:
        inside = 0.8 if 0 <= action.item() <= 1 else 0.0
        assert log_density == pytest.approx(math.log(0.2 / 4 + inside))


def test_the_density_is_unknown_without_one() -> None:
    class Certain(Uniform):
        is_deterministic = True

    class Undecided(Uniform):
        def log_prob(self, observations: Any, actions: NDArray[Any]) -> NDArray[Any]:
            raise PolicyError("no density")

    box = spaces.Box(-2, 2, (1,), np.float32)
    for policy, space in (
        (Certain(), box),
        (Undecided(), box),
        (None, spaces.Box(-np.inf, 2, (1,), np.float32)),
        (None, spaces.Box(-3, 3, (1,), np.int64)),
        (None, spaces.Box(1, 1, (1,), np.float32)),
    ):
        assert math.isnan(EpsilonGreedy(policy, 0.5, space).choose(np.zeros(3))[1])


def test_episodes_do_not_depend_on_who_runs_them(env: gym.Env[Any, Any]) -> None:
    behavior = EpsilonGreedy(AlwaysLeft(), 0.5, env.action_space)
    whole = rollout(env, behavior, seed=4, episodes=6)
    parts = [
        *rollout(env, behavior, seed=4, episodes=2),
        *rollout(env, behavior, seed=4, episodes=4, first_episode=2),
    ]
    assert [(e.seed, e.total_reward) for e in whole] == [(e.seed, e.total_reward) for e in parts]
    assert len({episode.seed for episode in whole}) == 6
    assert episode_seed(4, 1) != episode_seed(5, 0)


def test_steps_are_counted_exactly(env: gym.Env[Any, Any]) -> None:
    results = rollout(env, EpsilonGreedy(None, 1.0, env.action_space), seed=0, steps=100)
    assert sum(result.length for result in results) == 100
    assert results[-1].reason in ("interrupted", "terminated")
    with pytest.raises(ValueError, match="either episodes or steps"):
        rollout(env, EpsilonGreedy(None, 1.0, env.action_space), seed=0)


def test_scores_by_hand(env: gym.Env[Any, Any]) -> None:
    left = evaluate(env, [AlwaysLeft()], name="left", episodes=5, seed=0)
    random = evaluate(env, [None], name="random", episodes=5, seed=0)
    twice = evaluate(env, [AlwaysLeft(), AlwaysLeft()], name="twice", episodes=5, seed=0)
    assert [e.seed for e in left.results[0]] == [e.seed for e in random.results[0]]
    assert twice.returns.tolist() == [left.returns[0].tolist()] * 2, "greedy runs repeat"
    assert left.has_interval
    assert not twice.has_interval, "it would rest on one difference"
    assert normalize(left, random, None).normalized_score is None
    assert normalize(random, random, left).normalized_score == 0.0
    assert normalize(left, random, left).normalized_score == 1.0
    json.dumps(left.to_json())
    [compared] = improvements([left, random])
    assert {compared.better, compared.than} == {"left", "random"}
    assert 0.5 <= compared.interval[1] <= 1.0
    json.dumps(compared.to_json())


def test_reports_are_written(env: gym.Env[Any, Any], tmp_path: Path) -> None:
    random = evaluate(env, [None], name="random", episodes=3, seed=0)
    left = evaluate(env, [AlwaysLeft()], name="left", episodes=3, seed=0)
    compared = improvements([random, left])
    logged = (1.0, 0.5, 2.0)
    evaluation_page(
        tmp_path / "a", "CartPole", [left, random], compared, [], logged, (Path("x.mcap"), 1)
    )
    assert (tmp_path / "a" / "comparison.png").read_bytes()[:4] == b"\x89PNG"
    assert not (tmp_path / "a" / "trajectories.png").exists(), "CartPole has no map"
    page = (tmp_path / "a" / "index.html").read_text()
    assert "mcaprl replay x.mcap --episode " in page
    worst = min(random.results[0], key=lambda episode: episode.total_reward)
    assert f"reset(seed={worst.seed})" in page, "random was not recorded"
    assert f"return {worst.total_reward:.4g}, {worst.length} steps, terminated" in page
    lane = gym.make("mcaprl/LaneKeeping-v0")
    driven = evaluate(lane, [None], name="random", episodes=2, seed=0)
    world = [Shape("line", "line", (1, 1, 1, 1), points=np.zeros((2, 3)))]
    evaluation_page(tmp_path / "b", "lane", [driven], [], world, None, None)
    assert (tmp_path / "b" / "trajectories.png").stat().st_size > 5000


def test_policies_fit_environments_with_other_bounds() -> None:
    """A policy is refused if shapes or dtypes differ, but not if only bounds differ."""
    env = gym.make("CartPole-v1")
    unbounded = spaces.Box(-np.inf, np.inf, (4,), np.float32)
    trained = BasePolicy()
    trained.observation_space, trained.action_space = unbounded, env.action_space
    check_fit(trained, env)
    for other in (spaces.Box(-1, 1, (3,), np.float32), spaces.Box(-1, 1, (4,), np.float64)):
        trained.observation_space = other
        with pytest.raises(PolicyError, match="was trained on observation_space"):
            check_fit(trained, env)


class Alternating(BasePolicy):
    """Policy whose commands are 1, -1, 1, ... newton meters."""

    name = "alternating"

    def begin(self) -> None:
        self.step = 0

    def act(self, observations: Any) -> NDArray[Any]:
        self.step += 1
        return np.full((len(observations), 1), 1 if self.step % 2 else -1, np.float32)


@pytest.mark.parametrize("batched", [False, True])
def test_the_change_of_the_command_is_in_its_units(batched: bool) -> None:
    env = gym.make("Pendulum-v1", max_episode_steps=5)
    envs = None
    if batched:
        envs = gym.make_vec("Pendulum-v1", 3, vectorization_mode="sync", max_episode_steps=5)
    policy = Alternating()
    policy.begin()
    score = evaluate(env, [policy], name="alternating", episodes=3, seed=0, envs=envs)
    assert score.command_change == pytest.approx(2.0)
    assert score.to_json()["command_change"] == pytest.approx(2.0)


def test_numbered_actions_have_no_change(env: gym.Env[Any, Any]) -> None:
    score = evaluate(env, [AlwaysLeft()], name="left", episodes=2, seed=0)
    assert score.command_change is None

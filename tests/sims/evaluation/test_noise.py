"""Tests of noise on continuous actions: its distribution, density, seeds and refusals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import kstest, truncnorm

import mcaprl
from mcaprl.base_policy import BasePolicy, RandomPolicy
from mcaprl.errors import UsageError
from mcaprl.sims import EpsilonGreedy, NoisyPolicy, episode_seed, make_sim
from mcaprl.sims.evaluation.evaluate import make_pilot
from mcaprl.sims.evaluation.rollout import log_density

NODES, WEIGHTS = np.polynomial.legendre.leggauss(60)
SEEN = np.zeros((1, 3), np.float32)


class Constant(BasePolicy):
    """Policy with one command."""

    name = "constant"

    def __init__(self, *command: float) -> None:
        self.command = np.array(command, np.float32)

    def act(self, observations: Any) -> NDArray[np.float32]:
        return np.tile(self.command, (len(observations), 1))


def noisy(*command: float, noise: float = 0.3, high: float = 1.0, **options: Any) -> NoisyPolicy:
    """Return a started policy with noise around one command in the Box from -1 to `high`."""
    space = spaces.Box(-1.0, high, (len(command),), np.float32)
    policy = NoisyPolicy(Constant(*command), noise, space, **options)
    policy.seed(5)
    policy.begin()
    return policy


def integral(density: Any, size: int, high: float = 1.0) -> float:
    """Integrate a density of actions (N, size) over the Box from -1 to `high` by quadrature."""
    cells = np.linspace(-1.0, high, 21)
    half = (cells[1] - cells[0]) / 2
    points = (cells[:-1, None] + half + half * NODES).ravel()
    weights = np.tile(half * WEIGHTS, 20)
    grids = np.meshgrid(*[points] * size, indexing="ij")
    actions = np.stack([grid.ravel() for grid in grids], 1)
    products = np.multiply.outer(weights, weights).ravel() if size == 2 else weights
    return float(products @ density(actions))


@pytest.mark.parametrize("noise", [0.02, 0.3, 1.0])
@pytest.mark.parametrize("command", [(0.2,), (1.0,), (-1.0,), (0.999,), (1.0, -1.0), (0.3, 0.9)])
def test_the_density_integrates_to_one(command: tuple[float, ...], noise: float) -> None:
    """Commands at the bounds included."""
    policy = noisy(*command, noise=noise)

    def density(actions: Any) -> Any:
        return np.exp(policy.log_prob(np.zeros((len(actions), 1)), actions))

    assert integral(density, len(command)) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("command", [(0.2,), (1.0,), (1.0, -0.5)])
def test_the_mixture_with_random_actions_integrates_to_one(command: tuple[float, ...]) -> None:
    policy = noisy(*command, noise=0.1, high=3.0)
    assert policy.action_space is not None
    uniform = RandomPolicy(policy.action_space)

    def density(actions: Any) -> Any:
        rows = np.zeros((len(actions), 1))
        parts = [policy.log_prob(rows, actions), uniform.log_prob(rows, actions)]
        return 0.75 * np.exp(parts[0]) + 0.25 * np.exp(parts[1])

    assert integral(density, len(command), 3.0) == pytest.approx(1.0, abs=1e-6)
    behavior = EpsilonGreedy(policy, 0.25, policy.action_space)
    behavior.begin(3)
    for _ in range(20):
        action, found = behavior.choose(SEEN[0])
        assert found == pytest.approx(math.log(density(action[None])[0]), abs=1e-12)


def test_densities_by_hand() -> None:
    """Half of the normal distribution is left at a bound; far from the bounds, all of it."""
    peak = 1 / (0.1 * math.sqrt(2 * math.pi))
    at = np.array([[0.0], [1.0], [0.9], [1.0]])
    means = np.array([[0.0], [1.0], [1.0], [0.0]])
    found = log_density(at, means, np.array([0.1]), np.array([-1.0]), np.array([1.0]))
    expected = [peak, 2 * peak, 2 * peak * math.exp(-0.5), peak * math.exp(-50.0)]
    np.testing.assert_allclose(found[:, 0], np.log(expected), rtol=1e-12)
    outside = log_density(at + 1.5, means, np.array([0.1]), np.array([-1.0]), np.array([1.0]))
    assert (outside == -np.inf).all()


@settings(max_examples=50)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.01, 1))
def test_densities_are_those_of_scipy(mean: float, action: float, sigma: float) -> None:
    theirs = truncnorm((-1 - mean) / sigma, (1 - mean) / sigma, mean, sigma)
    ours = log_density(*(np.array([x]) for x in (action, mean, sigma, -1.0, 1.0)))
    np.testing.assert_allclose(ours, theirs.logpdf(action), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("command", [0.2, 1.0, -0.95])
def test_actions_have_the_truncated_distribution_and_no_atoms(command: float) -> None:
    policy = noisy(command, noise=0.3)
    actions = policy.act(np.zeros((4_000, 1)))[:, 0]
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1.0
    theirs = truncnorm((-1 - command) / 0.3, (1 - command) / 0.3, command, 0.3)
    assert kstest(actions.astype(float), theirs.cdf).pvalue > 0.01
    # Clipped noise would have many actions at the bound.
    assert len(np.unique(actions)) > 3_990


def test_the_deviation_is_a_fraction_of_half_the_range() -> None:
    policy = noisy(1.0, 3.0, noise=0.1, high=5.0)
    actions = policy.act(np.zeros((4_000, 1)))
    assert actions.std(0) == pytest.approx([0.3, 0.3], rel=0.05)
    assert actions.mean(0) == pytest.approx([1.0, 3.0], abs=0.02)


def test_each_episode_has_its_own_deviation_and_density() -> None:
    policy = noisy(0.0, noise=0.2, per_episode=True)
    deviations = []
    for seed in range(200):
        policy.seed(seed)
        policy.begin()
        peak = float(policy.log_prob(SEEN, np.zeros((1, 1)))[0])
        deviations.append(1 / (math.sqrt(2 * math.pi) * math.exp(peak)))
        actions = policy.act(np.zeros((400, 1)))
        assert actions.std() == pytest.approx(deviations[-1], rel=0.2)
    assert kstest(deviations, "uniform", (0.0, 0.2)).pvalue > 0.01


def test_an_episode_depends_only_on_its_seed() -> None:
    first, again = (noisy(0.5, noise=0.2, per_episode=True) for _ in range(2))
    first.act(SEEN)
    actions = []
    for policy in (first, again):
        policy.seed(9)
        policy.begin()
        actions.append([policy.act(SEEN).tobytes() for _ in range(5)])
    assert actions[0] == actions[1]


def test_the_policy_acts_once_for_an_action_and_its_density() -> None:
    """A policy that stores frames would store them twice otherwise."""

    class Counting(Constant):
        count = 0

        def act(self, observations: Any) -> NDArray[np.float32]:
            self.count += 1
            return super().act(observations)

    policy = Counting(0.5)
    space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    behavior = EpsilonGreedy(NoisyPolicy(policy, 0.1, space), 0.0, space)
    for _ in range(3):
        behavior.choose(SEEN[0])
    assert policy.count == 3


@pytest.mark.parametrize(
    ("policy", "space", "words"),
    [
        (Constant(0.0), spaces.Discrete(3), "needs a Box of floats, not Discrete.3."),
        (Constant(0.0), spaces.Box(0, 9, (1,), np.int64), "needs a Box of floats, not Box.*int64"),
        (Constant(0.0), spaces.Box(-np.inf, np.inf, (1,)), "needs finite bounds, not Box"),
        (RandomPolicy(spaces.Box(-1, 1, (1,))), spaces.Box(-1, 1, (1,)), "not of random"),
        (noisy(0.0), spaces.Box(-1, 1, (1,)), "of a deterministic policy, not of constant, noise"),
    ],
)
def test_what_has_no_density_is_refused(policy: Any, space: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        NoisyPolicy(policy, 0.1, space)


@pytest.mark.parametrize("options", [{}, {"noise_per_episode": True}, {"epsilon": 0.2}])
def test_a_log_has_the_density_of_each_action(tmp_path: Path, options: dict[str, Any]) -> None:
    """The density is computed again from the commands that the pilot gives in the same states."""
    out = tmp_path / "a.mcap"
    mcaprl.record("lane", out, actions="continuous", noise=0.05, steps=450, seed=4, **options)
    log = mcaprl.open(out)
    sim = make_sim("lane", actions="continuous")
    pilot, zero = make_pilot(sim), np.zeros((1, 12), np.float32)
    policy = NoisyPolicy(pilot, 0.05, sim.action_space, per_episode="noise_per_episode" in options)
    for number, episode in enumerate(log.episodes):
        seed = episode_seed(4, number)
        assert episode.seed == seed
        sim.reset(seed=seed)
        policy.seed(seed)
        policy.begin()
        for action, stored in zip(episode.actions, episode.behavior_log_probs, strict=True):
            density = math.exp(policy.log_prob(zero.copy(), action[None])[0])
            epsilon = options.get("epsilon", 0.0)
            mixed = (1 - epsilon) * density + epsilon / 4
            assert stored == pytest.approx(math.log(mixed), abs=1e-5)
            sim.step(action)
    name = "pilot, noise 0 to 0.05" if "noise_per_episode" in options else "pilot, noise 0.05"
    assert {episode.policy for episode in log.episodes} == {name}


def test_random_actions_have_the_density_of_the_box(tmp_path: Path) -> None:
    mcaprl.record("racer", tmp_path / "a.mcap", actions="continuous", policy="random", steps=9)
    log = mcaprl.open(tmp_path / "a.mcap")
    np.testing.assert_allclose(log.behavior_log_probs, -2 * math.log(2), rtol=1e-6)


def test_without_noise_the_density_is_unknown(tmp_path: Path) -> None:
    mcaprl.record("racer", tmp_path / "a.mcap", actions="continuous", steps=9)
    assert np.isnan(mcaprl.open(tmp_path / "a.mcap").behavior_log_probs).all()


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"noise": 0.1}, "needs a Box of floats, not Discrete"),
        ({"noise": 1.5, "actions": "continuous"}, "noise"),
        ({"noise_per_episode": True, "actions": "continuous"}, "needs a largest deviation"),
        ({"noise": 0.1, "actions": "continuous", "policy": "random"}, "not of random"),
        ({"actions": "continuous", "sim_options": {"actions": "discrete"}}, "actions is given twi"),
    ],
)
def test_a_bad_request_is_refused(tmp_path: Path, request_: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        mcaprl.record("lane", tmp_path / "a.mcap", episodes=1, **request_)
    assert not (tmp_path / "a.mcap").exists()


def test_noise_scales_with_the_bounds_of_any_environment(tmp_path: Path) -> None:
    env = gym.make("Pendulum-v1")
    mcaprl.record(env, tmp_path / "a.mcap", policy=Torque(), noise=0.1, steps=400)
    log = mcaprl.open(tmp_path / "a.mcap")
    assert log.actions.std() == pytest.approx(0.2, rel=0.15)
    assert np.isfinite(log.behavior_log_probs).all()


class Torque(Constant):
    """Policy of Pendulum without torque."""

    is_deterministic = True

    def __init__(self) -> None:
        super().__init__(0.0)

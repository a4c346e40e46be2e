"""Tests of the algorithms for Box actions, by hand and on a regulator with a known optimum."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

import mcaprl
from benchmarks.studies.pendulum_data import pendulum, returns_of
from mcaprl.api import load_policies
from mcaprl.errors import SpaceError, UsageError
from mcaprl.offline.algorithms.bc import BoxBC
from mcaprl.offline.algorithms.config import (
    ActorCriticConfig,
    BoxBCConfig,
    BoxIQLConfig,
    CQLConfig,
    ReBRACConfig,
    TD3BCConfig,
    TrainingConfig,
)
from mcaprl.offline.algorithms.iql import LOG_STD, BoxIQL
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.registry import ALGORITHMS, BOX_ALGORITHMS, choose_algorithm
from mcaprl.offline.algorithms.td3 import TD3BC, ReBRAC
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer
from mcaprl.offline.policy import Policy, read_policy, save_policy
from mcaprl.offline.training.train import best_episodes, train, with_more_data
from tests.support.offline_tasks import BOX_LQ, GAMMA, corridor, regulator, riccati

FAST: dict[str, Any] = {
    "updates": 1_500,
    "batch_size": 128,
    "learning_rate": 3e-3,
    "hidden": (32, 32),
    "held_out": 0.0,
}
FAST_Q: dict[str, Any] = {**FAST, "gamma": GAMMA}
TINY: dict[str, Any] = {"updates": 4, "batch_size": 8, "hidden": (8,)}
CONFIGS: list[TrainingConfig] = [
    BoxBCConfig(**TINY),
    BoxBCConfig(**TINY, head="gaussian"),
    BoxBCConfig(**TINY, head="mixture"),
    TD3BCConfig(**TINY),
    ReBRACConfig(**TINY),
    BoxIQLConfig(**TINY),
    BoxIQLConfig(**TINY, n_steps=3, frame_stack=2),
]
STATES = np.linspace(-0.8, 0.8, 9, dtype=np.float32)[:, None]


def learner_of(config: TrainingConfig, dataset: Any, *seeds: int) -> Any:
    torch.set_num_threads(1)
    buffer = TransitionBuffer.from_dataset(dataset, config.packing)
    return choose_algorithm(config).learner_type(config, buffer, seeds or (0,))


def policy_of(learner: Learner, folder: Path, seed: int = 0) -> Policy:
    save_policy(folder, learner, seed, "", {})
    return read_policy(folder)


def gain(policy: Policy) -> float:
    """Return K of the best linear fit u = -K x to the actions of a policy."""
    actions = policy.act(STATES)
    return -float((STATES * actions).sum() / np.square(STATES).sum())


@pytest.mark.parametrize(
    ("config", "noise"),
    [
        (BoxBCConfig(**FAST), 0.3),
        (BoxBCConfig(**FAST, head="gaussian"), 0.3),
        (BoxBCConfig(**FAST, head="mixture"), 0.3),
        (TD3BCConfig(**FAST_Q, alpha=20.0, policy_noise=0.05), None),
        (ReBRACConfig(**FAST_Q, actor_weight=0.01, critic_weight=0.0, policy_noise=0.05), None),
        (BoxIQLConfig(**FAST_Q, expectile=0.9, beta=20.0), None),
    ],
)
def test_the_regulator_is_near_its_optimum(
    config: TrainingConfig, noise: float | None, tmp_path: Path
) -> None:
    learner = learner_of(config, regulator(noise=noise))
    while learner.step < config.updates:
        learner.update()
    policy = policy_of(learner, tmp_path)
    p, k = riccati()
    assert gain(policy) == pytest.approx(k, rel=0.15)
    if isinstance(config, ActorCriticConfig):
        # V of IQL is below the best value of random actions, and so all its values have an offset.
        errors = policy.action_values(STATES, (-k * STATES).clip(-4, 4)) + p * STATES[:, 0] ** 2
        assert np.ptp(errors) < 0.2
        assert isinstance(config, BoxIQLConfig) or abs(errors.mean()) < 0.4


def test_the_regulators_optimum_by_hand() -> None:
    # One step of value iteration from the fixed point: -P x^2 = max_u r + gamma V(x').
    p, k = riccati()
    u = np.linspace(-3, 3, 60_001)
    returns = -(1 + 0.05 * u**2) - GAMMA * p * (0.9 + 0.25 * u) ** 2
    assert returns.max() == pytest.approx(-p, abs=1e-6)
    assert u[returns.argmax()] == pytest.approx(-k, abs=1e-3)


def batch_of(learner: Learner) -> Batch:
    return learner.buffer.batch(torch.arange(8))


def q_of(learner: Learner, model: str, batch: Batch, actions: Tensor) -> Tensor:
    """Return the values (2, 8) of the two critics, one network after the other."""
    networks = (
        learner.target_networks["q"].model.networks
        if model == "target"
        else learner.models["q"].networks
    )
    inputs = batch.observations.with_actions(actions)
    return torch.stack([network(inputs).squeeze(1) for network in networks])


def next_q(learner: Learner, batch: Batch, actions: Tensor) -> Tensor:
    inputs = batch.next_observations.with_actions(actions)
    networks = learner.target_networks["q"].model.networks
    return torch.stack([network(inputs).squeeze(1) for network in networks])


def test_losses_of_td3_bc_by_hand() -> None:
    learner: TD3BC = learner_of(TD3BCConfig(**TINY, policy_interval=1, alpha=2.0), regulator(8))
    batch, noise = batch_of(learner), torch.full((8, 1), 0.9)
    with torch.no_grad():
        actor = learner.target_networks["actor"].model.networks[0]
        # The noise is clipped to 0.5, and actions to 1.
        actions = (actor(batch.next_observations).tanh() + 0.5).clamp(-1, 1)
        target = batch.rewards + 0.97 * next_q(learner, batch, actions).amin(0)
        torch.testing.assert_close(learner.targets(batch, noise), target)
        pi = learner.models["actor"].networks[0](batch.observations).tanh()
        q = q_of(learner, "q", batch, pi)[0]
        cloning = (pi - batch.actions).square().mean(1)
        expected = cloning - 2.0 * q / q.abs().mean()
        torch.testing.assert_close(learner.policy_losses(batch)["policy_loss"], expected)


def test_losses_of_rebrac_by_hand() -> None:
    config = ReBRACConfig(**TINY, actor_weight=0.5, critic_weight=0.25)
    dataset = regulator(8)
    dataset = type(dataset).from_arrays(
        observations=dataset.observations,
        actions=dataset.actions,
        rewards=dataset.rewards,
        terminated=np.zeros(8, bool),
        truncated=np.arange(8) % 4 == 3,
        next_observations=np.roll(dataset.observations, -1, 0),
        action_space=BOX_LQ,
    )
    learner: ReBRAC = learner_of(config, dataset)
    batch, noise = batch_of(learner), torch.zeros(8, 1)
    assert any(isinstance(m, torch.nn.LayerNorm) for m in learner.network("q", 0).modules())
    assert not any(isinstance(m, torch.nn.LayerNorm) for m in learner.network("actor", 0).modules())
    with torch.no_grad():
        actor = learner.target_networks["actor"].model.networks[0]
        actions = actor(batch.next_observations).tanh()
        penalty = torch.zeros(8)
        for row in (0, 1, 2, 4, 5, 6):  # The others are the last ones of an episode.
            penalty[row] = 0.25 * (actions[row] - batch.actions[row + 1]).square().sum()
        target = batch.rewards + 0.97 * (next_q(learner, batch, actions).amin(0) - penalty)
        torch.testing.assert_close(learner.targets(batch, noise), target)
        pi = learner.models["actor"].networks[0](batch.observations).tanh()
        q = q_of(learner, "q", batch, pi).amin(0)
        expected = 0.5 * (pi - batch.actions).square().sum(1) - q / q.abs().mean()
        torch.testing.assert_close(learner.policy_losses(batch)["policy_loss"], expected)


def test_losses_of_iql_by_hand() -> None:
    config = BoxIQLConfig(**TINY, expectile=0.8, beta=2.0, normalize_advantages=False)
    learner: BoxIQL = learner_of(config, regulator(8))
    batch = batch_of(learner)
    with torch.no_grad():
        learner.scalars[LOG_STD].fill_(0.0)
        q = q_of(learner, "target", batch, batch.actions).amin(0)
        v = learner.models["v"].networks[0](batch.observations).squeeze(1)
        v_t = learner.models["v"].networks[0](batch.next_observations).squeeze(1)
        error = q - v
        value_loss = torch.where(error > 0, 0.8, 0.2) * error.square()
        target = batch.rewards + 0.97 * v_t
        td_loss = (q_of(learner, "q", batch, batch.actions) - target).square().sum(0)
        mean = learner.models["actor"].networks[0](batch.observations).tanh()
        std = torch.tensor(-2.0).exp()
        normal: Any = torch.distributions.Normal(mean, std)
        inside = normal.cdf(torch.ones(1)) - normal.cdf(-torch.ones(1))
        log_density = normal.log_prob(batch.actions) - inside.log()
        weight = (2.0 * error).exp().clamp(max=100)
        terms = learner.losses(batch)
        torch.testing.assert_close(terms["value_loss"], value_loss)
        torch.testing.assert_close(terms["td_loss"], td_loss)
        torch.testing.assert_close(terms["policy_loss"], -weight * log_density.squeeze(1))


def test_the_deterministic_clone_has_the_mean_squared_error() -> None:
    learner: BoxBC = learner_of(BoxBCConfig(**TINY), regulator(8))
    batch = batch_of(learner)
    error = learner.models["actor"].networks[0](batch.observations).tanh() - batch.actions
    torch.testing.assert_close(learner.losses(batch)["loss"], error.square().mean(1))


def test_the_actor_is_updated_less_often_than_the_critics() -> None:
    learner = learner_of(TD3BCConfig(**{**TINY, "updates": 10}, policy_interval=3), regulator(64))
    changed = []
    for _ in range(7):
        before = [learner.models[name].weights.detach().clone() for name in ("actor", "q")]
        learner.update()
        after = [learner.models[name].weights for name in ("actor", "q")]
        changed.append(tuple(not torch.equal(x, y) for x, y in zip(before, after, strict=True)))
    assert changed == [(False, True), (False, True), (True, True)] * 2 + [(False, True)]


def test_target_networks_are_averages() -> None:
    config = TD3BCConfig(**TINY, target_interval=2, polyak=0.25)
    learner = learner_of(config, regulator(64))
    before = learner.target_networks["q"].model.weights.detach().clone()
    learner.update()
    assert torch.equal(learner.target_networks["q"].model.weights, before)
    learner.update()
    expected = 0.75 * before + 0.25 * learner.models["q"].weights
    torch.testing.assert_close(learner.target_networks["q"].model.weights, expected)


@pytest.mark.parametrize("config", CONFIGS)
def test_a_resumed_run_has_the_same_bits(config: TrainingConfig, tmp_path: Path) -> None:
    # The interruption is between two updates of the actor.
    config = replace(config, updates=9, checkpoint_interval=3, log_interval=2)
    if isinstance(config, ActorCriticConfig):
        config = replace(config, gamma=0.5, polyak=0.5)
    data = regulator(64)
    runs = [tmp_path / name for name in ("whole", "resumed", "alone")]
    train(data, config, runs[0], seeds=2, progress=lambda _: None)

    class Stopped(Exception):
        pass

    def stop(now: Any) -> None:
        if now.done == 3 and now.seed == 1:
            raise Stopped

    with pytest.raises(Stopped):
        train(data, config, runs[1], seeds=2, progress=stop)
    train(data, config, runs[1], seeds=2, resume=True, progress=lambda _: None)
    train(data, config, runs[2], seeds=1, seed=1, progress=lambda _: None)
    for name in ("checkpoint.safetensors", "metrics.csv", "policy.safetensors"):
        for seed in (0, 1):
            file = f"seed-{seed}/{name}"
            assert (runs[0] / file).read_bytes() == (runs[1] / file).read_bytes(), file
    file = "seed-1/metrics.csv"
    assert (runs[0] / file).read_bytes() == (runs[2] / file).read_bytes()


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("batch_size", [16, 33])
def test_a_seeds_weights_do_not_depend_on_other_seeds(
    config: TrainingConfig, batch_size: int
) -> None:
    config = replace(config, batch_size=batch_size, hidden=(8, 8))
    alone, together = (learner_of(config, regulator(64), *seeds) for seeds in ([3], [4, 3, 7]))
    for _ in range(12):
        alone.update()
        together.update()
    for name, tensor in alone.state(3).items():
        assert torch.equal(tensor, together.state(3)[name]), name


@pytest.mark.parametrize("config", CONFIGS)
def test_a_policy_acts_in_the_units_of_the_space(config: TrainingConfig, tmp_path: Path) -> None:
    learner = learner_of(config, regulator(64), 3, 4)
    policy = policy_of(learner, tmp_path, 4)
    states = STATES if config.frame_stack == 1 else np.stack([STATES, STATES + 0.1], 1)
    observations = learner.buffer.encoder.encode(states.reshape(-1, 1)).stacked(config.frame_stack)
    head = policy.head
    outputs = learner.network("actor", 4)(observations)
    scaled = type(head).best(outputs).detach().numpy()  # type: ignore[attr-defined]
    actions = policy.act(states)
    np.testing.assert_allclose(actions, 4 * scaled, rtol=1e-5)
    assert actions.dtype == np.float32
    assert all(BOX_LQ.contains(action) for action in actions)
    assert policy.scores(states) is None


@pytest.mark.parametrize("config", CONFIGS)
def test_more_data_keep_the_scales(config: TrainingConfig) -> None:
    first, more = regulator(64, noise=0.1), regulator(96)
    unbounded = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    small, large = (
        type(each).from_arrays(
            observations=each.observations,
            actions=each.actions,
            rewards=each.rewards,
            terminated=each.terminated,
            truncated=each.truncated,
            next_observations=each.next_observations,
            action_space=unbounded,
        )
        for each in (first, more)
    )
    with pytest.warns(UserWarning, match="infinite bounds"):
        learner = learner_of(config, small)
    grown = with_more_data(learner, large, np.array([], np.int64))
    assert grown.buffer.box is learner.buffer.box
    assert grown.buffer.actions.abs().max() == 1
    grown.update()


def test_top_learns_from_the_episodes_with_the_largest_returns() -> None:
    data = regulator(40)
    best = np.argsort(data.rewards)[-4:]
    assert sorted(np.flatnonzero(best_episodes(data, 0.1))) == sorted(best)
    assert best_episodes(data, 0.001).sum() == 1
    assert best_episodes(data, 1.0).all()


def test_an_algorithm_that_does_not_fit_names_those_that_do(tmp_path: Path) -> None:
    with pytest.raises(SpaceError) as error:
        train(regulator(8), CQLConfig(), tmp_path / "run")
    assert str(error.value) == "cql needs discrete actions; for Box(1,) use iql or rebrac"
    with pytest.raises(SpaceError) as error:
        train(corridor(), "td3-bc", tmp_path / "run")
    assert str(error.value).startswith("td3-bc needs the actions of a Box; for Discrete(2")
    assert str(error.value).endswith("use cql or iql")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["bc", "iql"])
def test_a_name_selects_the_algorithm_of_the_space(name: str) -> None:
    assert choose_algorithm(name, space=BOX_LQ).learner_type is BOX_ALGORITHMS[name]
    assert choose_algorithm(name, space=spaces.Discrete(2)).learner_type is ALGORITHMS[name]


@pytest.mark.parametrize(
    ("config", "settings"),
    [
        (BoxBCConfig, {"head": "flow"}),
        (BoxBCConfig, {"top": 0.0}),
        (TD3BCConfig, {"polyak": 0.0}),
        (TD3BCConfig, {"policy_interval": 0}),
        (TD3BCConfig, {"policy_noise": -0.1}),
        (TD3BCConfig, {"noise_clip": -1.0}),
        (TD3BCConfig, {"alpha": -1.0}),
        (ReBRACConfig, {"actor_weight": -1.0}),
        (ReBRACConfig, {"critic_weight": -1.0}),
        (BoxIQLConfig, {"expectile": 1.0}),
        (BoxIQLConfig, {"beta": -1.0}),
    ],
)
def test_settings_out_of_range_are_refused(config: Any, settings: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=next(iter(settings))):
        config(**settings)


def test_the_horizon_counts_averages() -> None:
    # 1,000 updates, of which every second moves the target networks by 2 %: ten syncs.
    config = TD3BCConfig(updates=1_000, target_interval=2, polyak=0.02, gamma=0.9)
    assert config.horizon_fraction == pytest.approx(1 - 0.9**10)


@pytest.mark.long
def test_the_order_of_the_algorithms_on_a_mixed_log_of_pendulum(tmp_path: Path) -> None:
    """Cloning imitates a mixture; what evaluates actions is better than the log, -506."""
    data, means = pendulum("mixed"), {}
    for algo in ("bc", "td3-bc", "iql"):
        mcaprl.train(data, tmp_path / algo, algo=algo, seeds=2, updates=4_000)
        means[algo] = np.mean([returns_of(policy) for policy in load_policies(tmp_path / algo)])
    # Measured: -400, -270, -155.
    assert means["bc"] + 60 < means["td3-bc"]
    assert means["td3-bc"] + 60 < means["iql"]

"""Tests of each algorithm on small tasks that value iteration solves exactly."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.offline.algorithms.bcq import BCQ
from mcaprl.offline.algorithms.config import (
    BCConfig,
    BCQConfig,
    BootstrapConfig,
    CQLConfig,
    DoubleDQNConfig,
    DQNConfig,
    IQLConfig,
    TrainingConfig,
)
from mcaprl.offline.algorithms.dqn import DQN, DoubleDQN
from mcaprl.offline.algorithms.heads import build_head
from mcaprl.offline.algorithms.iql import IQL, normalized
from mcaprl.offline.algorithms.learner import Learner, NotFiniteError
from mcaprl.offline.algorithms.registry import ALGORITHMS
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.batches.observations import Observations
from mcaprl.offline.training.train import train
from mcaprl.recorder.dataset.dataset import Dataset
from tests.support.offline_tasks import (
    ACTION_SPACE,
    GAMMA,
    corridor,
    inner_observations,
    optimal_values,
)

SMALL: dict[str, Any] = {"updates": 600, "batch_size": 64, "learning_rate": 5e-3, "hidden": (32,)}
SMALL_Q: dict[str, Any] = {**SMALL, "gamma": GAMMA, "target_interval": 20}
ALL = list(ALGORITHMS.values())


def learner_of(config: TrainingConfig, dataset: Dataset, *seeds: int) -> Learner:
    learner_type = next(each for each in ALL if type(config) is each.config_type)
    return learner_type(
        config, TransitionBuffer.from_dataset(dataset, config.packing), seeds or (0,)
    )


def trained(learner: Learner) -> Learner:
    torch.set_num_threads(1)
    while learner.step < learner.config.updates:
        learner.update()
    return learner


def outputs(learner: Learner, observations: NDArray[np.float32], name: str = "q") -> Tensor:
    """Return the first seed's outputs (B, A); values are in units of the logged rewards."""
    network = learner.network(name, learner.seeds[0])
    with torch.no_grad():
        found = network(Observations(torch.from_numpy(observations)))
    values: Tensor = found.mean(2) if found.ndim == 3 else found
    return values if name == "logits" else learner.in_reward_units(values)


def best(learner: Learner, observations: NDArray[np.float32], seed: int | None = None) -> list[int]:
    """Return the action of a seed's policy for each observation; default: the first seed."""
    seed = learner.seeds[0] if seed is None else seed
    networks = {name: learner.network(name, seed) for name in learner.policy_models}
    threshold = getattr(learner.config, "threshold", 0.0)
    head = build_head(learner.acts_by, networks, learner.buffer.action_space, threshold)
    scores = cast(Tensor, head.scores(Observations(torch.from_numpy(observations))))
    found: list[int] = scores.argmax(1).tolist()
    return found


def lone_state(*, terminated: bool, gamma: float, reward: float = 1.0, **settings: Any) -> float:
    """Return the Q that DQN learns for a state that leads to itself with `reward`."""
    observation = np.ones((8, 1), np.float32)
    dataset = Dataset.from_arrays(
        observations=observation,
        actions=np.zeros(8, np.int64),
        rewards=np.full(8, reward),
        terminated=np.full(8, terminated),
        truncated=np.full(8, not terminated),
        next_observations=observation,
    )
    config = DQNConfig(**{**SMALL_Q, "gamma": gamma, **settings})
    return float(outputs(trained(learner_of(config, dataset)), observation[:1])[0, 0])


@pytest.mark.parametrize(
    "config",
    [
        DQNConfig(**SMALL_Q),
        DQNConfig(**SMALL_Q, dueling=True),
        DQNConfig(**SMALL_Q, n_quantiles=5),
        DoubleDQNConfig(**SMALL_Q),
        DoubleDQNConfig(**SMALL_Q, n_quantiles=5),
        DoubleDQNConfig(**SMALL_Q, layer_norm=True, normalize=True),
        CQLConfig(**SMALL_Q, alpha=0.0),
        CQLConfig(**SMALL_Q, alpha=0.0, scale_rewards=True, dueling=True),
        DoubleDQNConfig(**SMALL_Q, n_quantiles=5, scale_rewards=True),
        BCQConfig(**SMALL_Q),
    ],
)
def test_values_equal_those_of_value_iteration(config: Any) -> None:
    learner = trained(learner_of(config, corridor(), 0, 1))
    encoder = learner.buffer.encoder
    for seed in learner.seeds:
        with torch.no_grad():
            found = learner.network("q", seed)(encoder.encode(inner_observations()))
        values = learner.in_reward_units(found.mean(2) if found.ndim == 3 else found)
        np.testing.assert_allclose(values, optimal_values(), atol=0.03)


def test_the_corridors_values_by_hand() -> None:
    # From the far exit backward, the values of going right are 1, .9 and .81. The near exit has the
    # reward .3.
    np.testing.assert_allclose(optimal_values(), [[0.3, 0.81], [0.729, 0.9], [0.81, 1.0]])


def test_termination_stops_the_bootstrap_and_truncation_does_not() -> None:
    assert lone_state(terminated=True, gamma=0.5) == pytest.approx(1.0, abs=0.01)
    assert lone_state(terminated=False, gamma=0.5) == pytest.approx(2.0, abs=0.01)


def test_with_gamma_zero_only_the_reward_counts() -> None:
    assert lone_state(terminated=False, gamma=0.0, reward=-3.0) == pytest.approx(-3.0, abs=0.01)


def test_quantiles_stop_at_termination() -> None:
    settings = {"gamma": 0.5, "n_quantiles": 4}
    assert lone_state(terminated=True, **settings) == pytest.approx(1.0, abs=0.01)
    assert lone_state(terminated=False, **settings) == pytest.approx(2.0, abs=0.02)


def test_n_step_returns_propagate_a_reward_over_the_corridor() -> None:
    # The data are one episode from cell 1 to the far exit. If the target network is synced only
    # once, 1-step targets do not propagate the reward to cell 1, but n-step returns do.
    walk = corridor_walk()
    config = DQNConfig(**{**SMALL_Q, "n_steps": 3, "target_interval": 600})
    values = outputs(trained(learner_of(config, walk)), inner_observations())[:, 1]
    torch.testing.assert_close(values, torch.tensor([0.81, 0.9, 1.0]), rtol=0, atol=0.02)


def corridor_walk() -> Dataset:
    cells = np.eye(5, dtype=np.float32)
    return Dataset.from_arrays(
        observations=cells[1:4],
        actions=np.full(3, ACTION_SPACE.start + 1),
        rewards=[0, 0, 1],
        terminated=[False, False, True],
        truncated=[False] * 3,
        next_observations=cells[2:5],
        action_space=ACTION_SPACE,
    )


@pytest.mark.parametrize("learner_type", [DQN, DoubleDQN, BCQ, IQL])
@pytest.mark.parametrize("seeds", [(0,), (0, 1, 2)])
def test_the_cached_target_equals_the_computed_one(
    learner_type: type[Learner], seeds: tuple[int, ...]
) -> None:
    # If the batches between two syncs have at least as many rows as the data, the targets are
    # cached in a table.
    learner = learner_of(learner_type.config_type(**SMALL_Q), corridor(), *seeds)
    for _ in range(25):
        learner.update()
    batch = learner.buffer.batch(
        learner.buffer.sample_rows(64 * len(seeds), torch.Generator().manual_seed(0))
    )
    if isinstance(learner, IQL):
        target, seen = learner.target_networks["q_twin"], batch.observations
    else:
        assert isinstance(learner, DQN)
        target, seen = learner.target_network, batch.next_observations
    with torch.no_grad():
        torch.testing.assert_close(target.outputs(batch), target.model(seen))


@pytest.mark.parametrize(
    "config",
    [
        DQNConfig(),
        DQNConfig(n_quantiles=3),
        DoubleDQNConfig(),
        CQLConfig(),
        BCQConfig(),
        IQLConfig(),
    ],
)
def test_held_out_errors_do_not_depend_on_the_age_of_the_target_network(config: Any) -> None:
    learner = learner_of(replace(config, target_interval=1_000, hidden=(16,)), corridor(), 0)
    for _ in range(20):
        learner.update()
    batch = learner.buffer.batch(torch.arange(50))
    with torch.no_grad():
        before = learner.validate(batch)["td_error"]
        loss = learner.losses(batch)["loss"]
        for name, target in learner.target_networks.items():
            target.sync(learner.models[name])
        torch.testing.assert_close(learner.validate(batch)["td_error"], before)
        assert not torch.allclose(learner.losses(batch)["loss"], loss)


def test_the_target_network_is_constant_between_two_syncs() -> None:
    learner = learner_of(DQNConfig(**{**SMALL_Q, "target_interval": 5}), corridor())
    assert isinstance(learner, DQN)
    batch = learner.buffer.sample(16, torch.Generator().manual_seed(0))
    seen = [learner.target_network.outputs(batch)]
    for _ in range(10):
        learner.update()
        seen.append(learner.target_network.outputs(batch))
    changes = [not torch.equal(before, after) for before, after in pairwise(seen)]
    assert changes == [False, False, False, False, True] * 2


ONLY_LEFT = {(cell, 0): 1 for cell in (1, 2, 3)}


@pytest.mark.parametrize(
    "config",
    [
        CQLConfig(**SMALL_Q),
        CQLConfig(**SMALL_Q, n_quantiles=5),
        BCQConfig(**SMALL_Q),
        IQLConfig(**SMALL_Q),
    ],
)
def test_actions_absent_from_the_data_are_not_taken(config: Any) -> None:
    # The log never goes right, so the outcome of that action is unknown.
    learner = trained(learner_of(config, corridor(ONLY_LEFT), 0, 1, 2))
    for seed in learner.seeds:
        assert best(learner, inner_observations(), seed) == [0, 0, 0]


def test_more_alpha_means_lower_values_of_unseen_actions() -> None:
    gaps = []
    for alpha in (0.0, 0.1, 1.0):
        learner = trained(learner_of(CQLConfig(**SMALL_Q, alpha=alpha), corridor(ONLY_LEFT)))
        values = outputs(learner, inner_observations())
        gaps.append(float((values[:, 0] - values[:, 1]).min()))
    assert gaps == sorted(gaps)
    assert gaps[2] > gaps[0] + 1


@pytest.mark.parametrize(
    "config",
    [
        CQLConfig(**SMALL_Q, alpha=0.01),
        BCQConfig(**SMALL_Q),
        # The log goes left twice as often as right. The weights of the better action, right, make
        # up for this.
        IQLConfig(**SMALL_Q, expectile=0.9, beta=1.0),
        IQLConfig(**SMALL_Q, expectile=0.9, beta=20.0, normalize_advantages=False),
    ],
)
def test_the_better_action_is_found_if_the_data_has_both(config: Any) -> None:
    # In one third of the steps, the log goes right. Cloning alone would go left, but right has the
    # larger reward.
    mostly_left = corridor({(cell, action): 2 - action for cell in (1, 2, 3) for action in (0, 1)})
    assert best(trained(learner_of(config, mostly_left)), inner_observations()) == [1, 1, 1]
    clone = trained(learner_of(BCConfig(**SMALL), mostly_left))
    assert best(clone, inner_observations()) == [0, 0, 0]


def test_iql_values_are_between_mean_and_maximum() -> None:
    values = []
    for expectile in (0.5, 0.7, 0.99):
        config = IQLConfig(**{**SMALL_Q, "updates": 900}, expectile=expectile)
        learner = trained(learner_of(config, corridor()))
        values.append(outputs(learner, inner_observations()[1:2], "v").item())
    # Both actions are logged equally often. The mean values v1, v2 and v3 of the three cells are
    # therefore those of a random walk: v1 = (.3 + .9 v2) / 2, v2 = .9 (v1 + v3) / 2 and
    # v3 = (.9 v2 + 1) / 2. The solution is v2 = .585 / .595 / 2 = .492. The value of the best
    # action in the middle cell is .9.
    assert values[0] == pytest.approx(0.45 * 1.3 / 2 / (1 - 0.45 * 0.9), abs=0.02)
    assert values[0] < values[1] < values[2]
    assert values[2] == pytest.approx(0.9, abs=0.05)


def test_iql_values_are_means_of_large_rewards() -> None:
    # One of ten steps has a reward of 10. Where errors above 1 have the gradient 1, nine errors of
    # q and a gradient of 1 are in balance at q = 1 / 9; the mean is 1.
    observations = np.ones((10, 1), np.float32)
    data = Dataset.from_arrays(
        observations=observations,
        actions=np.zeros(10, np.int64),
        rewards=np.eye(10)[0] * 10,
        terminated=np.ones(10, bool),
        truncated=np.zeros(10, bool),
        next_observations=observations,
    )
    config = IQLConfig(**{**SMALL_Q, "batch_size": 512})
    learner = trained(learner_of(config, data))
    assert outputs(learner, observations[:1]).item() == pytest.approx(1.0, abs=0.15)


def test_normalized_advantages_do_not_depend_on_the_unit_of_the_reward() -> None:
    learner = cast(IQL, learner_of(IQLConfig(**{**SMALL_Q, "updates": 1}), corridor(), 0, 1))
    assert learner.config.normalize_advantages
    advantages = torch.tensor([3.0, -4.0, 0.0, 0.0, 30.0, -40.0, 0.0, 0.0])
    # The advantages of the two seeds have the root mean squares 2.5 and 25.
    found = normalized(learner, advantages).tolist()
    assert found == pytest.approx([1.2, -1.6, 0, 0] * 2)
    assert normalized(learner, torch.zeros(8)).tolist() == [0] * 8


def test_bcq_with_threshold_one_imitates_and_with_zero_is_double_dqn() -> None:
    mostly_left = corridor({(cell, action): 2 - action for cell in (1, 2, 3) for action in (0, 1)})
    found = [
        best(
            trained(learner_of(BCQConfig(**SMALL_Q, threshold=threshold), mostly_left)),
            inner_observations(),
        )
        for threshold in (0.0, 1.0)
    ]
    assert found == [[1, 1, 1], [0, 0, 0]]


def test_bc_learns_how_often_each_action_was_taken() -> None:
    counts = {(1, 0): 3, (1, 1): 1, (2, 0): 1, (2, 1): 1, (3, 0): 1, (3, 1): 9}
    learner = trained(learner_of(BCConfig(**{**SMALL, "batch_size": 320}), corridor(counts)))
    right = outputs(learner, inner_observations(), "logits").softmax(dim=1)[:, 1]
    torch.testing.assert_close(right, torch.tensor([0.25, 0.5, 0.9]), rtol=0, atol=0.05)


def masked_corridor() -> Dataset:
    """Return the corridor, in which the middle cell does not allow the action right."""
    data = corridor(ONLY_LEFT | {(1, 1): 1, (3, 1): 1})
    blocked: dict[str, Any] = {
        name: {
            "action_mask": ~((getattr(data, name)[:, 2:3] == 1) & [[False, True]]),
            "cell": getattr(data, name),
        }
        for name in ("observations", "next_observations")
    }
    columns: dict[str, Any] = {
        name: getattr(data, name) for name in ("actions", "rewards", "terminated", "truncated")
    }
    space = spaces.Dict(
        {"action_mask": spaces.Box(0, 1, (2,), np.bool_), "cell": data.observation_space}
    )
    return Dataset.from_arrays(
        **columns, **blocked, observation_space=space, action_space=ACTION_SPACE
    )


@pytest.mark.parametrize("config", [DQNConfig(**SMALL_Q), DoubleDQNConfig(**SMALL_Q)])
def test_masked_actions_do_not_contribute(config: Any) -> None:
    values = outputs(trained(learner_of(config, masked_corridor())), inner_observations())
    # From cell 1, the near exit has the reward .3. The cell to the right only leads back.
    assert values[0].tolist() == pytest.approx([0.3, 0.9 * 0.9 * 0.3], abs=0.02)
    assert values[1, 0].item() == pytest.approx(0.9 * 0.3, abs=0.02)
    assert values[2].tolist() == pytest.approx([0.81 * 0.3, 1.0], abs=0.02)


@pytest.mark.parametrize("learner_type", ALL)
def test_a_seeds_weights_do_not_depend_on_other_seeds(
    learner_type: type[Learner],
) -> None:
    config = learner_type.config_type(**{**SMALL, "updates": 30})
    alone = trained(learner_of(config, corridor(), 3))
    again = trained(learner_of(config, corridor(), 3))
    together = trained(learner_of(config, corridor(), 4, 3, 7))
    for name, tensor in alone.state(3).items():
        assert torch.equal(tensor, again.state(3)[name])
        assert torch.equal(tensor, together.state(3)[name]), name
    assert not torch.equal(
        alone.state(3)["generator.sampler"], together.state(4)["generator.sampler"]
    )


@pytest.mark.parametrize("learner_type", ALL)
def test_a_restored_learner_continues_bit_for_bit(learner_type: type[Learner]) -> None:
    values: dict[str, Any] = (
        {"target_interval": 20} if issubclass(learner_type.config_type, BootstrapConfig) else {}
    )
    config = learner_type.config_type(**{**SMALL, "updates": 60}, weight_decay=0.1, **values)
    whole = learner_of(config, corridor(), 0, 1)
    for _ in range(25):
        whole.update()
    saved = [{name: t.clone() for name, t in whole.state(seed).items()} for seed in (0, 1)]
    trained(whole)
    # Seed 1 continues without the other seed.
    resumed = learner_of(config, corridor(), 1)
    resumed.load_state(1, saved[1], 25)
    after, expected = trained(resumed).state(1), whole.state(1)
    assert after.keys() == expected.keys()
    assert all(torch.equal(after[name], tensor) for name, tensor in expected.items())


def test_weight_decay_shrinks_the_weights() -> None:
    sizes = []
    for weight_decay in (0.0, 1.0):
        config = CQLConfig(**SMALL_Q, weight_decay=weight_decay)
        learner = trained(learner_of(config, corridor()))
        sizes.append(learner.models["q"].weights.square().sum().item())
    assert sizes[1] < 0.9 * sizes[0]


def test_a_loss_that_is_not_finite_is_reported_and_changes_no_weights() -> None:
    learner = learner_of(CQLConfig(**SMALL_Q), corridor(), 2, 5)
    learner.buffer.returns[0] = torch.inf
    before = learner.models["q"].weights.clone()
    with pytest.raises(NotFiniteError, match="td_loss of seed 2 is inf"):
        learner.update()
    assert torch.equal(learner.models["q"].weights, before)
    assert learner.step == 0


def test_image_observations_are_learned_from() -> None:
    # Action 1 is the right action for the brighter of two images.
    images: NDArray[np.uint8] = np.zeros((40, 36, 36), np.uint8)
    images[::2] = 200
    dataset = Dataset.from_arrays(
        observations=images,
        actions=np.arange(40) % 2,
        rewards=np.ones(40),
        terminated=np.ones(40, bool),
        truncated=np.zeros(40, bool),
        next_observations=images,
    )
    config = BCConfig(updates=30, batch_size=16, hidden=(16,))
    learner = trained(learner_of(config, dataset, 0, 1))
    seen = learner.buffer.encoder.encode(images[:2])
    for seed in (0, 1):
        assert learner.network("logits", seed)(seen).argmax(1).tolist() == [0, 1]


def test_a_missing_device_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="device"):
        train(corridor(), "bc", tmp_path / "run", device="tpu")
    if not torch.cuda.is_available():
        with pytest.raises(UsageError, match=r"device cuda: torch .* finds no CUDA device"):
            train(corridor(), "bc", tmp_path / "run", device="cuda")
    assert not (tmp_path / "run").exists()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")
@pytest.mark.parametrize("learner_type", ALL)
def test_updates_on_a_gpu_are_those_of_the_cpu(learner_type: type[Learner]) -> None:
    config = learner_type.config_type(updates=40, batch_size=16, hidden=(16, 16))
    buffer = TransitionBuffer.from_dataset(corridor(), config.packing)
    found, expected = (
        trained(learner_type(config, buffer.to(torch.device(device)), (0, 1)))
        for device in ("cuda", "cpu")
    )
    # The results are not bit-identical: sums have another order, and Adam divides by small numbers.
    for name, model in expected.all_models().items():
        weights = found.all_models()[name].weights.detach().cpu()
        torch.testing.assert_close(weights, model.weights.detach(), rtol=2e-3, atol=2e-3)

"""Each algorithm on tasks small enough to solve by value iteration."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mcaprl.offline.bc import BC, BCConfig
from mcaprl.offline.buffer import TransitionBuffer
from mcaprl.offline.cql import CQL, CQLConfig
from mcaprl.offline.dqn import DQN, DoubleDQN, DoubleDQNConfig, DQNConfig
from mcaprl.offline.learner import Learner, NotFiniteError
from mcaprl.recorder.dataset import Dataset
from tests.offline_tasks import GAMMA, corridor, inner_observations, optimal_values

SMALL: dict[str, Any] = {"updates": 600, "batch_size": 64, "learning_rate": 5e-3, "hidden": (32,)}
SMALL_Q: dict[str, Any] = {**SMALL, "gamma": GAMMA, "target_interval": 20}


def trained(learner: Learner) -> Learner:
    torch.set_num_threads(1)
    while learner.step < learner.config.updates:
        learner.update()
    return learner


def outputs(learner: Learner, observations: NDArray[np.float32]) -> NDArray[np.float32]:
    with torch.no_grad():
        values: NDArray[np.float32] = learner.network(torch.from_numpy(observations)).numpy()
    return values


def lone_state(*, terminated: bool, gamma: float, reward: float = 1.0) -> float:
    """Q of a state that pays `reward` and leads to itself, learned by DQN."""
    observation = np.ones((8, 1), np.float32)
    dataset = Dataset.from_arrays(
        observations=observation,
        actions=np.zeros(8, np.int64),
        rewards=np.full(8, reward),
        terminated=np.full(8, terminated),
        truncated=np.full(8, not terminated),
        next_observations=observation,
    )
    config = DQNConfig(**{**SMALL_Q, "gamma": gamma})
    learner = trained(DQN(config, TransitionBuffer.from_dataset(dataset), seed=0))
    return float(outputs(learner, observation[:1])[0, 0])


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("learner_type", "config"),
    [
        (DQN, DQNConfig(**SMALL_Q)),
        (DoubleDQN, DoubleDQNConfig(**SMALL_Q)),
        (CQL, CQLConfig(**SMALL_Q, alpha=0.0)),
    ],
)
def test_values_are_those_of_value_iteration(
    learner_type: type[Learner], config: Any, seed: int
) -> None:
    buffer = TransitionBuffer.from_dataset(corridor())
    learner = trained(learner_type(config, buffer, seed))
    np.testing.assert_allclose(outputs(learner, inner_observations()), optimal_values(), atol=0.02)


def test_the_truth_of_the_corridor() -> None:
    # Written out: right is worth 1, .9, .81 counted from the far exit; the near exit pays .3.
    np.testing.assert_allclose(optimal_values(), [[0.3, 0.81], [0.729, 0.9], [0.81, 1.0]])


def test_termination_stops_the_bootstrap_and_truncation_does_not() -> None:
    assert lone_state(terminated=True, gamma=0.5) == pytest.approx(1.0, abs=0.01)
    assert lone_state(terminated=False, gamma=0.5) == pytest.approx(2.0, abs=0.01)


def test_with_gamma_zero_only_the_reward_counts() -> None:
    assert lone_state(terminated=False, gamma=0.0, reward=-3.0) == pytest.approx(-3.0, abs=0.01)


@pytest.mark.parametrize("learner_type", [DQN, DoubleDQN])
def test_looking_up_the_target_is_the_same_as_computing_it(learner_type: type[Learner]) -> None:
    # With as many updates between copies as there are rows or more, a table of targets is kept.
    buffer = TransitionBuffer.from_dataset(corridor())
    learner = learner_type(learner_type.config_type(**SMALL_Q), buffer, 0)
    assert isinstance(learner, DQN)
    for _ in range(25):
        learner.update()
    batch = buffer.sample(64, torch.Generator().manual_seed(0))
    with torch.no_grad():
        computed = learner.target.network(batch.next_observations)
    torch.testing.assert_close(learner.target.values(batch), computed)


def test_the_target_stands_still_between_two_copies() -> None:
    buffer = TransitionBuffer.from_dataset(corridor())
    learner = DQN(DQNConfig(**{**SMALL_Q, "target_interval": 5}), buffer, 0)
    batch = buffer.sample(16, torch.Generator().manual_seed(0))
    seen = [learner.target.values(batch)]
    for _ in range(10):
        learner.update()
        seen.append(learner.target.values(batch))
    changes = [not torch.equal(before, after) for before, after in pairwise(seen)]
    assert changes == [False, False, False, False, True] * 2


def test_cql_keeps_to_the_actions_in_the_data() -> None:
    # Nobody ever went right: whatever lies there, the log cannot tell.
    only_left = corridor({(cell, 0): 1 for cell in (1, 2, 3)})
    buffer = TransitionBuffer.from_dataset(only_left)
    for seed in range(3):
        values = outputs(trained(CQL(CQLConfig(**SMALL_Q), buffer, seed)), inner_observations())
        assert (values.argmax(1) == 0).all()


def test_more_alpha_means_lower_values_of_unseen_actions() -> None:
    buffer = TransitionBuffer.from_dataset(corridor({(cell, 0): 1 for cell in (1, 2, 3)}))
    gaps = []
    for alpha in (0.0, 0.1, 1.0):
        learner = trained(CQL(CQLConfig(**SMALL_Q, alpha=alpha), buffer, seed=0))
        values = outputs(learner, inner_observations())
        gaps.append((values[:, 0] - values[:, 1]).min())
    assert gaps == sorted(gaps)
    assert gaps[2] > gaps[0] + 1


def test_cql_still_finds_what_pays_when_the_data_show_both() -> None:
    # One in three visits goes right; the penalty pulls towards left and the reward wins.
    mostly_left = corridor({(cell, action): 2 - action for cell in (1, 2, 3) for action in (0, 1)})
    buffer = TransitionBuffer.from_dataset(mostly_left)
    learner = trained(CQL(CQLConfig(**SMALL_Q, alpha=0.01), buffer, seed=0))
    assert (outputs(learner, inner_observations()).argmax(1) == 1).all()
    clone = trained(BC(BCConfig(**SMALL), buffer, seed=0))
    assert (outputs(clone, inner_observations()).argmax(1) == 0).all()


def test_bc_learns_how_often_each_action_was_taken() -> None:
    counts = {(1, 0): 3, (1, 1): 1, (2, 0): 1, (2, 1): 1, (3, 0): 1, (3, 1): 9}
    buffer = TransitionBuffer.from_dataset(corridor(counts))
    learner = trained(BC(BCConfig(**{**SMALL, "batch_size": 320}), buffer, seed=0))
    logits = torch.from_numpy(outputs(learner, inner_observations()))
    right = logits.softmax(dim=1)[:, 1]
    torch.testing.assert_close(right, torch.tensor([0.25, 0.5, 0.9]), rtol=0, atol=0.05)


@pytest.mark.parametrize("learner_type", [DQN, DoubleDQN, CQL, BC])
def test_the_same_seed_gives_the_same_weights(learner_type: type[Learner]) -> None:
    buffer = TransitionBuffer.from_dataset(corridor())
    config = learner_type.config_type(**{**SMALL, "updates": 30})
    weights = [
        torch.nn.utils.parameters_to_vector(
            trained(learner_type(config, buffer, seed)).network.parameters()
        )
        for seed in (3, 3, 4)
    ]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


@pytest.mark.parametrize("learner_type", [DQN, DoubleDQN, CQL, BC])
def test_a_restored_learner_goes_on_bit_for_bit(learner_type: type[Learner]) -> None:
    buffer = TransitionBuffer.from_dataset(corridor())
    config = learner_type.config_type(**{**SMALL, "updates": 60})
    whole = learner_type(config, buffer, 0)
    for _ in range(25):
        whole.update()
    saved = {name: tensor.clone() for name, tensor in whole.state().items()}
    trained(whole)
    resumed = learner_type(config, buffer, 1)
    resumed.load_state(saved, 25)
    after, expected = trained(resumed).state(), whole.state()
    assert after.keys() == expected.keys()
    assert all(torch.equal(after[name], tensor) for name, tensor in expected.items())


def test_a_loss_that_is_not_finite_is_named_and_leaves_the_weights_alone() -> None:
    buffer = TransitionBuffer.from_dataset(corridor())
    learner = CQL(CQLConfig(**SMALL_Q), buffer, 0)
    buffer.rewards[:] = torch.inf
    before = [parameter.clone() for parameter in learner.network.parameters()]
    with pytest.raises(NotFiniteError, match="td_loss is inf"):
        learner.update()
    after = list(learner.network.parameters())
    assert all(torch.equal(old, new) for old, new in zip(before, after, strict=True))
    assert learner.step == 0

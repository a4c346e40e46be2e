"""Tests of updates as CUDA graphs; `test_algorithms` compares them with those of the CPU."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Sequence
from typing import Any

import pytest
import torch

from mcaprl.offline.algorithms.config import BCQConfig, CQLConfig, DQNConfig, TrainingConfig
from mcaprl.offline.algorithms.learner import Learner, NotFiniteError
from mcaprl.offline.algorithms.registry import choose_algorithm
from mcaprl.offline.batches.buffer import TransitionBuffer
from tests.offline.algorithms.test_algorithms import ALL
from tests.support.offline_tasks import corridor

SMALL: dict[str, Any] = {"updates": 40, "batch_size": 16, "hidden": (16, 16)}
pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device"),
]


def learner_of(config: TrainingConfig, seeds: Sequence[int] = (0, 1)) -> Learner:
    """Return an untrained learner on the GPU."""
    buffer = TransitionBuffer.from_dataset(corridor(), config.packing).to(torch.device("cuda"))
    return choose_algorithm(config)[0](config, buffer, seeds)


def small(learner_type: type[Learner]) -> TrainingConfig:
    """Return settings for a short training."""
    return learner_type.config_type(**SMALL)


def weights_of(learner: Learner) -> dict[str, torch.Tensor]:
    """Return copies of all weights, including those of target networks and learned numbers."""
    models = {name: model.weights for name, model in learner.all_models().items()}
    return {name: weights.detach().clone() for name, weights in (models | learner.scalars).items()}


@pytest.mark.parametrize(
    "config",
    [
        *map(small, ALL),
        DQNConfig(**SMALL, dueling=True, n_quantiles=5),
        BCQConfig(**SMALL, layer_norm=True, normalize=True, frame_stack=2),
    ],
)
def test_captured_updates_are_those_of_single_kernels(config: TrainingConfig) -> None:
    captured, single = learner_of(config), learner_of(config)
    single._is_captured = False
    for _ in range(40):
        found, expected = captured.update(), single.update()
        assert list(found) == list(expected)
        for name, term in expected.items():
            torch.testing.assert_close(found[name], term, rtol=1e-3, atol=1e-3)
    assert captured._captured is not None
    assert single._captured is None
    for name, weights in weights_of(single).items():
        torch.testing.assert_close(weights_of(captured)[name], weights, rtol=1e-3, atol=1e-3)


def test_alpha_is_learned_with_its_own_learning_rate() -> None:
    config = CQLConfig(**SMALL, target_gap=0.2)
    captured, single = learner_of(config), learner_of(config)
    single._is_captured = False
    for _ in range(40):
        captured.update()
        single.update()
    found, expected = weights_of(captured), weights_of(single)
    assert not torch.equal(expected["log_alpha"], learner_of(config).scalars["log_alpha"])
    torch.testing.assert_close(found["log_alpha"], expected["log_alpha"], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("learner_type", ALL)
def test_a_resumed_training_has_the_same_weights(learner_type: type[Learner]) -> None:
    whole = learner_of(small(learner_type))
    for _ in range(15):
        whole.update()
    states = {seed: whole.state(seed) for seed in whole.seeds}
    resumed = learner_of(small(learner_type))
    # The resumed learner captures its update before it loads the state.
    resumed.update()
    for seed, state in states.items():
        copies = {name: tensor.clone() for name, tensor in state.items()}
        resumed.load_state(seed, copies, 15)
    for _ in range(10):
        whole.update()
        resumed.update()
    for name, weights in weights_of(whole).items():
        torch.testing.assert_close(weights_of(resumed)[name], weights, rtol=1e-4, atol=1e-4)


def test_a_loss_that_is_not_finite_leaves_the_weights_unchanged() -> None:
    learner = learner_of(CQLConfig(**SMALL))
    learner.update()
    before = weights_of(learner)
    learner.buffer.returns[0] = torch.nan
    with pytest.raises(NotFiniteError, match="td_loss of seed 0 is nan"):
        learner.update()
    for name, weights in weights_of(learner).items():
        assert torch.equal(weights, before[name])


def test_the_target_network_follows_at_its_interval() -> None:
    config = CQLConfig(**SMALL, target_interval=5)
    learner = learner_of(config)
    for step in range(1, 12):
        learner.update()
        weights = weights_of(learner)
        assert torch.equal(weights["q"], weights["q_target"]) == (step % 5 == 0)


def test_the_learning_rate_follows_its_schedule() -> None:
    config = CQLConfig(updates=3, batch_size=16, hidden=(16, 16), final_learning_rate_fraction=0.0)
    learner = learner_of(config)
    # The last update has the learning rate 0.
    changes = []
    for _ in range(3):
        before = weights_of(learner)["q"]
        learner.update()
        changes.append(bool((weights_of(learner)["q"] != before).any()))
    assert changes == [True, True, False]


def test_graphs_of_an_earlier_learner_are_destroyed_before_a_capture() -> None:
    earlier = learner_of(CQLConfig(**SMALL))
    earlier.update()
    graphs = weakref.ref(earlier._captured)
    gc.disable()
    try:
        del earlier
        learner_of(CQLConfig(**SMALL)).update()
        assert graphs() is None
    finally:
        gc.enable()


def test_algorithms_that_cannot_be_captured_are_trained_by_single_kernels() -> None:
    config = small(ALL[0])
    kind = choose_algorithm(config)[0]
    other = type("Other", (kind,), {"can_be_captured": False})
    learner = other(config, learner_of(config).buffer, (0,))
    learner.update()
    assert learner._captured is None

"""Updates as a GPU makes them: through tensors that stay where they are, and as a CUDA graph."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from mcaprl.errors import TrainingError, UnknownNameError, UsageError
from mcaprl.offline.algorithms.bc import BCConfig
from mcaprl.offline.algorithms.bcq import BCQConfig
from mcaprl.offline.algorithms.captured import StaticUpdate
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.cql import CQLConfig
from mcaprl.offline.algorithms.dqn import DoubleDQNConfig, DQNConfig
from mcaprl.offline.algorithms.iql import IQLConfig
from mcaprl.offline.algorithms.learner import Learner, NotFiniteError
from mcaprl.offline.algorithms.registry import ALGORITHMS
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.policy import read_policy
from mcaprl.offline.training.train import train
from mcaprl.recorder.dataset.dataset import Dataset
from tests.support.offline_tasks import corridor, inner_observations

SMALL: dict[str, Any] = {"updates": 60, "batch_size": 16, "hidden": (16, 16)}
# 120 rows: with 12 updates of 16 between two copies there is a table of targets, with 3 none.
SMALL_Q: dict[str, Any] = {**SMALL, "gamma": 0.9, "target_interval": 12}
CONFIGS = [
    DQNConfig(**{**SMALL_Q, "target_interval": 3}),
    DQNConfig(**SMALL_Q, dueling=True, layer_norm=True),
    DoubleDQNConfig(**SMALL_Q, n_steps=2, frame_stack=2),
    CQLConfig(**SMALL_Q),
    CQLConfig(**SMALL_Q, n_quantiles=3, weight_decay=0.1),
    BCQConfig(**SMALL_Q),
    IQLConfig(**SMALL_Q),
    BCConfig(**SMALL, normalize=True),
]
NO_GPU = f"torch {torch.__version__} finds no CUDA device"
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason=NO_GPU)


def learner_of(config: TrainingConfig, device: str = "cpu", data: Dataset | None = None) -> Learner:
    learner_type = next(each for each in ALGORITHMS.values() if each.config_type is type(config))
    buffer = TransitionBuffer.from_dataset(data or corridor(), config.packing)
    return learner_type(config, buffer.to(torch.device(device)), (0, 1))


def static_learner(config: TrainingConfig) -> Learner:
    """One that makes its updates as a GPU would, but for the graph."""
    learner = learner_of(config)
    learner.static_update = StaticUpdate(learner)
    return learner


def weights(learner: Learner) -> dict[str, Tensor]:
    return {name: model.weights.cpu().clone() for name, model in learner.everything().items()}


def assert_same_curve(found: Learner, expected: Learner, tolerance: float) -> None:
    """Make all updates with both; terms and weights must be the same but for rounding."""
    for _ in range(expected.config.updates):
        terms = [learner.update() for learner in (found, expected)]
        for name, values in terms[1].items():
            torch.testing.assert_close(terms[0][name].cpu(), values, rtol=tolerance, atol=tolerance)
    found.check()
    for name, values in weights(expected).items():
        torch.testing.assert_close(weights(found)[name], values, rtol=tolerance, atol=tolerance)


def pictures() -> Dataset:
    """Two episodes of noise, seen as a picture and a number."""
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (42, 40, 40, 1)).astype(np.uint8)
    numbers = random.normal(size=(42, 2)).astype(np.float32)
    here = np.array([*range(20), *range(21, 41)])
    return Dataset.from_arrays(
        observations={"image": images[here], "number": numbers[here]},
        next_observations={"image": images[here + 1], "number": numbers[here + 1]},
        actions=random.integers(3, size=40),
        rewards=random.normal(size=40),
        terminated=np.isin(np.arange(40), (19, 39)),
        truncated=np.zeros(40, bool),
        action_space=spaces.Discrete(3),
    )


def wild(learner: Learner, update: int) -> int:
    """Let the rewards be infinite before an update; gives the updates made when it is told."""
    while learner.step < learner.config.updates:
        if learner.step == update - 1:
            learner.buffer.returns[0].fill_(torch.inf)
        learner.update()
        if learner.step % 10 == 0:
            learner.check()
    return learner.step


@pytest.mark.parametrize("config", CONFIGS)
def test_static_updates_are_the_usual_ones(config: Any) -> None:
    # The learning rate is a float32 here, and a Python float there.
    assert_same_curve(static_learner(config), learner_of(config), 1e-5)


@pytest.mark.parametrize("config", [CONFIGS[3], CONFIGS[6]])
def test_a_capture_leaves_no_trace(config: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    # The updates that warm a GPU up change weights, moments and counts, which are put back.
    learner, captures = static_learner(config), []
    update = learner.static_update
    assert update is not None

    class Stream:
        def wait_stream(self, _: Any) -> None:
            pass

    class Graph:
        def replay(self) -> None:
            assert update is not None
            update._update()

    def graph(captured: Graph) -> Any:
        captures.append(captured)
        return nullcontext()

    fakes = {"Stream": Stream, "current_stream": Stream, "CUDAGraph": Graph, "graph": graph}
    for name, fake in {**fakes, "stream": nullcontext}.items():
        monkeypatch.setattr(torch.cuda, name, fake)
    monkeypatch.setattr(update, "_run", lambda: begin())

    def begin() -> None:
        update._run = update._captured()
        update._run()

    assert_same_curve(learner, learner_of(config), 1e-5)
    assert len(captures) == 1


def test_a_target_that_changes_is_found_where_it_was() -> None:
    # A graph has the addresses of its tensors, so they may not move.
    learner = static_learner(CQLConfig(**SMALL_Q))
    (target,) = learner.copies.values()
    learner.update()
    assert target._table is not None
    address, before = target._table.data_ptr(), target._table.clone()
    for _ in range(12):
        learner.update()
    assert target._table.data_ptr() == address
    assert not torch.equal(target._table, before)


def test_a_loss_that_is_not_finite_is_told_later_with_its_update_and_term() -> None:
    learner = static_learner(CQLConfig(**{**SMALL_Q, "target_interval": 100}))
    with pytest.raises(NotFiniteError, match="td_loss of seed 0 is inf") as caught:
        wild(learner, 13)
    assert caught.value.update == 13
    assert learner.step == 20


def test_training_stops_when_a_static_update_tells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def losses(learner: Any, batch: Any) -> Any:
        found = original(learner, batch)
        if learner.step >= 34:
            found.terms["td_loss"].fill_(torch.nan)
            found.terms["loss"].fill_(torch.nan)
        return found

    learner_type = ALGORITHMS["cql"]
    original, make = learner_type.losses, learner_type.__init__

    def make_static(learner: Any, *arguments: Any) -> None:
        make(learner, *arguments)
        learner.static_update = StaticUpdate(learner)

    monkeypatch.setattr(learner_type, "losses", losses)
    monkeypatch.setattr(learner_type, "__init__", make_static)
    config = CQLConfig(**SMALL_Q, log_interval=10, checkpoint_interval=10)
    says = r"update 35 of .*td_loss of seed 0 is nan\. Last good checkpoint: .*seed-0/checkpoint"
    with pytest.raises(TrainingError, match=says):
        train(corridor(), config, tmp_path / "run", seeds=2, progress=lambda _: None)


def test_pictures_learn_the_same_in_static_updates() -> None:
    config = CQLConfig(**{**SMALL_Q, "updates": 6, "frame_stack": 2})
    assert_same_curve(
        static_learner_of(pictures(), config), learner_of(config, data=pictures()), 1e-5
    )


def static_learner_of(data: Dataset, config: TrainingConfig) -> Learner:
    learner = learner_of(config, data=data)
    learner.static_update = StaticUpdate(learner)
    return learner


def test_a_device_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="device"):
        train(corridor(), "bc", tmp_path / "run", device="tpu")
    if not torch.cuda.is_available():
        with pytest.raises(UsageError, match=r"device cuda: torch .* finds none here"):
            train(corridor(), "bc", tmp_path / "run", device="cuda")
    assert not (tmp_path / "run").exists()


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("config", CONFIGS)
def test_captured_updates_are_those_of_the_cpu(config: Any) -> None:
    # Sums are added up in another order, and Adam divides by small numbers: not to the last bit.
    assert_same_curve(learner_of(config, "cuda"), learner_of(config), 2e-3)


@pytest.mark.gpu
@needs_gpu
def test_captured_updates_of_pictures_are_those_of_the_cpu() -> None:
    config = CQLConfig(**{**SMALL_Q, "updates": 6, "frame_stack": 2})
    found, expected = (learner_of(config, device, pictures()) for device in ("cuda", "cpu"))
    assert_same_curve(found, expected, 1e-2)


@pytest.mark.gpu
@needs_gpu
def test_the_data_are_on_the_gpu_and_an_update_is_one_graph() -> None:
    learner = learner_of(CQLConfig(**SMALL_Q), "cuda")
    learner.update()
    buffer = learner.buffer
    tensors = [*buffer.frames.parts(), buffer.places, buffer.actions, buffer.returns]
    assert all(tensor.is_cuda for tensor in tensors)
    assert learner.static_update is not None
    assert isinstance(getattr(learner.static_update._run, "__self__", None), torch.cuda.CUDAGraph)


@pytest.mark.gpu
@needs_gpu
def test_a_gpu_tells_of_a_loss_that_is_not_finite() -> None:
    learner = learner_of(CQLConfig(**{**SMALL_Q, "target_interval": 100}), "cuda")
    with pytest.raises(NotFiniteError, match="td_loss of seed 0 is inf") as caught:
        wild(learner, 13)
    assert caught.value.update == 13


@pytest.mark.gpu
@needs_gpu
def test_a_run_on_the_gpu_is_a_run(tmp_path: Path) -> None:
    torch.cuda.reset_peak_memory_stats()
    config = CQLConfig(**SMALL_Q, checkpoint_interval=20)
    train(corridor(), config, tmp_path / "gpu", seeds=2, device="cuda", progress=lambda _: None)
    assert torch.cuda.max_memory_allocated() > 0
    train(corridor(), config, tmp_path / "cpu", seeds=2, progress=lambda _: None)
    values = [
        read_policy(tmp_path / name / "seed-1").q_values(inner_observations())
        for name in ("gpu", "cpu")
    ]
    np.testing.assert_allclose(values[0], values[1], atol=1e-2)

"""Actions relative to observations: ranges of chunks, and numbers worked by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

import mcaprl
from mcaprl.errors import PolicyError, SpaceError, UsageError
from mcaprl.offline.algorithms.config import BoxBCConfig
from mcaprl.offline.algorithms.registry import choose_algorithm
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.export import export_onnx
from mcaprl.offline.policy import Policy, read_policy, save_policy
from mcaprl.offline.training.train import train
from mcaprl.recorder.dataset.dataset import Dataset
from tests.conftest import need

try:
    import onnxruntime
except ImportError:
    onnxruntime = None

TINY: dict[str, Any] = {"updates": 4, "batch_size": 8, "hidden": (8,), "held_out": 0.0}


def reaching(starts: list[float], length: int = 4, speed: float = 1.0) -> Dataset:
    """Return episodes of a joint at `starts`, which moves by `speed` a step.

    The joint is commanded to where it is in one step, and the gripper to the number of the step.
    The observation is a clock, which is noise, and the joint.
    """
    steps = np.arange(length + 1.0)
    joints = [start + speed * steps for start in starts]
    seen = np.concatenate([np.stack([7 - steps, each], 1) for each in joints]).astype(np.float32)
    rows = np.concatenate([k * (length + 1) + np.arange(length) for k in range(len(starts))])
    ends = np.tile(np.arange(length) == length - 1, len(starts))
    grip = np.tile(np.arange(length), len(starts))
    return Dataset.from_arrays(
        observations=seen[rows],
        next_observations=seen[rows + 1],
        actions=np.stack([seen[rows + 1, 1], grip], 1).astype(np.float32),
        rewards=np.ones(len(rows)),
        terminated=np.zeros(len(rows), bool),
        truncated=ends,
        observation_space=spaces.Box(-100, 100, (2,), np.float32),
        action_space=spaces.Box(np.array([-20, 0]), np.array([20, 10]), dtype=np.float32),
    ).with_relative_actions({0: 1})


@pytest.mark.parametrize("normalize", [False, True])
def test_ranges_are_those_of_the_steps_of_chunks(normalize: bool) -> None:
    data = reaching([0, 5, -8])
    assert data.relative_to == (1, None)
    config = BoxBCConfig(**TINY, chunk=3, normalize=normalize)
    relative = TransitionBuffer.from_dataset(data, config.packing).relative
    assert relative is not None
    # The k-th command is 1 + k ahead of the joint, in all chunks: a constant has the number 0.
    # In halves of the range, 1 m is 1 / 20. Grippers keep the range of their Box.
    middle = (relative.low + relative.high)[:, 0] / 2
    torch.testing.assert_close(
        middle, torch.tensor([1, 2, 3]) / 20.0, check_dtype=False, atol=1e-6, rtol=0
    )
    assert relative.low[:, 1].tolist() == [-1, -1, -1]
    assert relative.high[:, 1].tolist() == [1, 1, 1]


def test_episodes_that_are_held_out_have_no_part_in_the_ranges() -> None:
    one = mixed(1.0, 2.0, 4.0)
    packing = BoxBCConfig(**TINY, chunk=2).packing
    every = TransitionBuffer.from_dataset(one, packing, weights=np.ones(3)).relative
    two = TransitionBuffer.from_dataset(one, packing, weights=np.array([1.0, 1.0, 0.0])).relative
    assert every is not None
    assert two is not None
    # With speeds of 1 and 2 m a step, the second command of a chunk is 2 to 4 m ahead.
    ranges = torch.stack([two.low[:, 0], two.high[:, 0]]).T * 20
    torch.testing.assert_close(ranges, torch.tensor([[1.0, 2], [2, 4]]).double(), atol=1e-5, rtol=0)
    ranges = torch.stack([every.low[:, 0], every.high[:, 0]]).T * 20
    torch.testing.assert_close(ranges, torch.tensor([[1.0, 4], [2, 8]]).double(), atol=1e-5, rtol=0)


def mixed(*speeds: float) -> Dataset:
    """Return an episode of `reaching` for each speed."""
    parts = [reaching([-3], speed=each) for each in speeds]
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in (
            "observations",
            "next_observations",
            "actions",
            "rewards",
            "terminated",
            "truncated",
        )
    }
    first = parts[0]
    spaces_: dict[str, Any] = {
        "observation_space": first.observation_space,
        "action_space": first.action_space,
    }
    return Dataset.from_arrays(**columns, **spaces_).with_relative_actions({0: 1})


def test_numbers_by_hand() -> None:
    data = mixed(1.0, 2.0)
    config = BoxBCConfig(**TINY, chunk=2, normalize=True)
    buffer = TransitionBuffer.from_dataset(data, config.packing)
    assert buffer.relative is not None
    batch = buffer.batch(torch.tensor([0, 3, 4]))
    actions, exist = buffer.chunks(batch.rows)
    numbers = buffer.relative.numbers(actions, batch.observations.vector)
    # Rows 0 and 3 move by 1 m, the smallest range, and row 4 by 2 m, the largest one.
    wanted: list[list[list[float]]] = [[[-1, -1], [-1, -0.8]], [[-1, -0.4]], [[1, -1], [1, -0.8]]]
    for row, each in enumerate(wanted):
        torch.testing.assert_close(
            numbers[row, : len(each)], torch.tensor(each).float(), atol=1e-5, rtol=0
        )
    assert exist.tolist() == [[True, True], [True, False], [True, True]]
    back = buffer.relative.actions(numbers.double(), batch.observations.vector)
    torch.testing.assert_close(back.float(), actions, atol=1e-6, rtol=0)


def policy_of(config: BoxBCConfig, data: Dataset, folder: Path) -> Policy:
    buffer = TransitionBuffer.from_dataset(data, config.packing)
    learner = choose_algorithm(config).learner_type(config, buffer, [0])
    while learner.step < config.updates:
        learner.update()
    save_policy(folder, learner, 0, "", {})
    return read_policy(folder)


@pytest.mark.parametrize(("head", "stack"), [("deterministic", 1), ("gaussian", 2), ("mixture", 1)])
def test_commands_follow_the_joint_where_no_data_was(head: str, stack: int, tmp_path: Path) -> None:
    settings: dict[str, Any] = {**TINY, "updates": 200, "learning_rate": 1e-2, "batch_size": 32}
    config = BoxBCConfig(**settings, head=head, chunk=3, frame_stack=stack)
    policy = policy_of(config, mixed(1.0, 1.5), tmp_path)
    # At -15 m, where nothing was learned, the command is still ahead of the joint.
    seen = np.array([[7, -15], [7, 2]], np.float32)
    if stack > 1:
        seen = np.repeat(seen[:, None], stack, 1)
        seen[:, 0, 1] += 3
    chunks = policy.act_chunk(seen)
    assert chunks.shape == (2, 3, 2)
    for row, joint in enumerate([-15, 2]):
        ahead, steps = chunks[row, :, 0] - joint, np.array([1, 2, 3])
        assert (ahead > steps - 1e-3).all()
        assert (ahead < 1.5 * steps + 1e-3).all()
    absolute = BoxBCConfig(**settings, head=head, chunk=3, frame_stack=stack, relative=False)
    assert policy_of(absolute, reaching([0, 1]), tmp_path / "absolute").head.relative is None
    with pytest.raises(PolicyError):
        policy.log_prob(seen, np.zeros((2, 2), np.float32))
    if onnxruntime is None:
        need(False, "onnxruntime is not installed")
    export_onnx(policy, tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    (found,) = session.run(None, {"observation": seen})
    np.testing.assert_allclose(found, chunks, atol=1e-4)


def test_commands_stay_within_the_bounds(tmp_path: Path) -> None:
    policy = policy_of(BoxBCConfig(**TINY, chunk=2), reaching([0, 1, 2]), tmp_path)
    far = policy.act_chunk(np.array([[7, 90], [7, -90]], np.float32))
    assert far[:, :, 0].tolist() == [[20, 20], [-20, -20]]


def test_single_actions_are_relative_too(tmp_path: Path) -> None:
    settings: dict[str, Any] = {**TINY, "updates": 100, "learning_rate": 1e-2}
    policy = policy_of(BoxBCConfig(**settings), mixed(1.0, 1.5), tmp_path)
    assert policy.act(np.array([[7, 4.0]], np.float32)).shape == (1, 2)
    assert not policy.chunk.has_memory
    with pytest.raises(PolicyError, match="relative to observations have no density"):
        policy.log_prob(np.zeros((1, 2), np.float32), np.zeros((1, 2), np.float32))


def test_a_log_keeps_what_its_actions_are_relative_to(tmp_path: Path) -> None:
    data = reaching([0, 1, 2])
    data.save(tmp_path / "log.mcap")
    again = mcaprl.open(tmp_path / "log.mcap")
    assert again.relative_to == (1, None)
    np.testing.assert_array_equal(again.actions, data.actions)
    own: dict[str, Any] = {**TINY, "final_learning_rate_fraction": 1.0, "chunk": 2}
    train(again, BoxBCConfig(**own), tmp_path / "run")
    found: Any = read_policy(tmp_path / "run/seed-0").head.relative
    assert found is not None
    # With other data, the ranges of the run are kept.
    longer = BoxBCConfig(**{**own, "updates": 6})
    train(mixed(1.0, 4.0), longer, tmp_path / "run", resume=True, other_data=True)
    other: Any = read_policy(tmp_path / "run/seed-0").head.relative
    torch.testing.assert_close(other.high, found.high)
    cases: list[tuple[dict[str | int, str | int], str]] = [
        ({"x": 1}, "the action has no element 'x'; elements: action\\[0\\], action\\[1\\]"),
        ({0: 5}, "the observation has no element 5; elements: observation\\[0\\], obs"),
    ]
    for wrong, text in cases:
        with pytest.raises(SpaceError, match=text):
            data.with_relative_actions(wrong)


@pytest.mark.filterwarnings("ignore:.*of the target network")
def test_algorithms_that_learn_absolute_actions_say_so(tmp_path: Path) -> None:
    data = reaching([0, 5, -8])
    with pytest.warns(UserWarning, match="iql learns absolute actions"):
        mcaprl.train(data, tmp_path / "iql", algo="iql", updates=1, hidden=(4,))
    # One episode is too few to train the candidates of `auto`.
    with (
        pytest.warns(UserWarning, match="each candidate of auto but bc learns absolute actions"),
        pytest.raises(UsageError, match="episodes or more"),
    ):
        mcaprl.train(reaching([0]), tmp_path / "auto", algo="auto")
    with pytest.raises(UsageError, match="chunk"):
        mcaprl.train(data, tmp_path / "chunks", algo="iql", updates=1, chunk=4)
    with pytest.raises(UsageError, match="chunk"):
        mcaprl.train(data, tmp_path / "auto", algo="auto", chunk=4)

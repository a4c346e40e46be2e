"""Tests of learning from MultiDiscrete and MultiBinary actions, against the same Discrete log."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.torch import load_file

import mcaprl
from mcaprl.errors import SpaceError
from mcaprl.offline.algorithms.config import BCConfig, BCQConfig, CQLConfig, IQLConfig
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.export import export_onnx
from mcaprl.offline.policy import read_policy
from mcaprl.offline.training.train import train
from mcaprl.recorder.dataset.dataset import Dataset
from tests.conftest import need

try:
    import onnxruntime
except ImportError:
    onnxruntime = None

MULTI = spaces.MultiDiscrete([2, 3], dtype=np.int32, start=[1, -1])
BINARY = spaces.MultiBinary(3)
SHORT: dict[str, Any] = {"updates": 60, "batch_size": 16, "hidden": (16,)}
VALUES: dict[str, Any] = {**SHORT, "gamma": 0.5, "target_interval": 20}


def silent(_: object) -> None:
    """A progress callback that does nothing."""


def logs(space: Any, count: int) -> tuple[Dataset, Dataset]:
    """Return a log with actions of a space, and the same log with the numbers of the actions.

    In episodes of five steps, the observation shows a number, and that action earns 1.
    """
    random = np.random.default_rng(0)
    frames = np.eye(count, dtype=np.float32)[random.integers(count, size=301)]
    numbers = random.integers(count, size=300)
    common: dict[str, Any] = {
        "observations": frames[:-1],
        "rewards": (frames[:-1].argmax(1) == numbers).astype(float),
        "terminated": np.arange(300) % 5 == 4,
        "truncated": np.zeros(300, bool),
        "next_observations": frames[1:],
        "behavior_probs": np.full(300, 1 / count, np.float32),
        "observation_space": spaces.Box(0, 1, (count,), np.float32),
    }
    # By hand: the last element of (a, b) in {1, 2} x {-1, 0, 1} changes fastest.
    if isinstance(space, spaces.MultiDiscrete):
        values = np.stack([numbers // 3 + 1, numbers % 3 - 1], 1).astype(np.int32)
    else:
        values = np.stack([numbers // 4, numbers // 2 % 2, numbers % 2], 1).astype(np.int8)
    discrete = spaces.Discrete(count)
    return (
        Dataset.from_arrays(**common, actions=values, action_space=space),
        Dataset.from_arrays(**common, actions=numbers, action_space=discrete),
    )


@pytest.mark.parametrize(("space", "count"), [(MULTI, 6), (BINARY, 8)])
@pytest.mark.parametrize(
    "config", [CQLConfig(**VALUES), BCConfig(**SHORT), BCQConfig(**VALUES), IQLConfig(**VALUES)]
)
def test_joint_actions_learn_as_their_numbers(
    space: Any, count: int, config: Any, tmp_path: Path
) -> None:
    joint, plain = logs(space, count)
    folders = []
    for name, dataset in (("joint", joint), ("plain", plain)):
        (summary,) = train(dataset, config, tmp_path / name, progress=silent)
        folders.append(summary.folder)
    weights = [load_file(folder / "policy.safetensors") for folder in folders]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(tensor, weights[1][key]) for key, tensor in weights[0].items())
    policy, numbered = map(read_policy, folders)
    actions, numbers = policy.act(joint.observations), numbered.act(plain.observations)
    assert actions.dtype == space.dtype
    assert all(action in space for action in actions)
    if space is MULTI:
        expected = np.stack([numbers // 3 + 1, numbers % 3 - 1], 1)
    else:
        expected = np.stack([numbers // 4, numbers // 2 % 2, numbers % 2], 1)
    np.testing.assert_array_equal(actions, expected)
    probs = policy.action_probabilities(joint.observations)
    assert probs.shape == (300, count)
    assert mcaprl.load_policy(tmp_path / "joint").action_space == space


class Guess(gym.Env[np.ndarray, np.ndarray]):
    """The observation shows the number of the right action of MULTI. Episodes have five steps."""

    observation_space = spaces.Box(0, 1, (6,), np.float32)
    action_space = MULTI

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = 5
        return self._next(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action in MULTI
        first, second = divmod(self.right, 3)
        reward = float(np.array_equal(action, [first + 1, second - 1]))
        self.left -= 1
        return self._next(), reward, self.left == 0, False, {}

    def _next(self) -> Any:
        self.right = int(self.np_random.integers(6))
        return np.eye(6, dtype=np.float32)[self.right]


def test_a_trained_policy_acts_in_its_environment_and_is_recorded(tmp_path: Path) -> None:
    gym.register("JointGuess-v0", lambda **_: Guess())
    try:
        joint, _ = logs(MULTI, 6)
        config = CQLConfig(updates=400, gamma=0.0, hidden=(32,), learning_rate=1e-2, alpha=0.0)
        train(joint, config, tmp_path / "run", progress=silent)
        found = mcaprl.evaluate(str(tmp_path / "run"), "JointGuess-v0", episodes=4)
        assert next(one for one in found.policies if one.policy == "run").mean_return == 5
        log = tmp_path / "log.mcap"
        mcaprl.record("JointGuess-v0", log, policy=str(tmp_path / "run"), epsilon=0.6, episodes=40)
    finally:
        del gym.registry["JointGuess-v0"]
    recorded = mcaprl.open(log)
    # A random action has 0.6 / 6, and the policy's action 0.4 more.
    right = recorded.rewards == 1
    np.testing.assert_allclose(recorded.behavior_probs, np.where(right, 0.5, 0.1), rtol=1e-6)
    assert 0.4 < right.mean() < 0.6
    calibrated = mcaprl.info(log).behavior_prob
    assert calibrated is not None
    assert (calibrated.possible, calibrated.available) == (True, 6)


def test_estimates_are_those_of_the_numbered_log(tmp_path: Path) -> None:
    joint, plain = logs(MULTI, 6)
    found = []
    for name, dataset in (("joint", joint), ("plain", plain)):
        run = tmp_path / name
        mcaprl.train(dataset, run, algo="bc", **SHORT)
        log = tmp_path / f"{name}.mcap"
        dataset.save(log)
        given: dict[str, Any] = {"gamma": 0.5, "updates": 40}
        found.append(mcaprl.estimate([str(run), "random"], log, **given))
        assert mcaprl.estimate_behavior(dataset, updates=20).log_likelihood < 0
    first, second = (
        json.dumps([one.to_json() for one in result.estimates]).replace("plain", "joint")
        for result in found
    )
    assert first == second


def test_auto_chooses_among_policies_for_joint_actions(tmp_path: Path) -> None:
    joint, _ = logs(MULTI, 6)
    given: dict[str, Any] = {**SHORT, "target_interval": 5, "gamma": 0.9, "model_updates": 60}
    (summary,) = mcaprl.train(joint, tmp_path, algo="auto", **given)
    assert read_policy(summary.folder).act(joint.observations[:3]).shape == (3, 2)


@pytest.mark.parametrize(("space", "count"), [(MULTI, 6), (BINARY, 8)])
def test_the_onnx_file_returns_actions_of_the_space(space: Any, count: int, tmp_path: Path) -> None:
    need(onnxruntime is not None, "onnxruntime is not installed")
    import onnx

    joint, _ = logs(space, count)
    (summary,) = train(joint, CQLConfig(**VALUES), tmp_path / "run", progress=silent)
    policy, path = read_policy(summary.folder), tmp_path / "policy.onnx"
    export_onnx(policy, path)
    session = onnxruntime.InferenceSession(path)
    observations = joint.observations[:50]
    actions, scores = session.run(None, {session.get_inputs()[0].name: observations})
    np.testing.assert_array_equal(actions, policy.act(observations))
    assert actions.dtype == space.dtype
    assert scores.shape == (50, count)
    properties = {one.key: one.value for one in onnx.load(path).metadata_props}
    assert f"numpy.unravel_index(k, {(2, 3) if space is MULTI else (2, 2, 2)})" in str(properties)


def test_values_of_a_log_number_the_joint_actions(tmp_path: Path) -> None:
    joint, _ = logs(MULTI, 6)
    joint.save(tmp_path / "log.mcap")
    train(joint, CQLConfig(**VALUES), tmp_path / "run", progress=silent)
    mcaprl.annotate(tmp_path / "log.mcap", tmp_path / "out.mcap", policy=tmp_path / "run")
    from mcaprl.offline.estimate.values import value_columns

    policy = read_policy(tmp_path / "run" / "seed-0")
    columns = value_columns(policy, joint.episodes[0], MULTI, 0.5)
    first, second = policy.act(joint.observations[:5]).T
    np.testing.assert_array_equal(columns["policy_action"], (first - 1) * 3 + second + 1)


def test_large_and_wrong_spaces_are_one_line() -> None:
    def packed(space: Any, action: Any) -> TransitionBuffer:
        dataset = Dataset.from_arrays(
            observations=np.zeros((1, 2), np.float32),
            actions=np.array([action]),
            rewards=[0.0],
            terminated=[True],
            truncated=[False],
            next_observations=np.zeros((1, 2), np.float32),
            action_space=space,
        )
        return TransitionBuffer.from_dataset(dataset)

    assert packed(spaces.MultiBinary(10), [0] * 9 + [1]).actions.tolist() == [1]
    with pytest.raises(SpaceError, match=r"has 2048 combinations of actions; .* at most 1,024"):
        packed(spaces.MultiBinary(11), [0] * 11)
    with pytest.raises(SpaceError, match=r"actions from 0 to 3, but its action space is Multi"):
        packed(spaces.MultiDiscrete([2, 3]), [0, 3])

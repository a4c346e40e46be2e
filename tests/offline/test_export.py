"""Tests that exported policies select the same actions in ONNX Runtime as the originals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from mcaprl.api.policies import load_policy
from mcaprl.chunks import Chunks
from mcaprl.cli import run
from mcaprl.offline.algorithms.config import (
    BCConfig,
    BCQConfig,
    BoxBCConfig,
    BoxIQLConfig,
    DQNConfig,
    TD3BCConfig,
    TrainingConfig,
)
from mcaprl.offline.algorithms.registry import choose_algorithm
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.export import ExportedPolicy, export_onnx
from mcaprl.offline.policy import Policy, read_policy, save_policy
from mcaprl.recorder.dataset.dataset import Dataset
from tests.conftest import need
from tests.support.paths import GOLDEN

try:
    import onnxruntime
except ImportError:
    onnxruntime = None

TINY: dict[str, Any] = {"updates": 1, "batch_size": 4, "hidden": (16, 8)}
VECTOR = spaces.Box(-5, 5, (3,), np.float32)
IMAGE = spaces.Box(0, 255, (36, 40, 1), np.uint8)
MIXED = spaces.Dict(
    {
        "action_mask": spaces.MultiBinary(4),
        "camera": IMAGE,
        "gear": spaces.Discrete(3, start=-1),
        "state": spaces.Box(-5, 5, (2, 2), np.float64),
        "switches": spaces.MultiDiscrete([2, 3]),
    }
)
CASES = [
    (DQNConfig(**TINY, normalize=True), VECTOR),
    (DQNConfig(**TINY, n_quantiles=3, dueling=True), VECTOR),
    (BCQConfig(**TINY), VECTOR),
    (BCConfig(**TINY, frame_stack=2), IMAGE),
    (BCConfig(**TINY, frame_stack=2, normalize=True, channels=(4, 6, 8)), IMAGE),
    (DQNConfig(**TINY, frame_stack=2, layer_norm=True), spaces.Box(0, 255, (84, 90, 1), np.uint8)),
    (DQNConfig(**TINY), MIXED),
    (DQNConfig(**TINY, frame_stack=2), spaces.Box(0, 255, (3, 12, 10), np.uint8)),
    (DQNConfig(**TINY), spaces.Box(0, 255, (10, 10, 4), np.uint8)),
]


def policy_of(
    config: TrainingConfig,
    space: spaces.Space[Any],
    folder: Path,
    actions: spaces.Box | None = None,
) -> Policy:
    space.seed(0)
    samples = [space.sample() for _ in range(20)]
    column: Any
    if isinstance(space, spaces.Dict):
        for sample in samples:
            sample["action_mask"][0] = 1
        column = {key: np.stack([sample[key] for sample in samples]) for key in space.spaces}
    else:
        column = np.stack(samples)
    data = Dataset.from_arrays(
        observations=column,
        actions=np.full(20, 7) if actions is None else [actions.sample() for _ in range(20)],
        rewards=np.ones(20),
        terminated=np.ones(20, bool),
        truncated=np.zeros(20, bool),
        next_observations=column,
        observation_space=space,
        action_space=actions or spaces.Discrete(4, start=7),
    )
    learner_type = choose_algorithm(config).learner_type
    learner = learner_type(config, TransitionBuffer.from_dataset(data, config.packing), [0])
    save_policy(folder, learner, 0, "", {})
    return read_policy(folder)


@pytest.mark.parametrize(("config", "space"), CASES)
def test_the_exported_policy_returns_the_same_scores_and_actions(
    tmp_path: Path, config: TrainingConfig, space: spaces.Space[Any]
) -> None:
    need(onnxruntime is not None, "onnxruntime is not installed")
    policy = policy_of(config, space, tmp_path)
    export_onnx(policy, tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    module = ExportedPolicy(policy)
    for batch_size in (1, 5):
        arrays = [tensor.numpy() for tensor in module.examples(batch_size, seed=batch_size)]
        named = dict(zip(module.input_names, arrays, strict=True))
        action, scores = session.run(["action", "scores"], named)
        leaves = [leaf.path[0] for leaf in policy.encoder.leaves if leaf.path]
        observations = dict(zip(leaves, arrays, strict=True)) if leaves else arrays[0]
        assert action.dtype == np.int64
        np.testing.assert_array_equal(action, policy.act(observations))
        expected: Any = policy.scores(observations)
        np.testing.assert_allclose(scores, expected, atol=1e-5)


@pytest.mark.parametrize(
    "config",
    [
        BoxBCConfig(**TINY, head="mixture"),
        BoxBCConfig(**TINY, head="gaussian", frame_stack=3),
        TD3BCConfig(**TINY),
        BoxIQLConfig(**TINY),
    ],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_exported_policy_returns_actions_in_the_units_of_their_box(
    tmp_path: Path, config: TrainingConfig, dtype: Any
) -> None:
    need(onnxruntime is not None, "onnxruntime is not installed")
    low, high = np.array([[[-3.0, 0.1]], [[5.0, 0.7]]], dtype)
    space = spaces.Box(low, high, dtype=dtype)
    policy = policy_of(config, VECTOR, tmp_path, space)
    export_onnx(policy, tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    module = ExportedPolicy(policy)
    for batch_size in (1, 5):
        arrays = [tensor.numpy() for tensor in module.examples(batch_size, seed=batch_size)]
        (action,) = session.run(None, dict(zip(module.input_names, arrays, strict=True)))
        expected = policy.act(arrays[0])
        assert action.dtype == expected.dtype == dtype
        np.testing.assert_allclose(action, expected, rtol=1e-5, atol=1e-6)
        assert all(space.contains(one) for one in expected)


@pytest.mark.parametrize("head", ["mixture", None])
def test_the_exported_policy_returns_chunks(head: str | None, tmp_path: Path) -> None:
    need(onnxruntime is not None, "onnxruntime is not installed")
    space = spaces.Box(-3, 5, (2,), np.float32) if head else None
    own: dict[str, Any] = {**TINY, "chunk": 5, "execute": 2, "frame_stack": 2}
    config = BoxBCConfig(**own, head=head) if head else BCConfig(**own)
    policy = policy_of(config, VECTOR, tmp_path, space)
    export_onnx(policy, tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    (inputs,) = (tensor.numpy() for tensor in ExportedPolicy(policy).examples(3, seed=1))
    found = session.run(["action"], {"observation": inputs})[0]
    np.testing.assert_allclose(found, policy.act_chunk(inputs), rtol=1e-5, atol=1e-6)
    about = session.get_modelmeta().custom_metadata_map
    assert Chunks(**json.loads(about["chunk"])) == policy.chunk
    assert about["execution"].startswith(
        "action[:, k] is for the k-th step from now: chunks of 5 actions, of which 2 are executed;"
    )
    assert head or about["scores"] == "scores[:, step, k] is the score of action k + 7"


@pytest.mark.parametrize("name", ["online-dqn.zip", "online-camera.zip", "sb3-a2c.zip"])
def test_policies_of_online_runs_are_exported(tmp_path: Path, name: str) -> None:
    need(onnxruntime is not None, "onnxruntime is not installed")
    policy = load_policy(GOLDEN / "policies" / name)
    export_onnx(policy, tmp_path / "policy.onnx")
    module = ExportedPolicy(policy)
    arrays = [tensor.numpy() for tensor in module.examples(5, seed=1)]
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    action, scores = session.run(None, dict(zip(module.input_names, arrays, strict=True)))
    leaves = [leaf.path[0] for leaf in policy.encoder.leaves if leaf.path]
    observations = dict(zip(leaves, arrays, strict=True)) if leaves else arrays[0]
    np.testing.assert_array_equal(action, policy.act(observations))
    expected: Any = policy.scores(observations)
    np.testing.assert_allclose(scores, expected, atol=1e-5)


def test_the_command_writes_a_file_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    need(onnxruntime is not None, "onnxruntime is not installed")
    policy_of(DQNConfig(**TINY), VECTOR, tmp_path)
    out = tmp_path / "policy.onnx"
    assert run(["export", str(tmp_path), "--out", str(out)]) == 0
    assert f"{out}: dqn policy" in capsys.readouterr().out
    assert run(["export", str(tmp_path), "--out", str(out)]) == 2
    assert "exists" in capsys.readouterr().err
    assert run(["export", str(tmp_path), "--out", str(out / "x.onnx")]) == 1
    assert "cannot write" in capsys.readouterr().err


def test_a_full_disk_is_one_line_and_leaves_no_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    need(onnxruntime is not None, "onnxruntime is not installed")
    resource = pytest.importorskip("resource", reason="needs limits on the size of files")
    policy_of(DQNConfig(**TINY), VECTOR, tmp_path / "policy")
    out = tmp_path / "out" / "policy.onnx"
    out.parent.mkdir()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, hard))
    try:
        status = run(["export", str(tmp_path / "policy"), "--out", str(out), "--quiet"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert status == 1
    error = capsys.readouterr().err
    assert error.startswith(f"mcaprl: cannot write {out}: ")
    assert "File too large" in error
    assert error.count("\n") == 1
    assert list(out.parent.iterdir()) == []

"""Tests of saved policies: saving and loading, and broken files."""

from __future__ import annotations

import json
import pickle
import tracemalloc
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.api.policies import load_policies, load_policy
from mcaprl.errors import PolicyError, ReportError
from mcaprl.frames import mapped
from mcaprl.networks import Convolutions
from mcaprl.offline.algorithms.bc import BC
from mcaprl.offline.algorithms.bcq import BCQ
from mcaprl.offline.algorithms.config import BCConfig, CQLConfig, DQNConfig, TrainingConfig
from mcaprl.offline.algorithms.cql import CQL
from mcaprl.offline.algorithms.iql import IQL
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.registry import ALGORITHMS
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.batches.observations import Observations
from mcaprl.offline.policy import Policy, read_policy, save_policy
from mcaprl.offline.training.metrics import draw_curves
from mcaprl.offline.training.train import train
from mcaprl.recorder.dataset.dataset import Dataset
from tests.support.offline_tasks import ACTION_SPACE, N_CELLS, corridor, inner_observations

TINY: dict[str, Any] = {"updates": 20, "batch_size": 16, "hidden": (16, 8)}


@pytest.fixture
def cql_run(tmp_path: Path) -> Path:
    config = CQLConfig(**TINY, gamma=0.5)
    train(corridor(), config, tmp_path / "run", seeds=2, progress=lambda _: None)
    return tmp_path / "run"


def learner_of(config: TrainingConfig, dataset: Dataset) -> Learner:
    learner_type = next(each for each in ALGORITHMS.values() if type(config) is each.config_type)
    return learner_type(config, TransitionBuffer.from_dataset(dataset, config.packing), [0])


def learner_with_outputs(learner_type: type[Learner], *outputs: list[float]) -> Learner:
    """Return a learner whose networks have constant outputs."""
    learner = learner_of(learner_type.config_type(**{**TINY, "hidden": ()}), corridor())
    for name, constants in zip(learner.policy_models, outputs, strict=True):
        *_, weight, bias = learner.network(name, 0).parameters()
        with torch.no_grad():
            weight.zero_()
            bias.copy_(torch.tensor(constants))
    return learner


def saved_and_loaded(folder: Path, learner: Learner) -> Policy:
    save_policy(folder, learner, 0, "Corridor-v0", {"length": 5})
    return read_policy(folder)


def test_a_loaded_policy_has_the_saved_networks_values(tmp_path: Path) -> None:
    learner = learner_of(CQLConfig(**TINY, scale_rewards=True), corridor())
    policy = saved_and_loaded(tmp_path, learner)
    with torch.no_grad():
        seen = Observations(torch.from_numpy(inner_observations()))
        expected = learner.in_reward_units(learner.network("q", 0)(seen)).numpy()
    assert policy.reward_scale != 1
    np.testing.assert_allclose(policy.q_values(inner_observations()), expected, rtol=1e-5)


def test_a_policy_stores_its_task(tmp_path: Path) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [1.0, 2.0]))
    assert (policy.algo, policy.env_id) == ("cql", "Corridor-v0")
    assert policy.env_kwargs == {"length": 5}
    assert policy.action_space == ACTION_SPACE
    assert policy.observation_space == spaces.Box(0, 1, (N_CELLS,), np.float32)


def test_actions_are_greedy_and_in_the_space(tmp_path: Path) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [1.0, 2.0]))
    actions = policy.act(inner_observations())
    assert actions.dtype == np.int64
    assert actions.tolist() == [6, 6, 6]
    assert policy.action_probabilities(inner_observations()).tolist() == [[0, 1]] * 3


def test_ties_are_broken_by_the_first_action(tmp_path: Path) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [2.0, 2.0]))
    assert policy.act(inner_observations()).tolist() == [5, 5, 5]
    assert policy.action_probabilities(inner_observations()).tolist() == [[1, 0]] * 3


def test_a_cloned_policy_has_probabilities_and_no_values(tmp_path: Path) -> None:
    logits = np.log([0.25, 0.75]).tolist()
    policy = saved_and_loaded(tmp_path, learner_with_outputs(BC, logits))
    assert policy.act(inner_observations()[:1]).tolist() == [6]
    np.testing.assert_allclose(
        policy.action_probabilities(inner_observations()[:1]), [[0.25, 0.75]], rtol=1e-6
    )
    with pytest.raises(PolicyError, match="no Q-values"):
        policy.q_values(inner_observations())


def test_log_probabilities_and_scores_by_hand(tmp_path: Path) -> None:
    seen, actions = inner_observations()[:2], np.array([5, 6])
    cloned = saved_and_loaded(tmp_path, learner_with_outputs(BC, [1e3, 1e3 + np.log(3)]))
    np.testing.assert_allclose(cloned.log_prob(seen, actions), np.log([0.25, 0.75]), rtol=1e-4)
    scores: Any = cloned.scores(seen)
    np.testing.assert_allclose(scores, [[1e3, 1e3 + np.log(3)]] * 2, rtol=1e-6)
    greedy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [1.0, 2.0]))
    assert greedy.log_prob(seen, actions).tolist() == [-np.inf, 0]
    scores = greedy.scores(seen)
    assert scores.tolist() == [[1, 2]] * 2
    filtered = learner_with_outputs(BCQ, [1.0, 2.0], np.log([10.0, 1.0]).tolist())
    scores = saved_and_loaded(tmp_path, filtered).scores(seen)
    assert scores.tolist() == [[1, -np.inf]] * 2


def test_probabilities_of_huge_logits_are_finite(tmp_path: Path) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(BC, [1e4, -1e4]))
    assert policy.action_probabilities(inner_observations()).tolist() == [[1, 0]] * 3


def test_bcq_filters_actions_that_are_rare_in_the_log(tmp_path: Path) -> None:
    # The second action has a higher value than the first, but only a tenth of the probability of
    # the first, so BCQ excludes it.
    learner = learner_with_outputs(BCQ, [1.0, 2.0], np.log([10.0, 1.0]).tolist())
    policy = saved_and_loaded(tmp_path, learner)
    assert policy.act(inner_observations()).tolist() == [5, 5, 5]
    assert policy.q_values(inner_observations()).tolist() == [[1, 2]] * 3
    assert policy.action_probabilities(inner_observations()).tolist() == [[1, 0]] * 3


def test_iql_acts_by_its_policy_and_has_values(tmp_path: Path) -> None:
    learner = learner_with_outputs(IQL, np.log([0.75, 0.25]).tolist(), [1.0, 2.0])
    policy = saved_and_loaded(tmp_path, learner)
    assert policy.act(inner_observations()).tolist() == [5, 5, 5]
    assert policy.q_values(inner_observations()).tolist() == [[1, 2]] * 3
    np.testing.assert_allclose(
        policy.action_probabilities(inner_observations()[:1]), [[0.75, 0.25]], rtol=1e-6
    )


@pytest.mark.parametrize(
    "config",
    [
        DQNConfig(**TINY, dueling=True, scale_rewards=True),
        DQNConfig(**TINY, n_quantiles=3, scale_rewards=True),
        DQNConfig(**TINY, layer_norm=True, normalize=True),
    ],
)
def test_every_kind_of_network_can_be_loaded(tmp_path: Path, config: TrainingConfig) -> None:
    learner = learner_of(config, corridor())
    policy = saved_and_loaded(tmp_path, learner)
    with torch.no_grad():
        outputs = learner.network("q", 0)(learner.buffer.encoder.encode(inner_observations()))
    expected = learner.in_reward_units(outputs.mean(2) if outputs.ndim == 3 else outputs)
    np.testing.assert_allclose(policy.q_values(inner_observations()), expected, rtol=1e-4)


def test_normalized_images_can_be_loaded(tmp_path: Path) -> None:
    images = np.random.default_rng(0).integers(90, 110, (9, 36, 36, 1), dtype=np.uint8)
    dataset = Dataset.from_arrays(
        observations=images[:-1],
        actions=np.arange(8) % 2,
        rewards=np.ones(8),
        terminated=np.arange(8) == 7,
        truncated=np.zeros(8, bool),
        next_observations=images[1:],
    )
    learner = learner_of(DQNConfig(**TINY, frame_stack=2, normalize=True), dataset)
    policy = saved_and_loaded(tmp_path, learner)
    stacks = np.stack([images[:-1], images[1:]], 1)
    codes = stacks[..., 0].transpose(0, 2, 3, 1).astype(np.float32)
    mean = images.astype(np.float64).mean(0)
    centered = (codes - mean) / np.sqrt(np.square(images - mean).mean())
    network = learner.network("q", 0)
    convolutions, *layers = cast(torch.nn.Sequential, network.stems[0])
    with torch.no_grad():
        seen = cast(Convolutions, convolutions).layers(
            torch.from_numpy(centered).permute(0, 3, 1, 2).float()
        )
        outputs = network.head(network.body(torch.nn.Sequential(*layers)(seen)))
    expected = learner.in_reward_units(outputs)
    np.testing.assert_allclose(policy.q_values(stacks), expected, rtol=1e-4, atol=1e-5)


def test_masked_actions_are_not_taken(tmp_path: Path) -> None:
    mask = np.array([[1, 1], [1, 0]], np.int8)
    parts = {"action_mask": mask, "x": np.zeros((2, 1), np.float32)}
    dataset = Dataset.from_arrays(
        observations=parts,
        actions=[1, 0],
        rewards=[1, 0],
        terminated=[True, True],
        truncated=[False, False],
        next_observations=parts,
    )
    learner = learner_of(DQNConfig(**{**TINY, "updates": 200}), dataset)
    for _ in range(200):
        learner.update()
    policy = saved_and_loaded(tmp_path, learner)
    assert policy.act(parts).tolist() == [1, 0]
    assert policy.q_values(parts)[1, 1] == -np.inf


def walk_policy(folder: Path, count: int) -> Policy:
    """Return a policy that observes a stack of `count` frames of one number."""
    steps = np.arange(8, dtype=np.float32)[:, None]
    dataset = Dataset.from_arrays(
        observations=steps[:-1],
        actions=np.arange(7) % 2,
        rewards=np.ones(7),
        terminated=np.arange(7) == 6,
        truncated=np.zeros(7, bool),
        next_observations=steps[1:],
    )
    return saved_and_loaded(folder, learner_of(DQNConfig(**TINY, frame_stack=count), dataset))


def test_a_policy_keeps_the_frames_of_its_stack(tmp_path: Path) -> None:
    policy = walk_policy(tmp_path, 3)
    random = np.random.default_rng(0)
    for _ in range(3):
        policy.begin()
        frames = random.normal(0, 5, (6, 4, 1)).astype(np.float32)
        for step in range(6):
            stack = frames[[max(step - 2, 0), max(step - 1, 0), step]].swapaxes(0, 1)
            expected = policy.q_values(stack).argmax(1)
            assert policy.act(frames[step]).tolist() == expected.tolist()
            assert policy.act(stack).tolist() == expected.tolist()


def test_an_environment_may_reuse_the_memory_of_its_observations(tmp_path: Path) -> None:
    policy, memory = walk_policy(tmp_path, 2), np.zeros((500, 1), np.float32)
    frames = np.random.default_rng(0).normal(0, 5, (2, 500, 1)).astype(np.float32)
    for frame in frames:
        memory[:] = frame
        actions = policy.act(memory)
    expected, wrong = (
        policy.q_values(pair.swapaxes(0, 1)).argmax(1) for pair in (frames, frames[[1, 1]])
    )
    assert actions.tolist() == expected.tolist() != wrong.tolist()


def test_values_of_single_frames_are_refused_by_a_stacking_policy(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="has a frame stack of 3"):
        walk_policy(tmp_path, 3).q_values(np.zeros((4, 1), np.float32))


def test_images_are_accepted_as_bytes(tmp_path: Path) -> None:
    images: NDArray[np.uint8] = np.random.default_rng(0).integers(
        0, 256, (6, 36, 40, 1), dtype=np.uint8
    )
    dataset = Dataset.from_arrays(
        observations=images,
        actions=np.arange(6) % 3,
        rewards=np.zeros(6),
        terminated=np.ones(6, bool),
        truncated=np.zeros(6, bool),
        next_observations=images,
    )
    policy = saved_and_loaded(tmp_path, learner_of(BCConfig(**TINY), dataset))
    assert policy.action_probabilities(images).shape == (6, 3)
    np.testing.assert_allclose(
        policy.action_probabilities(images[2:3]),
        policy.action_probabilities(images)[2:3],
        rtol=1e-4,
    )


def test_observations_are_not_modified(tmp_path: Path) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [1.0, 2.0]))
    observations = inner_observations()
    observations.flags.writeable = False
    assert policy.act(observations).tolist() == [6, 6, 6]
    assert policy.act(np.asfortranarray(observations, np.float64)).tolist() == [6, 6, 6]


SINGLES: dict[str, Any] = {
    "vector": np.arange(24, dtype=np.float32).reshape(8, 3),
    "number": np.arange(8, dtype=np.float32),
    "images": np.arange(8 * 36 * 36, dtype=np.uint32).astype(np.uint8).reshape(8, 36, 36, 1),
    "dict": {"x": np.arange(16, dtype=np.float32).reshape(8, 2), "speed": np.arange(8.0)},
}


@pytest.mark.parametrize("kind", SINGLES)
@pytest.mark.parametrize("count", [1, 2])
def test_a_single_observation_has_the_action_of_a_batch_of_one(
    tmp_path: Path, kind: str, count: int
) -> None:
    """Also with a frame stack, whose frames are the same ones."""
    frames = SINGLES[kind]
    dataset = Dataset.from_arrays(
        observations=mapped(lambda part: part[:-1], frames),
        actions=np.arange(7) % 3,
        rewards=np.ones(7),
        terminated=np.arange(7) == 6,
        truncated=np.zeros(7, bool),
        next_observations=mapped(lambda part: part[1:], frames),
    )
    policy = saved_and_loaded(tmp_path, learner_of(BCConfig(**TINY, frame_stack=count), dataset))
    found = []
    for rows in (range(3), [slice(k, k + 1) for k in range(3)]):
        policy.begin()
        found.append([policy.act(mapped(lambda part, k=k: part[k], frames)) for k in rows])
    singles, batches = found
    assert [action.shape for action in singles + batches] == [()] * 3 + [(1,)] * 3
    np.testing.assert_array_equal(singles, np.concatenate(batches))
    if kind == "dict":
        assert policy.act({"x": [1, 2], "speed": 3.0, "more": "unused"}).shape == ()
        with pytest.raises(PolicyError, match=r"expects observations \(B\) of speed, got \(\)"):
            policy.act({"x": frames["x"][:1], "speed": 3.0})


def test_as_many_frames_as_a_stack_are_a_batch(tmp_path: Path) -> None:
    policy, frames = walk_policy(tmp_path, 3), np.array([[1.0], [5.0], [9.0]], np.float32)
    assert policy.act(frames).shape == (3,), "of three environments"
    policy.begin()
    assert policy.act(frames[None]).shape == (1,), "a stack"


@pytest.mark.parametrize("shape", [(3, N_CELLS + 1), (3, 1, N_CELLS), ()])
def test_observations_of_another_shape_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [1.0, 2.0]))
    with pytest.raises(PolicyError, match=r"expects observations \(B, 5\), got"):
        policy.act(np.zeros(shape, np.float32))


def test_a_run_means_its_first_seed(cql_run: Path) -> None:
    both, first = load_policies(cql_run), load_policy(cql_run)
    values = [policy.q_values(inner_observations()) for policy in (*both, first)]
    assert len(both) == 2
    np.testing.assert_array_equal(values[0], values[2])
    assert not np.array_equal(values[0], values[1])
    second = load_policy(cql_run / "seed-1")
    np.testing.assert_array_equal(second.q_values(inner_observations()), values[1])
    assert both[0].name != both[1].name


def test_seeds_are_ordered_as_numbers(tmp_path: Path) -> None:
    for number, best in ((10, [1.0, 0.0]), (9, [0.0, 1.0])):
        folder = tmp_path / f"seed-{number}"
        folder.mkdir()
        save_policy(folder, learner_with_outputs(CQL, best), 0, "", {})
    actions = [policy.act(inner_observations()[:1]).item() for policy in load_policies(tmp_path)]
    assert actions == [6, 5]


@pytest.mark.parametrize("load", [load_policy, load_policies])
def test_a_path_without_a_policy_is_named(tmp_path: Path, load: Any) -> None:
    with pytest.raises(PolicyError, match=f"{tmp_path / 'nowhere'}: no such file or folder"):
        load(tmp_path / "nowhere")
    with pytest.raises(PolicyError, match=f"{tmp_path} has no policy"):
        load(tmp_path)


@pytest.mark.parametrize("name", ["policy.json", "policy.safetensors"])
@pytest.mark.parametrize("content", [b"", b"{}", b"nonsense", b"\xff" * 100, b"null", b"[1]"])
def test_a_broken_file_is_one_line(cql_run: Path, name: str, content: bytes) -> None:
    (cql_run / "seed-0" / name).write_bytes(content)
    with pytest.raises(PolicyError) as caught:
        load_policy(cql_run)
    assert "\n" not in str(caught.value)
    assert str(cql_run / "seed-0") in str(caught.value)


@pytest.mark.parametrize("cut", [1, 8, 100])
def test_weights_cut_short_are_refused(cql_run: Path, cut: int) -> None:
    path = cql_run / "seed-0" / "policy.safetensors"
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(PolicyError, match="seed-0"):
        load_policy(cql_run)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("format_version", 99),
        ("architecture", {"hidden": [16, 9]}),
        ("architecture", "wide"),
        ("acts_by", "wishes"),
        ("outputs", {"q": [3]}),
        ("action_space", {"type": "Box", "low": 0, "high": 1, "shape": [2], "dtype": "float32"}),
        ("observation_space", {"type": "Cupboard"}),
    ],
)
def test_a_description_that_does_not_fit_is_refused(cql_run: Path, key: str, value: Any) -> None:
    path = cql_run / "seed-0" / "policy.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(PolicyError, match="seed-0"):
        load_policy(cql_run)


class Bomb:
    """Calls a function when it is unpickled."""

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return (pytest.fail, ("a policy file was unpickled",))


def test_nothing_is_unpickled(cql_run: Path) -> None:
    (cql_run / "seed-0" / "policy.safetensors").write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(PolicyError):
        load_policy(cql_run)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("frame_stack", 10**9),
        ("observation_space", {"type": "MultiBinary", "n": 3 * 10**8}),
        ("action_space", {"type": "Discrete", "n": 10**12, "start": 0}),
        ("architecture", {"hidden": [10**9]}),
        ("architecture", {"hidden": [16, 10**5, 10**5]}),
        ("outputs", {"q": [10**9]}),
    ],
)
def test_sizes_are_refused_before_memory_is_taken(cql_run: Path, key: str, value: Any) -> None:
    path = cql_run / "seed-0" / "policy.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    tracemalloc.start()
    try:
        with pytest.raises(PolicyError) as error:
            read_policy(path.parent)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()
    assert "\n" not in str(error.value)


def test_deep_json_is_refused(cql_run: Path) -> None:
    (cql_run / "seed-0" / "policy.json").write_text("[" * 100_000 + "]" * 100_000)
    with pytest.raises(PolicyError, match="nested"):
        read_policy(cql_run / "seed-0")


def test_curves_of_a_removed_run_are_one_clear_error(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    with pytest.raises(ReportError, match="was the folder removed"):
        draw_curves(tmp_path / "removed")

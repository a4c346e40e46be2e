"""Saved policies: a round trip through files, and files that are not one."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import PolicyError
from mcaprl.offline.bc import BC, BCConfig
from mcaprl.offline.buffer import TransitionBuffer
from mcaprl.offline.cql import CQL, CQLConfig
from mcaprl.offline.learner import Learner
from mcaprl.offline.policy import Policy, load_policies, load_policy, save_policy
from mcaprl.offline.train import train
from mcaprl.recorder.dataset import Dataset
from tests.offline_tasks import ACTION_SPACE, N_CELLS, corridor, inner_observations

TINY: dict[str, Any] = {"updates": 20, "batch_size": 16, "hidden": (16, 8)}


@pytest.fixture
def cql_run(tmp_path: Path) -> Path:
    train(corridor(), CQLConfig(**TINY), tmp_path / "run", seeds=2, progress=lambda _: None)
    return tmp_path / "run"


def learner_with_outputs(learner_type: type[Learner], outputs: list[float]) -> Learner:
    """A learner whose network gives the same outputs for whatever it sees."""
    config = learner_type.config_type(**{**TINY, "hidden": ()})
    learner = learner_type(config, TransitionBuffer.from_dataset(corridor()), 0)
    linear = [module for module in learner.network.modules() if isinstance(module, torch.nn.Linear)]
    with torch.no_grad():
        linear[-1].weight.zero_()
        linear[-1].bias.copy_(torch.tensor(outputs))
    return learner


def saved_and_loaded(folder: Path, learner: Learner) -> Policy:
    save_policy(folder, learner, "Corridor-v0", {"length": 5})
    return load_policy(folder)


def test_a_loaded_policy_gives_the_values_of_the_network_that_was_saved(tmp_path: Path) -> None:
    learner = CQL(CQLConfig(**TINY), TransitionBuffer.from_dataset(corridor()), 0)
    policy = saved_and_loaded(tmp_path, learner)
    with torch.no_grad():
        expected = learner.network(torch.from_numpy(inner_observations())).numpy()
    np.testing.assert_array_equal(policy.q_values(inner_observations()), expected)


def test_a_policy_knows_its_task(tmp_path: Path) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [1.0, 2.0]))
    assert (policy.algo, policy.env_id) == ("cql", "Corridor-v0")
    assert policy.env_kwargs == {"length": 5}
    assert policy.action_space == ACTION_SPACE
    assert policy.observation_space == spaces.Box(0, 1, (N_CELLS,), np.float32)


def test_actions_are_those_of_the_space_and_greedy(tmp_path: Path) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [1.0, 2.0]))
    actions = policy.act(inner_observations())
    assert actions.dtype == np.int64
    assert actions.tolist() == [6, 6, 6]
    assert policy.action_probabilities(inner_observations()).tolist() == [[0, 1]] * 3


def test_of_equal_values_the_first_is_chosen(tmp_path: Path) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [2.0, 2.0]))
    assert policy.act(inner_observations()).tolist() == [5, 5, 5]
    assert policy.action_probabilities(inner_observations()).tolist() == [[1, 0]] * 3


def test_a_clone_gives_the_probabilities_it_learned_and_no_values(tmp_path: Path) -> None:
    logits = np.log([0.25, 0.75]).tolist()
    policy = saved_and_loaded(tmp_path, learner_with_outputs(BC, logits))
    assert policy.act(inner_observations()[:1]).tolist() == [6]
    np.testing.assert_allclose(
        policy.action_probabilities(inner_observations()[:1]), [[0.25, 0.75]], rtol=1e-6
    )
    with pytest.raises(PolicyError, match="no Q-values"):
        policy.q_values(inner_observations())


def test_probabilities_of_huge_logits_are_finite(tmp_path: Path) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(BC, [1e4, -1e4]))
    assert policy.action_probabilities(inner_observations()).tolist() == [[1, 0]] * 3


def test_images_are_taken_as_bytes(tmp_path: Path) -> None:
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
    learner = BC(BCConfig(**TINY), TransitionBuffer.from_dataset(dataset), 0)
    policy = saved_and_loaded(tmp_path, learner)
    assert policy.action_probabilities(images).shape == (6, 3)
    np.testing.assert_allclose(
        policy.action_probabilities(images[2:3]),
        policy.action_probabilities(images)[2:3],
        rtol=1e-4,
    )


def test_observations_are_only_read(tmp_path: Path) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [1.0, 2.0]))
    observations = inner_observations()
    observations.flags.writeable = False
    assert policy.act(observations).tolist() == [6, 6, 6]
    assert policy.act(np.asfortranarray(observations, np.float64)).tolist() == [6, 6, 6]


@pytest.mark.parametrize("shape", [(N_CELLS,), (3, N_CELLS + 1), (3, 1, N_CELLS), ()])
def test_observations_of_another_shape_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    policy = saved_and_loaded(tmp_path, learner_with_outputs(CQL, [1.0, 2.0]))
    with pytest.raises(PolicyError, match=r"takes observations \(B, 5\), got"):
        policy.act(np.zeros(shape, np.float32))


def test_a_run_stands_for_its_first_seed(cql_run: Path) -> None:
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
        save_policy(folder, learner_with_outputs(CQL, best), "", {})
    actions = [policy.act(inner_observations()[:1]).item() for policy in load_policies(tmp_path)]
    assert actions == [6, 5]


@pytest.mark.parametrize("load", [load_policy, load_policies])
def test_a_path_without_a_policy_is_named(tmp_path: Path, load: Any) -> None:
    with pytest.raises(PolicyError, match=f"{tmp_path / 'nowhere'} has no policy"):
        load(tmp_path / "nowhere")


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
        ("hidden", [16, 9]),
        ("hidden", "wide"),
        ("outputs", "wishes"),
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

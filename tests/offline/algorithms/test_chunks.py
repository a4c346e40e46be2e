"""Behavior cloning of chunks of actions: targets, losses, policies, and where they act."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

import mcaprl
from mcaprl.chunks import Chunks, planned
from mcaprl.errors import PolicyError, SpaceError, UsageError
from mcaprl.offline.algorithms.config import BCConfig, BoxBCConfig, TrainingConfig
from mcaprl.offline.algorithms.registry import choose_algorithm
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.policy import Policy, read_policy, save_policy
from mcaprl.offline.training.train import train
from mcaprl.recorder.dataset.dataset import Dataset

TINY: dict[str, Any] = {"updates": 4, "batch_size": 8, "hidden": (8,)}
FAST: dict[str, Any] = {
    "updates": 300,
    "batch_size": 64,
    "learning_rate": 1e-2,
    "hidden": (32, 32),
    "held_out": 0.0,
}


def episodes_of(
    observations: list[Any],
    actions: list[Any],
    action_space: spaces.Space[Any] | None = None,
) -> Dataset:
    """Return one truncated episode for each list of T observations and T actions."""
    lengths = [len(each) for each in actions]
    seen = np.concatenate([np.asarray(each) for each in observations])
    taken = np.concatenate([np.asarray(each) for each in actions])
    images = seen.dtype == np.uint8
    ends = np.zeros(len(taken), bool)
    ends[np.cumsum(lengths) - 1] = True
    return Dataset.from_arrays(
        observations=seen,
        next_observations=np.concatenate(
            [np.concatenate([each[1:], each[-1:]]) for each in map(np.asarray, observations)]
        ),
        actions=taken,
        rewards=np.ones(len(taken)),
        terminated=np.zeros(len(taken), bool),
        truncated=ends,
        observation_space=spaces.Box(0, 255, seen.shape[1:], np.uint8)
        if images
        else spaces.Box(-200, 200, seen.shape[1:], np.float32),
        action_space=action_space or spaces.Box(-10, 10, taken.shape[1:], np.float32),
    )


def numbered(*lengths: int) -> Dataset:
    """Return episodes in which the action of row r is (r, -r), and the observation is r."""
    rows = np.arange(sum(lengths), dtype=np.float32)
    parts = np.split(rows, np.cumsum(lengths)[:-1])
    return episodes_of(
        [part[:, None] for part in parts],
        [np.stack([part, -part], 1) for part in parts],
        spaces.Box(-200, 200, (2,), np.float32),
    )


def learner_of(config: TrainingConfig, dataset: Dataset, *seeds: int) -> Any:
    buffer = TransitionBuffer.from_dataset(dataset, config.packing)
    return choose_algorithm(config).learner_type(config, buffer, seeds or (0,))


def trained(config: TrainingConfig, dataset: Dataset, folder: Path) -> Policy:
    learner = learner_of(config, dataset)
    while learner.step < config.updates:
        learner.update()
    save_policy(folder, learner, 0, "", {})
    return read_policy(folder)


def test_chunks_end_with_their_episode() -> None:
    buffer = TransitionBuffer.from_dataset(numbered(3, 2), BCConfig(chunk=3).packing)
    actions, exist = buffer.chunks(torch.tensor([0, 1, 2, 3, 4]))
    rows = (actions[:, :, 0] * 200).round().int()
    assert rows.tolist() == [[0, 1, 2], [1, 2, 2], [2, 2, 2], [3, 4, 4], [4, 4, 4]]
    assert torch.equal(actions[:, :, 1], -actions[:, :, 0])
    t, f = True, False
    assert exist.tolist() == [[t, t, t], [t, t, f], [t, f, f], [t, t, f], [t, f, f]]


@pytest.mark.parametrize("head", ["deterministic", "gaussian", "mixture"])
def test_losses_leave_padding_out(head: str) -> None:
    learner = learner_of(BoxBCConfig(**TINY, head=head, chunk=3), numbered(3, 2))
    batch = learner.buffer.batch(torch.arange(5))
    terms = learner.losses(batch)
    (network,) = learner.models["actor"].networks
    with torch.no_grad():
        outputs = network(batch.observations)
    for row, count in enumerate([3, 2, 1, 2, 1]):
        wanted = learner.buffer.actions[row : row + count].flatten()
        # The first numbers of the outputs are those of the first actions.
        best = learner.head.best(outputs[row : row + 1])[0, : len(wanted)]
        torch.testing.assert_close(terms["action_error"][row], (best - wanted).abs().mean())
        if head == "deterministic":
            loss = (best - wanted).square().sum() / 6
        elif head == "gaussian":
            part = outputs[row : row + 1, :, : len(wanted)]
            loss = -learner.head.log_density(part, wanted[None])[0]
        else:
            weights, rest = outputs[row, :5], outputs[row, 5:].view(5, 2, 6)[:, :, : len(wanted)]
            part = torch.cat([weights, rest.flatten()])[None]
            loss = -learner.head.log_density(part, wanted[None])[0]
        torch.testing.assert_close(terms["loss"][row], loss)


def test_the_loss_of_classes_leaves_padding_out() -> None:
    data = episodes_of([np.zeros((3, 1), np.float32)], [np.array([2, 0, 1])], spaces.Discrete(3))
    learner = learner_of(BCConfig(**TINY, chunk=2), data)
    batch = learner.buffer.batch(torch.arange(3))
    terms = learner.losses(batch)
    with torch.no_grad():
        logs = learner.models["logits"].networks[0](batch.observations).log_softmax(2)
    wanted = torch.stack(
        [-logs[0, 0, 2] - logs[0, 1, 0], -logs[1, 0, 0] - logs[1, 1, 1], logs[2, 0, 1] * -1]
    )
    torch.testing.assert_close(terms["loss"], wanted)


def phases(head: str | None) -> Dataset:
    """Return episodes of a wave whose phase is observed; the actions follow from it."""
    observations, actions = [], []
    for start in range(40):
        phase = 0.3 * (start + np.arange(20))
        observations.append(np.stack([np.sin(phase), np.cos(phase)], 1).astype(np.float32))
        actions.append(8 * np.sin(phase)[:, None].astype(np.float32))
    if head is None:
        numbers = [(each[:, 0] > 0).astype(np.int64) + 1 for each in actions]
        return episodes_of(observations, numbers, spaces.Discrete(2, start=1))
    return episodes_of(observations, actions)


@pytest.mark.parametrize("head", ["deterministic", "gaussian", "mixture", None])
def test_the_next_actions_are_learned(head: str | None, tmp_path: Path) -> None:
    config = BCConfig(**FAST, chunk=4) if head is None else BoxBCConfig(**FAST, head=head, chunk=4)
    policy = trained(config, phases(head), tmp_path)
    assert policy.chunk == Chunks(4, 2)
    now = np.linspace(0, 6, 25)
    chunks = policy.act_chunk(np.stack([np.sin(now), np.cos(now)], 1))
    waves = np.sin(now[:, None] + 0.3 * np.arange(4))
    if head is None:
        is_clear = np.abs(waves) > 0.2
        assert chunks.shape == (25, 4)
        assert np.array_equal(chunks[is_clear], (waves > 0)[is_clear] + 1)
    else:
        assert chunks.shape == (25, 4, 1)
        assert chunks.dtype == np.float32
        np.testing.assert_allclose(chunks[:, :, 0], 8 * waves, atol=0.8)


def two_ways() -> Dataset:
    """Return episodes of 4 steps that are to the left or to the right, from the same state."""
    ways = [5.0 if k % 2 else -5.0 for k in range(60)]
    seen = np.zeros((4, 1), np.float32)
    seen[1:] = 1
    return episodes_of([seen] * 60, [np.full((4, 1), way, np.float32) for way in ways])


def test_a_mixture_commits_to_one_way_for_the_whole_chunk(tmp_path: Path) -> None:
    chunk: dict[str, Any] = {**FAST, "chunk": 4, "execute": 4}
    start = np.zeros((1, 1), np.float32)
    mixture = trained(BoxBCConfig(**chunk, head="mixture"), two_ways(), tmp_path / "a")
    (found,) = mixture.act_chunk(start)
    assert np.abs(np.abs(found) - 5).max() < 0.5
    assert len(np.unique(np.sign(found))) == 1
    mean = trained(BoxBCConfig(**chunk), two_ways(), tmp_path / "b")
    assert np.abs(mean.act_chunk(start)).max() < 2


def test_images_have_chunks(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    images = [random.integers(0, 256, (6, 36, 40, 1), np.uint8) for _ in range(3)]
    data = episodes_of(images, [random.uniform(-1, 1, (6, 2)).astype(np.float32)] * 3)
    config = BoxBCConfig(**TINY, encoder="compact", frame_stack=2, chunk=3, head="gaussian")
    policy = trained(config, data, tmp_path)
    chunks = [policy.act_chunk(np.repeat(images[0][:1, None], 2, 1))]
    assert chunks[0].shape == (1, 3, 2)
    assert np.array_equal(policy.act(images[0][:1]), chunks[0][:, 0])
    assert np.array_equal(policy.act(images[0][1:2]), chunks[0][:, 1])
    # The frame of a step without a prediction is in the stack of the next one.
    third = policy.act_chunk(images[0][None, 1:3])
    assert np.array_equal(policy.act(images[0][2:3]), third[:, 0])


def test_episodes_of_a_batch_begin_at_other_times(tmp_path: Path) -> None:
    data = numbered(*[6] * 5)
    policy = trained(BoxBCConfig(**TINY, chunk=4, execute=3, frame_stack=2), data, tmp_path)
    random = np.random.default_rng(1)
    seen = random.uniform(0, 30, (9, 2, 1)).astype(np.float32)
    policy.begin()
    together = []
    for step in range(9):
        if step == 4:
            policy.begin([1])
        together.append(policy.act(seen[step]))
    for row, starts in ((0, [0, 9]), (1, [0, 4, 9])):
        for first, last in itertools.pairwise(starts):
            policy.begin()
            alone = [policy.act(seen[step, row : row + 1])[0] for step in range(first, last)]
            np.testing.assert_allclose(np.stack(together)[first:last, row], alone, rtol=1e-5)
    again = policy.act_chunk(np.stack([seen[0], seen[1]], 1))
    policy.begin()
    policy.act(seen[0])
    policy.interrupt()
    np.testing.assert_array_equal(policy.act(seen[1]), again[:, 0])


def test_a_resumed_run_has_the_same_bits(tmp_path: Path) -> None:
    data, once, parts = numbered(*[9] * 12), tmp_path / "once", tmp_path / "parts"
    settings: dict[str, Any] = {**TINY, "final_learning_rate_fraction": 1.0, "chunk": 5}

    def config(updates: int) -> BoxBCConfig:
        return BoxBCConfig(**{**settings, "updates": updates}, head="gaussian", ensemble=True)

    train(data, config(20), once, seeds=2)
    train(data, config(10), parts, seeds=2)
    train(data, config(20), parts, resume=True)
    for seed in ("seed-0", "seed-1"):
        one, other = (each / seed / "policy.safetensors" for each in (once, parts))
        assert one.read_bytes() == other.read_bytes()
    assert read_policy(once / "seed-1").chunk == Chunks(5, 1, 0.01)


def test_the_file_of_a_policy_with_chunks(tmp_path: Path) -> None:
    trained(BoxBCConfig(**TINY, chunk=4, execute=3), numbered(6, 6), tmp_path)
    path = tmp_path / "policy.json"
    found = json.loads(path.read_text())
    assert found["format_version"] == 3
    assert found["chunk"] == {"length": 4, "execute": 3, "ensemble": None}
    for wrong in ({"length": 4, "execute": 9}, {"length": "x"}, {"length": 2, "steps": 1}):
        path.write_text(json.dumps({**found, "chunk": wrong}))
        with pytest.raises(PolicyError, match="cannot load the policy"):
            read_policy(tmp_path)
    trained(BoxBCConfig(**TINY), numbered(6, 6), tmp_path / "plain")
    plain = json.loads((tmp_path / "plain/policy.json").read_text())
    assert plain["format_version"] == 2
    assert "chunk" not in plain


def test_what_chunks_do_not_have(tmp_path: Path) -> None:
    data = numbered(6, 6, 6)
    policy = trained(BoxBCConfig(**TINY, head="gaussian", chunk=4), data, tmp_path / "box")
    with pytest.raises(
        PolicyError, match="predicts chunks of 4 actions, of which 2 are executed: an"
    ):
        policy.log_prob(data.observations, data.actions)
    averaged = policy.with_execution(ensemble=0.01)
    with pytest.raises(PolicyError, match=r"chunks of 4 actions, averaged with m = 0\.01"):
        averaged.action_values(data.observations, data.actions)
    with pytest.raises(PolicyError, match="cannot execute 5 actions of chunks of 4"):
        policy.with_execution(execute=5)
    with pytest.raises(PolicyError, match="pass either"):
        policy.with_execution()
    numbers = trained(BCConfig(**TINY, chunk=2), phases(None), tmp_path / "numbers")
    with pytest.raises(PolicyError, match=r"actions of Discrete\(2, start=1\) have no average"):
        numbers.with_execution(ensemble=0.0)
    with pytest.raises(PolicyError, match="an action has no probability"):
        numbers.action_probabilities(np.zeros((1, 2)))
    settings: list[tuple[dict[str, Any], str]] = [
        ({"chunk": 0}, r"chunk must be within \[1, 1000\]"),
        ({"chunk": 4, "execute": 5}, r"execute must be within \[0, 4\], got 5"),
        ({"chunk": 4, "execute": 2, "ensemble": True}, "execute must be 1 with an ensemble"),
    ]
    for wrong, text in settings:
        with pytest.raises(UsageError, match=text):
            BoxBCConfig(**wrong)
    mask = {"x": np.zeros((6, 1), np.float32), "action_mask": np.ones((6, 3), np.int8)}
    masked = Dataset.from_arrays(
        observations=mask,
        next_observations=mask,
        truncated=np.zeros(6, bool),
        actions=np.zeros(6, int),
        rewards=np.zeros(6),
        terminated=np.arange(6) == 5,
        observation_space=spaces.Dict(
            {"x": spaces.Box(-1, 1, (1,)), "action_mask": spaces.MultiBinary(3)}
        ),
        action_space=spaces.Discrete(3),
    )
    with pytest.raises(SpaceError, match="a chunk of actions needs the masks of the next steps"):
        learner_of(BCConfig(**TINY, chunk=2), masked)


SIM: dict[str, Any] = {"sim": "lane", "actions": "continuous"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return a run with chunks in the lane sim."""
    folder = tmp_path_factory.mktemp("chunks")
    log = folder / "log.mcap"
    mcaprl.record(**SIM, out=log, policy="pilot", noise=0.1, steps=150)
    settings: Any = {**TINY, "updates": 300, "chunk": 6, "execute": 4}
    return mcaprl.train(log, folder / "run", algo="bc", **settings)


def executed(policy: Policy, observations: NDArray[Any]) -> NDArray[Any]:
    """Return what a policy commands in an episode, written out."""
    found = []
    for step in range(len(observations)):
        first = step - step % policy.chunk.execute
        if policy.chunk.ensemble is not None:
            rows = range(max(0, step - policy.chunk.length + 1), step + 1)
            each = [policy.act_chunk(observations[k : k + 1])[0, step - k] for k in rows]
            weights = np.exp(-policy.chunk.ensemble * np.arange(len(each)))
            found.append(np.average(np.array(each, np.float64), 0, weights))
        else:
            found.append(policy.act_chunk(observations[first : first + 1])[0, step - first])
    return np.array(found)


@pytest.mark.parametrize("ensemble", [None, 0.5])
def test_chunks_are_executed_alike_everywhere(
    run: Any, ensemble: float | None, tmp_path: Path
) -> None:
    policy = run.policy if ensemble is None else run.policy.with_execution(ensemble=ensemble)
    log = tmp_path / "drive.mcap"
    mcaprl.record(**SIM, out=log, policy=policy, steps=60, seed=1_000_000)
    data = mcaprl.open(log)
    for episode in data.episodes:
        wanted = executed(policy, episode.observations)
        np.testing.assert_allclose(episode.actions, wanted, atol=1e-6)
        own = planned(policy.chunk, policy.act_chunk(episode.observations))
        np.testing.assert_allclose(episode.actions, own, atol=1e-5)
    # Evaluation runs all episodes at the same time, in a batch of environments.
    batched = mcaprl.evaluate(policy, **SIM, episodes=2).policies[0]
    single = mcaprl.evaluate(policy, **SIM, episodes=2, record=tmp_path / "own.mcap").policies[0]
    np.testing.assert_allclose(batched.mean_return, single.mean_return, rtol=1e-3)


def test_annotations_show_what_is_executed(run: Any, tmp_path: Path) -> None:
    log, out = tmp_path / "drive.mcap", tmp_path / "out.mcap"
    mcaprl.record(**SIM, out=log, policy=run.policy, steps=60)
    mcaprl.annotate(log, out, policy=run)
    from mcaprl.offline.estimate.values import value_columns

    for episode in mcaprl.open(log).episodes:
        found = value_columns(run.policy, episode, run.policy.action_space, 0.9)
        np.testing.assert_allclose(found["difference"], 0, atol=1e-5)
        assert np.isnan(found["q"]).all()


def test_values_of_chunks_are_refused(tmp_path: Path) -> None:
    data = numbered(*[6] * 6)
    for execute in (2, 1):
        train(data, BoxBCConfig(**TINY, chunk=3, execute=execute), tmp_path / str(execute))
    with pytest.raises(PolicyError, match=r"2 predicts chunks of 3 actions, of which 2 are exec"):
        mcaprl.estimate(tmp_path / "2", data, updates=1)
    # With one action of each chunk, an action depends on the state alone.
    assert not read_policy(tmp_path / "1/seed-0").chunk.has_memory
    assert mcaprl.estimate(tmp_path / "1", data, updates=2).estimates

"""Tests of frame stacking in training, in policy files and in loaded policies."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import DQN

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import PolicyError
from mcaprl.frames import FrameStack, frame_rows, joined, stacked_frames, stacked_space
from mcaprl.offline.algorithms.config import CQLConfig
from mcaprl.offline.training.train import train as train_offline
from mcaprl.online.learning import LearningAgent
from mcaprl.online.sb3 import BatchedVecEnv, StackedVecEnv
from mcaprl.online.task import Task
from mcaprl.online.train import train
from mcaprl.progress import TrainingProgress
from mcaprl.sims.evaluation.evaluate import Scale
from mcaprl.sims.evaluation.rollout import EpsilonGreedy, rollout

SHORT: dict[str, Any] = {
    "steps": 120,
    "envs": 4,
    "hidden": (8,),
    "frame_stack": 3,
    "learning_starts": 20,
    "target_update_interval": 40,
    "eval_interval": 60,
    "eval_episodes": 2,
    "final_episodes": 2,
    "checkpoint_interval": 60,
}


def silent(_: TrainingProgress) -> None:
    """A progress callback that does nothing."""


def test_stacks_end_with_the_newest_frame_and_repeat_the_first() -> None:
    stack, space = FrameStack(3), spaces.Box(0, 9, (2,))
    assert joined(stack.see({"": np.array([[1, 2], [5, 6]])})[""], space).tolist() == [
        [1, 2, 1, 2, 1, 2],
        [5, 6, 5, 6, 5, 6],
    ]
    assert joined(stack.see({"": np.array([[3, 4], [7, 8]])})[""], space).tolist() == [
        [1, 2, 1, 2, 3, 4],
        [5, 6, 5, 6, 7, 8],
    ]
    assert stack.ending(1, {"": np.array([9, 9])})[""].tolist() == [[[5, 6], [5, 6], [9, 9]]]
    stack.begin_one(1)
    assert joined(stack.frames[""], space).tolist() == [[1, 2, 1, 2, 3, 4], [7, 8, 7, 8, 7, 8]]
    assert stack.see({"": np.array([[8, 9]])})[""].tolist() == [[[8, 9]] * 3]


def test_rows_of_stacks_stay_within_their_episode() -> None:
    """Episodes begin at the rows 0 and 4."""
    arguments = np.array([1, 4, 6]), np.array([0, 4, 4]), np.array([2, 1, 0])
    expected = [[0, 0, 1], [4, 4, 4], [4, 5, 6]]
    assert frame_rows(*arguments).tolist() == expected
    assert frame_rows(*map(torch.from_numpy, arguments)).tolist() == expected
    frames = {"x": np.array([7, 8])}
    assert stacked_frames(frames, 3)["x"].tolist() == [[7, 7, 7], [7, 7, 8]]
    assert stacked_frames(frames, 1) is frames


@pytest.mark.parametrize(
    ("shape", "stacked"), [((84, 84, 1), (84, 84, 3)), ((1, 84, 84), (3, 84, 84))]
)
def test_images_are_stacked_along_their_channels(
    shape: tuple[int, ...], stacked: tuple[int, ...]
) -> None:
    space = spaces.Box(0, 255, shape, np.uint8)
    assert stacked_space(space, 3).shape == stacked
    frames = np.arange(3, dtype=np.uint8).reshape(1, 3, 1, 1, 1) * np.ones((1, 3, *shape), np.uint8)
    found = joined(frames, space)
    assert found.shape == (1, *stacked)
    axis = stacked.index(3)
    for k in range(3):
        assert (np.take(found[0], k, axis) == k).all()


def test_stacks_are_reset_at_each_environments_episode() -> None:
    """The newest frame is the current observation; earlier frames are earlier observations."""
    batch = Task.for_sim("lane").batch(3)
    with closing(StackedVecEnv(BatchedVecEnv(batch), 2)) as env:
        env.seed(0)
        before: Any = env.reset()
        assert before.shape == (3, 24)
        random, ends = np.random.default_rng(0), 0
        for _ in range(60):
            now, _, dones, infos = env.step(random.integers(6, size=3))
            now = np.asarray(now)
            for row in range(3):
                if dones[row]:
                    ends += 1
                    last = infos[row]["terminal_observation"]
                    np.testing.assert_array_equal(last[:12], before[row, 12:])
                    np.testing.assert_array_equal(now[row, :12], now[row, 12:])
                else:
                    np.testing.assert_array_equal(now[row, :12], before[row, 12:])
            before = now
    assert ends > 3


def test_a_stacking_policy_acts_outside_as_it_does_in_training(tmp_path: Path) -> None:
    """`evaluate` stacks frames in the policy; training stacks them in the replay buffer."""
    task = Task.for_sim("lane", **SHORT)
    (summary,) = train(task, tmp_path / "run", record=tmp_path / "log.mcap", progress=silent)
    policy = mcaprl.load_policy(summary.folder)
    assert policy.frame_stack == 3
    log = mcaprl.open(summary.folder / "evaluations" / f"step-{summary.best_step:09d}.mcap")
    for episode in log.episodes:
        policy.begin()
        acted = [int(policy.act(seen[None])[0]) for seen in episode.observations]
        assert acted == episode.actions.tolist()
    assert mcaprl.open(tmp_path / "log.mcap").observation_space.shape == (12,)


def test_the_commands_accept_a_stacking_policy(tmp_path: Path) -> None:
    (summary,) = train(Task.for_sim("lane", **SHORT), tmp_path / "run", progress=silent)
    path, log = str(summary.folder), str(tmp_path / "log.mcap")
    assert run(["record", "lane", "--policy", path, "--episodes", "2", "--out", log]) == 0
    out = tmp_path / "annotated.mcap"
    assert run(["annotate", log, "--policy", path, "--out", str(out)]) == 0
    dataset, policy = mcaprl.open(log), mcaprl.load_policy(path)
    episode = dataset.episodes[0]
    rows = np.maximum(np.arange(episode.length)[:, None] - [2, 1, 0], 0)
    values = policy.q_values(episode.observations[rows])
    assert values.argmax(1).tolist() == episode.actions.tolist()


def test_a_stacking_offline_policy_initializes_an_agent(tmp_path: Path) -> None:
    env = mcaprl.RecordMcap(mcaprl.sims.make_sim("lane"), tmp_path / "log.mcap", scene=False)
    rollout(env, EpsilonGreedy(None, 1.0, env.action_space), seed=0, steps=300)
    env.close()
    config = CQLConfig(updates=20, hidden=(8,), frame_stack=3, gamma=0.5, target_interval=2)
    train_offline(mcaprl.open(tmp_path / "log.mcap"), config, tmp_path / "cql", progress=silent)
    policy = mcaprl.load_policy(tmp_path / "cql")
    stacks = np.random.default_rng(0).normal(size=(5, 3, 12)).astype(np.float32)
    with closing(agent(tmp_path)) as begun:
        begun.start_from(mcaprl.open(tmp_path / "log.mcap"), policy)
        np.testing.assert_array_equal(begun.policy.q_values(stacks), policy.q_values(stacks))
        assert begun.agents.buffer.frames.vector.shape[1:] == (12,)
    with (
        closing(agent(tmp_path, frame_stack=1)) as other,
        pytest.raises(PolicyError, match=r"stacks 3 observations.*`frame_stack=3`"),
    ):
        other.start_from(None, policy)


def agent(folder: Path, **settings: Any) -> LearningAgent:
    (folder / "seed-0").mkdir(exist_ok=True)
    task = Task.for_sim("lane", **{**SHORT, **settings})
    return LearningAgent(task, "mcaprl/LaneKeeping-v0", folder / "seed-0", 0, Scale(0.0, 1.0))


def test_a_stacking_model_of_sb3_is_trained_and_read(tmp_path: Path) -> None:
    (summary,) = train(Task.for_sim("lane", "dqn", **SHORT), tmp_path / "run", progress=silent)
    model = DQN.load(summary.folder / "best_model.zip")
    assert model.observation_space.shape == (36,)
    policy = mcaprl.load_policy(summary.folder)
    stacks = np.random.default_rng(0).normal(size=(5, 3, 12)).astype(np.float32)
    acted = model.predict(stacks.reshape(5, 36), deterministic=True)[0]
    np.testing.assert_array_equal(policy.act(stacks), acted)

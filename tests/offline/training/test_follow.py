"""Tests of training on a log that another process is still writing."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError
from mcaprl.offline.algorithms.config import CQLConfig
from mcaprl.offline.algorithms.cql import CQL
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.training.train import CHECK_INTERVAL, train, with_more_data
from mcaprl.progress import TrainingProgress
from mcaprl.recorder.dataset.open import GrowingLogs
from mcaprl.runs import read_curve
from mcaprl.sims.evaluation.rollout import EpsilonGreedy, run_episode
from tests.support.paths import ROOT

SMALL = CQLConfig(
    updates=2 * CHECK_INTERVAL, hidden=(8,), batch_size=8, log_interval=100, target_interval=5
)


class Recorder:
    """A recorder of random episodes into one log."""

    def __init__(self, path: Path, env: gym.Env[Any, Any] | None = None) -> None:
        self.env = mcaprl.RecordMcap(env or gym.make("CartPole-v1"), path)
        self.behavior = EpsilonGreedy(None, 1.0, self.env.action_space)
        self.seed = 0

    def record(self, episodes: int) -> None:
        for _ in range(episodes):
            run_episode(self.env, self.behavior, seed=self.seed)
            self.seed += 1


def grows(logs: GrowingLogs) -> bool:
    before = logs.dataset
    return logs.grow() is not before


def test_each_finished_episode_is_read_once(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "log.mcap")
    recorder.record(2)
    recorder.env.reset(seed=99)
    recorder.env.step(0)
    logs = GrowingLogs([tmp_path / "log.mcap"])
    assert len(logs.dataset.episodes) == 2
    assert not grows(logs)
    recorder.record(3)
    assert grows(logs)
    assert not grows(logs)
    recorder.env.close()
    # Closing adds no episode: the first reset of `record` had ended the episode of seed 99.
    assert not grows(logs)
    whole = mcaprl.open(tmp_path / "log.mcap")
    assert [len(e.rewards) for e in logs.dataset.episodes] == [
        len(e.rewards) for e in whole.episodes
    ]
    np.testing.assert_array_equal(logs.dataset.observations, whole.observations)
    np.testing.assert_array_equal(logs.dataset.next_observations, whole.next_observations)


def test_a_compacted_log_is_not_read_twice(tmp_path: Path) -> None:
    """Closing a recorder replaces its log with a smaller file that has the same episodes."""
    path = tmp_path / "log.mcap"
    recorder = Recorder(path)
    recorder.record(6)
    logs = GrowingLogs([path])
    before = path.stat().st_ino
    recorder.record(3)
    recorder.env.close()
    assert path.stat().st_ino != before
    assert grows(logs)
    assert not grows(logs)
    whole = mcaprl.open(path)
    assert len(whole.episodes) == 9
    np.testing.assert_array_equal(logs.dataset.observations, whole.observations)
    # A file that is replaced is noticed even if its size is the same.
    copy = path.with_name("copy")
    copy.write_bytes(path.read_bytes())
    logs._counts[path], logs._ends_ns[path] = 8, whole.episodes[7].summary.end_time_ns
    copy.replace(path)
    assert grows(logs)


def test_a_replaced_log_is_an_error(tmp_path: Path) -> None:
    path, other = tmp_path / "log.mcap", tmp_path / "other.mcap"
    recorder = Recorder(path)
    recorder.record(3)
    recorder.env.close()
    logs = GrowingLogs([path])
    for episodes in (2, 6):
        another = Recorder(other)
        another.record(episodes)
        another.env.close()
        other.replace(path)
        with pytest.raises(LogError, match="was replaced by another log during the training"):
            logs.grow()


def test_new_files_are_read(tmp_path: Path) -> None:
    first = Recorder(tmp_path / "b.mcap")
    first.record(1)
    logs = GrowingLogs([tmp_path])
    before = logs.dataset.rewards.sum()
    second = Recorder(tmp_path / "a.mcap")
    assert not grows(logs)
    second.record(2)
    first.record(1)
    assert grows(logs)
    assert len(logs.dataset.episodes) == 4
    # Episodes read earlier keep their numbers.
    assert logs.dataset.episodes[0].rewards.sum() == before
    first.env.close()
    second.env.close()


def test_waiting_ends_after_the_timeout(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"no episode was finished in .*none"):
        GrowingLogs([tmp_path / "none.mcap"], patience_s=0.0)


def test_a_learner_continues_with_the_same_state(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "log.mcap")
    recorder.record(12)
    logs = GrowingLogs([tmp_path / "log.mcap"])
    learner = CQL(SMALL, TransitionBuffer.from_dataset(logs.dataset), [0, 1])
    for _ in range(10):
        learner.update()
    recorder.record(5)
    recorder.env.close()
    assert grows(logs)
    grown = with_more_data(learner, logs.dataset, np.array([3]))
    assert (grown.step, grown.seeds) == (10, (0, 1))
    for seed in (0, 1):
        old, new = learner.state(seed), grown.state(seed)
        assert all(torch.equal(old[name], new[name]) for name in old)
    assert len(grown.buffer) == len(logs.dataset)
    drawn = grown.buffer.sample_rows(2_000, torch.Generator().manual_seed(0))
    lengths = logs.dataset.episode_lengths
    episodes = np.repeat(np.arange(17), lengths)[drawn.numpy()]
    assert set(episodes.tolist()) == set(range(17)) - {3}


def test_new_episodes_are_learned_from(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "log.mcap")
    recorder.record(3)
    data = mcaprl.open(tmp_path / "log.mcap", follow=True)
    assert data.grow() is data

    def report(now: TrainingProgress) -> None:
        if now.done == 200:
            recorder.record(4)

    train(data, SMALL, tmp_path / "run", progress=report)
    recorder.env.close()
    per_check = CHECK_INTERVAL // SMALL.log_interval
    whole = np.cumsum(mcaprl.open(tmp_path / "log.mcap").episode_lengths)
    metrics = read_curve(tmp_path / "run" / "seed-0" / "metrics.csv")
    assert metrics["transitions"].tolist() == [whole[2]] * per_check + [whole[6]] * per_check


@pytest.mark.filterwarnings("ignore:.*values cover")
@pytest.mark.parametrize("algo", ["bc", "td3-bc", "rebrac", "iql"])
def test_new_episodes_of_a_box_are_learned_from(tmp_path: Path, algo: str) -> None:
    """The scaling of the actions is that of the first episodes, also where a bound is infinite."""
    recorder = Recorder(tmp_path / "log.mcap", Unbounded(gym.make("Pendulum-v1")))
    recorder.record(1)
    data = mcaprl.open(tmp_path / "log.mcap", follow=True)
    low, high = data.actions.min(), data.actions.max()

    def report(now: TrainingProgress) -> None:
        if now.done == 200:
            recorder.record(2)

    sizes: dict[str, Any] = {"hidden": (8,), "batch_size": 8, "log_interval": 100}
    sizes["updates"] = 2 * CHECK_INTERVAL
    with pytest.warns(UserWarning, match="infinite bounds"):
        found = mcaprl.train(data, tmp_path / "run", algo=algo, progress=report, **sizes)
    recorder.env.close()
    metrics = read_curve(tmp_path / "run" / "seed-0" / "metrics.csv")
    assert sorted(set(metrics["transitions"].tolist())) == [200, 600]
    # Later commands are beyond the first ones.
    whole = mcaprl.open(tmp_path / "log.mcap").actions
    assert whole.min() < low
    assert whole.max() > high
    head: Any = found.policy.head
    box = head.box
    np.testing.assert_allclose([box.low[0], box.high[0]], [low, high])


class Unbounded(gym.ActionWrapper[Any, Any, Any]):
    """Pendulum, whose torque is the tanh of an unbounded command."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.action_space = spaces.Box(-np.inf, np.inf, (1,), np.float32, seed=0)

    def action(self, action: Any) -> Any:
        return np.tanh(action)


def test_the_command_learns_beside_a_recorder_in_another_process(tmp_path: Path) -> None:
    code = """
        import sys, time
        from pathlib import Path
        from tests.offline.training.test_follow import Recorder
        recorder = Recorder(Path(sys.argv[1]))
        for _ in range(60):
            recorder.record(1)
            time.sleep(0.02)
        recorder.env.close()
    """
    path = tmp_path / "log.mcap"
    command = [sys.executable, "-c", textwrap.dedent(code), str(path)]
    with subprocess.Popen(command, cwd=ROOT):
        sizes = {"updates": 600, "hidden": 8, "batch-size": 8, "target-interval": 2}
        options = ["--follow", *(text for k, v in sizes.items() for text in (f"--{k}", f"{v}"))]
        arguments = ["train-offline", str(path), "--out", str(tmp_path / "run"), *options]
        assert run(arguments) == 0
    assert (tmp_path / "run" / "seed-0" / "policy.json").exists()

"""Tests of labels beside a log: kept, refused, carried, and used in edits and training."""

from __future__ import annotations

import json
import os
import signal
import sys
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.api.action_errors import _split_of
from mcaprl.cli import run
from mcaprl.errors import LogError, TrainingError, UnknownNameError, UsageError
from mcaprl.offline.batches.items import n_step_returns
from mcaprl.offline.training.train import best_episodes
from mcaprl.offline.training.watch import choose_held_out
from mcaprl.recorder.edit.piece import selected
from mcaprl.recorder.format.reading import McapReader, Topic


class Count(gym.Env[Any, Any]):
    """Counts 5 steps, 10 per second; the reward is a power of 2 of the step."""

    observation_space = spaces.Box(0, 99, (1,), np.float32)
    action_space = spaces.Discrete(2)
    metadata = {"render_fps": 10}  # noqa: RUF012

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self._k = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._k += 1
        return np.full(1, self._k, np.float32), 2.0 ** (self._k - 1), self._k == 5, False, {}


def _recorded(path: Path, episodes: int = 3) -> Path:
    with closing(mcaprl.RecordMcap(Count(), path)) as env:
        for seed in range(episodes):
            env.reset(seed=seed)
            for step in range(5):
                env.step(step % 2)
    return path


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return _recorded(tmp_path / "count.mcap")


def test_labels_are_kept_beside_an_unchanged_log(log: Path) -> None:
    before = log.read_bytes()
    mcaprl.label(log, episode=0, success=True, note="clean")
    mcaprl.label(log, episode=1, success=False)
    mcaprl.label(log, episode=1, interval="intervention", steps=(2, 4))
    found = mcaprl.label(log)
    assert found.rows() == [
        ["0", "success", "clean", ""],
        ["1", "failure", "", "intervention 2:4"],
    ]
    assert log.read_bytes() == before
    assert mcaprl.label(log, episode=1, interval="intervention", remove=True).intervals == []
    assert mcaprl.label(log, episode=0, remove=True).rows() == [["1", "failure", "", ""]]
    assert mcaprl.label(log, remove=True).rows() == []


def test_a_time_range_selects_the_steps_that_begin_in_it(log: Path) -> None:
    # Steps begin at 0, 0.1, 0.2, 0.3 and 0.4 s: those of 0.05 to 0.35 s are 1, 2 and 3.
    found = mcaprl.label(log, episode=2, interval="bad data", time=(0.05, 0.35))
    assert [(one.start, one.stop) for one in found.intervals] == [(1, 4)]


@pytest.mark.parametrize(
    "wrong",
    [
        {"episode": 3, "success": True},
        {"episode": -1, "success": True},
        {"success": True},
        {"episode": 0, "steps": (1, 2)},
        {"episode": 0, "interval": "x", "steps": (2, 2)},
        {"episode": 0, "interval": "x", "steps": (0, 6)},
        {"episode": 0, "interval": "x", "steps": (0, 1), "time": (0, 1)},
        {"episode": 0, "interval": ""},
        {"episode": 0, "remove": True, "note": "x"},
    ],
)
def test_wrong_requests_save_nothing(log: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        mcaprl.label(log, **wrong)
    assert [path.name for path in log.parent.iterdir()] == [log.name]


def test_labels_of_other_data_are_refused(log: Path, tmp_path: Path) -> None:
    mcaprl.label(log, episode=0, success=True)
    other = _recorded(tmp_path / "other.mcap", 2)
    other.with_name("other.mcap.labels.json").write_bytes(
        log.with_name("count.mcap.labels.json").read_bytes()
    )
    with pytest.raises(LogError, match="labels of other data"):
        mcaprl.label(other)
    # A copy of the log under another name has the same data.
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(log.read_bytes())
    copy.with_name("copy.mcap.labels.json").write_bytes(
        log.with_name("count.mcap.labels.json").read_bytes()
    )
    assert mcaprl.label(copy).success == {"0": True}


@pytest.mark.parametrize("change", ["{", "[]", '{"log": 3}', "x" * 20])
def test_damaged_labels_are_one_error(log: Path, change: str) -> None:
    log.with_name("count.mcap.labels.json").write_text(change)
    with pytest.raises(LogError, match="labels"):
        mcaprl.label(log)


@pytest.mark.parametrize("key", ["7", "x", "-1"])
def test_labels_of_missing_episodes_are_refused(log: Path, key: str) -> None:
    path = log.with_name("count.mcap.labels.json")
    mcaprl.label(log, episode=0, success=True)
    found = json.loads(path.read_text())
    path.write_text(json.dumps(found | {"success": {key: True}}))
    with pytest.raises(LogError, match="no episode"):
        mcaprl.label(log)


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_a_file_of_labels_is_applied_whole_or_not_at_all(log: Path, suffix: str) -> None:
    file = log.with_name(f"labels{suffix}")
    rows = [
        {"episode": 0, "success": True, "note": "good"},
        {"episode": 2, "interval": "intervention", "start": 1, "stop": 3},
    ]
    lines = ["episode,success,note,interval,start,stop", "0,true,good,,,", "2,,,intervention,1,3"]
    file.write_text("\n".join(lines) if suffix == ".csv" else json.dumps(rows))
    assert run(["label", str(log), "--file", str(file)]) == 0
    found = mcaprl.label(log)
    assert found.rows() == [["0", "success", "good", ""], ["2", "", "", "intervention 1:3"]]
    lines += ["1,false,,,,", "9,true,,,,"]
    rows += [{"episode": 1, "success": False}, {"episode": 9, "success": True}]
    file.write_text("\n".join(lines) if suffix == ".csv" else json.dumps(rows))
    assert run(["label", str(log), "--file", str(file)]) == 2
    assert mcaprl.label(log) == found


def test_filter_and_split_use_and_carry_labels(log: Path, tmp_path: Path) -> None:
    mcaprl.label(log, episode=0, success=False)
    mcaprl.label(log, episode=2, success=True)
    mcaprl.label(log, episode=2, interval="intervention", steps=(1, 2))
    out = tmp_path / "good.mcap"
    assert mcaprl.filter("success == 1", log, out).episodes == 1
    assert mcaprl.label(out).rows() == [["0", "success", "", "intervention 1:2"]]
    mcaprl.split(log, tmp_path / "parts", episodes=2)
    first, second = (tmp_path / "parts" / f"count-0000{k}.mcap" for k in range(2))
    assert mcaprl.label(first).success == {"0": False}
    assert mcaprl.label(second).success == {"0": True}


def test_labels_of_other_data_stop_a_copy_before_it_begins(log: Path, tmp_path: Path) -> None:
    mcaprl.label(log, episode=0, success=True)
    _recorded(tmp_path / "other.mcap", 2).replace(log)
    with pytest.raises(LogError, match="labels of other data"):
        mcaprl.filter("length > 0", log, tmp_path / "new.mcap")
    with pytest.raises(LogError, match="labels of other data"):
        mcaprl.split(log, tmp_path / "parts", episodes=1)
    assert not (tmp_path / "new.mcap").exists()
    assert not (tmp_path / "parts").exists()


def test_rewards_from_labels(log: Path, tmp_path: Path) -> None:
    for episode in range(3):
        mcaprl.label(log, episode=episode, success=episode == 1)
    mcaprl.label(log, episode=0, interval="bad-data", steps=(3, 5))
    reward = "success * terminated - bad_data"
    found = mcaprl.relabel(log, tmp_path / "new.mcap", reward=reward)
    assert found.rewards.tolist() == [0, 0, 0, -1, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0]


def test_returns_do_not_cross_masked_steps(log: Path) -> None:
    """Rewards are 1, 2, 4, 8, 16; without step 2, the parts are (1, 2) and (8, 16)."""
    data = mcaprl.open(log, episodes=0)
    found = data.without(np.array([False, False, True, False, False]))
    assert [episode.length for episode in found.episodes] == [2, 2]
    assert found.observations.ravel().tolist() == [0, 1, 3, 4]
    assert found.next_observations.ravel().tolist() == [1, 2, 4, 5]
    assert found.truncated.tolist() == [False, True, False, False]
    assert found.terminated.tolist() == [False, False, False, True]
    assert [episode.total_reward for episode in found.episodes] == [3, 24]
    # Two steps with a discount of 0.5: 1 + 0.5 * 2 = 2, 2, 8 + 0.5 * 16 = 16, 16.
    returns = n_step_returns(found, 2, 0.5)[1]
    assert np.asarray(returns)[0].tolist() == [2, 2, 16, 16]


def test_training_leaves_out_the_intervals(log: Path, tmp_path: Path) -> None:
    mcaprl.label(log, episode=0, interval="intervention", steps=(1, 3))
    settings: dict[str, Any] = {"algo": "bc", "updates": 3}
    data = mcaprl.open(log)
    dropped = np.isin(np.arange(15), [1, 2])
    mcaprl.train(data.without(dropped), tmp_path / "a", **settings)
    mcaprl.train(log, tmp_path / "b", mask=["intervention"], **settings)
    weights = [(tmp_path / name / "policy.safetensors") for name in "ab"]
    weights = [path if path.exists() else path.parent / "seed-0" / path.name for path in weights]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    with pytest.raises(UnknownNameError, match="intervention"):
        mcaprl.train(log, tmp_path / "c", mask="interventions", **settings)


def test_parts_of_an_episode_are_held_out_together(tmp_path: Path) -> None:
    log = _recorded(tmp_path / "many.mcap", 12)
    for episode in range(12):
        mcaprl.label(log, episode=episode, interval="cut", steps=(2, 3))
    data = mcaprl.open(log)
    parts = selected(data, mask=["cut"])
    assert parts.wholes.tolist() == np.repeat(np.arange(12), 2).tolist()
    assert parts.filter(lambda one: one.index > 2).wholes.tolist()[:3] == [1, 2, 2]
    joined = mcaprl.Dataset.concatenate([parts, parts])
    assert joined.wholes.tolist() == np.repeat(np.arange(24), 2).tolist()
    # The same episodes are held out as without the cuts.
    chosen = choose_held_out(data.wholes, 0.25)
    assert len(chosen) == 3
    expected = np.stack([2 * chosen, 2 * chosen + 1], 1).ravel()
    assert choose_held_out(parts.wholes, 0.25).tolist() == expected.tolist()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_killed_command_leaves_the_old_or_the_new_labels(log: Path) -> None:
    """The process is killed before each of its operations on files, one after the other."""
    file = log.with_name("count.mcap.labels.json")
    old = mcaprl.label(log, episode=0, success=True)
    before, found = file.read_bytes(), []
    for limit in range(1, 500):
        if _finishes(log, limit):
            break
        found.append(mcaprl.label(log))
        # Neither a lock nor an unfinished file keeps others from saving.
        assert mcaprl.label(log, episode=2, success=True).success["2"]
        file.write_bytes(before)
    new = mcaprl.label(log)
    assert new.rows() == [["0", "success", "", ""], ["1", "failure", "killed", ""]]
    # All that were killed before the rename left the old labels, all others the new ones.
    changes = found.index(new)
    assert changes > 5
    assert found == [old] * changes + [new] * (len(found) - changes)


def _finishes(log: Path, limit: int) -> bool:
    """Save labels in a process that is killed at its operation number `limit` on files."""
    pid = os.fork()
    if pid == 0:
        operations = count()

        def hook(event: str, _: Any) -> None:
            is_of_files = event == "open" or event.startswith(("os.", "fcntl.", "shutil."))
            if is_of_files and event != "os.kill" and next(operations) == limit:
                os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(hook)
        try:
            mcaprl.label(log, episode=1, success=False, note="killed")
        finally:
            os._exit(0)
    return os.waitpid(pid, 0)[1] == 0


def test_labels_are_a_topic_of_annotated_logs(log: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="or a log with labels"):
        mcaprl.annotate(log, tmp_path / "none.mcap")
    mcaprl.label(log, episode=0, success=True, note="clean \ud800")
    mcaprl.label(log, episode=2, interval="bad data", steps=(1, 3))
    mcaprl.label(log, episode=2, interval="intervention", steps=(2, 5))
    out = tmp_path / "out.mcap"
    assert mcaprl.annotate(log, out).labels
    assert mcaprl.label(out).rows() == mcaprl.label(log).rows()
    topic = Topic(McapReader(out), "/rl/labels")
    texts = [str(text) for text in topic.read(("data",))["data"]]
    first, second, third = (one.log_time_ns for one in mcaprl.open(log).episodes)
    assert list(zip(topic.times.tolist(), texts, strict=True)) == [
        (first[0], r"success: clean \ud800"),
        (second[0], ""),
        (third[1], "bad data"),
        (third[2], "bad data, intervention"),
        (third[3], "intervention"),
        (third[5], ""),
    ]


def test_training_uses_the_successes(log: Path, tmp_path: Path) -> None:
    for episode in range(3):
        mcaprl.label(log, episode=episode, success=episode != 1)
    mcaprl.label(log, episode=0, interval="cut", steps=(2, 3))
    data = mcaprl.open(log)
    both = selected(data, "success == 1", ["cut"])
    assert both.episode_lengths.tolist() == [2, 2, 5]
    assert both.wholes.tolist() == [0, 0, 2]
    assert (
        selected(data, "success == 1").fingerprint
        == data.filter(lambda e: e.index != 1).fingerprint
    )
    assert selected(data) is data
    settings = ["--algo", "bc", "--updates", "3"]
    ask = ["train-offline", str(log), *settings, "--only"]
    assert run([*ask, "success == 1", "--out", str(tmp_path / "a")]) == 0
    mcaprl.train(data.filter(lambda e: e.index != 1), tmp_path / "b", algo="bc", updates=3)
    first, second = (next((tmp_path / name).rglob("policy.safetensors")) for name in "ab")
    assert first.read_bytes() == second.read_bytes()
    assert run([*ask, "success == 3", "--out", str(tmp_path / "c")]) == 1


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Record 12 episodes, of which the odd ones succeed, and train on these without step 2."""
    folder = tmp_path_factory.mktemp("trained")
    log = _recorded(folder / "log.mcap", 12)
    for episode in range(12):
        mcaprl.label(log, episode=episode, success=episode % 2 == 1)
        mcaprl.label(log, episode=episode, interval="cut", steps=(2, 3))
    chosen: Any = {"only": "success == 1", "mask": "cut"}
    mcaprl.train(log, folder / "run", algo="bc", updates=2, held_out=0.4, **chosen)
    return log, folder / "run"


def test_a_run_is_compared_on_what_it_held_out_of_its_selection(
    trained: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    log, run_folder = trained
    data = mcaprl.open(log)
    whole = _split_of(run_folder, data)
    # Two of the episodes 1, 3, 5, 7, 9 and 11 are held out; the even ones are in neither part.
    expected = (2 * choose_held_out(np.arange(6), 0.4) + 1).tolist()
    assert len(expected) == 2
    assert whole["compared"] == expected
    assert whole["trained_on"] == sorted({1, 3, 5, 7, 9, 11} - {*expected})
    # The parts of the same episodes, if the data are selected in the same way.
    parts = mcaprl.select(data, only="success == 1", mask="cut")
    found = _split_of(run_folder, parts)["compared"]
    assert parts.wholes[found].tolist() == np.repeat(expected, 2).tolist()
    assert "other data" in _split_of(run_folder, data.filter(lambda one: one.index > 0))["why"]
    ask = ["evaluate", str(run_folder), "--data", str(log), "--updates", "2"]
    assert run([*ask, "--only", "success == 1", "--mask", "cut"]) == 0
    assert "4 episodes, held out of the training" in capsys.readouterr().out


def test_weights_and_masks_of_actions_do_not_make_other_data(log: Path, tmp_path: Path) -> None:
    both = [log, _recorded(tmp_path / "other.mcap", 9)]
    mcaprl.train([f"{log}:2", both[1]], tmp_path / "run", algo="bc", updates=2, held_out=0.2)
    assert len(_split_of(tmp_path / "run", mcaprl.open(both))["compared"]) == 2


@pytest.mark.filterwarnings("ignore:the learning rate decayed")
def test_a_resumed_run_selects_the_same_data(trained: tuple[Path, Path]) -> None:
    log, run_folder = trained
    mcaprl.train(log, run_folder, resume=True, updates=3)
    with pytest.raises(TrainingError, match="trained on other data"):
        mcaprl.train(log, run_folder, resume=True, updates=4, only="success == 0")
    file = log.with_name("log.mcap.labels.json")
    before = file.read_bytes()
    mcaprl.label(log, episode=1, success=False)
    with pytest.raises(TrainingError, match="trained on other data"):
        mcaprl.train(log, run_folder, resume=True, updates=4)
    # What was held out does not depend on later labels.
    assert "compared" in _split_of(run_folder, mcaprl.open(log))
    file.write_bytes(before)


def test_commands_select_the_same_episodes(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mcaprl.label(log, episode=2, interval="bad data", steps=(1, 3))
    condition = "not labels.bad_data and length == 5"
    kept = mcaprl.filter(condition, log, tmp_path / "kept.mcap").episodes
    assert kept == len(mcaprl.select(log, only=condition).episodes) == 2
    assert run(["info", str(log), "--only", condition, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == kept
    assert run(["info", str(log), "--mask", "bad data", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 13
    for command in (["info"], ["evaluate", "random", "--data"]):
        assert run([*command, str(log), "--only", "winner == 1"]) == 2
        assert "winner" in capsys.readouterr().err


def test_the_best_episodes_are_those_of_an_expression(log: Path, tmp_path: Path) -> None:
    data = mcaprl.open(log)
    # Rewards are 1, 2, 4, 8, 16 in each episode: by the return, all three are equal.
    assert best_episodes(data, 0.4).tolist() == [True, True, True]
    mcaprl.label(log, episode=0, success=False)
    mcaprl.label(log, episode=2, success=True, note="slow")
    assert best_episodes(data, 0.4, "success").tolist() == [False, False, True]
    # Two of three are wanted: a success comes before a failure, and no label is no value.
    assert best_episodes(data, 0.7, "labels.success").tolist() == [True, False, True]
    assert best_episodes(data, 1 / 3, "-episode").tolist() == [True, False, False]
    assert best_episodes(data, 0.4, "not labels.cut").tolist() == [True, True, True]
    with pytest.raises(UsageError, match=r"'0 / 0' has no value in any of the 3 episodes"):
        best_episodes(data, 0.4, "0 / 0")
    with pytest.raises(UnknownNameError, match="winner"):
        best_episodes(data, 0.4, "winner")
    # Parts of episodes have the labels of the whole.
    mcaprl.label(log, episode=2, interval="cut", steps=(1, 2))
    mcaprl.label(log, episode=2, interval="late", steps=(1, 4))
    parts = mcaprl.select(data, mask="cut")
    assert parts.episode_lengths.tolist() == [5, 5, 1, 3]
    assert best_episodes(parts, 0.5, "success").tolist() == [False, False, True, True]
    assert best_episodes(parts, 0.2, "labels.late").tolist() == [False, False, False, True]
    again = mcaprl.select(parts, only="success == 1 and not labels.late")
    assert again.episode_lengths.tolist() == [1]


def test_training_takes_the_best_by_an_expression(log: Path, tmp_path: Path) -> None:
    for episode in range(3):
        mcaprl.label(log, episode=episode, success=episode == 1)
    ask = ["train-offline", str(log), "--algo", "bc", "--updates", "2", "--held-out", "0"]
    ask += ["--top", "0.3", "--top-by"]
    assert run([*ask, "success", "--out", str(tmp_path / "a")]) == 0
    data = mcaprl.open(log).with_weights([0, 1, 0])
    mcaprl.train(data, tmp_path / "b", algo="bc", updates=2, held_out=0)
    first, second = (next((tmp_path / name).rglob("policy.safetensors")) for name in "ab")
    assert first.read_bytes() == second.read_bytes()
    assert run([*ask, "winner", "--out", str(tmp_path / "c")]) == 2
    assert run([*ask[:-3], "--top-by", "success", "--out", str(tmp_path / "d")]) == 2

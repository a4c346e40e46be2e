"""RecordMcap: the content of the log after each step, and interrupted episodes."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import closing
from io import BytesIO, FileIO
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.errors import (
    LogError,
    NoEpisodesError,
    NoStepsError,
    OutputExistsError,
    SpaceError,
    UsageError,
)
from mcaprl.recorder.columns.output import HoldSignals, create
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.repair.check import check_log
from tests.support.paths import ROOT
from tests.support.recordings import KnownCommands, ScriptedEnv

BOX = spaces.Box(-np.inf, np.inf, (2,), np.float32)


def two(a: float, b: float) -> np.ndarray[Any, Any]:
    return np.array([a, b], np.float32)


def scripted(*episodes: list[tuple[Any, float, bool, bool]], **infos: Any) -> ScriptedEnv:
    return ScriptedEnv(BOX, spaces.Discrete(3), episodes, infos)


ONE = [
    (two(0, 0), 0.0, False, False),
    (two(1, 10), 0.5, False, False),
    (two(2, 20), -1.5, True, False),
]


def test_a_probability_that_is_not_a_number_is_refused(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(scripted(ONE), log_path)) as env:
        env.reset()
        for wrong in (None, "0.5", [0.5, 0.5]):
            env.behavior_prob = wrong  # type: ignore[assignment]
            with pytest.raises(
                UsageError, match=r"is not the prob.*or NaN if it is unknown"
            ) as one:
                env.step(2)
            assert str(one.value).startswith(f"behavior_prob {wrong!r} ")
        env.behavior_prob = math.nan
        env.step(1)


@pytest.mark.parametrize("prob", [-0.5, 0.0, 1e-60, 1.5, math.inf])
def test_impossible_probabilities_are_refused_before_the_step(prob: float, log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(scripted(ONE), log_path)) as env:
        env.reset()
        env.behavior_prob = prob
        with pytest.raises(UsageError, match=f"behavior_prob {prob:g} is not the probability"):
            env.step(2)
        env.behavior_prob = 1 + 1e-7
        env.step(1)
        env.step(0)
    (episode,) = mcaprl.open(log_path).episodes
    assert episode.actions.tolist() == [1, 0]
    assert episode.behavior_probs[0] == pytest.approx(1.0)


@pytest.mark.parametrize("wrong", [math.inf, -math.inf, 1e39, None, "0.5", [0.5, 0.5]])
def test_impossible_densities_are_refused_before_the_step(wrong: Any, log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(KnownCommands(), log_path)) as env:
        env.reset()
        env.behavior_log_prob = wrong
        with pytest.raises(UsageError, match=r"^behavior_log_prob .* is not the log density"):
            env.step(two(0, 0))
        env.behavior_log_prob = 300.5
        env.step(two(0, 0))
        assert math.isnan(env.behavior_log_prob)
        env.behavior_log_prob = math.nan
        env.step(two(0, 1))
    data = mcaprl.open(log_path)
    np.testing.assert_array_equal(data.behavior_log_probs, [300.5, math.nan])
    assert data.action_part_names == ("steering", "speed")
    assert data.action_units == ("right | left", "m/s")


def test_commands_have_no_probability(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(KnownCommands(), log_path)) as env:
        env.reset()
        with pytest.raises(SpaceError, match=r"densities, not prob.*: use behavior_log_prob$"):
            env.behavior_prob = 0.5
        env.step(two(0, 0))
    data = mcaprl.open(log_path)
    for one in (data, data.episodes[0], data.batch(np.array([0]))):
        with pytest.raises(SpaceError, match=r"use behavior_log_probs$"):
            _ = one.behavior_probs


def test_buttons_have_probabilities_and_their_logarithms(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(scripted(ONE), log_path)) as env:
        env.reset()
        env.behavior_log_prob = math.log(0.25)
        assert env.behavior_prob == pytest.approx(0.25)
        env.step(0)
        env.behavior_log_prob = 0.5
        with pytest.raises(UsageError, match=r"behavior_prob 1.6.* is not the probability"):
            env.step(0)
        env.behavior_log_prob = None  # type: ignore[assignment]
        with pytest.raises(UsageError, match="behavior_prob None is not the probability"):
            env.step(0)
        env.behavior_prob = 0.5
        assert env.behavior_log_prob == pytest.approx(math.log(0.5))
        env.step(0)
    data = mcaprl.open(log_path)
    np.testing.assert_allclose(data.behavior_probs, [0.25, 0.5])
    np.testing.assert_allclose(data.behavior_log_probs, np.log([0.25, 0.5]), rtol=1e-6)


def test_columns_by_hand(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(scripted(ONE, ONE), log_path, policy="me", epsilon=0.5)) as env:
        env.reset(seed=7)
        env.behavior_prob = 0.25
        env.step(2)
        env.step(np.int64(1))
        env.reset()
        env.step(0)
        env.step(0)
    data = mcaprl.open(log_path)
    assert data.observations.tolist() == [[0, 0], [1, 10], [0, 0], [1, 10]]
    assert data.next_observations.tolist() == [[1, 10], [2, 20], [1, 10], [2, 20]]
    assert data.actions.tolist() == [2, 1, 0, 0]
    assert data.rewards.tolist() == [0.5, -1.5, 0.5, -1.5]
    assert data.terminated.tolist() == [False, True, False, True]
    assert not data.truncated.any()
    assert data.behavior_probs[0] == 0.25
    assert np.isnan(data.behavior_probs[1:]).all(), "a probability holds for one step"
    first, second = data.episodes
    assert (first.seed, second.seed) == (7, None)
    assert (first.total_reward, first.reason, first.policy, first.epsilon) == (
        -1.0,
        "terminated",
        "me",
        0.5,
    )


def test_reason_comes_from_info(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(scripted(ONE, reason="off_lane"), log_path)) as env:
        env.reset()
        env.step(0)
        env.step(0)
    assert mcaprl.open(log_path).episodes[0].reason == "off_lane"


def test_log_times(log_path: Path) -> None:
    start = 1_700_000_000_123_456_789
    recorder = mcaprl.RecordMcap(
        scripted(ONE, ONE), log_path, start_time_ns=start, step_duration_s=0.25
    )
    with closing(recorder) as env:
        for _ in range(2):
            env.reset()
            env.step(0)
            env.step(0)
    first, second = mcaprl.open(log_path).episodes
    assert (first.log_time_ns - start).tolist() == [0, 250_000_000, 500_000_000]
    assert (second.log_time_ns - start).tolist() == [750_000_000, 1_000_000_000, 1_250_000_000]


@pytest.mark.parametrize("way", ["reset", "close"])
def test_interrupted_episode_is_kept(log_path: Path, way: str) -> None:
    env = mcaprl.RecordMcap(scripted(ONE, ONE), log_path)
    env.reset()
    env.step(1)
    if way == "reset":
        env.reset()
    env.close()
    env.close()
    data = mcaprl.open(log_path)
    assert len(data.episodes) == 1, "an episode without a transition leaves no trace"
    assert data.truncated.tolist() == [True]
    assert data.terminated.tolist() == [False]
    assert data.episodes[0].reason == "interrupted"
    assert data.next_observations.tolist() == [[1, 10]]


class ReusesBuffer(gym.Env[Any, Any]):
    observation_space = spaces.Dict({"image": spaces.Box(0, 255, (8, 8), np.uint8), "x": BOX})
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self) -> None:
        self.values = {"image": np.zeros((8, 8), np.uint8), "x": two(0, 0)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.values["image"][:] = 0
        self.values["x"][:] = 0
        return self.values, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.values["image"] += 1
        self.values["x"] += 1
        action[:] = 99  # The environment overwrites the action, too.
        return self.values, 1.0, False, bool(self.values["x"][0] == 3), {}


def test_reused_buffers_are_copied(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(ReusesBuffer(), log_path)) as env:
        env.reset()
        for _ in range(3):
            env.step(np.zeros(2, np.float32))
    data = mcaprl.open(log_path)
    assert data.observations["x"][:, 0].tolist() == [0, 1, 2]
    assert data.next_observations["image"][:, 0, 0].tolist() == [1, 2, 3]
    assert data.actions.tolist() == [[0, 0], [0, 0], [0, 0]], "the action that was asked for"


def test_wrong_shapes_are_refused(log_path: Path) -> None:
    bad = [(np.zeros(3, np.float32), 0.0, False, False)]
    with (
        closing(mcaprl.RecordMcap(scripted(bad), log_path)) as env,
        pytest.raises(SpaceError, match=r"observation has shape \(3,\); its space declares \(2,\)"),
    ):
        env.reset()


def test_episode_ends_before_a_wrong_observation(log_path: Path) -> None:
    rows = [*ONE[:2], (np.zeros(3, np.float32), 9.0, False, False)]
    env = mcaprl.RecordMcap(scripted(rows), log_path)
    env.reset()
    env.step(1)
    with pytest.raises(SpaceError):
        env.step(2)
    env.close()
    data = mcaprl.open(log_path)
    assert data.rewards.tolist() == [0.5]
    assert data.next_observations.tolist() == [[1, 10]]
    assert data.episodes[0].total_reward == 0.5


class Breaks(ScriptedEnv):
    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if action == 2:
            raise RuntimeError("motor on fire")
        return super().step(action)


def test_episode_ends_before_an_exception(log_path: Path) -> None:
    env = mcaprl.RecordMcap(Breaks(BOX, spaces.Discrete(3), [ONE]), log_path)
    env.reset()
    env.step(1)
    with pytest.raises(RuntimeError, match="motor on fire"):
        env.step(2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(1)
    env.close()
    data = mcaprl.open(log_path)
    assert data.actions.tolist() == [1]
    assert data.truncated.tolist() == [True]
    assert data.next_observations.tolist() == [[1, 10]]


def test_another_dtype_is_cast_with_one_warning(log_path: Path) -> None:
    rows = [(np.array([0.1, 0.2]), 0.0, False, False), (two(1, 2), 1.0, True, False)]
    env = mcaprl.RecordMcap(scripted(rows), log_path)
    with pytest.warns(UserWarning, match="converted to float32, as its space declares"):
        env.reset()
    env.step(0)
    env.close()
    assert mcaprl.open(log_path).observations.tolist() == [two(0.1, 0.2).tolist()]


def test_values_that_the_dtype_cannot_represent_are_refused(log_path: Path) -> None:
    scalar = spaces.Dict({"a": spaces.Box(0, 255, (), np.uint8), "b": spaces.Discrete(5)})
    for number, bad in enumerate([{"a": 300, "b": 1}, {"a": 3, "b": 2.7}, {"a": 3}, None]):
        rows = [({"a": 1, "b": 2}, 0.0, False, False), (bad, 1.0, False, False)]
        path = log_path.with_name(f"{number}.mcap")
        env = mcaprl.RecordMcap(ScriptedEnv(scalar, spaces.Discrete(3), [rows]), path)
        env.reset()
        with pytest.raises(SpaceError, match=r"observation\['[ab]'\]"):
            env.step(0)
        with pytest.raises(gym.error.ResetNeeded):
            env.step(0)
        env.close()


@pytest.mark.parametrize(
    ("space", "action", "kept"),
    [
        (spaces.Discrete(5), 1.7, None),
        (spaces.Discrete(5), np.array([1, 2]), None),
        (spaces.Discrete(5), np.array([3]), 3),
        (spaces.Discrete(5), True, 1),
        (spaces.MultiDiscrete([3, 3]), [1.5, 2], None),
        (spaces.MultiDiscrete([3, 3]), [1, 2], [1, 2]),
        (spaces.Box(-1, 1, (), np.float32), 0.25, 0.25),
        (spaces.Box(-1, 1, (2,), np.float32), [0.5, -0.5], [0.5, -0.5]),
    ],
)
def test_actions_are_stored_or_refused(log_path: Path, space: Any, action: Any, kept: Any) -> None:
    env = mcaprl.RecordMcap(ScriptedEnv(BOX, space, [ONE]), log_path)
    env.reset()
    if kept is None:
        with pytest.raises(SpaceError, match="action"):
            env.step(action)
        env.close()
        return
    env.step(action)
    env.close()
    assert mcaprl.open(log_path).actions.tolist() == [kept]


def test_large_observations_make_small_chunks(log_path: Path) -> None:
    """The recorder limits the size of a chunk, because readers refuse larger chunks."""
    image = spaces.Box(0, 255, (720, 1280, 3), np.uint8)
    rows = [(np.full(image.shape, k, np.uint8), 0.0, False, k == 9) for k in range(10)]
    env = mcaprl.RecordMcap(ScriptedEnv(image, spaces.Discrete(3), [rows]), log_path)
    env.reset()
    for _ in range(9):
        env.step(0)
    env.close()
    assert max(chunk.uncompressed_size for chunk in McapReader(log_path).chunks) < 16 * 2**20
    assert mcaprl.open(log_path).observations[:, 5, 7, 1].tolist() == list(range(9))


def test_the_policy_name_is_read_at_the_episodes_start(log_path: Path) -> None:
    env = mcaprl.RecordMcap(scripted(ONE, ONE), log_path, policy="a")
    env.reset()
    env.step(0)
    env.policy = "b"
    env.reset()
    env.step(0)
    env.close()
    assert [episode.policy for episode in mcaprl.open(log_path).episodes] == ["a", "b"]


@pytest.mark.parametrize("options", [{"step_duration_s": 0.0}, {"start_time_ns": -5}])
def test_log_times_must_increase(log_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="the step must be positive"):
        mcaprl.RecordMcap(scripted(ONE), log_path, **options)
    assert not log_path.exists()


def test_invalid_reset_arguments_are_refused(log_path: Path) -> None:
    env = mcaprl.RecordMcap(scripted(ONE), log_path)
    with pytest.raises(UsageError, match=r"2\*\*64 - 2"):
        env.reset(seed=2**64)
    env.close()
    with pytest.raises(UsageError, match="closed"):
        env.reset()


def test_disk_full_leaves_the_finished_episodes(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = mcaprl.RecordMcap(scripted(ONE, ONE), log_path)
    env.reset()
    env.step(0)
    env.step(0)
    env.reset()
    env.step(0)

    class Full:
        def __init__(self, file: Any) -> None:
            self._file = file

        def __getattr__(self, name: str) -> Any:
            return getattr(self._file, name)

        def write(self, data: Any) -> int:
            if len(data) > 40:
                return int(self._file.write(data[:40]))
            raise OSError(28, "No space left on device")

    writer = env._recording.log.mcap
    monkeypatch.setattr(writer, "_file", Full(writer._file))
    with pytest.raises(LogError, match="No space left on device; everything written before"):
        env.step(0)
    env.close()
    with pytest.warns(UserWarning, match="cut off"):
        assert len(mcaprl.open(log_path).episodes) == 1


@pytest.mark.parametrize("topic", ["/rl/step", "image"])
def test_disk_full_within_an_episode_is_one_error(tmp_path: Path, topic: str) -> None:
    script = f"""
        import resource, signal, sys
        import gymnasium as gym
        import numpy as np
        import mcaprl, mcaprl.errors
        from tests.support.recordings import ScriptedEnv

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        shape, dtype = ((64, 64), np.uint8) if {topic!r} == "image" else ((2,), np.float32)
        box = gym.spaces.Box(0, 255, shape, dtype)
        rng = np.random.default_rng(0)
        rows = [(box.sample(), 0.0, False, False) for _ in range(20_000)]
        short = [rows[0], (rows[1][0], 0.0, True, False)]
        scripted = ScriptedEnv(box, gym.spaces.Discrete(2), [short, rows])
        env = mcaprl.RecordMcap(scripted, sys.argv[1])
        env.reset()
        env.step(0)
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, resource.RLIM_INFINITY))
        env.reset()
        try:
            for _ in range(19_000):
                env.step(0)
        except mcaprl.errors.LogError as error:
            print(error)
        env.close()
    """
    path = tmp_path / "log.mcap"
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), str(path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.startswith(f"cannot write {path}: File too large; "), done
    assert done.stderr == ""
    with pytest.warns(UserWarning, match="cut off"):
        assert len(mcaprl.open(path).episodes) == 1


@pytest.mark.skipif(os.name == "nt", reason="Windows does not remove open files")
@pytest.mark.parametrize("way", ["removed", "replaced", "folder removed", "moved"])
def test_a_removed_file_is_an_error_at_the_end_of_the_episode(log_path: Path, way: str) -> None:
    folder = log_path.parent / "folder"
    path = folder / "log.mcap"
    env = mcaprl.RecordMcap(scripted(ONE, ONE), path)
    env.reset()
    env.step(0)
    env.step(0)
    env.reset()
    env.step(0)
    if way == "moved":
        path.rename(log_path)
    else:
        path.unlink()
        if way == "replaced":
            path.write_text("mine")
        if way == "folder removed":
            folder.rmdir()
    with pytest.raises(LogError, match="was removed or replaced while it was being recorded"):
        env.step(0)
    env.close()
    if way == "replaced":
        assert path.read_text() == "mine"
    if way == "moved":
        assert check_log(log_path) == []
        assert len(mcaprl.open(log_path).episodes) == 2


@pytest.mark.skipif(os.name == "nt", reason="Windows does not remove open files")
def test_a_removed_file_is_an_error_of_close(log_path: Path) -> None:
    env = mcaprl.RecordMcap(scripted(ONE, ONE), log_path)
    env.reset()
    env.step(0)
    env.step(0)
    log_path.unlink()
    with pytest.raises(LogError, match="was removed or replaced while it was being recorded"):
        env.close()


def test_the_working_folder_may_change_while_recording(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(log_path.parent)
    env = mcaprl.RecordMcap(scripted(ONE, ONE), log_path.name)
    monkeypatch.chdir("/")
    env.reset()
    env.step(0)
    env.step(0)
    env.close()
    assert len(mcaprl.open(log_path).episodes) == 1


@pytest.mark.usefixtures("python_signals")
def test_interrupts_at_any_moment_leave_whole_episodes(log_path: Path) -> None:
    """Interrupt a hundred recordings, each at a different time."""
    main = threading.get_ident()
    for trial in range(100):
        path = log_path.with_name(f"{trial}.mcap")
        env = mcaprl.RecordMcap(gym.make("CartPole-v1"), path)
        timer = threading.Timer(0.001 + trial * 0.0003, signal.pthread_kill, (main, signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):  # noqa: PT012
            timer.start()
            while True:
                env.reset(seed=trial)
                while not any(env.step(0)[2:4]):
                    pass
        env.close()
        try:
            data = mcaprl.open(path)
        except NoStepsError:
            continue
        assert check_log(path) == []
        assert all(episode.reason == "terminated" for episode in data.episodes[:-1])
        assert all(episode.terminated[-1] for episode in data.episodes[:-1])


def test_step_needs_reset(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(scripted(ONE), log_path)) as env:
        with pytest.raises(gym.error.ResetNeeded):
            env.step(0)
        env.reset()


def test_existing_file_is_kept(log_path: Path) -> None:
    log_path.write_text("precious")
    with pytest.raises(OutputExistsError, match="exists"):
        mcaprl.RecordMcap(scripted(ONE), log_path)
    assert log_path.read_text() == "precious"
    mcaprl.RecordMcap(scripted(ONE), log_path, overwrite=True).close()


def test_an_unwritable_path_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="cannot write"):
        mcaprl.RecordMcap(scripted(ONE), tmp_path / "file" / "log.mcap")


def test_unsupported_spaces_create_no_file(log_path: Path) -> None:
    env = ScriptedEnv(spaces.Text(5), spaces.Discrete(2), [])
    with pytest.raises(SpaceError, match="observation is a Text space"):
        mcaprl.RecordMcap(env, log_path)
    env = ScriptedEnv(BOX, spaces.Dict({"a": spaces.Discrete(2)}), [])
    with pytest.raises(SpaceError, match="action is a Dict space"):
        mcaprl.RecordMcap(env, log_path)
    assert not log_path.exists()


def test_metadata_comes_first_and_is_repeated(log_path: Path) -> None:
    env = gym.make("CartPole-v1", sutton_barto_reward=True)
    mcaprl.RecordMcap(env, log_path, seed=3, policy="random", epsilon=1.0).close()
    reader = McapReader(log_path)
    kinds = [opcode for _, opcode, _ in reader.records(8)]
    assert kinds[:2] == [0x01, 0x0C], "header, then metadata"
    strings = reader.metadata["mcaprl.dataset"]
    channel = reader.channel_of("/rl/step")
    assert channel is not None
    assert channel.metadata == strings
    assert strings["env_id"] == "CartPole-v1"
    assert strings["env_kwargs"] == '{"sutton_barto_reward": true}'
    assert (strings["seed"], strings["policy"], strings["epsilon"]) == ("3", "random", "1.0")
    assert strings["step_duration_ns"] == "20000000", "CartPole renders 50 frames a second"


def _record_for_ever(path: Path) -> None:
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), path)
    while True:
        env.reset(seed=0)
        done = False
        while not done:
            _, _, terminated, truncated, _ = env.step(0)
            done = terminated or truncated
        time.sleep(0.001)


def test_killed_recorder_loses_only_the_open_episode(log_path: Path) -> None:
    process = multiprocessing.get_context("spawn").Process(
        target=_record_for_ever, args=(log_path,)
    )
    process.start()
    deadline = time.monotonic() + 60
    while not (log_path.exists() and log_path.stat().st_size > 30_000):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    with pytest.warns(UserWarning, match="cut off"):
        data = mcaprl.open(log_path)
    assert len(data.episodes) > 3
    assert all(episode.terminated[-1] for episode in data.episodes)
    assert math.isclose(data.episodes[0].total_reward, data.episodes[0].length)


@pytest.mark.usefixtures("python_signals")
def test_an_interruption_while_a_log_is_created_leaves_a_log_without_episodes(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def create_and_interrupt(path: Path, *, overwrite: bool) -> FileIO:
        file = create(path, overwrite=overwrite)
        signal.raise_signal(signal.SIGINT)
        return file

    monkeypatch.setattr("mcaprl.recorder.columns.writer.create", create_and_interrupt)
    with pytest.raises(KeyboardInterrupt):
        mcaprl.RecordMcap(scripted(ONE), log_path)
    assert McapReader(log_path).complete
    with pytest.raises(NoEpisodesError):
        mcaprl.open(log_path)


@pytest.mark.usefixtures("python_signals")
def test_a_deferred_signal_keeps_no_references() -> None:
    """A pending signal keeps no references to buffers.

    A signal arrives while a buffer is in use. The buffer is resized before the signal is handled.
    """
    buffer = BytesIO(b"12345678")

    def look() -> int:
        view = buffer.getbuffer()
        signal.raise_signal(signal.SIGINT)
        return len(view)

    with pytest.raises(KeyboardInterrupt), HoldSignals():  # noqa: PT012
        assert look() == 8
        buffer.truncate(0)
    assert buffer.getvalue() == b""

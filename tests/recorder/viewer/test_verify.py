"""Verification: a replay of a log returns the same bits, or the first difference is reported."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, SpaceError
from mcaprl.recorder.viewer.annotate import Verification, verify
from mcaprl.sims import SIMS, make_sim
from mcaprl.texts import counted
from tests.support.recordings import MIXED_SPACE, ScriptedEnv

WALK_LENGTH = 9


class Walk(gym.Env[Any, Any]):
    """Random walk in which each step depends on all random numbers since the last seed."""

    metadata: dict[str, Any] = {"render_fps": 10}  # noqa: RUF012 (as Gymnasium declares it)
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)
    observation_names = ("place_m", "count")

    def __init__(self, fault: tuple[str, int] = ("", -1)) -> None:
        """Create an environment with a fault, given by its kind and the number of the step."""
        self._fault, self._life = fault, -1

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._place, self._count = float(self.np_random.normal()), 0
        if options:
            self._place = options["place"]
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._count += 1
        self._life += 1
        kind = self._fault[0] if self._life == self._fault[1] else ""
        if kind == "crash":
            raise RuntimeError("the engine is on fire")
        self._place += float(action[0]) + self.np_random.normal() + (kind == "observation")
        reward = np.nextafter(self._place, 10) if kind == "reward" else self._place
        ends = self._count == WALK_LENGTH or kind == "end"
        return self._observation(), float(reward), ends, False, {}

    def _observation(self) -> Any:
        return np.array([self._place, self._count], np.float32)


def walk(
    path: Path, seeds: list[int | None], options: dict[str, Any] | None = None, cut: int = 0
) -> mcaprl.Dataset:
    """Record one episode per seed; interrupt the last one `cut` steps before its end."""
    with closing(mcaprl.RecordMcap(Walk(), path, start_time_ns=5 * 10**9)) as env:
        env.action_space.seed(0)
        for number, seed in enumerate(seeds):
            env.reset(seed=seed, options=options)
            for _ in range(WALK_LENGTH - cut * (number == len(seeds) - 1)):
                env.step(env.action_space.sample())
    return mcaprl.open(path)


@pytest.mark.parametrize("sim", [*SIMS, "CartPole-v1", "Pendulum-v1"])
def test_a_repeated_simulation_reproduces_the_log(
    sim: str, log_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["record", sim, "--policy", "random", "--steps", "60", "--out", str(log_path)]
    assert run(command) == 0
    capsys.readouterr()
    assert run(["replay", str(log_path), "--verify"]) == 0
    episodes = counted(len(mcaprl.open(log_path).episodes), "episode")
    assert f"{episodes} and 60 steps compared: every" in capsys.readouterr().out


def test_images_and_dict_observations_are_compared(log_path: Path) -> None:
    random = np.random.default_rng(0)
    MIXED_SPACE.seed(1)
    rewards = [0.0, np.nan, -0.0, 1e-320]
    rows = [(MIXED_SPACE.sample(), reward, False, reward == rewards[-1]) for reward in rewards]

    def scripted() -> ScriptedEnv:
        return ScriptedEnv(MIXED_SPACE, spaces.MultiDiscrete([3, 4]), [rows])

    with closing(mcaprl.RecordMcap(scripted(), log_path)) as env:
        env.reset(seed=1)
        for _ in rows[1:]:
            env.step(random.integers([3, 4]))
    data = mcaprl.open(log_path)
    assert verify(data, scripted()) == Verification(1, 3, (), None)
    rows[2] = ({**rows[2][0], "camera": rows[2][0]["camera"] ^ 1}, 0.0, False, False)
    found = verify(data, scripted()).difference
    assert found is not None
    assert found.step == 2
    names = [field.name for field in found.fields]
    assert names[:2] == ["reward", "camera[0, 0, 0]"]
    assert (found.fields[0].logged, found.fields[0].now) == ("-0.0", "0.0")


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("observation", ["reward", "place_m"]),
        ("reward", ["reward"]),
        ("end", ["terminated"]),
    ],
)
def test_the_first_difference_is_reported_with_its_place(
    kind: str, names: list[str], log_path: Path
) -> None:
    data = walk(log_path, [1, 2])
    found = verify(data, Walk((kind, WALK_LENGTH + 3)))
    assert found.steps == WALK_LENGTH + 4
    difference = found.difference
    assert difference is not None
    assert (difference.episode, difference.step) == (1, 4)
    assert difference.time_s == 0.4
    assert difference.time_ns == data.episodes[1].log_time_ns[4]
    assert [field.name for field in difference.fields] == names
    for field in difference.fields:
        assert field.logged != field.now
    assert "episode 1 differs first at step 4 (0.400 s after" in str(difference.to_problem())


def test_an_episode_without_a_seed_continues_the_random_state(log_path: Path) -> None:
    data = walk(log_path, [None, 7, None, None])
    found = verify(data, Walk())
    assert found == Verification(3, 3 * WALK_LENGTH, (0,), None)
    assert verify(data, Walk(), only=3) == Verification(3, 3 * WALK_LENGTH, (), None)
    assert verify(data, Walk(), only=0) == Verification(0, 0, (0,), None)


def test_an_unknown_start_is_not_a_difference(log_path: Path) -> None:
    """Do not compare an episode without a seed if the log lacks a reset before it."""
    with closing(mcaprl.RecordMcap(Walk(), log_path)) as env:
        for seed in (3, None):
            env.reset(seed=seed)
            env.reset() if seed is None else None
            while not env.step(np.zeros(1, np.float32))[2]:
                pass
    assert verify(mcaprl.open(log_path), Walk()) == Verification(1, WALK_LENGTH, (1,), None)


def test_options_and_interrupted_episodes(log_path: Path) -> None:
    data = walk(log_path, [4, 5], {"place": 3.5}, cut=2)
    assert data.episodes[1].reason == "interrupted"
    assert verify(data, Walk()) == Verification(2, 2 * WALK_LENGTH - 2, (), None)


def test_frames_are_drawn_in_the_state_of_their_step(log_path: Path) -> None:
    data, env = walk(log_path, [1, 2]), Walk()
    seen = []
    verify(data, env, on_frame=lambda e, step: seen.append((e.index, step, env._count)))
    assert seen == [(e, step, step) for e in (0, 1) for step in range(WALK_LENGTH + 1)]


def test_failing_or_different_environments_are_reported(log_path: Path) -> None:
    data = walk(log_path, [1])
    with pytest.raises(LogError, match=r"fails at step 3 of the logged episode 0.*on fire"):
        verify(data, Walk(("crash", 2)))
    with pytest.raises(SpaceError, match=r"CartPole-v1 has Box"):
        verify(data, make_sim("CartPole-v1"))


def test_command_exits_with_1_on_a_difference(
    log_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env = gym.make("CartPole-v1")
    vars(env.unwrapped)["gravity"] = 9.7
    with closing(mcaprl.RecordMcap(env, log_path)) as recorder:
        recorder.reset(seed=1)
        for _ in range(3):
            recorder.step(1)
    assert run(["replay", str(log_path), "--verify"]) == 1
    assert (
        "episode 0 differs first at step 1 (0.020 s after its start, log_time"
        in capsys.readouterr().out
    )
    assert run(["replay", str(log_path), "--verify", "--episode", "1"]) == 2
    assert "has episodes 0 to 0" in capsys.readouterr().err

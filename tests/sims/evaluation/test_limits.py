"""Limits on the steps of an episode: evaluations and recordings end in every environment."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import UsageError
from mcaprl.sims.evaluation import rollout
from mcaprl.sims.evaluation.rollout import (
    DEFAULT_MAX_STEPS,
    StepLimit,
    make_limited,
    make_limited_sims,
    warn_of_cuts,
)


class Endless(gym.Env[Any, Any]):
    """An environment that counts its steps, and ends at 1,000 of them."""

    observation_space = spaces.Box(-1, 2_000, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._now = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: int) -> Any:
        self._now += 1
        return np.full(1, self._now, np.float32), 1.0, self._now == 1_000, False, {"now": self._now}


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(rollout, "DEFAULT_MAX_STEPS", 70)
    gym.register("Endless-v0", cast(Any, Endless), disable_env_checker=True)
    gym.register("Ending-v0", cast(Any, Endless), disable_env_checker=True, max_episode_steps=20)
    yield
    for name in ("Endless-v0", "Ending-v0"):
        gym.registry.pop(name)


def test_the_default_is_that_of_ale() -> None:
    assert DEFAULT_MAX_STEPS == 27_000


@pytest.mark.parametrize(
    ("sim", "max_steps", "length", "reason"),
    [
        ("Endless-v0", None, 70, "step_limit"),
        ("Endless-v0", 7, 7, "step_limit"),
        ("Endless-v0", 1_000, 1_000, "terminated"),
        ("Endless-v0", 2_000, 1_000, "terminated"),
        ("Ending-v0", None, 20, "time_limit"),
        ("Ending-v0", 7, 7, "step_limit"),
        ("Ending-v0", 20, 20, "time_limit"),
        ("Ending-v0", 70, 20, "time_limit"),
    ],
)
def test_recordings_are_truncated(
    log_path: Path, sim: str, max_steps: int | None, length: int, reason: str
) -> None:
    cuts = pytest.warns(
        UserWarning, match=rf"random: 2 of 2 episodes in {sim} .* of {length} steps"
    )
    with cuts if reason == "step_limit" else warnings.catch_warnings():
        found = mcaprl.record(sim, log_path, policy="random", episodes=2, max_steps=max_steps)
    assert [(one.length, one.reason) for one in found.results] == [(length, reason)] * 2
    data = mcaprl.open(log_path)
    assert [(one.length, one.reason) for one in data.episodes] == [(length, reason)] * 2
    assert np.flatnonzero(data.truncated).tolist() == (
        [] if reason == "terminated" else [length - 1, 2 * length - 1]
    )
    assert mcaprl.verify(log_path).difference is None


def test_a_number_of_steps_needs_no_default_limit(log_path: Path) -> None:
    found = mcaprl.record("Endless-v0", log_path, policy="random", steps=150)
    assert [(one.length, one.reason) for one in found.results] == [(150, "interrupted")]
    with pytest.warns(UserWarning, match="2 of 3 episodes"):
        found = mcaprl.record(
            "Endless-v0", log_path, policy="random", steps=150, max_steps=60, overwrite=True
        )
    assert [one.length for one in found.results] == [60, 60, 30]


def test_processes_have_the_limit(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="4 of 4 episodes in lane"):
        found = mcaprl.record("lane", tmp_path / "logs", episodes=4, envs=2, max_steps=3)
    assert [one.length for one in found.results] == [3] * 4


@pytest.mark.parametrize("max_steps", [None, 9])
def test_evaluations_are_truncated(max_steps: int | None, tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    with pytest.warns(UserWarning, match="random: 3 of 3 episodes in Endless-v0"):
        found = mcaprl.evaluate("random", "Endless-v0", episodes=3, max_steps=max_steps, record=log)
    (score,) = found.policies
    assert score.ends == {"step_limit": 3}
    assert [one.length for one in score.results[0]] == [max_steps or 70] * 3
    assert mcaprl.open(log).truncated.sum() == 3


def test_sims_that_are_stepped_together_have_the_limit() -> None:
    with pytest.warns(UserWarning, match=r"\w+: 4 of 4 episodes in lane") as seen:
        found = mcaprl.evaluate("pilot", "lane", episodes=4, max_steps=5)
    assert sorted(str(one.message).split(":")[0] for one in seen) == ["pilot", "random"]
    assert [one.length for score in found.policies for one in score.results[0]] == [5] * 8
    with closing(make_limited_sims("lane", 2, 5, autoreset_mode="SameStep")) as envs:
        envs.reset(seed=0)
        for _ in range(4):
            assert not envs.step(np.zeros(2, np.int64))[3].any()
        *_, truncated, infos = envs.step(np.zeros(2, np.int64))
        assert truncated.all()
        assert infos["final_info"]["reason"].tolist() == ["step_limit"] * 2
    with closing(make_limited_sims("lane", 2, None)) as envs:
        assert not isinstance(envs, gym.vector.SyncVectorEnv)


def test_an_argument_of_the_environment_may_have_the_same_name() -> None:
    class Own(Endless):
        def __init__(self, max_steps: int = 3, name: str = "") -> None:
            self.limit, self.name = max_steps, name

    gym.register("Own-v0", cast(Any, Own), disable_env_checker=True)
    try:
        with closing(make_limited("Own-v0", 8, max_steps=5, name="x")) as env:
            own: Any = env.unwrapped
            assert (own.limit, own.name) == (5, "x")
            assert isinstance(env, StepLimit)
            assert env.max_steps == 8
    finally:
        gym.registry.pop("Own-v0")


def test_a_limit_must_be_positive(log_path: Path) -> None:
    with pytest.raises(UsageError, match="`max_steps=0`: give a number of at least 1"):
        mcaprl.record("lane", log_path, episodes=1, max_steps=0)
    with pytest.raises(UsageError, match="`max_steps=-1`"):
        mcaprl.evaluate("random", "lane", max_steps=-1)
    with pytest.raises(UsageError, match="`max_steps=0`"):
        mcaprl.train_online("lane", log_path.with_suffix(""), max_steps=0)


def test_the_option_of_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["evaluate", "random", "--sim", "Endless-v0", "--episodes", "2", "--json"]
    with pytest.warns(UserWarning, match="reached the limit of 4 steps"):
        assert run([*arguments, "--max-steps", "4"]) == 0
    ends = json.loads(capsys.readouterr().out)["policies"][0]["ends"]
    assert ends == {"step_limit": 2}
    log = str(tmp_path / "log.mcap")
    options = ["--policy", "random", "--episodes", "1", "--max-steps", "6", "--out", log]
    with pytest.warns(UserWarning, match="reached the limit of 6 steps"):
        assert run(["record", "Endless-v0", *options]) == 0
    assert mcaprl.open(log).truncated.tolist() == [False] * 5 + [True]


@pytest.mark.parametrize("max_steps", [None, 30])
def test_training_and_its_evaluations_are_truncated(tmp_path: Path, max_steps: int | None) -> None:
    settings: dict[str, Any] = {
        "steps": 200,
        "envs": 2,
        "eval_interval": 100,
        "eval_episodes": 2,
        "final_episodes": 3,
    }
    out, log = tmp_path / "run", tmp_path / "log.mcap"
    with pytest.warns(UserWarning, match="reached the limit") as seen:
        (found,) = mcaprl.train_online(
            "Endless-v0", out, algo="dqn", max_steps=max_steps, record=log, **settings
        )
    length = max_steps or 70
    assert found.ends == {"step_limit": 3}
    assert found.mean_return == length
    texts = [str(one.message) for one in seen if "reached the limit" in str(one.message)]
    assert len(texts) == 2
    assert all(f"limit of {length} steps" in text for text in texts)
    trained = mcaprl.open(log)
    lengths = [30, 30, 30, 10] if max_steps else [100]
    assert [one.length for one in trained.episodes] == sorted(lengths * 2, reverse=True)
    config = json.loads((out / "config.json").read_text())
    assert config.get("max_steps") == max_steps
    evaluated = mcaprl.open(out / "seed-0/evaluations")
    assert {one.length for one in evaluated.episodes} == {length}
    with pytest.warns(UserWarning, match=f"reached the limit of {length} steps"):
        again = mcaprl.train_online(None, out, resume=True, record=log)
    assert again[0].ends == found.ends


def test_no_warning_without_cuts() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_cuts([], "random", "lane")

"""Arguments of environments: given on the command line, logged, or those of a policy's training."""

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
from mcaprl.cli.options import env_arguments
from mcaprl.errors import PolicyError, SpaceError, UsageError
from mcaprl.offline.algorithms.config import BCConfig
from mcaprl.offline.training.train import train as train_offline
from mcaprl.recorder.format.metadata import LogMetadata, as_json
from mcaprl.sims import make_sim


class Wide(gym.Env[Any, Any]):
    """An environment whose spaces and rewards depend on its arguments."""

    action_space = spaces.Discrete(2)

    def __init__(
        self, width: int = 2, scale: Any = 1.0, config: Any = None, render_mode: Any = None
    ) -> None:
        if width < 1:
            raise KeyError(width)
        self.observation_space = spaces.Box(-9, 9, (width,), np.float32)
        self._scale = scale(1.0) if callable(scale) else scale
        self.config = config

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._steps = 0
        return self._see(), {}

    def step(self, action: Any) -> Any:
        self._steps += 1
        return self._see(), float(self._scale), self._steps == 3, False, {}

    def _see(self) -> Any:
        return self.np_random.uniform(-9, 9, self.observation_space.shape).astype(np.float32)


def double(value: float) -> float:
    return 2 * value


DEFAULTS = {"width": 2, "config": {"map": ["SF", "FG"]}}


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gym.register(
        "Wide-v0", cast(Any, Wide), disable_env_checker=True, max_episode_steps=9, kwargs=DEFAULTS
    )
    gym.register(
        "Called-v0",
        cast(Any, Wide),
        disable_env_checker=True,
        max_episode_steps=9,
        kwargs={"scale": double},
    )
    yield
    for name in ("Wide-v0", "Called-v0"):
        gym.registry.pop(name)


def recorded(path: Path, name: str = "Wide-v0", **options: Any) -> Path:
    with closing(mcaprl.RecordMcap(make_sim(name, **options), path)) as env:
        for seed in range(2):
            env.reset(seed=seed)
            for _ in range(3):
                env.step(0)
    return path


def trained(folder: Path, **options: Any) -> str:
    data = mcaprl.open(recorded(folder / "log.mcap", **options))
    config = BCConfig(updates=2, hidden=(4,))
    train_offline(data, config, folder / "run", progress=lambda _: None)
    return str(folder / "run")


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        ([], None),
        (["continuous=false"], {"continuous": False}),
        (["map_name=4x4", "size=3"], {"map_name": "4x4", "size": 3}),
        (['config={"a": {"b": [1, null]}}'], {"config": {"a": {"b": [1, None]}}}),
        (["a=True", "b=None", "c=False"], {"a": True, "b": None, "c": False}),
        (
            ['text="True"', "equation=x=y", "empty="],
            {"text": "True", "equation": "x=y", "empty": ""},
        ),
    ],
)
def test_values_are_json_or_texts(texts: list[str], expected: Any) -> None:
    assert env_arguments(texts) == expected


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["continuous"], "expected KEY=VALUE, such as continuous=false"),
        (["=1"], "expected KEY=VALUE"),
        (["a-b=1"], "expected KEY=VALUE"),
        (["a=1", "a=2"], "--env-arg a is given twice"),
        (["config={'a': 1}"], "--env-arg config: .* is not JSON"),
        (["maps=[1,"], "is not JSON"),
    ],
)
def test_other_texts_are_refused(texts: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        env_arguments(texts)


def test_every_command_passes_the_arguments(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, sheet = str(tmp_path / "log.mcap"), str(tmp_path / "layout.json")
    arguments = ["--env-arg", "width=3", "--env-arg", 'config={"lanes": 4}']
    record = ["record", "Wide-v0", "--policy", "random", "--episodes", "2", "--out", log]
    assert run([*record, *arguments]) == 0
    data = mcaprl.open(log)
    assert data.env_kwargs == {"width": 3, "config": {"lanes": 4}}
    assert data.observation_space.shape == (3,)
    evaluate = ["evaluate", "random", "--sim", "Wide-v0", "--episodes", "2", "--json"]
    capsys.readouterr()
    assert run([*evaluate, "--env-arg", "scale=2.5"]) == 0
    scores = json.loads(capsys.readouterr().out)["policies"]
    assert [score["mean_return"] for score in scores] == [7.5]
    assert run(["layout", "Wide-v0", *arguments, "--out", sheet]) == 0
    assert run(["layout", log, *arguments, "--out", sheet, "--overwrite"]) == 2
    assert run(["replay", log, "--verify"]) == 2
    assert "--trust-env" in capsys.readouterr().err
    assert run(["replay", log, "--verify", *arguments]) == 0
    assert run(["replay", log, "--verify", "--trust-env", "--env-arg", "width=2"]) == 1
    assert "the log has observation_space" in capsys.readouterr().err
    train = ["train-online", "Wide-v0", "--algo", "dqn", "--steps", "40", "--envs", "2"]
    quick = ["--eval-episodes", "1", "--final-episodes", "1", "--out", str(tmp_path / "run")]
    assert run([*train, *quick, "--env-arg", "width=5"]) == 0
    policy = mcaprl.load_policy(tmp_path / "run")
    assert policy.env_kwargs == {"width": 5}
    assert policy.observation_space is not None
    assert policy.observation_space.shape == (5,)


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluate = ["evaluate", "random", "--sim", "Wide-v0", "--episodes", "1"]
    assert run([*evaluate, "--env-arg", "width=0"]) == 2
    assert "cannot make sim 'Wide-v0' with width=0: KeyError: 0" in capsys.readouterr().err
    assert run([*evaluate, "--env-arg", "other=0"]) == 2
    assert "has no argument other" in capsys.readouterr().err
    assert run(["evaluate", "random", "--data", "x", "--env-arg", "width=1"]) == 2
    assert "--env-arg requires --sim" in capsys.readouterr().err
    lane = ["evaluate", "random", "--sim", "lane", "--rules", "classic", "--env-arg"]
    assert run([*lane, "rules=default"]) == 2
    assert "the argument rules is given twice" in capsys.readouterr().err


def test_defaults_of_the_registry_need_no_trust(log_path: Path) -> None:
    recorded(log_path)
    assert mcaprl.open(log_path).env_kwargs == DEFAULTS
    assert mcaprl.verify(log_path).difference is None
    assert mcaprl.verify(log_path, sim="Wide-v0").difference is None
    log = recorded(log_path.with_name("other.mcap"), config={"map": ["SF", "HG"]})
    with pytest.raises(
        UsageError, match=r"names arguments of [\w.]+:Wide-v0: config=\{'map': \['SF', 'H"
    ):
        mcaprl.verify(log)
    assert mcaprl.verify(log, sim_options={"config": None}).difference is None


def test_frozen_lake_is_verified_without_trust(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(gym.make("FrozenLake-v1"), log_path)) as env:
        env.reset(seed=0)
        env.step(2)
    assert mcaprl.open(log_path).env_kwargs == {"map_name": "4x4"}
    assert mcaprl.verify(log_path).difference is None


def test_arguments_that_are_not_json_are_not_stored(
    log_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.warns(UserWarning, match="does not store scale of Wide-v0.*not JSON"):
        recorded(log_path, scale=double, width=3)
    data = mcaprl.open(log_path)
    assert data.env_kwargs == {**DEFAULTS, "width": 3}
    assert data.unstored_kwargs == ("scale",)
    assert run(["replay", str(log_path), "--verify", "--trust-env"]) == 2
    assert "Wide-v0 that are not stored" in capsys.readouterr().err
    given = {"scale": double}
    assert mcaprl.verify(log_path, trust_env=True, sim_options=given).difference is None
    found = mcaprl.verify(log_path, trust_env=True, sim_options={"scale": 1.0}).difference
    assert found is not None
    data.save(log_path.with_name("copy.mcap"))
    assert mcaprl.open(log_path.with_name("copy.mcap")).unstored_kwargs == ("scale",)


def test_defaults_that_are_not_json_need_no_warning(log_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recorded(log_path, "Called-v0")
    data = mcaprl.open(log_path)
    assert (data.env_kwargs, data.unstored_kwargs) == ({}, ())
    assert data.rewards.tolist() == [2.0] * 6
    assert mcaprl.verify(log_path).difference is None


def test_json_values() -> None:
    value = {"a": (1, np.float32(0.5)), "b": [None, True, "x"]}
    assert as_json(value) == {"a": [1, 0.5], "b": [None, True, "x"]}
    deep: Any = []
    for _ in range(1_000):
        deep = [deep]
    for bad in ({1: 2}, {"a": {1, 2}}, np.zeros(2), object(), double, deep):
        with pytest.raises(ValueError, match=r"JSON"):
            as_json(bad)
    assert LogMetadata(spaces.Discrete(2), spaces.Discrete(2)).unstored_kwargs == ()


def test_a_run_is_evaluated_with_the_arguments_of_its_log(tmp_path: Path) -> None:
    run_folder = trained(tmp_path, width=3, scale=2.0)
    advice = r"trained with other arguments: pass `sim_options=\{'width': 3, 'scale': 2.0\}`"
    with (
        pytest.warns(UserWarning, match=r"was trained with width=3, scale=2.0, but Wide-v0 is"),
        pytest.raises(PolicyError, match=advice),
    ):
        mcaprl.evaluate(run_folder, "Wide-v0", episodes=2)
    found = mcaprl.evaluate(run_folder, "Wide-v0", episodes=2, trust_env=True)
    assert [score.mean_return for score in found.policies] == [6.0, 6.0]
    given = mcaprl.evaluate(run_folder, "Wide-v0", episodes=2, sim_options={"width": 3})
    assert [score.mean_return for score in given.policies] == [3.0, 3.0]
    log = tmp_path / "again.mcap"
    mcaprl.record("Wide-v0", log, policy=run_folder, episodes=1, trust_env=True)
    assert mcaprl.open(log).rewards.tolist() == [2.0] * 3
    with pytest.raises(PolicyError, match="was trained on observation_space"):
        mcaprl.evaluate(run_folder, "CartPole-v1", episodes=2, trust_env=True)


def test_a_run_with_other_arguments_but_equal_spaces_is_reported(tmp_path: Path) -> None:
    run_folder = trained(tmp_path, scale=2.0)
    with pytest.warns(UserWarning, match="scale=2.0, but Wide-v0 is used with its defaults"):
        found = mcaprl.evaluate(run_folder, "Wide-v0", episodes=1)
    assert found.policies[0].mean_return == 3.0


def test_runs_with_different_arguments_use_the_defaults(tmp_path: Path) -> None:
    for name in ("a", "b", "plain"):
        (tmp_path / name).mkdir()
    runs = [trained(tmp_path / "a", scale=2.0), trained(tmp_path / "b", scale=4.0)]
    with pytest.warns(UserWarning, match="different arguments"):
        found = mcaprl.evaluate(runs, "Wide-v0", episodes=1, trust_env=True)
    assert found.policies[0].mean_return == 3.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plain = trained(tmp_path / "plain")
        assert mcaprl.evaluate(plain, "Wide-v0", episodes=1).policies[0].mean_return == 3.0


def test_own_sims_need_no_trust(tmp_path: Path) -> None:
    log = tmp_path / "lane.mcap"
    mcaprl.record("lane", log, episodes=2, rules="classic")
    config = BCConfig(updates=2, hidden=(4,))
    train_offline(mcaprl.open(log), config, tmp_path / "run", progress=lambda _: None)
    own = mcaprl.evaluate(tmp_path / "run", "lane", episodes=2)
    given = mcaprl.evaluate(tmp_path / "run", "lane", episodes=2, rules="classic")
    assert [s.mean_return for s in own.policies] == [s.mean_return for s in given.policies]


class Noted(Wide):
    """An environment with a Dict of a vector and a list of any length."""

    def __init__(self) -> None:
        super().__init__()
        inner = {"x": self.observation_space, "note": spaces.Sequence(spaces.Discrete(9))}
        self.observation_space = spaces.Dict(inner)

    def _see(self) -> Any:
        return {"x": self.np_random.uniform(-9, 9, 2).astype(np.float32), "note": (1,)}


def test_a_policy_of_some_keys_acts_in_the_whole_environment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gym.register("Noted-v0", cast(Any, Noted), disable_env_checker=True, max_episode_steps=9)
    try:
        log = tmp_path / "log.mcap"
        record = ["record", "Noted-v0", "--policy", "random", "--episodes", "2", "--out", str(log)]
        assert run(record) == 1
        assert "leave it out with --keys x" in capsys.readouterr().err
        assert run([*record, "--keys", "x"]) == 0
        data = mcaprl.open(log)
        assert data.observation_space == spaces.Dict({"x": spaces.Box(-9, 9, (2,), np.float32)})
        config = BCConfig(updates=2, hidden=(4,))
        train_offline(data, config, tmp_path / "run", progress=lambda _: None)
        out = tmp_path / "evaluated.mcap"
        evaluate = ["evaluate", str(tmp_path / "run"), "--sim", "Noted-v0", "--episodes", "2"]
        assert run([*evaluate, "--record", str(out), "--keys", "x"]) == 0
        actions = mcaprl.open(out).actions
        policy = mcaprl.load_policy(tmp_path / "run")
        assert actions.tolist() == policy.act(mcaprl.open(out).observations).tolist()
        assert run([*evaluate, "--keys", "x"]) == 2
        with pytest.raises(SpaceError, match="note"):
            mcaprl.evaluate(tmp_path / "run", "Noted-v0", episodes=1, record=tmp_path / "no.mcap")
    finally:
        gym.registry.pop("Noted-v0")


class Said(Noted):
    """An environment with a Dict of a vector and a text, as MiniGrid has."""

    def __init__(self) -> None:
        super().__init__()
        inner = {"x": spaces.Box(-9, 9, (2,), np.float32), "note": spaces.Text(9)}
        self.observation_space = spaces.Dict(inner)

    def _see(self) -> Any:
        return {**super()._see(), "note": "hello"}


def test_a_text_is_an_info_and_no_input_of_a_policy(tmp_path: Path) -> None:
    gym.register("Said-v0", cast(Any, Said), disable_env_checker=True, max_episode_steps=9)
    try:
        log = tmp_path / "log.mcap"
        mcaprl.record("Said-v0", log, policy="random", episodes=2)
        data = mcaprl.open(log)
        assert data.observation_space == spaces.Dict({"x": spaces.Box(-9, 9, (2,), np.float32)})
        assert set(data.infos["observation.note"].tolist()) == {"hello"}
        config = BCConfig(updates=2, hidden=(4,))
        train_offline(data, config, tmp_path / "run", progress=lambda _: None)
        out = tmp_path / "evaluated.mcap"
        mcaprl.evaluate(tmp_path / "run", "Said-v0", episodes=2, record=out)
        policy = mcaprl.load_policy(tmp_path / "run")
        found = mcaprl.open(out)
        assert found.actions.tolist() == policy.act(found.observations).tolist()
        assert mcaprl.verify(log, trust_env=True).difference is None
    finally:
        gym.registry.pop("Said-v0")


def test_a_policy_of_a_tuple_acts_in_its_environment(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    mcaprl.record("Blackjack-v1", log, policy="random", episodes=20)
    config = BCConfig(updates=2, hidden=(4,))
    train_offline(mcaprl.open(log), config, tmp_path / "run", progress=lambda _: None)
    again = tmp_path / "again.mcap"
    mcaprl.record("Blackjack-v1", again, policy=tmp_path / "run", episodes=5)
    data = mcaprl.open(again)
    policy = mcaprl.load_policy(tmp_path / "run")
    assert data.actions.tolist() == policy.act(data.observations).tolist()


def test_a_layout_of_some_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gym.register("Noted-v0", cast(Any, Noted), disable_env_checker=True)
    try:
        out = ["--out", str(tmp_path / "layout.json")]
        assert run(["layout", "Noted-v0", *out]) == 1
        assert "--keys x" in capsys.readouterr().err
        assert run(["layout", "Noted-v0", *out, "--keys", "x"]) == 0
    finally:
        gym.registry.pop("Noted-v0")

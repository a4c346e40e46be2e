"""Tests that an untrusted log cannot import a module or pass arguments to an environment."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.format.metadata import LogMetadata, same_env
from mcaprl.sims import make_sim, make_sims
from tests.support.damage.forged_logs import forged

MODULE = '''
"""Registers an environment when it is imported, and leaves a file."""
from pathlib import Path

import gymnasium as gym
from gymnasium.envs.classic_control.cartpole import CartPoleEnv

Path("imported").touch()


class Foreign(CartPoleEnv):
    """An environment of the module."""


gym.register("Foreign-v0", "foreign_envs:Foreign")
'''


@pytest.fixture
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Prepare a working folder, and a module `foreign_envs` on Python's import path."""
    (tmp_path / "foreign_envs.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    unload()
    yield tmp_path
    unload()


def unload() -> None:
    sys.modules.pop("foreign_envs", None)
    gym.registry.pop("Foreign-v0", None)


def recorded(path: Path, **options: Any) -> Path:
    assert path.name.endswith(".mcap")
    with closing(mcaprl.RecordMcap(make_sim("foreign_envs:Foreign-v0"), path, **options)) as env:
        env.reset(seed=0)
        for _ in range(5):
            env.step(0)
    unload()
    Path("imported").unlink()
    return path


STEPPING: list[Callable[[Path, dict[str, Any]], Any]] = [
    lambda log, options: mcaprl.verify(log, **options),
    lambda log, options: mcaprl.render(log, video=log.with_suffix(".gif"), **options),
    lambda log, options: mcaprl.annotate(log, log.with_name("o.mcap"), scene=True, **options),
]


@pytest.mark.parametrize("step", STEPPING)
def test_a_module_is_imported_only_with_trust(foreign: Path, step: Any) -> None:
    pytest.importorskip("imageio")
    log = recorded(foreign / "log.mcap")
    with pytest.raises(
        UsageError, match=r"foreign_envs would be imported.*`trust_env=True` or `sim='"
    ):
        step(log, {})
    assert not Path("imported").exists()
    # Some commands fail later, because the environment lacks what they need.
    with contextlib.suppress(UsageError):
        step(log, {"trust_env": True})
    assert Path("imported").exists()


def test_a_log_names_the_module_that_registers_its_environment(foreign: Path) -> None:
    log = recorded(foreign / "log.mcap")
    assert mcaprl.open(log).env_id == "foreign_envs:Foreign-v0"
    assert mcaprl.verify(log, trust_env=True).difference is None
    unload()
    assert mcaprl.verify(log, sim="foreign_envs:Foreign-v0").difference is None


def test_registered_arguments_need_no_trust(foreign: Path) -> None:
    module = foreign / "foreign_envs.py"
    module.write_text(
        MODULE.replace(':Foreign")', ':Foreign", kwargs={"sutton_barto_reward": True})')
    )
    log = recorded(foreign / "log.mcap")
    assert mcaprl.open(log).env_kwargs == {"sutton_barto_reward": True}
    assert mcaprl.verify(log, sim="foreign_envs:Foreign-v0").difference is None
    with closing(make_sims("foreign_envs:Foreign-v0", 2)) as envs:
        assert LogMetadata.of_env(envs).env_id == "foreign_envs:Foreign-v0"
    with closing(make_sim("CartPole-v1")) as env:
        assert LogMetadata.of_env(env).env_id == "CartPole-v1"


def test_gym_make_is_enough_to_name_the_module(foreign: Path) -> None:
    importlib.import_module("foreign_envs")
    log = foreign / "log.mcap"
    with mcaprl.RecordMcap(gym.make("Foreign-v0"), log) as env:
        env.reset(seed=0)
        env.step(0)
    assert mcaprl.open(log).env_id == "foreign_envs:Foreign-v0"
    assert mcaprl.verify(log).difference is None, "the program has imported the module itself"
    unload()
    with pytest.raises(UsageError, match="module foreign_envs would be imported"):
        mcaprl.verify(log)


def test_an_id_without_its_module_is_reported(
    foreign: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("mcaprl.recorder.format.metadata._env_id", lambda env: env.spec.id)
        log = recorded(foreign / "log.mcap")
    unload()
    assert run(["replay", str(log), "--verify"]) == 2
    assert "Foreign-v0, which is not registered: pass --sim MODULE:Foreign-v0" in (
        capsys.readouterr().err
    )


def test_the_options_of_the_command_line(foreign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(recorded(foreign / "log.mcap"))
    assert run(["replay", log, "--verify"]) == 2
    assert "--trust-env" in capsys.readouterr().err
    assert run(["replay", log, "--verify", "--trust-env"]) == 0
    assert run(["replay", log, "--verify", "--sim", "foreign_envs:Foreign-v0"]) == 0
    assert run(["annotate", log, "--scene", "--out", "out.mcap"]) == 2


def test_logs_without_the_module_can_be_appended_to(
    foreign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("mcaprl.recorder.format.metadata._env_id", lambda env: env.spec.id)
        log = recorded(foreign / "log.mcap")
    assert mcaprl.open(log).env_id == "Foreign-v0"
    recorded(log, append=True)
    assert len(mcaprl.open(log).episodes) == 2
    with pytest.raises(LogError, match="its env_id is"):
        mcaprl.RecordMcap(make_sim("CartPole-v1"), log, append=True)


def test_ids_with_and_without_a_module_are_of_one_environment() -> None:
    assert same_env("a:Env-v0", "Env-v0")
    assert same_env("Env-v0", "a:Env-v0")
    assert not same_env("a:Env-v0", "b:Env-v0")
    assert not same_env("a:Env-v0", "Env-v1")


def test_arguments_are_passed_to_other_environments_only_with_trust(log_path: Path) -> None:
    with closing(
        mcaprl.RecordMcap(make_sim("CartPole-v1", sutton_barto_reward=True), log_path)
    ) as env:
        env.reset(seed=0)
        env.step(0)
    with pytest.raises(UsageError, match=r"arguments of CartPole-v1: sutton_barto_reward=True"):
        mcaprl.verify(log_path)
    assert mcaprl.verify(log_path, trust_env=True).difference is None


def test_own_sims_need_no_trust(log_path: Path) -> None:
    with closing(mcaprl.RecordMcap(make_sim("lane", rules="classic"), log_path)) as env:
        env.reset(seed=0)
        env.step(0)
    assert mcaprl.verify(log_path).difference is None


@pytest.mark.parametrize("name", ["name", "id", "no_such_argument"])
def test_arguments_that_a_sim_does_not_have_are_refused(log_path: Path, name: str) -> None:
    forged(log_path, env_id="mcaprl/LaneKeeping-v0", env_kwargs=f'{{"{name}": "os:x"}}')
    with pytest.raises(UsageError, match=r"cannot make sim|has no argument"):
        mcaprl.verify(log_path)

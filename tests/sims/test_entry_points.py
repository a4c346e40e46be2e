"""Tests of sims that installed packages add through entry points."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BOATS = """
import gymnasium as gym
import numpy as np
from mcaprl.sims import SimSpec

class BoatEnv(gym.Env):
    observation_space = gym.spaces.Box(-9.0, 9.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x_m = 0.0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.x_m += 2.0 * float(action) - 1.0
        return np.full(1, self.x_m, np.float32), self.x_m, False, False, {}

class BoatPilot:
    name = "pilot"

    def __init__(self, sim):
        assert isinstance(sim, BoatEnv)

    def act(self, observations):
        return np.ones(len(observations), np.int64)

def spec():
    return SimSpec("boat", "boats/Boat-v0", BoatEnv, max_episode_steps=3, pilot=BoatPilot)
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Install a package that adds the sim `boat` into a folder, and return the folder."""
    install(tmp_path / "site", "boats", "boat = boats:spec", BOATS)
    return tmp_path / "site"


def install(site: Path, package: str, entry_point: str, code: str) -> None:
    """Write the module and the metadata of a package, like an installer."""
    info = site / f"{package}-1.0.dist-info"
    info.mkdir(parents=True)
    (site / f"{package}.py").write_text(code)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[mcaprl.sims]\n{entry_point}\n")


def python(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the packages of a folder installed."""
    path = os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )


def test_an_installed_sim_is_recorded_and_evaluated(site: Path, tmp_path: Path) -> None:
    log = tmp_path / "boat.mcap"
    command = ("-m", "mcaprl.cli", "record", "boat", "--policy", "pilot", "--episodes", "2")
    recorded = python(site, *command, "--out", str(log))
    assert recorded.returncode == 0, recorded.stderr
    done = python(site, "-m", "mcaprl.cli", "info", str(log), "--json")
    summary = json.loads(done.stdout)
    assert (summary["env_id"], summary["steps"], summary["mean_return"]) == ("boats/Boat-v0", 6, 6)
    command = ("-m", "mcaprl.cli", "evaluate", "pilot", "--sim", "boat", "--episodes", "2")
    evaluated = python(site, *command, "--json")
    assert evaluated.returncode == 0, evaluated.stderr
    scores = {one["policy"]: one for one in json.loads(evaluated.stdout)["policies"]}
    assert scores["pilot"]["normalized_score"] == 1.0
    assert scores["pilot"]["returns"] == [6.0, 6.0]


def test_an_installed_sim_is_loaded_on_first_use(site: Path) -> None:
    code = """
import sys
import mcaprl
from mcaprl.sims import SIMS, make_sim
from mcaprl.sims.evaluation.evaluate import make_pilot
assert "boat" in SIMS and list(SIMS)[-1] == "boat" and len(SIMS) == 5
make_sim("CartPole-v1")
assert "boats" not in sys.modules
env = make_sim("boats/Boat-v0")
assert (env.spec.id, env.spec.max_episode_steps) == ("boats/Boat-v0", 3)
assert SIMS["boat"] == "boats/Boat-v0" and make_pilot(env).name == "pilot"
"""
    done = python(site, "-W", "error", "-c", code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("entry_point", "code", "reason"),
    [
        ("raft = rafts:spec", "import no_such_engine", "No module named 'no_such_engine'"),
        ("raft = rafts:spec", "", "has no attribute 'spec'"),
        ("raft = rafts:spec", "spec = lambda: 1 / 0", "ZeroDivisionError: division by zero"),
        ("raft = rafts:spec", "spec = lambda: 3", "must return a SimSpec named 'raft', not 3"),
        ("raft = boats:spec", "", "must return a SimSpec named 'raft', not SimSpec(name='boat'"),
    ],
)
def test_a_broken_entry_point_is_named_and_breaks_nothing_else(
    site: Path, entry_point: str, code: str, reason: str
) -> None:
    install(site, "rafts", entry_point, code)
    check = """
import mcaprl, pytest
from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.sims import SIMS, make_sim
assert {"boat", "raft"} < set(SIMS)
make_sim("boat"), make_sim("CartPole-v1")
with pytest.raises(UsageError) as caught:
    make_sim("raft")
print(caught.value)
with pytest.warns(UserWarning, match="entry point 'raft = "), pytest.raises(UnknownNameError):
    make_sim("rafts/Raft-v0")
"""
    done = python(site, "-c", check)
    assert done.returncode == 0, done.stderr
    assert f"entry point '{entry_point}' in group 'mcaprl.sims' of package 'rafts'" in done.stdout
    assert reason in done.stdout
    assert done.stdout.count("\n") == 1


def test_an_installed_package_does_not_replace_our_own_sims(site: Path) -> None:
    install(site, "rafts", "lane = boats:spec", "")
    code = "from mcaprl.sims import SIMS; print(SIMS['lane'], list(SIMS).count('lane'))"
    assert python(site, "-c", code).stdout == "mcaprl/LaneKeeping-v0 1\n"

"""The robots of examples/06_drive, each in a separate process, driven over DDS on this machine."""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.base_policy import BasePolicy

pytest.importorskip("cyclonedds")
EXAMPLE = Path(__file__).parents[2] / "examples" / "06_drive"
DOMAIN = itertools.count(160 + os.getpid() % 30)
KINDS = {
    "car": ("lane", "continuous"),
    "car-buttons": ("lane", "discrete"),
    "drone": ("powerline", "continuous"),
    "drone-buttons": ("powerline", "discrete"),
}


class Pursuit(BasePolicy):
    """Steers to the point 5 m ahead, at 7 m/s."""

    name = "pursuit"
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def act(self, observations: Any) -> Any:
        """Return pedal and steering; the track has the point at 3 and 4, the speed is at 11."""
        forward, left = observations[:, 3], observations[:, 4]
        steering = 2.7 * 2 / 5 * left / (forward**2 + left**2) / 0.65
        pedal = 2 * (7 / 30 - observations[:, 11]) * 30 / 4
        return np.clip(np.stack([pedal, steering], axis=1), -1, 1).astype(np.float32)


def robot(*arguments: Any, **options: Any) -> subprocess.Popen[str]:
    """Start a robot."""
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLE.parents[1]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(EXAMPLE / "robot.py"), *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, **options)


def recorded(folder: Path, kind: str, *arguments: Any) -> Path:
    """Return a bag of a robot that its pilot drives."""
    process = robot(*KINDS[kind], "--pilot", "--bag", folder, "--limit", 30, *arguments)
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0, out
    return folder


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("robot") / "bag", "car", "--episodes", 2)


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_bag_of_the_pilot_has_its_episodes(kind: str, tmp_path: Path) -> None:
    bag = recorded(tmp_path / "bag", kind, "--episodes", 2, "--drop", 0.05)
    with mcaprl.open_bag(bag) as opened:
        expected = "/depth" if "drone" in kind else "/scan"
        assert opened.topics[expected].count > 0
        assert opened.topics["/odom"].count < opened.topics["/track"].count, "some are lost"
    data = mcaprl.open(bag, mapping=EXAMPLE / f"{kind}.yaml")
    assert data.episode_lengths.tolist() == [30, 30]
    assert data.rewards.mean() > 0


def drive(car: Path, tmp_path: Path, *arguments: Any, **options: Any) -> tuple[Any, str]:
    """Drive the car; return the status at the end and what the robot printed."""
    domain = next(DOMAIN)
    process = robot("lane", "continuous", "--domain", domain, *arguments)
    driver = mcaprl.Driver(Pursuit(), mapping=EXAMPLE / "car.yaml", bag=car)
    try:
        status = mcaprl.drive_robot(driver, "dds", domain_id=domain, deadline_s=1.0, **options)
        out, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0
    return status, out


def test_a_car_is_driven_over_dds(car: Path, tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    request = ("--episodes", 2, "--limit", 60, "--period", 0.04, "--bag", bag)
    status, out = drive(car, tmp_path, *request, duration_s=20)
    found = re.search(r"score (\S+)", out)
    assert found is not None
    # It is slower than the pilot, but stays in the lane.
    assert 0.2 < float(found[1]) < 1
    assert status.driven >= 110
    assert status.steps >= status.driven
    data = mcaprl.open(bag, mapping=EXAMPLE / "car.yaml")
    # An episode whose first command is late is left out.
    assert set(data.episode_lengths.tolist()) == {60}
    assert not data.terminated.any()
    # The robot recorded the commands that the policy gave.
    wanted = Pursuit().act(data.observations)
    close = np.abs(wanted - data.actions).max(axis=1) < 1e-5
    assert close.mean() > 0.9


def test_a_car_stops_if_its_scanner_dies(car: Path, tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    request = ("--episodes", 1, "--limit", 120, "--period", 0.04, "--dies", "/scan", "--bag", bag)
    status, _ = drive(car, tmp_path, *request, "--after", 80, duration_s=20)
    with mcaprl.open_bag(bag) as opened:
        pedals = opened.read("/cmd_vel", ["linear.x"]).columns["linear.x"]
    # The scan may be .5 s old.
    assert 40 < status.driven < 110
    assert pedals[-1] == -1
    assert (pedals != -1).any()

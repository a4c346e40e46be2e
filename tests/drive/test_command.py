"""Tests of the command `drive`, with a policy that was trained from a small bag."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mcaprl
from mcaprl.cli import run
from tests.support.bags import write_rosbag2

MAPPING = """
clock: {topic: /joints}
observation:
  speed: {field: /odom.twist.twist.linear.x}
action: {fields: [/cmd_vel.angular.z], box: {low: -1, high: 1}}
"""


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a bag, its mapping, and a run."""
    folder = tmp_path_factory.mktemp("trained")
    write_rosbag2(folder / "bag")
    (folder / "robot.yaml").write_text(MAPPING)
    data = mcaprl.open(folder / "bag", mapping=folder / "robot.yaml")
    mcaprl.train(data, folder / "run", algo="bc", updates=2, batch_size=4)
    return folder


def test_a_bag_is_played(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["drive", str(trained / "run"), "--bag", str(trained / "bag")]) == 0
    out, err = capsys.readouterr()
    assert "/odom" in out
    assert "nav_msgs/msg/Odometry" in out
    assert "/cmd_vel.angular.z" in out
    assert "12 steps, 12 driven" in out
    assert err == ""


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ([], 2, "choose one of --dds, --ros1, --ros2 and --bag"),
        (["--dds", "--ros2"], 2, "choose one of --dds, --ros1, --ros2 and --bag"),
        (["--dds", "--dry-run", "--record", "out.mcap"], 2, "a dry run cannot be recorded"),
        (["--ros2", "--domain-id", "3"], 2, "--domain-id and --interface are for"),
        (["--dds", "--enable", "joy"], 2, "--enable joy is neither the topic of a Bool"),
        (["--dds", "--interface", "nic9"], 2, "cannot join DDS domain"),
        (["--bag", "missing"], 1, "missing"),
    ],
)
def test_a_wrong_request_is_one_line(
    trained: Path,
    arguments: list[str],
    code: int,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if "--interface" in arguments:
        pytest.importorskip("cyclonedds")
    assert run(["drive", str(trained / "run"), *arguments]) == code
    out, err = capsys.readouterr()
    assert message in err
    assert len(err.splitlines()) == 1
    assert "driven" not in out or "0 driven" in out


def test_a_run_without_a_robot_cannot_drive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log.mcap"
    mcaprl.record("CartPole-v1", log, policy="random", episodes=2)
    mcaprl.train(log, tmp_path / "run", algo="bc", updates=2, batch_size=4)
    assert run(["drive", str(tmp_path / "run"), "--dds"]) == 2
    assert "has no robot.json" in capsys.readouterr().err


def test_a_drive_is_recorded_as_a_log(trained: Path, tmp_path: Path) -> None:
    """The log of a drive has the actions that the policy would choose again."""
    from tests.support.memory_robot import MemoryTransport

    def script(robot: MemoryTransport) -> None:
        for step in range(6):
            robot.send(step, "/odom", "/joints")

    log = tmp_path / "drive.mcap"
    robot = MemoryTransport(script)
    found = mcaprl.drive_robot(trained / "run", robot, record=log, duration_s=1.5, deadline_s=1.0)
    assert found.driven == 6
    data = mcaprl.open(log)
    policy = mcaprl.load_policy(trained / "run")
    np.testing.assert_allclose(policy.act(data.observations), data.actions, atol=1e-6)
    turns = robot.turns[: len(data.actions)]
    np.testing.assert_allclose(turns, data.actions[:, 0], atol=1e-6)

"""Tests of the loop that drives a robot: when it commands, and when it stops.

Each test is a script of messages and the list of commands that it must lead to.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.errors import LogError, OutputExistsError, UsageError
from tests.support.bags import START_NS, STORE2, write_rosbag1, write_rosbag2
from tests.support.memory_robot import TURN, Cruise, MemoryTransport, driver

ALL = ("/joints", "/odom")
STOP = 0.0


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rosbag2(tmp_path_factory.mktemp("drive") / "bag")


def drive(bag: Path, script: Any, policy: Any = None, **options: Any) -> tuple[Any, list[float]]:
    """Drive for .5 s, or as long as the options say; return the status and all turns."""
    changes = options.pop("changes", {})
    robot = MemoryTransport(script)
    status: list[Any] = []
    # A test computer may be slow.
    options = {"duration_s": 0.5, "deadline_s": 5.0, "on_status": status.append, **options}
    try:
        mcaprl.drive_robot(driver(bag, policy, **changes), robot, **options)
    finally:
        assert robot.is_closed == bool(status)
        drive.turns = robot.turns  # type: ignore[attr-defined]
    return status[-1], robot.turns


def test_a_robot_is_commanded_at_each_step_and_stopped_at_the_end(bag: Path) -> None:
    def script(robot: MemoryTransport) -> None:
        for step in range(4):
            robot.send(step, *ALL)
            time.sleep(0.02)

    status, turns = drive(bag, script, duration_s=0.3)
    assert turns == [TURN] * 4 + [STOP] * 5, status
    assert (status.steps, status.driven, status.missed, status.dropped) == (4, 4, 0, 0)
    assert status.state == "driving"
    assert 0 < status.latency_p50_ms <= status.latency_p99_ms < 100
    assert {each.name: each.count for each in status.topics} == {"/odom": 4, "/joints": 4}
    assert all(each.age_s > 0.1 for each in status.topics)


def test_nothing_is_commanded_before_all_inputs_are_there(bag: Path) -> None:
    def script(robot: MemoryTransport) -> None:
        for step in range(5):
            robot.send(step, "/joints")
            time.sleep(0.01)

    status, turns = drive(bag, script, duration_s=0.2)
    assert turns == []
    assert (status.steps, status.driven) == (5, 0)
    assert status.state == "speed: no message of /odom yet"


def test_a_robot_stops_if_an_input_dies(bag: Path) -> None:
    def script(robot: MemoryTransport) -> None:
        robot.send(0, *ALL)
        for step in range(8):
            time.sleep(0.1)
            robot.send(step, "/joints")

    # The odometry may be .3 s old.
    status, turns = drive(bag, script, duration_s=0.8)
    assert turns[:3] == [TURN] * 3
    stops = turns.index(STOP)
    assert stops in (3, 4)
    assert set(turns[stops:]) == {STOP}
    assert status.driven == stops


def test_a_robot_stops_if_the_clock_dies(bag: Path) -> None:
    def script(robot: MemoryTransport) -> None:
        robot.send(0, *ALL)

    changes = {"drive": {"timeout_s": 0.2}}
    status, turns = drive(bag, script, duration_s=0.8, deadline_s=0.2, changes=changes)
    assert turns[:2] == [TURN, STOP]
    assert set(turns[1:]) == {STOP}
    assert len(turns) > 2, "a single stop may be lost"
    assert status.state.startswith("no step for 0.4")


def test_a_late_command_is_replaced_by_the_stop_command(bag: Path) -> None:
    class Slow(Cruise):
        def act(self, observations: Any) -> Any:
            self.delay_s = 0.5 if self.calls == 1 else 0.0
            self.calls += 1
            return super().act(observations)

        calls = 0

    def script(robot: MemoryTransport) -> None:
        for step in range(3):
            robot.send(step, *ALL)
            time.sleep(0.6)

    changes = {"drive": {"timeout_s": 5}}
    status, turns = drive(bag, script, Slow(), duration_s=1.8, deadline_s=0.4, changes=changes)
    assert status.missed == 1, status
    assert (status.steps, status.driven) == (3, 2)
    assert turns[0] == TURN
    assert turns[1] == STOP
    assert TURN in turns[2:]


@pytest.mark.parametrize("path", ["/enable", "/joy.buttons[4]"])
def test_a_robot_moves_only_while_the_switch_is_held(bag: Path, path: str) -> None:
    topic = path.partition(".")[0]

    def press(robot: MemoryTransport, is_on: bool) -> None:
        types = STORE2.types
        if topic == "/enable":
            message = types["std_msgs/msg/Bool"](is_on)
        else:
            header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "joy")
            buttons = np.array([0, 0, 0, 0, is_on], np.int32)
            message = types["sensor_msgs/msg/Joy"](header, np.empty(0, np.float32), buttons)
        data = bytes(STORE2.serialize_cdr(message, message.__msgtype__))
        robot.receive(topic, data, robot.now_ns())

    def script(robot: MemoryTransport) -> None:
        for step, is_on in enumerate([None, True, True, False, False, True]):
            if is_on is not None:
                press(robot, is_on)
            robot.send(step, *ALL)
            time.sleep(0.02)
        # Without new messages the switch is off.
        time.sleep(0.6)
        robot.send(6, *ALL)

    status, turns = drive(bag, script, enable=path, duration_s=0.9)
    # The stop command is repeated for a short time, and a person may drive then.
    assert [turn for turn in turns if turn] == [TURN] * 3
    assert turns[:3] == [TURN, TURN, STOP]
    assert status.steps == 7
    assert status.driven == 3


@pytest.mark.parametrize("path", ["enable", "/odom.pose", "/other.field"])
def test_a_switch_that_is_none_is_refused(bag: Path, path: str) -> None:
    def script(robot: MemoryTransport) -> None:
        robot.send(0, *ALL)
        robot.send(1, *ALL)

    with pytest.raises((UsageError, LogError), match=r"neither the topic of a Bool|has no switch"):
        drive(bag, script, enable=path)
    assert not any(drive.turns)  # type: ignore[attr-defined]


def test_a_dry_run_publishes_nothing(bag: Path) -> None:
    def script(robot: MemoryTransport) -> None:
        robot.send(0, *ALL)

    status, turns = drive(bag, script, dry_run=True)
    assert turns == []
    assert status.driven == 1


def other_type(robot: MemoryTransport) -> None:
    message = STORE2.types["std_msgs/msg/Bool"](True)
    data = bytes(STORE2.serialize_cdr(message, message.__msgtype__))
    robot.receive("/odom", data, robot.now_ns())


def clock_in_the_past(robot: MemoryTransport) -> None:
    robot.now_ns = lambda: START_NS  # type: ignore[method-assign]
    robot.send(1, *ALL)


def node_of_another_type(robot: MemoryTransport) -> None:
    robot.problem = "a node has messages of std_msgs/msg/Bool on /odom"


@pytest.mark.parametrize("fault", [other_type, clock_in_the_past, node_of_another_type])
def test_a_fault_stops_the_robot_and_ends_the_drive(bag: Path, fault: Any) -> None:
    def script(robot: MemoryTransport) -> None:
        robot.send(0, *ALL)
        time.sleep(0.05)
        fault(robot)

    with pytest.raises(LogError, match=r"odom|clock|time") as error:
        drive(bag, script, duration_s=2)
    assert error.value.exit_code == 1
    assert "\n" not in str(error.value)
    turns = drive.turns  # type: ignore[attr-defined]
    assert turns[:2] == [TURN, STOP]
    assert set(turns[1:]) == {STOP}


def test_an_image_of_another_size_stops_the_robot(bag: Path) -> None:
    def script(robot: MemoryTransport) -> None:
        robot.send(0, "/camera/depth")
        time.sleep(0.05)
        image = STORE2.types["sensor_msgs/msg/Image"]
        header = STORE2.types["std_msgs/msg/Header"]
        stamp = STORE2.types["builtin_interfaces/msg/Time"](0, 0)
        other = image(header(stamp, ""), 2, 2, "16UC1", 0, 4, np.zeros(8, np.uint8))
        data = bytes(STORE2.serialize_cdr(other, other.__msgtype__))
        robot.receive("/camera/depth", data, robot.now_ns())

    changes = {
        "observation": {"depth": {"image": "/camera/depth"}},
        "clock": {"topic": "/camera/depth"},
    }
    with pytest.raises(LogError, match="image"):
        drive(bag, script, duration_s=2, changes=changes)
    turns = drive.turns  # type: ignore[attr-defined]
    assert turns[:2] == [TURN, STOP]


def interrupted(bag: Path, number: int, error: type[BaseException]) -> None:
    """Drive until a signal comes, which raises an error, and check that the robot is stopped."""

    def script(robot: MemoryTransport) -> None:
        robot.send(0, *ALL)
        time.sleep(0.05)
        os.kill(os.getpid(), number)

    with pytest.raises(error):
        drive(bag, script, duration_s=5)
    assert drive.turns == [TURN] + [STOP] * 5  # type: ignore[attr-defined]


@pytest.mark.usefixtures("python_signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_the_robot(bag: Path, number: int) -> None:
    interrupted(bag, number, KeyboardInterrupt)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.usefixtures("python_signals")
def test_a_signal_that_the_program_handles_stops_the_robot(bag: Path) -> None:
    def leave(number: int, _: object) -> None:
        sys.exit(number)

    signal.signal(signal.SIGTERM, leave)
    interrupted(bag, signal.SIGTERM, SystemExit)
    assert signal.getsignal(signal.SIGTERM) is leave


def test_messages_that_come_too_fast_are_dropped(bag: Path) -> None:
    class Slow(Cruise):
        delay_s = 2.0

    def script(robot: MemoryTransport) -> None:
        robot.send(0, *ALL)
        time.sleep(0.2)
        for _ in range(20_000):
            robot.send(1, "/odom")

    status, _ = drive(bag, script, Slow(), duration_s=4, deadline_s=9)
    assert status.dropped >= 1
    assert sum(each.count for each in status.topics) + status.dropped <= 20_002


def test_a_fixed_rate_drives_between_messages(bag: Path) -> None:
    def script(robot: MemoryTransport) -> None:
        robot.send(0, *ALL)

    changes = {"clock": {"rate_hz": 20}, "drive": {"timeout_s": 0.25}}
    status, turns = drive(bag, script, duration_s=0.6, changes=changes)
    # A step each 50 ms as long as the message is not older than .25 s; then the robot stops.
    assert 4 <= turns.count(TURN) <= 6
    assert turns[turns.count(TURN)] == STOP
    assert status.steps >= 8


def test_a_bag_shows_what_would_have_been_commanded(bag: Path, tmp_path: Path) -> None:
    old = write_rosbag1(tmp_path / "old.bag")
    for each in (bag, old):
        status = mcaprl.drive_robot(driver(bag), "bag", bag=each)
        assert status.driven == status.steps == 12
        assert status.topics[0].rate_hz == pytest.approx(12 / 1.1)
        (turn,) = [each for each in status.compared if each.field == "/cmd_vel.angular.z"]
        # The bag has each command before the message of the step. It turns by -1 and 1 in turn
        # after the first step, the policy by .5: 6 differences are 1.5, and 5 are .5.
        assert turn.steps == 11
        assert turn.logged == pytest.approx(-1 / 11)
        assert turn.commanded == TURN
        assert turn.difference == pytest.approx(((6 * 1.5**2 + 5 * 0.5**2) / 11) ** 0.5)
        assert np.isnan(turn.correlation)
        assert [each.field for each in status.compared] == [
            "/cmd_vel.angular.z",
            "/cmd_vel.linear.x",
        ]
    beside = tmp_path / "beside.mcap"
    mcaprl.drive_robot(driver(bag), "bag", bag=bag, record=beside)
    with mcaprl.open_bag(beside) as opened:
        for topic, expected in (("/cmd_vel", [1.0, -1.0] * 6), ("/mcaprl/cmd_vel", [TURN] * 12)):
            found = opened.read(topic, ["angular.z"]).columns["angular.z"]
            assert found.tolist()[:12] == expected
    with pytest.raises(OutputExistsError):
        mcaprl.drive_robot(driver(bag), "bag", bag=bag, record=beside)
    with pytest.raises(UsageError, match="a dry run cannot be recorded"):
        mcaprl.drive_robot(driver(bag), "dds", dry_run=True, record=tmp_path / "log.mcap")
    with pytest.raises(UsageError, match="are for `transport='dds'`"):
        mcaprl.drive_robot(driver(bag), "ros2", interface="eth0")
    with pytest.raises(UsageError, match="needs `bag=`"):
        mcaprl.drive_robot(driver(bag), "bag")
    with pytest.raises(UsageError, match="unknown transport 'rso1': did you mean ros1"):
        mcaprl.drive_robot(driver(bag), "rso1")

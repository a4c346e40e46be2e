"""Continuous commands of a robot as actions: names, units, limits and densities."""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.api.convert import Conversion
from mcaprl.errors import UsageError
from mcaprl.files import parse_json, write_json
from mcaprl.recorder.mapping.actions import unit_of
from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.draft import suggested
from mcaprl.recorder.mapping.read import MappedBag, read_open_bag
from tests.support.memory_bag import MemoryBag

TWIST = "geometry_msgs/msg/Twist"
FORWARD, TURN = [0.5, 2.0, 1.0, 0.0, 9.0], [-0.25, 0.0, 0.75, 0.1, 9.0]


def robot(**topics: Any) -> MemoryBag:
    """Return a bag with a command and a measurement a second; the last command acts no more."""
    times = [float(k) for k in range(5)]
    commands = {"linear.x": FORWARD, "linear.y": [0.0] * 5, "angular.z": TURN}
    return MemoryBag(
        {"/cmd_vel": (times, commands), "/odom": (times, {"speed": times}), **topics},
        types={"/cmd_vel": TWIST},
    )


def read(action: dict[str, Any], bag: MemoryBag | None = None, **parts: Any) -> MappedBag:
    tree = {
        "clock": {"rate_hz": 1},
        "observation": {"speed": {"field": "/odom.speed"}},
        "action": action,
        **parts,
    }
    return read_open_bag(bag or robot(), parse_mapping(tree))


def limits(data: mcaprl.Dataset) -> list[list[float]]:
    space = data.action_space
    assert isinstance(space, spaces.Box)
    return [space.low.tolist(), space.high.tolist()]


FIELDS = ["/cmd_vel.linear.x", "/cmd_vel.angular.z"]
LIMITED = {"fields": FIELDS, "box": {"low": [0, -1], "high": [2, 1]}}


def test_parts_have_the_names_and_units_of_their_fields() -> None:
    data, report = read(LIMITED)
    assert limits(data) == [[0, -1], [2, 1]]
    assert data.action_part_names == ("linear.x", "angular.z")
    assert data.action_units == ("m/s", "rad/s")
    labels = ["linear.x (0 to 2 m/s)", "angular.z (-1 to 1 rad/s)"]
    assert (list(data.action_labels), report.action_parts) == (labels, labels)
    assert ("action", ", ".join(labels)) in report.rows()
    assert report.to_json()["action_parts"] == labels
    columns, rows = Conversion(data, report, None).first_table()
    assert rows[0][columns.index("action")] == "0.5, -0.25"


def test_names_of_elements_expressions_and_several_topics() -> None:
    times = [float(k) for k in range(5)]
    ramp = [[k, k + 1.0] for k in times]
    more = {
        "/arm": (times, {"position": ramp}),
        "/left/cmd": (times, {"v": FORWARD}),
        "/right/cmd": (times, {"v": TURN}),
    }
    box = {"low": -9, "high": 9}
    for fields, names in (
        (["/arm.position"], ("position[0]", "position[1]")),
        (["/arm.position[1]", "/left/cmd.v"], ("position[1]", "v")),
        (["/left/cmd.v", "/right/cmd.v"], ("/left/cmd.v", "/right/cmd.v")),
    ):
        data = read({"fields": fields, "box": box}, robot(**more)).dataset
        assert data.action_part_names == names
        assert data.action_units == ()
    data = read({"expressions": ["next(speed) - speed"], "box": box}).dataset
    assert data.action_part_names == ("next(speed) - speed",)


def test_units_of_the_mapping() -> None:
    data = read({**LIMITED, "units": ["m/s", "right | left"]}).dataset
    assert data.action_labels == ("linear.x (0 to 2 m/s)", "angular.z (-1 right, 1 left)")
    with pytest.raises(UsageError, match="units needs 2 entries, one for each of fields"):
        read({**LIMITED, "units": ["m/s"]})
    with pytest.raises(UsageError, match="units are for a command with box"):
        read({"fields": FIELDS, "edges": [[1], [0]], "units": ["m/s", "rad/s"]})


@pytest.mark.parametrize(
    ("type_name", "field", "unit"),
    [
        ("geometry_msgs/Twist", "linear.y", "m/s"),
        ("geometry_msgs.msg.TwistStamped", "twist.angular.z", "rad/s"),
        ("ackermann_msgs/msg/AckermannDriveStamped", "drive.steering_angle", "rad"),
        ("ackermann_msgs/msg/AckermannDriveStamped", "drive.speed", "m/s"),
        ("geometry_msgs/msg/Wrench", "torque.x", "N m"),
        ("geometry_msgs/msg/Twist", "nonlinear.x", ""),
        ("my_msgs/msg/Speed", "speed", ""),
    ],
)
def test_units_of_common_types(type_name: str, field: str, unit: str) -> None:
    assert unit_of(type_name, field) == unit


def test_limits_of_the_data_are_said_and_stored(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"this data: linear.x from 0 to 2, angular.z from -0.25"):
        data, report = read({"fields": FIELDS, "box": {}})
    # The command at the last observation, 9 and 9, is not that of a transition.
    assert limits(data) == [[0, -0.25], [2, 0.75]]
    np.testing.assert_allclose(data.actions, np.transpose([FORWARD[:4], TURN[:4]]), rtol=1e-6)
    assert report.far_actions == 0
    with pytest.warns(UserWarning, match=r"this data: linear.x from 0 to 1.5, angular.z from -0."):
        data, report = read({"fields": FIELDS, "box": {"high": 1.5}})
    assert limits(data) == [[0, -0.25], [1.5, 1.5]]
    assert report.far_actions == 0.25


def test_the_mapping_of_a_run_reads_other_bags_with_the_same_limits(tmp_path: Path) -> None:
    open_end = {"speed": {"field": "/odom.speed", "clip": [-math.inf, 3]}}
    for box in ({}, {"high": [2, 2]}, {"low": [-math.inf, 0], "high": math.inf}):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            data = read({"fields": FIELDS, "box": box}, observation=open_end).dataset
        write_json(tmp_path / "mapping.json", data.origin.mapping, UsageError)
        tree = parse_json((tmp_path / "mapping.json").read_text())
        commands = {"linear.x": [0.1] * 4, "angular.z": [0.2] * 4}
        other = robot(**{"/cmd_vel": ([0.0, 1, 2, 3], commands)})
        again = read_open_bag(other, parse_mapping(tree)).dataset
        assert again.action_space == data.action_space
        assert again.frames[-1] == 3


def test_commands_beyond_the_limits_are_clipped_and_counted() -> None:
    data, report = read({"fields": FIELDS, "box": {"low": [0, 0], "high": [1, 1]}})
    expected = np.transpose([[0.5, 1, 1, 0], [0, 0, 0.75, 0.1]])
    np.testing.assert_allclose(data.actions, expected, rtol=1e-6)
    assert report.far_actions == 0.5
    assert ("commands beyond the limits", "50.0%") in report.rows()
    (found,) = (str(each) for each in report.problems() if "50%" in str(each))
    assert found.startswith(
        "50% of the commands are beyond the limits of linear.x (0 to 1 m/s), angular.z (0 to 1"
    )
    assert "wider limits in `box`" in found


def test_densities_of_the_commands() -> None:
    times = [0.0, 1, 2, 3]
    bag = robot(**{"/density": (times, {"log": [7.5, -2.0, math.nan, 0.0]})})
    data = read(LIMITED, bag, behavior_log_prob={"field": "/density.log"}).dataset
    np.testing.assert_array_equal(data.behavior_log_probs, [7.5, -2, np.nan, 0])
    discrete = {"fields": FIELDS, "edges": [[1], [0]]}
    logs = {"field": "/density.log", "clip": [-9, 0]}
    data = read(discrete, bag, behavior_log_prob=logs).dataset
    np.testing.assert_allclose(data.behavior_probs, np.exp([0, -2, np.nan, 0]), rtol=1e-6)
    with pytest.raises(UsageError, match=r"a box have densities: use behavior_log_prob"):
        read(LIMITED, bag, behavior_prob={"field": "/density.log"})
    both = {"behavior_prob": {"field": "/a.b"}, "behavior_log_prob": {"field": "/a.b"}}
    with pytest.raises(UsageError, match=r"either behavior_prob or behavior_log_prob"):
        read(discrete, bag, **both)
    with pytest.raises(UsageError, match="behavior_log_prob must be a field"):
        read(LIMITED, bag, behavior_log_prob={"transform": "base"})
    expected = r"behavior_log_prob: the log density is inf at 1000000000 ns; it is not a finite num"
    for column in ([0.0, math.inf, 0.0, 0.0], [0.0, 1e39, 0.0, 0.0]):
        wrong = robot(**{"/density": (times, {"log": column})})
        with pytest.raises(UsageError, match=expected):
            read(LIMITED, wrong, behavior_log_prob={"field": "/density.log"})


def test_a_continuous_command_is_suggested_as_a_box() -> None:
    text = suggested(robot())
    assert "  fields: [/cmd_vel.linear.x, /cmd_vel.angular.z]" in text
    assert "  box: {low: [0, -0.25], high: [9, 9]}" in text
    assert "edges" not in text
    assert "  edges: [[" in suggested(robot(), bins=2)


def test_a_written_log_keeps_names_and_units(tmp_path: Path) -> None:
    data = read(LIMITED).dataset
    data.save(tmp_path / "robot.mcap")
    again = mcaprl.open(tmp_path / "robot.mcap")
    assert again.action_labels == data.action_labels
    assert json.loads(again.metadata["action_units"]) == ["m/s", "rad/s"]

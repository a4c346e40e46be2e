"""Suggestions for robots of many kinds: each finds an episode, or says why it cannot."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import McaprlError, UsageError
from mcaprl.recorder.mapping.config import Mapping, Quantity, load_mapping
from mcaprl.recorder.mapping.likely import box_limits, quantile_edges
from tests.support.bags import Channel, numbers, write_channels
from tests.support.robots import (
    FORMATS,
    Robot,
    odometry,
    transform,
    twist,
    vector,
    write_json,
    write_mcap,
    write_plain_json,
)

ODOM, TWIST = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist"
FLOAT, INT = "std_msgs/msg/Float64", "std_msgs/msg/Int32"
TF, JOINTS = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/JointState"


def base() -> Robot:
    """Return a robot with odometry at 30 Hz and velocity commands at 10 Hz."""
    return Robot([]).add("/odom", ODOM, 30, odometry).add("/cmd_vel", TWIST, 10, twist)


def scan(t: float) -> dict[str, Any]:
    ranges = [1 + math.sin(t + k) ** 2 for k in range(360)]
    ranges[7], ranges[90] = math.inf, math.inf if t > 3 else 2.0
    return {"range_min": 0.1, "range_max": 12.0, "ranges": ranges}


def joints(t: float) -> dict[str, Any]:
    angles = [math.sin(t + k) for k in range(6)]
    names = [f"joint_{k}" for k in range(6)]
    return {"name": names, "position": angles, "velocity": angles[::-1], "effort": []}


def swapped_joints(t: float) -> dict[str, Any]:
    pairs = [("hip", math.sin(t)), ("knee", 2.0 + math.sin(t))]
    names, angles = zip(*(pairs if round(10 * t) % 2 else pairs[::-1]), strict=True)
    return {"name": list(names), "position": list(angles)}


def trajectory(t: float) -> dict[str, Any]:
    return {"joint_names": ["a", "b"], "points": [{"positions": [math.sin(t), 1.0]}]}


def image(t: float) -> dict[str, Any]:
    data = [int(10 * t) % 256] * 48
    shape = {"height": 4, "width": 4, "step": 12}
    return {**shape, "encoding": "rgb8", "data": data}


ACKERMANN = "float64 steering_angle\nfloat64 speed\nuint32 sequence\n"
MOTORS = "my_dog/Motor[12] motors\nuint32 tick\nfloat32[4] foot_force\n"
MOTOR = "float32 q\nfloat32 dq\n"
MOTORS += f"{'=' * 80}\nMSG: my_dog/Motor\n{MOTOR}"
PX4 = "uint64 timestamp\nfloat32[3] position\nfloat32[4] q\nfloat32[3] velocity\nuint8 frame\n"
SETPOINT = "uint64 timestamp\nfloat32[3] velocity\nfloat32 yaw\nfloat32 yawspeed\n"


def px4(t: float) -> dict[str, Any]:
    turn = [math.cos(t / 9), 0.0, 0.0, math.sin(t / 9)]
    values = {"position": [t, 2 * t, -1.0], "q": turn, "velocity": [math.sin(t), 2.0, 0.0]}
    return {"timestamp": int(1e6 * t) + 10**15, "frame": 1, **values}


def setpoint(t: float) -> dict[str, Any]:
    velocity = [math.sin(t), math.cos(t), math.nan]
    return {
        "timestamp": int(1e6 * t) + 10**15,
        "velocity": velocity,
        "yawspeed": math.nan,
        "yaw": t,
    }


def ackermann() -> Robot:
    types = {"my_car/msg/Drive": ACKERMANN, "my_car/msg/State": "float32 speed\nfloat32 slip\n"}
    return (
        Robot([], types)
        .add(
            "/drive_cmd",
            "my_car/msg/Drive",
            20,
            lambda t: {
                "steering_angle": math.sin(t),
                "speed": 3.3 + math.cos(t),
                "sequence": int(20 * t + 0.5),
            },
        )
        .add("/state", "my_car/msg/State", 50, lambda t: {"speed": 3 + math.sin(t), "slip": t % 1})
    )


def quadruped() -> Robot:
    types = {"my_dog/msg/Low": MOTORS, "my_dog/msg/Command": "float32[12] q\nuint32 tick\n"}

    def state(t: float) -> dict[str, Any]:
        motors = [{"q": math.sin(t + k), "dq": math.cos(t + k)} for k in range(12)]
        return {"motors": motors, "tick": int(100 * t), "foot_force": [math.sin(t), t, 2.0, 3.0]}

    return (
        Robot([], types)
        .add("/lowstate", "my_dog/msg/Low", 50, state)
        .add(
            "/lowcmd",
            "my_dog/msg/Command",
            50,
            lambda t: {"q": [math.sin(t * (k + 1)) for k in range(12)], "tick": int(100 * t)},
        )
    )


def events(robot: Robot) -> Robot:
    """Add a topic of two messages within 22 us, which has a rate of 4.47e+04 Hz."""
    robot.add("/bumper", INT, 44_700, lambda t: {"data": int(t > 5)}, first_s=5.0, last_s=5.00004)
    return robot


def modes(values: list[int]) -> Callable[[float], dict[str, Any]]:
    return lambda t: {"data": values[int(t) % len(values)]}


IMPOSSIBLE = frozenset(
    {"only one message each", "camera and lidar without command", "command after everything"}
)
"""Robots whose bags have no steps."""

ROBOTS: dict[str, Callable[[], Robot]] = {
    "diff drive": base,
    "diff drive with scan": lambda: base().add("/scan", "sensor_msgs/msg/LaserScan", 8, scan),
    "ackermann": ackermann,
    "arm": lambda: (
        Robot([])
        .add("/joint_states", JOINTS, 50, joints)
        .add(
            "/arm_controller/joint_trajectory", "trajectory_msgs/msg/JointTrajectory", 5, trajectory
        )
    ),
    "arm with array commands": lambda: (
        Robot([])
        .add("/joint_states", JOINTS, 50, joints)
        .add(
            "/position_controller/commands",
            "std_msgs/msg/Float64MultiArray",
            20,
            lambda t: {"data": [math.sin(t), 0.5, math.cos(t)]},
        )
    ),
    "joints that change their order": lambda: base().add("/joints", JOINTS, 10, swapped_joints),
    "quadruped": quadruped,
    "drone": lambda: (
        Robot(
            [], {"px4_msgs/msg/VehicleOdometry": PX4, "px4_msgs/msg/TrajectorySetpoint": SETPOINT}
        )
        .add("/fmu/out/vehicle_odometry", "px4_msgs/msg/VehicleOdometry", 100, px4)
        .add("/fmu/in/trajectory_setpoint", "px4_msgs/msg/TrajectorySetpoint", 50, setpoint)
    ),
    "camera and lidar without command": lambda: (
        Robot([])
        .add("/camera/image_raw", "sensor_msgs/msg/Image", 10, image)
        .add("/scan", "sensor_msgs/msg/LaserScan", 5, scan)
    ),
    "camera and command": lambda: (
        Robot([])
        .add("/camera/image_raw", "sensor_msgs/msg/Image", 10, image)
        .add("/cmd_vel", TWIST, 10, twist)
    ),
    "transforms and command": lambda: (
        Robot([])
        .add("/tf", TF, 20, lambda t: {"transforms": [transform("odom", "base_link", t)]})
        .add(
            "/tf_static",
            TF,
            1,
            lambda t: {"transforms": [transform("base_link", "laser", 1)]},
            last_s=0.5,
        )
        .add("/cmd_vel", TWIST, 10, twist)
    ),
    "one message": lambda: base().add("/map_id", INT, 1, lambda t: {"data": 4}, last_s=0.5),
    "only one message each": lambda: (
        Robot([])
        .add("/odom", ODOM, 1, odometry, last_s=0.5)
        .add("/cmd_vel", TWIST, 1, twist, last_s=0.5)
    ),
    "events": lambda: events(base()),
    "topics that stop early": lambda: base().add(
        "/gps_speed", FLOAT, 10, lambda t: {"data": math.sin(t)}, last_s=6.0
    ),
    "topics that begin late": lambda: base().add(
        "/camera_speed", FLOAT, 10, lambda t: {"data": math.sin(t)}, first_s=12.0
    ),
    "rare topic": lambda: base().add("/goal_x", FLOAT, 0.2, lambda t: {"data": t}),
    "command before everything": lambda: (
        Robot([])
        .add("/odom", ODOM, 10, odometry, first_s=50, last_s=60)
        .add("/cmd_vel", TWIST, 10, twist)
    ),
    "command after everything": lambda: (
        Robot([])
        .add("/odom", ODOM, 10, odometry)
        .add("/cmd_vel", TWIST, 10, twist, first_s=50, last_s=60)
    ),
    "no overlap": lambda: (
        Robot([])
        .add("/x", FLOAT, 10, lambda t: {"data": math.sin(t)})
        .add("/y", FLOAT, 10, lambda t: {"data": math.sin(t)}, first_s=40, last_s=60)
        .add("/cmd", FLOAT, 10, lambda t: {"data": math.sin(t)}, last_s=60)
    ),
    "integer command": lambda: base().add("/gear_cmd", INT, 10, modes([0, 1, 2])),
    "only an integer command": lambda: (
        Robot([]).add("/odom", ODOM, 10, odometry).add("/mode_command", INT, 10, modes([0, 1, 2]))
    ),
    "negative command": lambda: (
        Robot([]).add("/odom", ODOM, 10, odometry).add("/turn_cmd", INT, 10, modes([-1, 0, 1]))
    ),
    "text command": lambda: (
        Robot([])
        .add("/odom", ODOM, 10, odometry)
        .add(
            "/voice_command",
            "std_msgs/msg/String",
            5,
            lambda t: {"data": ["go", "stop: #1", "on"][int(t) % 3]},
        )
    ),
    "constant command": lambda: (
        Robot([]).add("/odom", ODOM, 10, odometry).add("/cmd_x", FLOAT, 10, lambda t: {"data": 0.7})
    ),
    "constant observation": lambda: (
        Robot([])
        .add("/level", FLOAT, 10, lambda t: {"data": 0.5})
        .add("/cmd_vel", TWIST, 10, twist)
    ),
    "logs and diagnostics": lambda: (
        base()
        .add("/rosout_agg", "std_msgs/msg/Int32", 10, lambda t: {"data": int(10 * t)})
        .add("/robot/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 10, lambda t: {})
    ),
    "counters": lambda: base().add("/frame", INT, 10, lambda t: {"data": int(10 * t + 0.5)}),
    "slow robot": lambda: (
        Robot([])
        .add("/depth", FLOAT, 0.1, lambda t: {"data": t % 70}, last_s=400)
        .add("/valve_cmd", FLOAT, 0.1, lambda t: {"data": math.sin(t)}, last_s=400)
    ),
    "two drives": lambda: (
        base()
        .add("/odom2", ODOM, 30, odometry)
        .add("/odom2", ODOM, 30, odometry, first_s=100, last_s=110)
        .add("/cmd_vel", TWIST, 10, twist, first_s=100, last_s=110)
    ),
    "utm position": lambda: base().add(
        "/utm_x", FLOAT, 10, lambda t: {"data": 5_412_345.0 + 0.01 * math.sin(t)}
    ),
    "scan only": lambda: (
        Robot([])
        .add("/scan", "sensor_msgs/msg/LaserScan", 8, scan)
        .add("/cmd_vel", TWIST, 10, twist)
    ),
}
CASES = [
    (name, list(FORMATS)[(k + j) % len(FORMATS)]) for k, name in enumerate(ROBOTS) for j in (0, 2)
]


def suggested(bag: Path, **options: Any) -> tuple[str, list[str]]:
    """Return the suggestion, and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        text = mcaprl.suggest_mapping(bag, **options)
    return text, [str(each.message) for each in caught]


def holds(bag: Path, folder: Path, **options: Any) -> tuple[Mapping | None, Any]:
    """Check the property of a suggestion; return the mapping and the conversion, if any."""
    try:
        text, warned = suggested(bag, **options)
    except McaprlError as error:
        why = str(error)
        assert "no topic can be observed: /" in why
        return None, None
    path = folder / "suggested.yaml"
    path.write_text(text, encoding="utf-8")
    mapping, _ = load_mapping(path)
    assert mapping.observation
    try:
        found = mcaprl.convert(mcaprl.open(bag, mapping=path), None)
    except McaprlError:
        (warning,) = [each for each in warned if "the suggested mapping" in each]
        assert re.search(r"/\w+", warning)
        assert warning.partition(": ")[2] in text
        return mapping, None
    assert found.dataset.episode_lengths.sum() > 0
    assert not [each for each in warned if "the suggested mapping" in each]
    assert found.report is not None
    assert found.report.far_actions == 0.0
    return mapping, found


@pytest.mark.parametrize(("name", "form"), CASES)
def test_each_suggestion_finds_an_episode_or_says_why_not(
    name: str, form: str, tmp_path: Path
) -> None:
    bag = FORMATS[form](ROBOTS[name](), tmp_path / "robot.mcap")
    _, found = holds(bag, tmp_path)
    impossible = IMPOSSIBLE
    with mcaprl.open_bag(bag) as opened:
        fields = [each for info in opened.topics.values() for each in info.fields]
    if not any(each.startswith("points[].") for each in fields):
        # The trajectories are arrays of messages, whose fields the bag does not list.
        impossible = impossible | {"arm"}
    assert (found is None) == (name in impossible)


def observed(name: str, tmp_path: Path, form: str = "mcap", **options: Any) -> Mapping:
    bag = FORMATS[form](ROBOTS[name](), tmp_path / "robot.mcap")
    mapping, _ = holds(bag, tmp_path, **options)
    assert mapping is not None
    return mapping


def test_what_is_observed_and_what_is_not(tmp_path: Path) -> None:
    odom = {"odom_linear_x", "odom_angular_z", "odom_position_x", "odom_position_y"}
    odom |= {"odom_orientation_yaw"}
    for k, name in enumerate(
        (
            "one message",
            "events",
            "topics that stop early",
            "topics that begin late",
            "rare topic",
            "logs and diagnostics",
            "counters",
            "integer command",
        )
    ):
        folder = tmp_path / str(k)
        folder.mkdir()
        assert set(observed(name, folder).observation) == odom, name


def test_common_types_come_first_and_raw_data_is_not_observed(tmp_path: Path) -> None:
    robot = Robot([], {"my/msg/Grid": "float32[] cells\nfloat32 level\n"})
    robot.add("/a_grid", "my/msg/Grid", 2, lambda t: {"cells": [t] * 20_000, "level": math.sin(t)})
    for k in range(20):
        robot.add(f"/b{k}", FLOAT, 5, lambda t: {"data": math.sin(t)})
    robot.add("/odom", ODOM, 10, odometry).add("/cmd_vel", TWIST, 10, twist)
    robot.add("/control/image", "sensor_msgs/msg/Image", 5, image)
    mapping, _ = holds(write_mcap(robot, tmp_path / "robot.mcap"), tmp_path)
    assert mapping is not None
    names = list(mapping.observation)
    assert names[:2] == ["odom_linear_x", "odom_angular_z"]
    assert len(names) == 12
    assert "a_grid_level" in names
    assert "a_grid_cells" not in names
    assert mapping.action.fields == ["/cmd_vel.linear.x", "/cmd_vel.angular.z"]


def test_types_have_two_forms_of_their_name(tmp_path: Path) -> None:
    expected = observed("camera and lidar without command", tmp_path).observation
    for k, form in enumerate(("short names", "ros1 mcap", "bag")):
        folder = tmp_path / str(k)
        folder.mkdir()
        found = observed("camera and lidar without command", folder, form).observation
        assert found == expected
    assert set(expected) == {"scan_ranges"}
    camera = observed("camera and command", tmp_path, "short names").observation
    assert {name: each.image for name, each in camera.items()} == {"camera": "/camera/image_raw"}


def test_scans_with_infinite_beams_are_clipped(tmp_path: Path) -> None:
    scan = observed("scan only", tmp_path).observation["scan_ranges"]
    assert (scan.scan, scan.to, scan.clip, scan.missing) == ("/scan", 36, (0.1, 12.0), 12.0)


def test_frames_of_tf_are_observed(tmp_path: Path) -> None:
    (pose,) = observed("transforms and command", tmp_path).observation.values()
    assert (pose.transform, pose.in_) == ("base_link", "odom")


def test_joints_are_selected_by_name_if_mappings_can(tmp_path: Path) -> None:
    found = observed("joints that change their order", tmp_path).observation
    # By position, the elements would change their meaning.
    if "names" in Quantity.model_fields:
        assert sorted(found["joints_position"].model_dump()["names"]) == ["hip", "knee"]
    else:
        assert not any(name.startswith("joints") for name in found)


def test_actions_by_kind_of_command(tmp_path: Path) -> None:
    cases: dict[str, dict[str, Any]] = {
        "only an integer command": {"field": "/mode_command.data"},
        "negative command": {"actions": {"-1": [-1], "0": [0], "1": [1]}},
        "text command": {"names": {"go": 0, "on": 1, "stop: #1": 2}},
        "constant command": {"fields": ["/cmd_x.data"]},
        "ackermann": {"fields": ["/drive_cmd.steering_angle", "/drive_cmd.speed"]},
        "quadruped": {"fields": [f"/lowcmd.q[{k}]" for k in range(12)]},
    }
    for k, (name, expected) in enumerate(cases.items()):
        folder = tmp_path / str(k)
        folder.mkdir()
        action = observed(name, folder).action.model_dump()
        assert {key: action[key] for key in expected} == expected, name


def test_limits_of_a_box_contain_the_commands(tmp_path: Path) -> None:
    box = observed("diff drive", tmp_path).action.box
    assert box is not None
    # The speeds are from 0.04 to 0.66, and the turns from -0.7 to 0.7. As float32, 0.7 is less.
    assert (box.low, box.high) == ([0.04, -0.7], [0.66, 0.71])


@pytest.mark.parametrize("bins", [2, 3, 7])
def test_bins_have_similar_numbers_of_commands(bins: int, tmp_path: Path) -> None:
    robot = Robot([]).add("/odom", ODOM, 30, odometry)
    robot.add("/cmd", FLOAT, 10, lambda t: {"data": math.exp(math.sin(3 * t))})
    _, found = holds(write_mcap(robot, tmp_path / "robot.mcap"), tmp_path, bins=bins)
    counts = list(found.report.action_counts.values())
    assert len(counts) == bins
    assert min(counts) > 0
    assert max(counts) < 1.5 * len(found.dataset) / bins


def test_bins_are_for_suggestions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_mcap(base(), tmp_path / "robot.mcap")
    assert run(["convert", str(bag), "--suggest", "--bins", "3"]) == 0
    assert "edges: [[" in capsys.readouterr().out
    assert run(["convert", str(bag), "--dry-run", "--bins", "3"]) == 2
    assert "--bins is for --suggest" in capsys.readouterr().err
    with pytest.raises(UsageError, match="`bins=1`: give a number of at least 2"):
        mcaprl.suggest_mapping(bag, bins=1)


NUMBERS = st.floats(-1e9, 1e9) | st.integers(-5, 5).map(float) | st.sampled_from([0.1, 0.7, 1e-12])


@given(values=st.lists(NUMBERS, min_size=1, max_size=60), bins=st.integers(2, 9))
def test_no_bin_is_empty(values: list[float], bins: int) -> None:
    column = np.array(values)
    edges = quantile_edges(column, bins)
    assert edges == sorted(set(edges))
    counts = np.bincount(np.digitize(column, edges), minlength=len(edges) + 1)
    assert counts.min() > 0
    assert len(counts) <= bins
    assert all(column.min() < edge <= column.max() for edge in edges)


@given(values=st.lists(NUMBERS | st.just(1.7e18), min_size=1, max_size=20))
def test_limits_are_rounded_outward(values: list[float]) -> None:
    low, high = box_limits(np.array(values))
    assert low < high
    assert float(np.float32(low)) <= min(values)
    assert float(np.float32(high)) >= max(values)
    if min(values) < max(values):
        span = max(values) - min(values)
        # Below 1e-38, the numbers of float32 have fewer digits.
        slack = 0.03 * span + 3e-7 * max(map(abs, values)) + 3e-45
        assert low >= min(values) - slack
        assert high <= max(values) + slack


def plain(robot: Robot) -> Robot:
    """Return a robot whose messages are given as JSON: with a speed, a mode and a command."""
    robot.add(
        "/state", "State", 20, lambda t: {"speed": math.sin(t), "at": vector(t), "seq": int(20 * t)}
    )
    return robot.add("/command", "Command", 10, lambda t: {"speed": math.cos(t), "turn": t % 2})


def test_json_with_a_schema(tmp_path: Path) -> None:
    mapping, found = holds(write_json(plain(Robot([])), tmp_path / "robot.mcap"), tmp_path)
    assert found is not None
    assert mapping is not None
    assert "state_speed" in mapping.observation
    assert not any("seq" in name for name in mapping.observation)
    assert mapping.action.fields == ["/command.speed", "/command.turn"]


def test_json_without_a_schema(tmp_path: Path) -> None:
    bag = write_plain_json(plain(Robot([])), tmp_path / "robot.mcap")
    mapping, _ = holds(bag, tmp_path)
    # Fields are known only if the bag finds them in the messages.
    if mapping is None:
        with pytest.raises(
            McaprlError, match=r"/state \(its fields are unknown, because it has no s"
        ):
            mcaprl.suggest_mapping(bag)
    else:
        assert "state_speed" in mapping.observation


def test_protobuf_of_foxglove(tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="needs foxglove-sdk")
    import foxglove
    from foxglove.channels import LaserScanChannel, PoseInFrameChannel, RawImageChannel
    from foxglove.messages import LaserScan, Pose, PoseInFrame, Quaternion, RawImage, Vector3

    path, context = tmp_path / "robot.mcap", foxglove.Context()
    poses, scans = (
        PoseInFrameChannel("/pose", context=context),
        LaserScanChannel("/scan", context=context),
    )
    images = RawImageChannel("/camera", context=context)
    number = {"type": "object", "properties": {"speed": {"type": "number"}}}
    commands = foxglove.Channel("/cmd", schema=number, context=context)
    with foxglove.open_mcap(path, context=context):
        for k in range(100):
            time_ns = 10**18 + k * 10**8
            turn = Quaternion(x=0.0, y=0.0, z=math.sin(k / 50), w=math.cos(k / 50))
            pose = Pose(position=Vector3(x=k / 10, y=math.sin(k), z=0.0), orientation=turn)
            poses.log(PoseInFrame(frame_id="map", pose=pose), log_time=time_ns)
            ranges = [1.0 + math.sin(k), math.inf, 3.0]
            scans.log(LaserScan(ranges=ranges), log_time=time_ns)
            raw = RawImage(width=2, height=2, encoding="rgb8", step=6, data=bytes(12))
            images.log(raw, log_time=time_ns)
            commands.log({"speed": math.cos(k / 10)}, log_time=time_ns)
    mapping, found = holds(path, tmp_path)
    assert found is not None
    assert mapping is not None
    assert set(mapping.observation) == {
        *("pose_position_x", "pose_position_y", "pose_orientation_yaw", "scan_ranges")
    }
    text, _ = suggested(path)
    assert "# camera: {image: /camera, resize: [84, 84]}" in text


def test_unreadable_commands_are_named(tmp_path: Path) -> None:
    odom = numbers("/odom_x", [(k / 10, math.sin(k)) for k in range(50)])
    command = Channel("/cmd_vel", "own/msg/Twist", "", [(k / 10, bytes(8)) for k in range(50)])
    bag = write_channels(tmp_path / "robot.mcap", [odom, command])
    with warnings.catch_warnings(record=True):
        text, (warned,) = suggested(bag)
    expected = "/cmd_vel looks like the command, but cannot be read: own/msg/Twist: its definition"
    assert expected in warned
    assert expected in text
    assert "# /cmd_vel cannot be read: own/msg/Twist" in text


def test_what_prevents_episodes_is_left_out_without_a_command_too(tmp_path: Path) -> None:
    robot = Robot([]).add("/odom", ODOM, 10, odometry)
    robot.add("/x", FLOAT, 10, lambda t: {"data": math.sin(t)})
    robot.add("/y", FLOAT, 10, lambda t: {"data": math.nan if t > 19.5 else math.sin(t)})
    text, (warned,) = suggested(write_mcap(robot, tmp_path / "robot.mcap"))
    assert "no topic looks like a command" in warned
    assert "y_data: {field: /y.data}" in text
    robot.topics[2] = robot.topics[2]._replace(name="/z", messages=robot.topics[2].messages[:2])
    text, _ = suggested(write_mcap(robot, tmp_path / "robot.mcap"))
    assert "z_data" not in text


def test_all_times_equal(tmp_path: Path) -> None:
    same = [(0.0, {"data": 0.1 * k}) for k in range(10)]
    robot = Robot([]).add("/cmd", FLOAT, 10, lambda t: {"data": t})
    robot.topics.append(robot.topics[0]._replace(name="/x", messages=same))
    bag = write_mcap(robot, tmp_path / "robot.mcap")
    with pytest.raises(McaprlError, match=r"/x \(all messages have the same time\)"):
        mcaprl.suggest_mapping(bag)

"""Definitions of ROS types in the user's files, for bags that lack them."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

import mcaprl
from mcaprl.cli import cli
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.files import DefinitionFiles
from tests.support.bags import START_NS, Channel, write_channels

Row = tuple[str, str, Sequence[bytes]]


def write_database(path: Path, topics: Sequence[Row]) -> Path:
    """Write a database as distributions before Iron do, which has no definitions."""
    with closing(sqlite3.connect(path)) as file:
        file.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
                     " serialization_format TEXT, offered_qos_profiles TEXT)")  # fmt: skip
        file.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER,"
                     " timestamp INTEGER, data BLOB)")  # fmt: skip
        for number, (name, kind, messages) in enumerate(topics, 1):
            file.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')", (number, name, kind))
            for k, data in enumerate(messages):
                file.execute(
                    "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)",
                    (number, START_NS + k * 100_000_000, b"\0\1\0\0" + data),
                )
        file.commit()
    return path


def package(root: Path, name: str, **files: str) -> Path:
    """Write a package with message definitions; `Name="text"` is the file `msg/Name.msg`."""
    for stem, text in files.items():
        path = root / name / "msg" / f"{stem}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root / name


ROBOT = "acme_msgs/Motor motor\nJoint joint\nstd_msgs/Header header"
MOTOR, JOINT = "float64 q", "float32 angle\r\nfloat32 speed\r\n"
DATA = struct.pack("<d2fiI", 1.5, 2.5, 3.5, 7, 8) + struct.pack("<I2s", 2, b"a\0")


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_database(
        tmp_path / "old.db3",
        [("/robot", "acme_msgs/msg/Robot", [DATA] * 3), ("/other", "b_msgs/msg/B", [b"\0"])],
    )


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    root = tmp_path / "ws" / "src"
    package(root, "acme_msgs", Robot=ROBOT, Motor=MOTOR, Joint=JOINT, Broken="float64 = 3")
    package(root, "unused_msgs", Bad="this is not a definition")
    return root.parent


@pytest.mark.parametrize("part", ["", "src", "src/acme_msgs", "src/acme_msgs/msg"])
def test_workspaces_packages_and_folders(part: str, bag: Path, workspace: Path) -> None:
    with closing(open_bag(bag)) as found:
        assert "acme_msgs/msg/Robot: its definition is missing" in found.topics["/robot"].problem
    with closing(open_bag(bag, definitions=[workspace / part])) as found:
        assert not found.topics["/robot"].problem
        columns = found.read("/robot", ["motor.q", "joint.speed", "header.stamp"]).columns
        assert columns["motor.q"].tolist() == [1.5] * 3
        assert columns["joint.speed"].tolist() == [3.5] * 3
        assert columns["header.stamp"].tolist() == [7 * 10**9 + 8] * 3
        problem = found.topics["/other"].problem
        assert "b_msgs/msg/B: its definition is missing" in problem
        assert str(workspace / part) in problem


def test_single_files_and_flat_folders(bag: Path, tmp_path: Path) -> None:
    flat = tmp_path / "acme_msgs"
    flat.mkdir()
    for name, text in (("Robot", ROBOT), ("Motor", MOTOR), ("Joint", JOINT)):
        (flat / f"{name}.msg").write_text(text)
    for definitions in ([flat], sorted(flat.iterdir())):
        with closing(open_bag(bag, definitions=definitions)) as found:
            assert found.read("/robot", ["motor.q"]).columns["motor.q"].tolist() == [1.5] * 3


def test_the_name_of_a_package_is_that_of_its_package_xml(bag: Path, tmp_path: Path) -> None:
    folder = package(tmp_path, "acme-main", Robot=ROBOT, Motor=MOTOR, Joint=JOINT)
    (folder / "package.xml").write_text("<package><name>acme_msgs</name></package>")
    with closing(open_bag(bag, definitions=[folder])) as found:
        assert found.read("/robot", ["motor.q"]).columns["motor.q"].tolist() == [1.5] * 3


def test_a_bad_file_costs_only_what_needs_it(bag: Path, workspace: Path, tmp_path: Path) -> None:
    package(workspace, "acme_msgs", Motor="float64")
    with closing(open_bag(bag, definitions=[workspace / "acme_msgs", workspace])) as found:
        problem = found.topics["/robot"].problem
        assert "Motor.msg: the definition of acme_msgs/msg/Motor does not parse" in problem
    (workspace / "acme_msgs/msg/Motor.msg").write_text("float32 q")
    with closing(open_bag(bag, definitions=[workspace])) as found:
        assert "acme_msgs/msg/Motor is defined differently in" in found.topics["/robot"].problem
    (workspace / "acme_msgs/msg/Motor.msg").write_bytes(b"#" * (2**20 + 1))
    with closing(open_bag(bag, definitions=[workspace])) as found:
        assert "at most 1048576 bytes" in found.topics["/robot"].problem


def test_wrong_paths_of_definitions(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="none: no such file or folder of definitions"):
        open_bag(bag, definitions=[tmp_path / "none"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match=r"empty has no \.msg, \.srv, \.action, \.idl files"):
        open_bag(bag, definitions=[tmp_path / "empty"])


def test_services_actions_and_idl(tmp_path: Path) -> None:
    folder = tmp_path / "acme_msgs"
    for kind, name, text in (
        ("msg", "Point.msg", "float64 x"),
        ("srv", "Go.srv", "Point to\n---\nbool done\n"),
        ("action", "Drive.action", "float64 goal\n---\nfloat64 end\n---\nPoint at\n"),
        ("idl", "all.idl", "module acme_msgs { module msg { struct Odd { double y; }; }; };"),
    ):
        path = folder / kind / name
        path.parent.mkdir(parents=True)
        path.write_text(text)
    (folder / "idl" / "bad.idl").write_text("module {")
    files = DefinitionFiles([folder])

    def fields(name: str) -> Any:
        found = files.types_of(name)
        return found and [each for each, _ in found[1]]

    assert fields("acme_msgs/srv/msg/Go_Request") == ["to"]
    request = files.types_of("acme_msgs/srv/msg/Go_Request")
    assert request is not None
    assert request[1][0][1][1] == "acme_msgs/msg/Point"
    assert fields("acme_msgs/srv/msg/Go_Event") == ["info", "request", "response"]
    assert fields("acme_msgs/action/Drive_FeedbackMessage") == ["goal_id", "feedback"]
    assert fields("acme_msgs/action/Drive_Result") == ["end"]
    with pytest.warns(UserWarning, match=r"bad\.idl: .* does not parse.*: skipped"):
        assert fields("acme_msgs/msg/Odd") == ["y"]
    assert fields("acme_msgs/msg/None") is None


def test_the_definitions_of_the_bag_are_used_first(tmp_path: Path) -> None:
    bag = tmp_path / "new.db3"
    write_database(bag, [("/m", "acme_msgs/msg/Motor", [struct.pack("<f", 1.5)])])
    with closing(sqlite3.connect(bag)) as file:
        file.execute("CREATE TABLE message_definitions(topic_type TEXT, encoding TEXT,"
                     " encoded_message_definition TEXT)")  # fmt: skip
        row = ("acme_msgs/msg/Motor", "ros2msg", "float32 own")
        file.execute("INSERT INTO message_definitions VALUES(?, ?, ?)", row)
        file.commit()
    folder = package(tmp_path, "acme_msgs", Motor="float64 q")
    with closing(open_bag(bag, definitions=[folder])) as found:
        assert found.read("/m", ["own"]).columns["own"].tolist() == [1.5]


@pytest.mark.parametrize("form", ["mcap", "db3"])
def test_definitions_are_used_before_those_of_the_distribution(form: str, tmp_path: Path) -> None:
    kind, data = "std_msgs/msg/Float32", struct.pack("<f", 1.5)
    path = tmp_path / f"a.{form}"
    if form == "mcap":
        write_channels(path, [Channel("/x", kind, "", [(0, data)])])
    else:
        write_database(path, [("/x", kind, [data])])
    folder = package(tmp_path, "std_msgs", Float32="uint8[4] bytes")
    for definitions, field in (([], "data"), ([folder], "bytes")):
        with closing(open_bag(path, definitions=definitions)) as found:
            assert found.topics["/x"].fields.keys() == {field}
            value = found.read("/x", [field]).columns[field][0]
            assert bytes(value) == data if field == "bytes" else value == 1.5


MAPPING = """\
clock: {rate_hz: 10}
observation: {q: {field: /robot.motor.q}}
action: {fields: [/robot.joint.angle], edges: [[0]]}
"""


def test_definitions_of_a_mapping_and_of_a_command(
    bag: Path, workspace: Path, tmp_path: Path
) -> None:
    mapping = tmp_path / "maps" / "robot.yaml"
    mapping.parent.mkdir()
    mapping.write_text(f"{MAPPING}definitions: [../ws]\n")
    assert mcaprl.open(bag, mapping=mapping).observations.tolist() == [[1.5]] * 2
    mapping.write_text(MAPPING)
    with pytest.raises((UsageError, LogError), match="its definition is missing"):
        mcaprl.open(bag, mapping=mapping)
    assert len(mcaprl.open(bag, mapping=mapping, definitions=[workspace])) == 2
    with pytest.warns(UserWarning, match="no topic looks like a command"):
        assert "/robot.motor.q" in mcaprl.suggest_mapping(bag, definitions=[workspace])
    options = ["--mapping", str(mapping), "--definitions", str(workspace / "src")]
    for command in ("info", "check", ("convert", "--dry-run")):
        words = [command] if isinstance(command, str) else list(command)
        result = CliRunner().invoke(cli, [*words, str(bag), *options])
        assert result.exit_code == 0, result.output
    mapping.write_text(f"{MAPPING}definitions:\n- nowhere\n")
    with pytest.raises(UsageError, match=r"robot.yaml:5: definitions.0: .*nowhere does not exist"):
        mcaprl.open(bag, mapping=mapping)

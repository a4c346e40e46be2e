"""Tests of the transports: types and bytes of DDS, and drives over DDS, ROS 1 and ROS 2."""

from __future__ import annotations

import itertools
import os
import runpy
import shutil
import socket
import subprocess
import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype

import mcaprl
from mcaprl.drive.transports import Wire
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.source import Definition
from mcaprl.system import udp_sockets
from tests.conftest import need
from tests.support.bags import STORE1, STORE2, messages, write_rosbag1, write_rosbag2
from tests.support.memory_robot import TURN, Cruise, driver

DIST_PACKAGES = Path("/usr/lib/python3/dist-packages")
EXAMPLE = Path(__file__).parents[2] / "examples" / "06_drive"
DOMAIN = itertools.count(100 + os.getpid() % 50)
TYPES = (
    "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan",
    "sensor_msgs/msg/Image", "sensor_msgs/msg/JointState", "sensor_msgs/msg/Joy",
    "sensor_msgs/msg/Imu", "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/NavSatFix",
    "std_msgs/msg/Bool", "std_msgs/msg/Float32MultiArray", "std_msgs/msg/Empty",
    "tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticArray", "nav_msgs/msg/Path",
)  # fmt: skip


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rosbag2(tmp_path_factory.mktemp("drive") / "bag")


def filled(kind: str, random: np.random.Generator) -> Any:
    """Return a message of rosbags with random values."""
    fields = STORE2.fielddefs[kind][1]
    return STORE2.types[kind](**{name: _value(what, random) for name, what in fields})


def _value(description: Any, random: np.random.Generator) -> Any:
    kind, what = description
    if kind == Nodetype.NAME:
        return filled(what, random)
    if kind == Nodetype.BASE:
        if what[0] == "string":
            return "aä€"[: random.integers(4)]
        # rosbags takes a byte for signed.
        data = bytes(8) if what[0] in ("byte", "octet") else random.bytes(8)
        return np.frombuffer(data, _dtype(what[0]))[0].item()
    element, count = what
    count = count if kind == Nodetype.ARRAY else int(random.integers(4))
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        return np.array([_value(element, random) for _ in range(count)], _dtype(element[1][0]))
    return [_value(element, random) for _ in range(count)]


def _dtype(name: str) -> Any:
    return {"byte": "uint8", "octet": "uint8", "char": "uint8"}.get(name, name)


def idl_object(kind: Any, message: Any) -> Any:
    """Return an object of an IDL type with the values of a message of rosbags."""
    found = kind.__new__(kind)
    for name, hint in kind.__annotations__.items():
        value = getattr(message, name, 0)
        element = getattr(hint, "__metadata__", [None])[-1]
        inner = getattr(element, "subtype", None)
        if hasattr(hint, "__idl__"):
            value = idl_object(hint, value)
        elif isinstance(value, list) and hasattr(inner, "__idl__"):
            value = [idl_object(inner, each) for each in value]
        setattr(found, name, value.tolist() if isinstance(value, np.ndarray) else value)
    return found


@pytest.mark.parametrize("name", TYPES)
def test_idl_types_encode_as_rosbags_does(name: str) -> None:
    """Cyclone encodes with the IDL type that was made; the bytes must be those of rosbags."""
    pytest.importorskip("cyclonedds")
    from mcaprl.drive.transports.dds import idl_type

    wire = Wire("/topic", Definition(name, "cdr"), "cdr")
    kind, random = idl_type(wire), np.random.default_rng(0)
    assert kind.__idl_typename__ == name.replace("/msg/", "::msg::dds_::").replace("/", "::") + "_"
    for _ in range(20):
        message = filled(name, random)
        expected = bytes(STORE2.serialize_cdr(message, name))
        found = kind.__idl__.serialize(idl_object(kind, message), use_version_2=False)
        assert found.ljust(len(expected), b"\0") == expected
        assert wire.encode(message).ljust(len(expected), b"\0") == expected
        assert wire.encode(wire.decode(expected)) == wire.encode(message)


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_a_bag_of_another_ros_drives_by_the_types_of_the_distribution(encoding: str) -> None:
    other = Definition("geometry_msgs/Twist", "ros1" if encoding == "cdr" else "cdr", "", b"")
    wire = Wire("/cmd_vel", other, encoding)
    assert not wire.is_own
    found = wire.decode(wire.encode({"linear": {"x": 1.5}}))
    assert (found.linear.x, found.angular.z) == (1.5, 0.0)
    with pytest.raises(UsageError, match="/odom cannot be sent or received by ROS"):
        Wire("/odom", Definition("robot.Odometry", "protobuf"), encoding)
    wire.check("/cmd_vel", "geometry_msgs/Twist")
    with pytest.raises(UsageError, match=r"std_msgs/msg/Bool on /cmd_vel; the mapping needs geo"):
        wire.check("/cmd_vel", "std_msgs/msg/Bool")


class Peer:
    """Another participant of the domain, with the types of Cyclone DDS alone."""

    def __init__(self, domain_id: int) -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.domain import DomainParticipant

        self.part = DomainParticipant(domain_id)
        self.qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(100))
        self.kinds: dict[str, Any] = {}

    def end(self, topic: str, name: str, *, writes: bool) -> Any:
        """Return a writer or reader of a topic."""
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        from mcaprl.drive.transports.dds import _idl

        if not writes:
            kind = runpy.run_path(str(EXAMPLE / "messages.py"), run_name="messages")["Twist"]
        else:
            wire = Wire(topic, Definition(name, "cdr"), "cdr")
            kind = self.kinds[topic] = _idl(wire.definitions.whole, name, {})
        end: Any = DataWriter if writes else DataReader
        return end(self.part, Topic(self.part, f"rt{topic}", kind), qos=self.qos)


def test_a_robot_is_driven_over_dds(bag: Path) -> None:
    pytest.importorskip("cyclonedds")
    from mcaprl.drive.transports.dds import DdsTransport

    domain = next(DOMAIN)
    seen: dict[str, Any] = {"turns": []}

    def robot() -> None:
        """Publish what the bag has, as soon as the driver listens, and read the commands."""
        peer = seen["peer"] = Peer(domain)
        commands = peer.end("/cmd_vel", "geometry_msgs/msg/Twist", writes=False)
        ends = {
            topic: peer.end(topic, kind, writes=True)
            for topic, kind in (
                ("/joints", "sensor_msgs/msg/JointState"), ("/odom", "nav_msgs/msg/Odometry")
            )
        }  # fmt: skip
        _wait(lambda: all(each.get_matched_subscriptions() for each in ends.values()))
        for topic, _, message in messages(STORE2):
            if topic in ends:
                ends[topic].write(idl_object(peer.kinds[topic], message))
                time.sleep(0.01)
                found = commands.take(10)
                seen["turns"] += [each.angular.z for each in found if hasattr(each, "angular")]

    class Opened(DdsTransport):
        def open(self, *arguments: Any) -> None:
            super().open(*arguments)
            import threading

            seen["thread"] = threading.Thread(target=robot)
            seen["thread"].start()

    transport = Opened(domain_id=domain)
    status = mcaprl.drive_robot(driver(bag), transport, duration_s=2)
    seen["thread"].join()
    assert status.steps == 12
    assert status.driven == 12
    assert seen["turns"].count(TURN) >= 11
    assert status.latency_p50_ms < 50


def _wait(condition: Any, seconds: float = 10) -> None:
    ends = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < ends, "timeout"
        time.sleep(0.01)


def test_dds_stays_on_this_machine(bag: Path) -> None:
    pytest.importorskip("cyclonedds")
    from mcaprl.drive.transports import dds

    before = udp_sockets() or set()
    transport = dds.DdsTransport(domain_id=next(DOMAIN))
    transport.open({}, {}, lambda *_: None)
    opened = (udp_sockets() or set()) - before
    assert opened
    for number in opened:
        with socket.socket(fileno=os.dup(number)) as one:
            assert one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16) == b"lo\0"
    transport.close()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dds, "udp_sockets", lambda: None)
        with pytest.raises(UsageError, match="cannot keep DDS on this machine"):
            dds.DdsTransport(domain_id=next(DOMAIN)).open({}, {}, lambda *_: None)
    for given, message in (
        ({"domain_id": 233}, "0 to 232"),
        ({"interface": "<x/>"}, "is not a network interface"),
    ):
        with pytest.raises(UsageError, match=message):
            dds.DdsTransport(**given)
    with pytest.raises(UsageError, match="cannot join DDS domain"):
        dds.DdsTransport(domain_id=next(DOMAIN), interface="nic9").open({}, {}, lambda *_: None)


def test_a_topic_of_another_type_in_dds_ends_the_drive(bag: Path) -> None:
    pytest.importorskip("cyclonedds")
    from mcaprl.drive.transports.dds import DdsTransport

    domain = next(DOMAIN)
    seen = []

    class Opened(DdsTransport):
        def open(self, *arguments: Any) -> None:
            super().open(*arguments)
            seen.append(Peer(domain))
            seen.append(seen[0].end("/odom", "sensor_msgs/msg/Imu", writes=True))

    with pytest.raises(LogError, match=r"sensor_msgs/msg/Imu on /odom; the mapping needs nav_msgs"):
        mcaprl.drive_robot(driver(bag), Opened(domain_id=domain), duration_s=10)


ROS1_DRIVE = f"""
import sys
sys.path.append({str(DIST_PACKAGES)!r})
import mcaprl
from pathlib import Path
from tests.support.memory_robot import driver
found = mcaprl.drive_robot(driver(Path(sys.argv[1])), "ros1", duration_s=float(sys.argv[2]))
print(found.steps, found.driven)
"""
ROS1_ROBOT = """
import sys, time
import rospy
from std_msgs.msg import Header
class Raw(rospy.AnyMsg):
    def serialize(self, buffer):
        buffer.write(self.data)
turns = []
rospy.init_node("robot", disable_signals=True)
from geometry_msgs.msg import Twist
rospy.Subscriber("/cmd_vel", Twist, lambda message: turns.append(message.angular.z))
ends = {}
for line in open(sys.argv[1]):
    topic, kind, md5, text, data = line.split()
    if topic not in ends:
        text = bytes.fromhex(text).decode()
        own = type("Own", (Raw,), {"_type": kind, "_md5sum": md5, "_full_text": text})
        ends[topic] = rospy.Publisher(topic, own, queue_size=10), own
        while not ends[topic][0].get_num_connections() and sys.argv[2] == "wait":
            time.sleep(0.02)
    message = ends[topic][1]()
    message.data = bytes.fromhex(data)
    ends[topic][0].publish(message)
    time.sleep(0.02)
time.sleep(0.5)
print(turns)
"""


@pytest.fixture
def ros_master() -> Any:
    master = shutil.which("rosmaster") or ""
    need(bool(master) and (DIST_PACKAGES / "rospy").exists(), "rospy is not installed")
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    uri = f"http://127.0.0.1:{port}"
    process = subprocess.Popen(
        [master, "--core", "-p", str(port)],
        env={**os.environ, "ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    yield {**os.environ, "ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1", "PYTHONPATH": os.getcwd()}
    process.terminate()
    process.wait(10)


def test_a_robot_is_driven_over_ros1(ros_master: Any, tmp_path: Path) -> None:
    """rospy of Debian is the robot; rospy in this environment drives."""
    bag, script = write_rosbag1(tmp_path / "old.bag"), tmp_path / "messages"
    lines = []
    for topic, _, message in messages(STORE1):
        if topic in ("/joints", "/odom"):
            kind = message.__msgtype__
            text, md5 = STORE1.generate_msgdef(kind, ros_version=1)
            data = bytes(STORE1.serialize_ros1(message, kind))
            name = kind.replace("/msg/", "/")
            lines.append(f"{topic} {name} {md5} {text.encode().hex()} {data.hex()}\n")
    script.write_text("".join(lines))
    _wait(lambda: _is_online(ros_master["ROS_MASTER_URI"]))
    drive = subprocess.Popen(
        [sys.executable, "-c", ROS1_DRIVE, bag, "8"], env=ros_master, stdout=subprocess.PIPE
    )
    robot = subprocess.run(
        ["/usr/bin/python3", "-c", ROS1_ROBOT, script, "wait"],
        env={**ros_master, "PYTHONPATH": ""},
        capture_output=True,
        text=True,
        timeout=60,
    )
    out, _ = drive.communicate(timeout=60)
    assert robot.returncode == 0, robot.stderr
    assert drive.returncode == 0
    steps, driven = map(int, out.split())
    assert steps == 12
    assert driven >= 11
    turns = [float(each) for each in robot.stdout.strip("[]\n").split(",")]
    assert turns.count(TURN) >= 11
    assert turns[-1] in (TURN, 0.0)


def _is_online(uri: str) -> bool:
    host, port = uri.removeprefix("http://").split(":")
    with socket.socket() as one:
        return one.connect_ex((host, int(port))) == 0


class FakeRclpy:
    """Stand-in of rclpy: its interface as far as the transport uses it, with bytes in memory."""

    def __init__(self) -> None:
        self.topics: dict[str, str] = {}
        self.subscriptions: dict[str, Any] = {}
        self.sent: list[tuple[str, bytes]] = []
        self.profiles: dict[str, Any] = {}
        self.is_running = True
        self.signals: list[Any] = []

    def modules(self) -> dict[str, Any]:
        rclpy = types.ModuleType("rclpy")
        rclpy.Context = object  # type: ignore[attr-defined]
        rclpy.init = lambda context, signal_handler_options: self.signals.append(  # type: ignore[attr-defined]
            signal_handler_options
        )
        rclpy.create_node = lambda name, context: self  # type: ignore[attr-defined]
        rclpy.shutdown = lambda context: setattr(self, "is_running", False)  # type: ignore[attr-defined]
        rclpy.duration = types.SimpleNamespace(Duration=lambda seconds: seconds)  # type: ignore[attr-defined]
        names = types.SimpleNamespace
        qos = names(
            QoSProfile=lambda **values: names(**values),
            ReliabilityPolicy=names(RELIABLE=1, BEST_EFFORT=2),
            DurabilityPolicy=names(TRANSIENT_LOCAL=1, VOLATILE=2),
        )
        executor = names(add_node=lambda node: None, spin=lambda: None, shutdown=lambda: None)
        found = {
            "rclpy": rclpy,
            "rclpy.signals": names(SignalHandlerOptions=names(NO="no")),
            "rclpy.executors": names(SingleThreadedExecutor=lambda context: executor),
            "rclpy.qos": qos,
        }
        for kind in ("nav_msgs/Odometry", "sensor_msgs/JointState", "geometry_msgs/Twist"):
            package, name = kind.split("/")
            found.setdefault(f"{package}.msg", types.SimpleNamespace())
            setattr(found[f"{package}.msg"], name, kind)
        return found

    def create_subscription(
        self, kind: Any, topic: str, callback: Any, qos_profile: Any, *, raw: bool
    ) -> None:
        assert raw
        self.subscriptions[topic], self.profiles[topic] = callback, qos_profile

    def create_publisher(self, kind: Any, topic: str, qos_profile: Any) -> Any:
        assert kind == "geometry_msgs/Twist"
        self.profiles[topic] = qos_profile
        return types.SimpleNamespace(
            publish=lambda data: self.sent.append((topic, data)),
            wait_for_all_acked=lambda timeout: True,
        )

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        found = self.topics.get(topic)
        return [types.SimpleNamespace(topic_type=found)] if found else []

    get_subscriptions_info_by_topic = get_publishers_info_by_topic

    def destroy_node(self) -> None:
        self.sent.append(("closed", b""))


def test_a_robot_is_driven_over_ros2(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a stand-in of rclpy's interface: rclpy itself cannot be installed by pip."""
    fake = FakeRclpy()
    for name, module in fake.modules().items():
        monkeypatch.setitem(sys.modules, name, module)

    class Policy(Cruise):
        """Sends the next messages after each command."""

    sent = iter(
        [
            (topic, bytes(STORE2.serialize_cdr(message, message.__msgtype__)))
            for topic, _, message in messages(STORE2)
            if topic in ("/odom", "/joints")
        ]
    )

    def more(_: Any) -> None:
        for topic, data in itertools.islice(sent, 2):
            if topic in fake.subscriptions:
                fake.subscriptions[topic](data)

    status = mcaprl.drive_robot(driver(bag, Policy()), "ros2", duration_s=1, on_status=more)
    assert status.driven == status.steps >= 2
    decoded = [
        STORE2.deserialize_cdr(data, "geometry_msgs/msg/Twist") for _, data in fake.sent[:-1]
    ]
    turns: list[float] = [each.angular.z for each in decoded]  # type: ignore[attr-defined]
    assert set(turns[: status.driven]) == {TURN}
    assert turns[-1] == 0.0
    assert fake.sent[-1][0] == "closed"
    assert not fake.is_running
    assert fake.signals == ["no"]
    assert fake.profiles["/odom"].reliability == 2
    assert (fake.profiles["/cmd_vel"].reliability, fake.profiles["/cmd_vel"].depth) == (1, 1)
    fake.topics["/odom"] = "sensor_msgs/msg/Imu"
    with pytest.raises(LogError, match="Imu on /odom; the mapping needs nav_msgs/msg/Odometry"):
        mcaprl.drive_robot(driver(bag), "ros2", duration_s=5)


@pytest.mark.parametrize("name", ["ros1", "ros2"])
def test_a_ros_that_is_missing_is_named(
    bag: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("rospy", "rclpy"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match="cannot be imported"):
        mcaprl.drive_robot(driver(bag), name, duration_s=1)

"""An exported node publishes what `Driver` commands, through a stand-in of rclpy."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from functools import partial
from io import BytesIO
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

import mcaprl
from mcaprl.drive.node import export_node
from mcaprl.drive.node_main import node_import
from mcaprl.errors import UsageError
from tests.support.robots import Robot, odometry, transform, twist, write_mcap

START_NS = 1_700_000_000 * 10**9
STORE = get_typestore(Stores.ROS2_HUMBLE)
TF = "tf2_msgs/msg/TFMessage"
RAW = "sensor_msgs/msg/Image"


def plain_type(kind: str) -> type:
    """Return a class of messages as rclpy has them."""
    package, _, name = kind.split("/")
    if kind == TF:
        types = {"transforms": "sequence<geometry_msgs/TransformStamped>"}
        body: dict[str, Any] = {"transforms": []}
    else:
        types = {field: "" for field, _ in STORE.fielddefs[kind][1]}
        body = {}

    def start(self: Any) -> None:
        for field, (node, what) in () if kind == TF else STORE.fielddefs[kind][1]:
            value: Any = 0.0
            if node == Nodetype.NAME:
                value = plain_type(str(what))()
            elif node == Nodetype.BASE:
                value = "" if what[0] == "string" else 0
            else:
                value = [0.0] * int(what[1] or 0)
            setattr(self, field, value)

    found = type(name, (), {**body, "__init__": start})
    found.__module__ = f"{package}.msg._{name.lower()}"
    found.get_fields_and_field_types = classmethod(lambda cls: types)  # type: ignore[attr-defined]
    return found


def filled(message: Any, values: dict[str, Any]) -> Any:
    for name, value in values.items():
        if isinstance(value, dict):
            filled(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            kind = "geometry_msgs/msg/TransformStamped"
            setattr(message, name, [filled(plain_type(kind)(), each) for each in value])
        else:
            setattr(message, name, value)
    return message


def as_dict(message: Any) -> Any:
    if not hasattr(message, "__dict__"):
        return message
    return {name: as_dict(value) for name, value in vars(message).items()}


class Ros:
    """Stand-in of rclpy: a clock, subscriptions, timers, and the published messages."""

    def __init__(self, messages: list[tuple[int, str, Any]]) -> None:
        """Store what will come: time, topic and message."""
        self.now_ns, self._coming = messages[0][0], messages
        self.published: list[tuple[int, str, Any]] = []
        self.subscriptions: dict[str, Any] = {}
        self.timers: list[list[Any]] = []

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        """Return what stores published messages."""
        return SimpleNamespace(
            publish=lambda message: self.published.append((self.now_ns, topic, as_dict(message)))
        )

    def create_subscription(self, kind: Any, topic: str, callback: Any, qos: Any) -> None:
        """Store a callback."""
        self.subscriptions[topic] = callback

    def create_timer(self, period_s: float, callback: Any) -> None:
        """Store a callback, which is called on time."""
        self.timers.append([self.now_ns, round(period_s * 1e9), callback])

    def get_clock(self) -> Any:
        """Return the clock."""
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.now_ns))

    def get_logger(self) -> Any:
        """Return what drops texts."""
        return SimpleNamespace(info=lambda text: None, error=lambda text: None)

    def destroy_node(self) -> None:
        """Do nothing."""

    def ok(self) -> bool:
        """Return whether messages are left."""
        return bool(self._coming)

    def spin_once(self, node: Any, timeout_sec: float) -> None:
        """Call what is next: timers before messages that are later."""
        time_ns, topic, message = self._coming[0]
        for timer in self.timers:
            if timer[0] < time_ns:
                self.now_ns = timer[0]
                timer[0] += timer[1]
                timer[2]()
                return
        self.now_ns = time_ns
        self._coming.pop(0)
        self.subscriptions[topic](message)


@pytest.fixture
def rclpy(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Provide modules that look like those of ROS 2."""
    found = ModuleType("rclpy")
    qos = ModuleType("rclpy.qos")
    qos.QoSProfile = lambda **options: options  # type: ignore[attr-defined]
    qos.DurabilityPolicy = SimpleNamespace(TRANSIENT_LOCAL=1)  # type: ignore[attr-defined]
    qos.qos_profile_sensor_data = "sensors"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "rclpy", found)
    monkeypatch.setitem(sys.modules, "rclpy.qos", qos)
    for package, names in {
        "nav_msgs": ["Odometry"],
        "sensor_msgs": ["CameraInfo", "CompressedImage", "Image"],
        "geometry_msgs": ["Twist", "TransformStamped"],
        "tf2_msgs": ["TFMessage"],
    }.items():
        module = ModuleType(f"{package}.msg")
        for name in names:
            setattr(module, name, plain_type(f"{package}/msg/{name}"))
        monkeypatch.setitem(sys.modules, f"{package}.msg", module)
    return found


def image(kind: tuple[str, int], t: float) -> dict[str, Any]:
    """Return an image of 8 x 6 pixels of `width` bytes, which changes from step to step."""
    encoding, width = kind
    data = np.random.default_rng(round(1000 * t)).integers(0, 255, 8 * 6 * width).tolist()
    data = data if encoding != "32FC1" else list(np.linspace(t, 9, 48, dtype="<f4").tobytes())
    size = {"height": 6, "width": 8, "step": 8 * width, "is_bigendian": 0}
    return {**size, "encoding": encoding, "data": data}


def photo(t: float) -> dict[str, Any]:
    """Return a PNG file."""
    buffer = BytesIO()
    Image.fromarray(np.full((4, 6, 3), round(40 * t), np.uint8)).save(buffer, "PNG")
    return {"format": "png", "data": list(buffer.getvalue())}


def robot() -> Robot:
    found = Robot([])
    found.add("/odom", "nav_msgs/msg/Odometry", 20, odometry, last_s=6)
    found.add("/cmd_vel", "geometry_msgs/msg/Twist", 10, twist, last_s=6)
    frames = [("map", "base")]
    for topic, kind in (("/camera", ("bgr8", 3)), ("/depth", ("32FC1", 4))):
        found.add(topic, RAW, 10, partial(image, kind), last_s=6)
    found.add("/photo", "sensor_msgs/msg/CompressedImage", 10, photo, last_s=6)
    info = {"width": 8, "height": 6, "distortion_model": "plumb_bob", "d": [-0.1, 0, 0, 0, 0]}
    info |= {"k": [5.0, 0, 3, 0, 5, 2, 0, 0, 1], "r": [0.0] * 9, "p": [0.0] * 12}
    found.add("/info", "sensor_msgs/msg/CameraInfo", 10, lambda _: info, last_s=6)
    found.add("/tf", TF, 20, lambda t: {"transforms": [transform(*f, t) for f in frames]}, last_s=6)
    return found


MAPPING = {
    "clock": {"rate_hz": 5},
    "observation": {
        "speed": {"field": "/odom.twist.twist.linear.x", "scale": 0.5},
        "yaw": {"field": "/odom.pose.pose.orientation", "as": "yaw"},
        "pose": {"transform": "base", "in": "map", "parts": ["x", "yaw"]},
    },
    "stack": 2,
    "action": {
        "fields": ["/cmd_vel.linear.x", "/cmd_vel.angular.z"],
        "box": {"low": -1, "high": 1},
    },
    "reward": "next(speed)",
    "episodes": {"max_steps": 10, "terminated": "speed > 100"},
    "drive": {"max_change": 2.0},
}
SIGHT = {
    **MAPPING,
    "observation": {
        "speed": {"field": "/odom.twist.twist.linear.x", "scale": 0.5},
        "camera": {"image": "/camera", "gray": True},
        "small": {"image": "/camera", "undistort": "/info", "resize": [4, 3]},
        "depth": {"image": "/depth", "range_m": [0, 10]},
        "photo": {"image": "/photo", "crop": [1, 1, 4, 3]},
    },
    "stack": 1,
}
BINS = {
    **MAPPING,
    "clock": {"topic": "/odom"},
    "action": {"fields": ["/cmd_vel.linear.x"], "edges": [[0.2, 0.5]]},
}


CHUNKS: list[dict[str, Any]] = [{"chunk": 4, "execute": 3}, {"chunk": 3, "ensemble": True}]


@pytest.mark.parametrize(
    ("mapping", "settings"),
    [
        (MAPPING, {}),
        (BINS, {}),
        (SIGHT, {}),
        (BINS, CHUNKS[0]),
        *((MAPPING, each) for each in CHUNKS),
    ],
)
def test_a_node_commands_what_the_driver_commands(
    mapping: dict[str, Any], settings: dict[str, Any], tmp_path: Path, rclpy: Any
) -> None:
    bag = write_mcap(robot(), tmp_path / "bag.mcap")
    data = mcaprl.open(bag, mapping=mapping)
    run = mcaprl.train(data, tmp_path / "run", algo="bc", updates=3, **settings)
    node = tmp_path / "drive.py"
    mcaprl.export(run, node=node)
    driver = mcaprl.Driver(run)
    rows = [
        (START_NS + round(t * 1e9), topic.name, filled(plain_type(topic.kind)(), values))
        for topic in robot().topics
        for t, values in topic.messages
        if topic.name in driver.inputs
    ]
    rows.sort(key=lambda row: row[0])
    expected = []
    for time_ns, topic, message in rows:
        while driver.period_ns and (next_ns := driver.next_step_ns) and next_ns < time_ns:
            expected.append(driver.command(next_ns).messages["/cmd_vel"])
        driver.push(topic, message, time_ns)
        if topic == driver.clock_topic:
            expected.append(driver.command(time_ns).messages["/cmd_vel"])
    ros = Ros(rows)
    for name in ("ok", "spin_once"):
        setattr(rclpy, name, getattr(ros, name))
    rclpy.init, rclpy.try_shutdown = (lambda: None), (lambda: None)
    rclpy.create_node = lambda name: ros
    spec = importlib.util.spec_from_file_location("exported_node", node)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["exported_node"] = module
    spec.loader.exec_module(module)
    with pytest.raises(SystemExit) as done:
        module.main(module.SPEC, module.MODEL)
    assert done.value.code == 0
    found = [message for _, _, message in ros.published if message != driver.stop["/cmd_vel"]]
    wanted = [message for message in expected if message != driver.stop["/cmd_vel"]]
    assert ros.published[-1][2] == driver.stop["/cmd_vel"]
    assert len(found) > 15
    values = [
        [(each["linear"]["x"], each["angular"]["z"]) for each in part] for part in (found, wanted)
    ]
    # ONNX Runtime and PyTorch round differently.
    np.testing.assert_allclose(values[0], values[1], atol=1e-5)
    code = "import runpy, sys; runpy.run_path(sys.argv[1]); print(*sys.modules)"
    done_ = subprocess.run(
        [sys.executable, "-P", "-c", code, str(node)], capture_output=True, text=True, check=True
    )
    heavy = {"mcaprl", "torch", "gymnasium", "rosbags", "pydantic"}
    assert not heavy & {name.partition(".")[0] for name in done_.stdout.split()}


def test_a_node_names_the_package_that_its_images_need(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.delitem(sys.modules, "PIL.Image")
    with pytest.raises(UsageError, match="Pillow is not installed, which the images need"):
        node_import("PIL.Image", "bags")


def test_a_node_does_not_decode_videos(tmp_path: Path) -> None:
    reader = SimpleNamespace(packets_ns=0.0, topic="/video")
    driver: Any = SimpleNamespace(_plan=SimpleNamespace(images={"camera": reader}))
    with pytest.raises(UsageError, match="camera: a node of one file cannot decode the video of /"):
        export_node(driver, tmp_path / "drive.py")
    assert not [*tmp_path.iterdir()]


def test_an_export_needs_a_file_to_write(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="pass `out`, `node`, or both"):
        mcaprl.export(tmp_path)

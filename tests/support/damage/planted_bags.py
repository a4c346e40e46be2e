"""Bags of a robot that drives and rests, and faults that are planted into them."""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.support.robots import Robot, Topic, vector

RATE_HZ: Final = 50
Random = np.random.Generator
Fault = Callable[[Robot, Random], tuple[str, int, int] | None]


def _header(t: float) -> dict[str, Any]:
    stamp = {"sec": int(t), "nanosec": int(t % 1 * 1e9)}
    return {"seq": round(1000 * t), "stamp": stamp, "frame_id": "base"}


def _targets(random: Random, steps: int) -> NDArray[np.float64]:
    """Return speeds that are held for one to four seconds; a third of them are 0."""
    found: list[float] = []
    while len(found) < steps:
        speed = 0.0 if random.random() < 1 / 3 else float(np.round(random.uniform(-1, 1), 1))
        found += [speed] * int(random.integers(1 * RATE_HZ, 4 * RATE_HZ))
    return np.array(found[:steps])


def _followed(targets: NDArray[np.float64], limit: float) -> NDArray[np.float64]:
    """Return speeds that follow targets with a bounded change in each step."""
    speed, found = 0.0, []
    for target in targets.tolist():
        speed += float(np.clip(target - speed, -limit, limit))
        found.append(speed)
    return np.array(found)


def clean_robot(seed: int, *, is_sim: bool = False, seconds: float = 20) -> Robot:
    """Return a robot that drives and rests.

    A sim has no noise, and in half of the seeds it starts and stops within a step. The wheels of a
    real robot slip, its sensors have noise, and its wheels' odometry at rest has none.
    """
    random = np.random.default_rng(seed)
    steps = int(seconds * RATE_HZ)
    limit = 9.0 if is_sim and seed % 2 else 0.02
    targets, turns = _targets(random, steps), _targets(random, steps)
    speed, turn = _followed(targets, limit), _followed(turns, 2 * limit)
    noise = 0.0 if is_sim else 1.0
    slip = 1 + 0.02 * noise * random.normal(size=steps)
    yaw = np.cumsum(turn * slip) / RATE_HZ
    x, y = (np.cumsum(speed * slip * part(yaw)) / RATE_HZ for part in (np.cos, np.sin))
    arm = np.cumsum(_followed(_targets(random, steps), 0.05)) / RATE_HZ
    scene = np.zeros((64, 256))
    for size in (4, 16, 64):
        patches = random.integers(0, 86, (64 // size, 256 // size))
        scene += patches.repeat(size, 0).repeat(size, 1)

    def at(t: float) -> int:
        return min(round(t * RATE_HZ), steps - 1)

    def rough(size: float, count: int = 1) -> NDArray[np.float64]:
        return noise * size * random.normal(size=count)

    def odometry(t: float) -> dict[str, Any]:
        k = at(t)
        turned = {"x": 0.0, "y": 0.0, "z": np.sin(yaw[k] / 2), "w": np.cos(yaw[k] / 2)}
        twist = {"linear": vector(speed[k] * slip[k]), "angular": vector(0, 0, turn[k] * slip[k])}
        pose = {"position": vector(x[k], y[k]), "orientation": turned}
        return {"header": _header(t), "pose": {"pose": pose}, "twist": {"twist": twist}}

    def imu(t: float) -> dict[str, Any]:
        k = at(t)
        push = (speed[k] - speed[max(k - 1, 0)]) * RATE_HZ
        force, spin = rough(0.02, 3), rough(0.01, 3)
        return {
            "header": _header(t),
            "linear_acceleration": vector(push + force[0], force[1], 9.81 + force[2]),
            "angular_velocity": vector(spin[0], spin[1], turn[k] + spin[2]),
        }

    def view(t: float) -> NDArray[np.uint8]:
        k = at(t)
        left = x[k] * 40 + yaw[k] * 80
        columns = np.arange(48) + left
        low = np.floor(columns).astype(int)
        share = columns - low
        lines = scene[:36]
        seen = lines[:, low % 256] * (1 - share) + lines[:, (low + 1) % 256] * share
        seen = 30 + 0.7 * seen + rough(2.0, 36 * 48).reshape(36, 48)
        colors = np.stack([seen, seen, 0.5 * seen], -1).clip(0, 255)
        pixels: NDArray[np.uint8] = colors.astype(np.uint8)
        return pixels

    def raw(t: float) -> dict[str, Any]:
        return raw_image(t, view(t))

    def scan(t: float) -> dict[str, Any]:
        k = at(t)
        ranges = 3 + np.cos(np.linspace(0, 6, 36) + yaw[k]) + 0.1 * x[k] + rough(0.01, 36)
        return {"header": _header(t), "ranges": ranges.astype(np.float32), "range_max": 30.0}

    robot = Robot([])
    spans = {"last_s": seconds}
    for name, kind, rate_hz, message in (
        ("/odom", "nav_msgs/msg/Odometry", 50, odometry),
        ("/imu", "sensor_msgs/msg/Imu", 50, imu),
        (
            "/cmd_vel",
            "geometry_msgs/msg/Twist",
            10,
            lambda t: {"linear": vector(targets[at(t)]), "angular": vector(0, 0, turns[at(t)])},
        ),
        (
            "/joints",
            "sensor_msgs/msg/JointState",
            25,
            lambda t: {
                "header": _header(t),
                "name": ["lift", "grip"],
                "position": [arm[at(t)], 0.5 + 0.0 * t],
            },
        ),
        ("/scan", "sensor_msgs/msg/LaserScan", 10, scan),
        ("/camera", "sensor_msgs/msg/Image", 10, raw),
        (
            "/camera/compressed",
            "sensor_msgs/msg/CompressedImage",
            10,
            lambda t: jpeg_image(t, view(t)),
        ),
        ("/map", "nav_msgs/msg/OccupancyGrid", 2, lambda t: {"header": _header(t), "data": [0, 9]}),
        (
            "/battery",
            "sensor_msgs/msg/BatteryState",
            2,
            lambda t: {"header": _header(t), "percentage": round(0.9 - t / 900, 3)},
        ),
    ):
        robot.add(name, kind, rate_hz, message, **spans)
    static = {"transforms": [{"header": _header(0.0), "child_frame_id": "camera"}]}
    return robot.add("/tf_static", "tf2_msgs/msg/TFMessage", 1, lambda t: static, last_s=0.5)


def raw_image(t: float, pixels: NDArray[np.uint8]) -> dict[str, Any]:
    """Return the fields of an Image."""
    height, width, _ = pixels.shape
    sizes = {"height": height, "width": width, "step": 3 * width, "encoding": "rgb8"}
    return {"header": _header(t), **sizes, "data": pixels.ravel()}


def jpeg_image(t: float, pixels: NDArray[np.uint8]) -> dict[str, Any]:
    """Return the fields of a CompressedImage."""
    Image.fromarray(pixels).save(file := io.BytesIO(), "JPEG")
    data = np.frombuffer(file.getvalue(), np.uint8)
    return {"header": _header(t), "format": "jpeg", "data": data}


def topic_of(robot: Robot, name: str) -> Topic:
    """Return a topic of a robot."""
    return next(topic for topic in robot.topics if topic.name == name)


def repeat(robot: Robot, name: str, first: int, count: int) -> None:
    """Send the content before message `first` again in `count` messages, with stamps that go on."""
    messages = topic_of(robot, name).messages
    for k in range(first, first + count):
        t, values = messages[k]
        again = {**messages[first - 1][1]}
        if "header" in again:
            again["header"] = values["header"]
        messages[k] = (t, again)


def blacken(robot: Robot, name: str, first: int, count: int, seed: int = 0) -> None:
    """Cover a camera for `count` frames, in which a little noise is left."""
    random = np.random.default_rng(seed)
    topic = topic_of(robot, name)
    make = jpeg_image if "Compressed" in topic.kind else raw_image
    for k in range(first, first + count):
        pixels = random.integers(0, 3, (36, 48, 3)).astype(np.uint8)
        topic.messages[k] = (topic.messages[k][0], make(topic.messages[k][0], pixels))


def slow(robot: Robot, name: str, times: int) -> None:
    """Send each content several times."""
    messages = topic_of(robot, name).messages
    for first in range(1, len(messages) - times, times):
        repeat(robot, name, first, times - 1)


def _content(values: dict[str, Any]) -> str:
    return repr({name: value for name, value in values.items() if name != "header"})


def _plant(plant: Callable[..., None], name: str, count: int) -> Fault:
    def planted(robot: Robot, random: Random) -> tuple[str, int, int] | None:
        contents = [_content(values) for _, values in topic_of(robot, name).messages]
        moves = np.array([one != two for one, two in itertools.pairwise(contents)])
        # Message k follows with another content if moves[k - 1].
        fits = [
            k for k in range(2, len(moves) - count) if moves[k - 2 : k + count + 1].mean() > 0.9
        ]
        if not fits:
            return None
        plant(robot, name, first := int(random.choice(fits)), count)
        return name, first, first + count - 1

    return planted


BAG_FAULTS: Final[dict[str, Fault]] = {
    "repeated, /odom": _plant(repeat, "/odom", 50),
    "repeated, /imu": _plant(repeat, "/imu", 50),
    "repeated, /scan": _plant(repeat, "/scan", 12),
    "repeated, /joints": _plant(repeat, "/joints", 25),
    "frozen, /camera": _plant(repeat, "/camera", 12),
    "frozen, /camera/compressed": _plant(repeat, "/camera/compressed", 12),
    "black, /camera": _plant(blacken, "/camera", 5),
    "black, /camera/compressed": _plant(blacken, "/camera/compressed", 5),
}
"""Faults by kind and topic. Each plants itself while the topic changes, and returns topic, first
and last message; None if the topic never changes for so long."""

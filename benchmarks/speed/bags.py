"""Measure the reading of robots' bags: message fields, compressed images, and mapped bags."""

from __future__ import annotations

import io
import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from operator import attrgetter
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np

from benchmarks.measure import OURS, Side, Table, compare
from benchmarks.speed import rivals
from mcaprl.recorder import clear_types, open_bag

MESSAGES = 100_000
SLOW_SHARE = 0.02
IMAGES, IMAGE_SIZE = 600, (640, 480)
STEP_NS = 10_000_000
FIELDS = {
    "nav_msgs/msg/Odometry": ("pose.pose.position.x", "twist.twist.linear.x"),
    "sensor_msgs/msg/Imu": ("linear_acceleration.y", "angular_velocity.z"),
    "geometry_msgs/msg/Twist": ("linear.x", "angular.z"),
    "sensor_msgs/msg/JointState": ("position",),
    "sensor_msgs/msg/LaserScan": ("ranges",),
}
"""Fields to read, by message type; each type is on a separate topic, such as `/odometry`."""
LIMIT_S = 300.0
"""Maximum time for reading a gigabyte, in seconds; users require at most five minutes."""


def tables(folder: Path) -> list[Table]:
    """Write bags to `folder`, and measure reading them."""
    path, images = folder / "fields.mcap", folder / "images.mcap"
    _write_fields(path)
    encoded = _write_images(images)
    return [*(_fields(path, kind) for kind in FIELDS), _decoded(images, encoded), _gigabyte(images)]


def _fields(path: Path, kind: str) -> Table:
    topic, fields = _topic(kind), FIELDS[kind]
    return compare(
        f"Fields of {kind}, from the file to NumPy",
        [
            Side(OURS, lambda: _ours(path, topic, fields)),
            Side("rerun's McapReader", lambda: rivals.read_rerun(path, topic, fields)),
            Side(
                "mcap-ros2-support, message by message",
                lambda: _one_by_one(path, topic, fields, int(MESSAGES * SLOW_SHARE)),
                SLOW_SHARE,
            ),
        ],
        goal="20 times less than mcap-ros2-support, 3 times less than rerun",
    )


def _ours(path: Path, topic: str, fields: Sequence[str]) -> Any:
    # Measure only the first opening of a bag, because it parses the message definitions.
    clear_types()
    with closing(open_bag(path)) as bag:
        return bag.read(topic, fields).columns


def _one_by_one(path: Path, topic: str, fields: Sequence[str], count: int) -> list[Any]:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    getters, found = [attrgetter(field) for field in fields], []
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for *_, message in reader.iter_decoded_messages(topics=[topic]):
            found.append([get(message) for get in getters])
            if len(found) == count:
                break
    return found


def _decoded(path: Path, encoded: list[bytes]) -> Table:
    def decode() -> None:
        from PIL import Image

        for image in encoded:
            np.asarray(Image.open(io.BytesIO(image)).resize((84, 84), Image.Resampling.BOX))

    return compare(
        f"Compressed images of a bag: {IMAGE_SIZE[0]}x{IMAGE_SIZE[1]} JPEG to 84x84",
        [Side(OURS, lambda: _open(path)), Side("Pillow's decoding and averaging alone", decode)],
        goal="bound by Pillow",
        rounds=3,
    )


def _open(path: Path) -> Any:
    import mcaprl

    return mcaprl.open(
        path,
        mapping={
            "clock": {"topic": "/camera"},
            "observation": {"camera": {"image": "/camera", "resize": [84, 84]}},
            "action": {"field": "/mode.data"},
        },
    )


def _gigabyte(path: Path) -> Table:
    """Measure reading images in a separate process, whose memory no other work uses."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        seconds, memory = pool.submit(_cost, path).result()
    table = Table(
        "A bag of compressed images through a mapping",
        goal="time less than 1; memory bounded by the size of the result",
        unit="ratio",
    )
    table.ratios = {
        "time for a gigabyte, five minutes = 1": seconds * 1e9 / path.stat().st_size / LIMIT_S,
        "peak memory, result = 1": memory,
    }
    print(table.to_markdown(), flush=True)
    return table


def _cost(path: Path) -> tuple[float, float]:
    """Return the seconds for reading a bag, and peak memory divided by the size of the result.

    Pages of the mapped file do not count, because the system can release them at any time.
    """
    few = path.with_name("few.mcap")
    _write_images(few, 5)
    _open(few)
    before, start, samples, done = _private_bytes(), time.perf_counter(), [0], Event()

    def sample() -> None:
        while not done.wait(0.005):
            samples.append(_private_bytes())

    thread = Thread(target=sample)
    thread.start()
    data = _open(path)
    seconds = time.perf_counter() - start
    done.set()
    thread.join()
    result = data.frames.nbytes
    return seconds, (max(samples) - before) / result


def _private_bytes() -> int:
    """Return the memory of this process in bytes, without mapped files."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))


def _topic(kind: str) -> str:
    return "/" + kind.rpartition("/")[2].lower()


def _write_fields(path: Path) -> None:
    """Write messages of each type, with random numbers, one type after the other."""
    random = np.random.default_rng(0)
    with _Log(path) as log:
        for kind in FIELDS:
            several = [log.encoded(kind, random) for _ in range(20)]
            for number in range(MESSAGES):
                log.write(_topic(kind), kind, number * STEP_NS, several[number % len(several)])


def _write_images(path: Path, count: int = IMAGES) -> list[bytes]:
    """Write JPEG images of smooth noise, each followed by an action; return the images."""
    from PIL import Image

    random = np.random.default_rng(0)
    width, height = IMAGE_SIZE
    images = []
    for _ in range(20):
        coarse = random.integers(0, 256, (height // 8, width // 8, 3), np.uint8)
        file = io.BytesIO()
        Image.fromarray(coarse).resize(IMAGE_SIZE).save(file, "JPEG", quality=85)
        images.append(file.getvalue())
    encoded = [images[number % len(images)] for number in range(count)]
    with _Log(path) as log:
        kind = "sensor_msgs/msg/CompressedImage"
        header = log.store.types["std_msgs/msg/Header"](
            log.store.types["builtin_interfaces/msg/Time"](0, 0), "camera"
        )
        for number, image in enumerate(encoded):
            data = np.frombuffer(image, np.uint8)
            message = log.store.types[kind](header, "jpeg", data)
            content = bytes(log.store.serialize_cdr(message, kind))
            log.write("/camera", kind, number * STEP_NS, content)
            mode = log.store.types["std_msgs/msg/UInt8"](number % 2)
            content = bytes(log.store.serialize_cdr(mode, mode.__msgtype__))
            log.write("/mode", mode.__msgtype__, number * STEP_NS + 1, content)
    return encoded


class _Log:
    """Writer of ROS 2 messages to MCAP files with message definitions, like `ros2 bag record`."""

    def __init__(self, path: Path) -> None:
        from mcap.writer import Writer
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self._writer = Writer(str(path))
        self._channels: dict[str, int] = {}

    def __enter__(self) -> _Log:
        self._writer.start(profile="ros2")
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.finish()

    def write(self, topic: str, kind: str, time_ns: int, content: bytes) -> None:
        if topic not in self._channels:
            text, _ = self.store.generate_msgdef(kind, ros_version=2)
            schema = self._writer.register_schema(kind, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        self._writer.add_message(self._channels[topic], time_ns, content, time_ns)

    def encoded(self, kind: str, random: np.random.Generator) -> bytes:
        """Return an encoded message with random numbers, such as 6 joints or 360 ranges."""
        return bytes(self.store.serialize_cdr(self._message(kind, random), kind))

    def _message(self, kind: str, random: np.random.Generator) -> Any:
        _, fields = self.store.fielddefs[kind]
        values = {name: self._value(name, node, random) for name, node in fields}
        return self.store.types[kind](**values)

    def _value(self, name: str, node: Any, random: np.random.Generator) -> Any:
        from rosbags.interfaces import Nodetype

        sort, what = node
        if sort == Nodetype.NAME:
            return self._message(what, random)
        if sort == Nodetype.BASE:
            return "base_link" if what[0] == "string" else 1
        (_, (item, _)), length = what
        count = length or (360 if name in ("ranges", "intensities") else 6)
        if item == "string":
            return [f"joint_{number}" for number in range(count)]
        return random.random(count).astype(item)

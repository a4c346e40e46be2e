"""Suggestion of a mapping file, from the topics of a bag."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.bags.bag import Bag, TopicInfo
from mcaprl.recorder.format.topics import STEP_TOPIC
from mcaprl.recorder.mapping.align import NS_PER_S
from mcaprl.recorder.mapping.images import is_image_type
from mcaprl.texts import printable

# If the name of a topic or type contains one of these words, the topic is likely to have commands.
_COMMAND_WORDS = ("cmd", "command", "action", "target", "setpoint", "ackermann", "control")
_MAX_RATE_HZ, _MIN_RATE_HZ = 20.0, 1.0
_MAX_OBSERVED = 12
_SIZES = (8, 16, 32, 64)
_NUMBERS = {"float32", "float64", "bool", *(f"{u}int{bits}" for u in ("", "u") for bits in _SIZES)}
_SKIPPED = ("/rosout", "/parameter_events", "/tf", "/tf_static", "/diagnostics", "/clock")
_LIKELY = {
    "nav_msgs/msg/Odometry": (
        "twist.twist.linear.x",
        "twist.twist.angular.z",
        "pose.pose.position.x",
        "pose.pose.position.y",
    ),
    "sensor_msgs/msg/Imu": ("angular_velocity.z", "linear_acceleration.x"),
    "sensor_msgs/msg/LaserScan": ("ranges[::10]",),
    "sensor_msgs/msg/JointState": ("position", "velocity"),
    "std_msgs/msg/Float32MultiArray": ("data",),
    "std_msgs/msg/Float64MultiArray": ("data",),
}
"""Fields of common types that a policy is likely to observe."""
# YAML reads these paths as text without quotes.
_PLAIN = re.compile(r"/[\w/.-]+", re.ASCII)


class _Entry(NamedTuple):
    """A line of the mapping: name and path of an observation, and a comment."""

    name: str
    path: str
    remark: str


class _Topic(NamedTuple):
    """A topic and its rate: that of the median interval, so that pauses do not count."""

    info: TopicInfo
    rate_hz: float

    def __str__(self) -> str:
        info = self.info
        return f"{info.type_name or info.encoding}, {info.count} messages, {self.rate_hz:.3g} Hz"


def suggested(bag: Bag) -> str:
    """Return the text of a mapping file with the likely observations and action of a bag.

    Comments list all other numbers and images that can be read, with type and rate.

    Raises:
        LogError: The bag has no topic with numbers, or is a log.
    """
    where = ", ".join(map(str, bag.paths))
    if STEP_TOPIC in bag.topics:
        raise LogError(
            f"{where} is a log already, with the topic {STEP_TOPIC}: it needs no mapping"
        )
    usable = [
        _Topic(info, _rate_of(bag.times(info.name)))
        for info in bag.topics.values()
        if info.count and not info.problem
    ]
    command = _command(usable)
    rate_hz = _rate(usable)
    frequent = [topic for topic in usable if topic is not command and 2 * topic.rate_hz >= rate_hz]
    observed = list(_observations(bag, frequent))
    if not observed and command is None:
        raise LogError(f"{where}: no topic has numbers; topics: {', '.join(bag.topics) or 'none'}")
    lines = [
        "# Mapping of a bag to observations, actions and rewards. Edit it, and look at the result:",
        "#   mcaprl convert BAG --mapping THIS_FILE --dry-run",
        "time: log_time  # or publish_time, or header",
        f"clock: {{rate_hz: {rate_hz:g}}}",
        "observation:",
        *(f"  {name}: {{field: {_quoted(path)}}}  # {remark}" for name, path, remark in observed),
    ]
    lines += [
        f"  # camera: {{image: {_quoted(topic.info.name)}, resize: [84, 84]}}  # {topic}"
        for topic in usable
        if is_image_type(topic.info.type_name)
    ]
    lines += [
        f"  # other: {{field: {_quoted(path)}}}  # {remark}"
        for path, remark in _others(usable, observed)
    ]
    lines += ["action:", *_action_lines(command, usable)]
    first = observed[0].name if observed else "name"
    lines += [
        f'reward: "0"  # for example "next({first}) - {first}"',
        "episodes:",
        "  gap_s: 2.0",
        "  # max_steps: 1000",
        f'  # terminated: "{first} > 1"',
        f'  # begin: "{first} != 0"',
    ]
    unreadable = [info for info in bag.topics.values() if info.problem]
    lines += [f"# {info.name} cannot be read: {info.problem}" for info in unreadable]
    return "".join(f"{_one_line(line)}\n" for line in lines)


def _observations(bag: Bag, topics: Iterable[_Topic]) -> Iterator[_Entry]:
    """Yield the likely observations, each with a unique name."""
    names: set[str] = set()
    for topic in topics:
        info = topic.info
        if info.name in _SKIPPED or is_image_type(info.type_name):
            continue
        fields = _LIKELY.get(_ros2_name(info.type_name)) or _numbers(info)[:3]
        for field in fields:
            plain = field.split("[")[0]
            if plain not in info.fields or len(names) == _MAX_OBSERVED:
                continue
            if info.fields[plain].endswith("[]") and not _first_length(bag, info, plain):
                continue
            name = _name(info.name, plain, names)
            names.add(name)
            yield _Entry(name, f"{info.name}.{field}", str(topic))


def _ros2_name(type_name: str) -> str:
    """Return the name of a type with `/msg/`, which names of ROS 1 lack."""
    package, slash, name = type_name.partition("/")
    return f"{package}/msg/{name}" if slash and "/" not in name else type_name


def _first_length(bag: Bag, info: TopicInfo, field: str) -> int:
    """Return the number of elements of an array in the first message."""
    return len(bag.read(info.name, [field], np.array([0])).columns[field][0])


def _others(topics: Iterable[_Topic], observed: list[_Entry]) -> Iterator[tuple[str, str]]:
    """Yield the paths of all other numbers, with their topic's type and rate."""
    known = {entry.path.split("[")[0] for entry in observed}
    for topic in topics:
        info = topic.info
        if info.name not in _SKIPPED and not is_image_type(info.type_name):
            for field in _numbers(info):
                path = f"{info.name}.{field}"
                if path not in known:
                    yield path, f"{info.fields[field]}, {topic}"


def _command(topics: Iterable[_Topic]) -> _Topic | None:
    """Return the topic that most likely contains the commands, by its name or else its type."""

    def likelihood(topic: _Topic) -> int:
        info = topic.info
        text = f"{info.name} {info.type_name}".lower()
        is_twist = info.type_name.endswith(("/Twist", "/TwistStamped", "/AckermannDriveStamped"))
        return 2 * any(word in text for word in _COMMAND_WORDS) + is_twist

    found = max(topics, key=likelihood, default=None)
    return found if found is not None and likelihood(found) and _numbers(found.info) else None


def _action_lines(command: _Topic | None, topics: list[_Topic]) -> list[str]:
    if command is None:
        names = ", ".join(topic.info.name for topic in topics[:8])
        return [f"  field: /TOPIC.FIELD  # no topic looks like a command; topics: {names}"]
    info = command.info
    numbers = _numbers(info)
    if len(numbers) == 1 and info.fields[numbers[0]].startswith(("int", "uint", "bool")):
        return [f"  field: {_quoted(f'{info.name}.{numbers[0]}')}  # {command}"]
    used = [field for field in numbers if field.endswith(("linear.x", "angular.z"))] or numbers[:2]
    paths = ", ".join(_quoted(f"{info.name}.{field}") for field in used)
    edges = ", ".join("[-0.1, 0.1]" for _ in used)
    low, high = (", ".join(limit for _ in used) for limit in ("-1", "1"))
    return [
        f"  fields: [{paths}]  # {command}",
        f"  edges: [{edges}]  # three bins for each field",
        "  # or named commands, of which the nearest is the action:",
        f"  # actions: {{stop: [{', '.join('0' for _ in used)}]}}",
        f"  # or continuous: box: {{low: [{low}], high: [{high}]}}",
    ]


def _numbers(info: TopicInfo) -> list[str]:
    """Return the names of the scalar number fields of a topic, except headers and stamps."""
    return [
        name
        for name, kind in info.fields.items()
        if kind in _NUMBERS and not name.startswith(("header.", "stamp.", "timestamp"))
    ]


def _rate(topics: Iterable[_Topic]) -> float:
    """Return the step rate: the rate of the slowest topic with at least 1 Hz, limited to 20 Hz."""
    rates = [topic.rate_hz for topic in topics if topic.info.name not in _SKIPPED]
    slowest = min((rate for rate in rates if rate >= _MIN_RATE_HZ), default=_MIN_RATE_HZ)
    return float(f"{min(slowest, _MAX_RATE_HZ):.2g}")


def _rate_of(times_ns: NDArray[np.int64]) -> float:
    """Return messages per second by the median interval; 0 for fewer than two times."""
    intervals_ns = np.diff(times_ns)
    intervals_ns = intervals_ns[intervals_ns > 0]
    return float(NS_PER_S / np.median(intervals_ns)) if len(intervals_ns) else 0.0


def _name(topic: str, field: str, used: set[str]) -> str:
    """Return an unused name: the first part of the topic name and the last parts of the path."""
    words = [*topic.strip("/").split("/"), *field.split(".")]
    words = [re.sub(r"[^0-9A-Za-z]", "_", word).lower() for word in words]
    words[0] = f"t_{words[0]}" if words[0][:1].isdigit() else words[0]
    for count in range(min(3, len(words)), len(words) + 1):
        name = "_".join([words[0], *words[len(words) - count + 1 :]])
        if name not in used:
            return name
    return f"{'_'.join(words)}_{len(used)}"


def _quoted(path: str) -> str:
    """Return a path as YAML: in quotes, unless YAML reads it as this text without them."""
    return path if _PLAIN.fullmatch(path) else json.dumps(path, ensure_ascii=False)


def _one_line(text: str) -> str:
    """Return a text without control characters, in which YAML escapes and comments stay valid."""
    return printable(text.replace("\n", "\\n").replace("\t", " "))

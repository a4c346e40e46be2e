"""Quantities that a policy is likely to observe, and the action that commands are likely to be."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.bag import Bag, TopicInfo
from mcaprl.recorder.bags.overview import TopicOverview, instants_of, is_fresh
from mcaprl.recorder.bags.values import without_lacks
from mcaprl.recorder.format.reading import full_name
from mcaprl.recorder.mapping.align import pooled, rows_of
from mcaprl.recorder.mapping.config import LARGEST, Quantity
from mcaprl.recorder.mapping.images import with_bytes
from mcaprl.recorder.mapping.spatial import cloud_points, fields_of, layer_of
from mcaprl.recorder.mapping.summary import needed_offset

_SAMPLES = 200
_SIZES = (8, 16, 32, 64)
NUMBERS = {"float32", "float64", "bool", *(f"{u}int{bits}" for u in ("", "u") for bits in _SIZES)}
ELEMENTS = NUMBERS - {"uint8", "int8"}
"""Kinds of numbers, and of the elements of arrays that are not raw data."""
_MAX_ELEMENTS, _ELEMENTS = 64, 36
"""Number of elements up to which an array is observed as a whole, and to which it is thinned."""
_MAX_JOINTS, _MAX_INNER, _MAX_SAMPLED = 64, 8, 10_000
_ARE_FRESH, _ARE_FINITE = 0.9, 0.95
"""Share of the time with a recent message, and share of numbers, of a likely quantity."""

IMAGES = {
    *("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    *("foxglove.RawImage", "foxglove.CompressedImage", "foxglove.CompressedVideo"),
    *("foxglove_msgs/msg/CompressedVideo", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"),
}
_SCANS = ("sensor_msgs/msg/LaserScan", "foxglove.LaserScan")
_CLOUDS = ("sensor_msgs/msg/PointCloud2", "foxglove.PointCloud")
_COLORS = ("red", "green", "blue", "alpha")
_NO_POINTS = np.empty((0, 3))
_NEVER_TOPICS = {
    *("rosout", "rosout_agg", "parameter_events", "tf", "tf_static", "diagnostics"),
    *("diagnostics_agg", "clock", "camera_info", "bond", "statistics", "events"),
}
_NEVER_TYPES = re.compile(
    r"rosgraph_msgs/msg/.*|rcl_interfaces/msg/.*|tf2?_msgs/msg/.*|diagnostic_msgs/msg/.*"
    r"|sensor_msgs/msg/(CameraInfo|PointCloud2?)|nav_msgs/msg/(OccupancyGrid|Path|MapMetaData)"
    r"|visualization_msgs/msg/.*|bond/msg/.*|foxglove[.](Log|CameraCalibration|PointCloud|Grid"
    r"|SceneUpdate|FrameTransforms?|ImageAnnotations|GeoJSON)"
)
LIKELY = {
    "nav_msgs/msg/Odometry": (
        "twist.twist.linear.x",
        "twist.twist.angular.z",
        "pose.pose.position.x",
        "pose.pose.position.y",
    ),
    "geometry_msgs/msg/PoseStamped": ("pose.position.x", "pose.position.y"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose.pose.position.x", "pose.pose.position.y"),
    "geometry_msgs/msg/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/msg/TwistStamped": ("twist.linear.x", "twist.angular.z"),
    "sensor_msgs/msg/Imu": ("angular_velocity.z", "linear_acceleration.x"),
    "sensor_msgs/msg/LaserScan": ("ranges",),
    "foxglove.LaserScan": ("ranges",),
    "foxglove.PoseInFrame": ("pose.position.x", "pose.position.y"),
    "sensor_msgs/msg/JointState": ("position", "velocity"),
    "sensor_msgs/msg/Range": ("range",),
    "sensor_msgs/msg/BatteryState": ("percentage", "voltage"),
    "std_msgs/msg/Float32MultiArray": ("data",),
    "std_msgs/msg/Float64MultiArray": ("data",),
}
"""Fields of common types that a policy is likely to observe."""
_YAWS = {
    "nav_msgs/msg/Odometry": "pose.pose.orientation",
    "geometry_msgs/msg/PoseStamped": "pose.orientation",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose.orientation",
    "foxglove.PoseInFrame": "pose.orientation",
}
_COUNTING = {"seq", "sequence", "id", "ids", "idx", "index", "counter", "count", "num", "stamp"}
_COUNTING |= {"stamps", "timestamp", "time", "sec", "nanosec", "nsec", "secs", "nsecs", "nanos"}
_COUNTING |= {"seconds", "covariance", "crc", "checksum", "version", "reserved", "reserve", "tick"}
_COUNTING |= {"ticks", "code", "bigendian", "offset", "stride"}
_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_BASES = ("base_link", "base_footprint", "base", "body", "pelvis", "trunk", "torso")
_FIXED = ("odom", "map", "world", "earth")


class Candidate(NamedTuple):
    """A quantity that may be observed.

    Attributes:
        topic: Topic of the quantity.
        label: Field or frame, from which the name is made.
        spec: Keys and values of the quantity in the mapping.
        is_scalar: Whether the value is one number.
        penalty: 0 for a likely quantity, more for others.
        why_not: Reason of the penalty; empty without one.
    """

    topic: TopicOverview
    label: str
    spec: dict[str, Any]
    is_scalar: bool = False
    penalty: int = 0
    why_not: str = ""


def kind_of(info: TopicInfo) -> str:
    """Return the name of a type in one form: `pkg/msg/Type`, or `foxglove.Type`.

    ROS 1 bags, and some writers of MCAP, have names such as `pkg/Type`.
    """
    name = full_name(info.type_name)
    for start in ("foxglove_msgs/msg/", "foxglove_msgs."):
        if name.startswith(start):
            return f"foxglove.{name.removeprefix(start)}"
    return name


def image_spec(bag: Bag, info: TopicInfo) -> dict[str, Any] | None:
    """Return the keys and values of an image, cloud or grid; None if the topic has none."""
    kind, size = kind_of(info), [84, 84]
    if kind in IMAGES:
        return {"image": info.name, "resize": size}
    if kind == "nav_msgs/msg/OccupancyGrid":
        return {"grid": info.name, "size": size}
    if kind == "foxglove.Grid":
        return {"grid": info.name, "size": size, **_layer_spec(bag, info)}
    if kind not in _CLOUDS:
        return None
    spec = {"cloud": info.name, "as": "height", "size": size}
    try:
        cloud = Quantity.model_validate({**spec, **_limits_of_points(_NO_POINTS)})
        points = cloud_points(_middle_message(bag, info, cloud))
    except (LogError, UsageError, IndexError, TypeError, ValueError):
        points = _NO_POINTS
    return {**spec, **_limits_of_points(points)}


def _layer_spec(bag: Bag, info: TopicInfo) -> dict[str, Any]:
    """Return the field of a foxglove.Grid, the first that is no color, and its range."""
    try:
        message = _middle_message(bag, info, Quantity(grid=info.name))
        names = [str(each) for each in message["fields[:].name"]]
        name = next((each for each in names if each not in _COLORS), names[0])
        values = layer_of(message, name)
    except (LogError, UsageError, IndexError, TypeError, ValueError):
        return {}
    spec: dict[str, Any] = {"field": name} if len(names) > 1 else {}
    finite = values[np.isfinite(values)]
    if values.dtype == np.uint8 or not finite.size:
        return spec
    low, high = (float(np.clip(each, -LARGEST, LARGEST)) for each in (finite.min(), finite.max()))
    low = math.floor(low)
    return {**spec, "range": [low, max(low + 1, math.ceil(high))]}


def _middle_message(bag: Bag, info: TopicInfo, quantity: Quantity) -> dict[str, Any]:
    fields = fields_of(info, quantity)
    columns = bag.read(info.name, fields, np.array([info.count // 2])).columns
    return with_bytes({name: column[0] for name, column in columns.items()})


def _limits_of_points(points: NDArray[np.float64]) -> dict[str, list[int]]:
    """Return limits around nearly all points: a square about the sensor, and heights."""
    if not len(points):
        return {"x_m": [-20, 20], "y_m": [-20, 20], "z_m": [-3, 3]}
    half = max(1, math.ceil(min(1e4, float(np.quantile(np.abs(points[:, :2]), 0.95)))))
    low, high = np.clip(np.quantile(points[:, 2], [0.02, 0.98]), -1e4, 1e4)
    z_m = [math.floor(low), max(math.floor(low) + 1, math.ceil(high))]
    return {"x_m": [-half, half], "y_m": [-half, half], "z_m": z_m}


def is_never_observed(info: TopicInfo) -> bool:
    """Return whether a topic has log lines, transforms, or data that is not a quantity."""
    parts = info.name.strip("/").split("/")
    is_named = parts[-1] in _NEVER_TOPICS or parts[-1].startswith("_service_event")
    return is_named or _NEVER_TYPES.fullmatch(kind_of(info)) is not None


def shares_of_time(topics: Sequence[TopicOverview], gap_s: float) -> dict[str, float]:
    """Return the share of the time in which each topic has a message of the last `gap_s` seconds.

    Only the time in which at least half of the topics have messages counts.
    """
    instants_ns = instants_of([topic.times_ns for topic in topics])
    fresh = {topic.info.name: is_fresh(topic.times_ns, instants_ns, gap_s) for topic in topics}
    count = np.sum(list(fresh.values()), axis=0)
    is_data = count >= np.max(count, initial=0) / 2
    return {name: float(each[is_data].mean()) for name, each in fresh.items() if is_data.any()}


def number_fields(info: TopicInfo) -> list[str]:
    """Return the names of the scalar number fields of a topic, except headers and stamps."""
    return [
        name
        for name, kind in info.fields.items()
        if kind in NUMBERS and not name.startswith(("header.", "stamp.", "timestamp"))
    ]


def sampled(bag: Bag, info: TopicInfo, fields: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return fields of at most 200 messages of a topic, spread evenly."""
    rows = np.unique(np.linspace(0, info.count - 1, min(info.count, _SAMPLES)).astype(np.int64))
    return dict(bag.read(info.name, list(fields), rows).columns)


def candidates(bag: Bag, topic: TopicOverview, share: float) -> list[Candidate]:
    """Return the quantities of a topic that may be observed, the likely ones first."""
    info, kind = topic.info, kind_of(topic.info)
    likely = [name for name in LIKELY.get(kind, ()) if name in info.fields]
    extra = ("range_min", "range_max", "name")
    try:
        names = _short_fields(bag, info, likely or _unknown_fields(info))
        columns = sampled(bag, info, [*names, *(each for each in extra if each in info.fields)])
    except (LogError, UsageError):
        return []
    is_scan, ranges = kind in _SCANS and "ranges" in names, columns.get("ranges")
    if is_scan and ranges is not None and ranges.dtype.kind == "O":
        # The number of beams changes.
        with suppress(UsageError):
            columns["ranges"] = pooled(rows_of(without_lacks(ranges), info.name), "min", _ELEMENTS)
    found = []
    for name in names:
        if (spec := _spec(info, name, columns)) is not None:
            if is_scan:
                spec = {"scan": info.name, **_sectors(columns["ranges"], ranges), **spec}
                del spec["field"]
            penalty, why = _penalty(name, columns[name], share, is_known=bool(likely))
            is_scalar = columns[name].ndim == 1
            found.append(Candidate(topic, name, spec, is_scalar, penalty, why))
    found += _inner(bag, topic, share)
    yaw = _YAWS.get(kind)
    if yaw is not None and f"{yaw}.w" in info.fields:
        penalty, why = (0, "") if share >= _ARE_FRESH else _rare(share)
        spec = {"field": f"{info.name}.{yaw}", "as": "yaw"}
        found.append(Candidate(topic, f"{yaw}.yaw", spec, True, penalty, why))
    return sorted(found, key=lambda each: each.penalty)


def _sectors(column: NDArray[Any], ranges: NDArray[Any] | None) -> dict[str, int]:
    """Return the number of sectors of a scan, if it has many beams or a number that changes."""
    is_long = column is not ranges or (column.ndim > 1 and column.shape[1] > _MAX_ELEMENTS)
    return {"to": _ELEMENTS} if is_long else {}


def _short_fields(bag: Bag, info: TopicInfo, names: list[str]) -> list[str]:
    """Return the fields that are not arrays of very many numbers, such as images of an own type."""
    arrays = [name for name in names if info.fields[name].endswith("]")]
    first = bag.read(info.name, arrays, np.array([0])).columns if arrays else {}
    long = [
        name for name, column in first.items() if len(column) and np.size(column[0]) > _MAX_SAMPLED
    ]
    return [name for name in names if name not in long]


def _inner(bag: Bag, topic: TopicOverview, share: float) -> list[Candidate]:
    """Return numbers in arrays of messages as vectors, such as `motors[:].q`."""
    info, found = topic.info, list[Candidate]()
    names = [
        name
        for name, kind in info.fields.items()
        if "[]." in name and kind.count("[") == 1 and kind.partition("[")[0] in NUMBERS
    ]
    for name in names[:_MAX_INNER]:
        path = name.replace("[]", "[:]")
        try:
            columns = sampled(bag, info, [path])
        except (LogError, UsageError):
            continue
        if (spec := _spec(info, path, columns)) is not None and columns[path].ndim == 2:
            penalty, why = _penalty(name, columns[path], share, is_known=False)
            found.append(Candidate(topic, path, spec, False, penalty, why))
    return found


def _unknown_fields(info: TopicInfo) -> list[str]:
    """Return the fields of an own type that are numbers, or arrays of numbers."""
    arrays = [
        name
        for name, kind in info.fields.items()
        if kind.endswith("]")
        and "[" not in name
        and kind.partition("[")[0] in ELEMENTS
        and not name.startswith(("header.", "stamp.", "timestamp"))
    ]
    has_frame = {"height", "width"} <= {name.rpartition(".")[2] for name in info.fields}
    names = [*number_fields(info), *arrays]
    return [
        name
        for name in names
        if not (has_frame and name.rpartition(".")[2] in ("height", "width", "step"))
    ]


def _spec(info: TopicInfo, name: str, columns: dict[str, NDArray[Any]]) -> dict[str, Any] | None:
    """Return the keys and values of a quantity; None if it cannot be one."""
    column, path = columns[name], f"{info.name}.{name}"
    if column.dtype.kind not in "biuf" or column.ndim > 2 or not column.size:
        return None
    spec: dict[str, Any] = {"field": path}
    if column.ndim == 2 and column.shape[1] > _MAX_ELEMENTS:
        spec["field"] = f"{path}[::{math.ceil(column.shape[1] / _ELEMENTS)}]"
    if name == "ranges":
        spec |= _limits_of(columns)
    is_joints = "name" in columns and name in ("position", "velocity", "effort")
    if is_joints and not _add_joints(spec, columns["name"]):
        return None
    numbers = column.astype(np.float64)
    finite = np.isfinite(numbers)
    if "clip" not in spec and finite.mean() < _ARE_FINITE:
        return None
    if column.ndim == 1 and (offset := needed_offset(numbers)) is not None:
        spec["offset"] = offset
    return spec


def _limits_of(columns: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return `clip` of a scan, and `missing` if some beams have no number."""
    limits = [columns[each] for each in ("range_min", "range_max") if each in columns]
    column, found = columns["ranges"], dict[str, Any]()
    is_number = np.isfinite(column.astype(np.float64))
    if len(limits) == 2 and all(np.isfinite(each).all() for each in limits):
        low, high = float(limits[0].min()), float(limits[1].max())
    elif is_number.any():
        low, high = 0.0, float(column[is_number].max())
    else:
        return found
    if low < high:
        found["clip"] = [_short(low), _short(high)]
        if not is_number.all() or (column < low).any():
            found["missing"] = _short(high)
    return found


def _short(number: float) -> float:
    """Return a float32 number as the shortest number that float32 stores equally."""
    return float(str(np.float32(number)))


def _add_joints(spec: dict[str, Any], names: NDArray[Any]) -> bool:
    """Select joints by name if mappings can; return False if their order changes otherwise."""
    lists = [list(map(str, each)) for each in names]
    every = list(dict.fromkeys(name for each in lists for name in each))
    if not every or len(every) > _MAX_JOINTS:
        return False
    if "names" in Quantity.model_fields:
        spec["names"] = every
        return True
    return all(each == lists[0] for each in lists)


def _penalty(name: str, column: NDArray[Any], share: float, *, is_known: bool) -> tuple[int, str]:
    """Return how unlikely a quantity is, and why."""
    if not is_known and is_counting(name, column):
        return 4, "a time, counter or id"
    if share < _ARE_FRESH:
        return _rare(share)
    numbers = column.astype(np.float64)
    return (
        (1, "constant") if (np.nan_to_num(numbers) == np.nan_to_num(numbers[:1])).all() else (0, "")
    )


def is_counting(name: str, column: NDArray[Any]) -> bool:
    """Return whether a field is a time, a counter or an id, by its name and values."""
    words = {word.lower() for word in _WORDS.findall(name.rpartition(".")[2])}
    if words & _COUNTING:
        return True
    if column.dtype.kind not in "iu" or column.ndim > 1 or len(column) < 3:
        return False
    # A counter of messages may have the same value twice in messages of equal times.
    steps = np.diff(column.astype(np.float64))
    is_rising = bool((steps >= 0).all()) and (steps > 0).mean() > 0.5
    return is_rising or bool(np.abs(column.astype(np.float64)).max() > 2**31)


def _rare(share: float) -> tuple[int, str]:
    return 2, f"has a recent message in {share:.0%} of the time only"


def transforms(bag: Bag, topics: dict[str, TopicOverview]) -> Iterator[Candidate]:
    """Yield the pose of the robot's base in a fixed frame, if `/tf` has it."""
    if "/tf" not in topics or topics["/tf"].why_unusable:
        return
    moving, static = _parents(bag, topics, "/tf"), _parents(bag, topics, "/tf_static")
    parents = {**static, **moving}
    bases = [frame for base in _BASES for frame in parents if frame.rpartition("/")[2] == base]
    for frame in dict.fromkeys([*bases, *moving]):
        chain = _chain(frame, parents)
        fixed = [each for name in _FIXED for each in chain if each.rpartition("/")[2] == name]
        for parent in [*fixed, chain[-1]][: 1 if chain else 0]:
            path = [frame, *chain[: chain.index(parent)]]
            if any(each in moving for each in path):
                spec = {"transform": frame, "in": parent}
                yield Candidate(topics["/tf"], f"{frame}.in_{parent}", spec)
                return


def _parents(bag: Bag, topics: dict[str, TopicOverview], name: str) -> dict[str, str]:
    """Return the parent of each frame in samples of a topic of transforms."""
    if name not in topics or topics[name].info.problem or not topics[name].info.count:
        return {}
    found: dict[str, str] = {}
    try:
        column = sampled(bag, topics[name].info, ["transforms"])["transforms"]
    except (LogError, UsageError):
        return found
    for transforms in column:
        for each in transforms if isinstance(transforms, Sequence) else ():
            child, header = _get(each, "child_frame_id"), _get(each, "header")
            parent = _get(header, "frame_id")
            if isinstance(child, str) and isinstance(parent, str):
                found.setdefault(child.removeprefix("/"), parent.removeprefix("/"))
    return found


def _get(value: Any, name: str) -> Any:
    return value.get(name) if isinstance(value, dict) else getattr(value, name, None)


def _chain(frame: str, parents: dict[str, str]) -> list[str]:
    """Return the ancestors of a frame, the nearest first."""
    found: list[str] = []
    while (parent := parents.get(found[-1] if found else frame)) is not None:
        if parent in found or parent == frame:
            return found
        found.append(parent)
    return found


# If the name of a topic or type contains one of these words, the topic is likely to have commands,
# unless its name also contains one of the words of `_ANSWERS`.
_COMMANDS = ("cmd", "command", "action", "target", "setpoint", "ackermann", "control", "joy")
_ANSWERS = re.compile(
    r"state|status|feedback|result|mode|limit|info|event|ack(?!erm)|measured|actual|odom|estimat"
)
_TYPES = re.compile(
    r".*/(Twist|TwistStamped|AckermannDrive|AckermannDriveStamped|JointTrajectory|Joy|TrajectorySetpoint"
    r"|AttitudeTarget|PositionTarget|ActuatorControls|ActuatorMotors|Actuators|JointJog)"
)
_MAX_FIELDS, _MAX_VALUES, _MAX_NUMBER = 32, 16, 31
"""Number of elements of a command, number of different values of a discrete command, and largest
number of a discrete field."""
_DIGITS = 3
_FLOAT = np.finfo(np.float32)


class Command(NamedTuple):
    """Commands of a topic.

    Attributes:
        topic: Topic with the commands.
        paths: Path of each element.
        values: (N, K) values of the elements in all messages; NaN where there is none.
        texts: Different values of a text; empty if the command is numbers.
    """

    topic: TopicOverview
    paths: tuple[str, ...]
    values: NDArray[np.float64]
    texts: tuple[str, ...] = ()


def likelihood(info: TopicInfo) -> int:
    """Return how likely it is that a topic has commands, by its name and type; 0 if it has none."""
    name, kind = info.name.lower(), kind_of(info)
    score = 4 * any(word in name for word in _COMMANDS)
    score += 2 * any(word in kind.lower() for word in _COMMANDS)
    score += _TYPES.fullmatch(kind) is not None
    score += any(word in name for word in ("cmd", "command", "setpoint"))
    if is_never_observed(info) or kind in IMAGES or not score:
        return 0
    return max(1, score - 5) if _ANSWERS.search(name) else score


def command_of(bag: Bag, topics: Sequence[TopicOverview]) -> Command | None:
    """Return the most likely commands that can be read; None if there are none."""
    for topic in sorted(topics, key=lambda each: (-likelihood(each.info), -each.info.count)):
        if not likelihood(topic.info):
            return None
        try:
            found = _commands(bag, topic)
        except (LogError, UsageError):
            found = None
        if found is not None:
            return found
    return None


def _commands(bag: Bag, topic: TopicOverview) -> Command | None:
    info = topic.info
    numbers = [name for name in number_fields(info) if "[" not in name]
    arrays = [
        name
        for name, kind in info.fields.items()
        if kind.endswith("]") and kind.partition("[")[0] in ELEMENTS and "[" not in name
    ]
    columns = dict(bag.read(info.name, [*numbers, *arrays]).columns)
    found = {
        name: columns[name].astype(np.float64)
        for name in numbers
        if not is_counting(name, columns[name])
    }
    inner = _inner_commands(bag, info)
    for name, column in [*((name, columns[name]) for name in arrays), *inner.items()]:
        if column.dtype.kind in "biuf" and column.ndim == 2:
            # `motors[:].q` becomes `motors[3].q`, and `positions` becomes `positions[3]`.
            path = name.replace("[:]", "[{}]") if "[:]" in name else f"{name}[{{}}]"
            elements = column.astype(np.float64).T[:_MAX_FIELDS]
            found |= {path.format(k): each for k, each in enumerate(elements)}
    # A Box action is float32.
    found = {
        name: np.where(np.abs(each) < _FLOAT.max, each, np.nan) for name, each in found.items()
    }
    chosen = _chosen(found)
    if chosen:
        values = np.column_stack([found[name] for name in chosen])
        return Command(topic, tuple(f"{info.name}.{name}" for name in chosen), values)
    return _texts(bag, topic)


def _inner_commands(bag: Bag, info: TopicInfo) -> dict[str, NDArray[Any]]:
    """Return numbers in arrays of messages by path; of a trajectory, those of its first point."""
    found: dict[str, NDArray[Any]] = {}
    for name, kind in info.fields.items():
        if "[]." not in name or kind.partition("[")[0] not in NUMBERS:
            continue
        path = name.replace("[]", "[:]" if kind.count("[") == 1 else "[0]")
        try:
            found |= bag.read(info.name, [path]).columns
        except (LogError, UsageError):
            continue
    return found


def _chosen(columns: dict[str, NDArray[np.float64]]) -> list[str]:
    """Return the elements of a command: those that vary and are not NaN."""
    usable = [name for name, values in columns.items() if np.isfinite(values).mean() > 0.5]
    varying = [name for name in usable if np.nanmax(columns[name]) > np.nanmin(columns[name])]
    # The speed and the turn of a vehicle are a pair, even if one of them is constant.
    pair = [name for name in usable if re.fullmatch(r"(.*\.)?(linear\.x|angular\.z)", name)]
    found = [name for name in usable if name in varying or name in pair]
    return (found or usable[:2])[:_MAX_FIELDS]


def _texts(bag: Bag, topic: TopicOverview) -> Command | None:
    """Return the commands of a topic with a text, if it has few different values."""
    info = topic.info
    names = [name for name, kind in info.fields.items() if kind == "string" and "." not in name]
    if not names or not info.count:
        return None
    column = bag.read(info.name, names[:1]).columns[names[0]].tolist()
    texts = sorted({text for text in column if isinstance(text, str)})
    if not 0 < len(texts) <= _MAX_VALUES:
        return None
    return Command(topic, (f"{info.name}.{names[0]}",), np.empty((len(column), 0)), tuple(texts))


def action_spec(command: Command, bins: int | None, used: NDArray[np.float64]) -> dict[str, Any]:
    """Return the keys and values of the action in the mapping.

    Few whole numbers and texts become a discrete action. All others become a Box with limits from
    the data, or with `bins` a discrete action with quantile bins.

    Args:
        command: Commands of the bag.
        bins: Number of bins of each element; None for a Box.
        used: (M, K) commands of the transitions, from which the bins are made.
    """
    if command.texts:
        return {
            "field": command.paths[0],
            "names": {text: number for number, text in enumerate(command.texts)},
        }
    values = command.values[np.isfinite(command.values).all(axis=1)]
    if len(values) and (values == np.rint(values)).all():
        distinct = np.unique(values, axis=0)
        if 1 < len(distinct) <= _MAX_VALUES:
            return _discrete(command.paths, distinct)
    if bins is not None:
        finite = used[np.isfinite(used).all(axis=1)]
        return {
            "fields": list(command.paths),
            "edges": [quantile_edges(column, bins) for column in finite.T],
        }
    low, high = zip(*(box_limits(column) for column in values.T), strict=True)
    return {"fields": list(command.paths), "box": {"low": list(low), "high": list(high)}}


def _discrete(paths: tuple[str, ...], distinct: NDArray[np.float64]) -> dict[str, Any]:
    """Return an action of a field with numbers from 0, or else of named commands."""
    if len(paths) == 1 and distinct.min() >= 0 and distinct.max() <= _MAX_NUMBER:
        return {"field": paths[0]}
    names = {
        ", ".join(f"{number:g}" for number in command): [float(number) for number in command]
        for command in distinct
    }
    return {"fields": list(paths), "actions": names}


def box_limits(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return limits that contain all values, rounded outward to three digits of the range."""
    low, high = float(values.min()), float(values.max())
    below = float(np.nextafter(np.float32(low), np.float32(-np.inf)))
    above = float(np.nextafter(np.float32(high), np.float32(np.inf)))
    if high - low < _FLOAT.tiny:
        return min(math.floor(low) - 1.0, below), max(math.ceil(high) + 1.0, above)
    unit = 10.0 ** (math.floor(math.log10(high - low)) - _DIGITS + 1)
    least, most = math.floor(low / unit), math.ceil(high / unit)
    # The limits are stored as float32, which must not cut the lowest and the highest value.
    lows, highs = (
        [_times(n, unit) for n in each] for each in ((least, least - 1), (most, most + 1))
    )
    return (
        next(each for each in [*lows, below] if float(np.float32(each)) <= low),
        next(each for each in [*highs, above] if float(np.float32(each)) >= high),
    )


def _times(count: int, unit: float) -> float:
    """Return a multiple of a power of ten as the nearest short number."""
    return float(f"{count * unit:.12g}")


def quantile_edges(values: NDArray[np.float64], bins: int) -> list[float]:
    """Return increasing edges of at most `bins` bins with similar numbers of values.

    Each edge is between two different values, so no bin is empty.

    >>> quantile_edges(np.array([0.0, 0, 0, 1, 1, 4, 4, 4]), 3)
    [0.5, 2.0]
    """
    distinct, counts = np.unique(values, return_counts=True)
    shares = np.cumsum(counts)[:-1] / max(len(values), 1)
    edges: set[float] = set()
    for k in range(1, bins):
        if len(shares):
            place = int(np.abs(shares - k / bins).argmin())
            edges.add(_between(float(distinct[place]), float(distinct[place + 1])))
    return sorted(edges)


def _between(low: float, high: float) -> float:
    """Return the shortest decimal number that is above `low`, and at most `high`."""
    for digits in range(1, 18):
        found = float(f"{(low + high) / 2:.{digits}g}")
        if low < found <= high:
            return found
    return high

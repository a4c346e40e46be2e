"""Poses of coordinate frames in other frames, from the transforms of a bag.

The messages are those of ROS (TFMessage, TransformStamped) and Foxglove, in any encoding. Rotations
are unit quaternions (N, 4) x y z w.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag, TopicInfo
from mcaprl.recorder.bags.decoders import value_at
from mcaprl.recorder.mapping.align import NONE, NS_PER_S, last, nearest, time_order, topic_of
from mcaprl.recorder.mapping.config import TimeSource
from mcaprl.recorder.mapping.runs import Recorded, Run

STATIC = "_static"
"""Suffix of the topic of static transforms."""
_TYPES = ("TFMessage", "tfMessage", "TransformStamped", "FrameTransform", "FrameTransforms")
_LIST, _CHILD = "transforms", "child_frame_id"
# Paths of parent, stamp, translation and rotation in a transform of ROS and of Foxglove.
_FORMS = (
    ("header.frame_id", "header.stamp", "transform.translation", "transform.rotation"),
    ("parent_frame_id", "timestamp", "translation", "rotation"),
)
_AXES = ("x", "y", "z", "w")
_BLOCK_MESSAGES = 4096
"""Number of messages that are decoded to objects at a time."""


class Transform(NamedTuple):
    """A transform of a message.

    Attributes:
        child: Name of the frame, without a leading `/`.
        parent: Name of its parent, without a leading `/`.
        time_ns: Time as the mapping wants it.
        place: Place of the message; see `Bag.places`.
        translation: Object or dict with x, y, z.
        rotation: Object or dict with x, y, z, w.
    """

    child: str
    parent: str
    time_ns: int
    place: Sequence[int]
    translation: Any
    rotation: Any

    def pose(self) -> list[float]:
        """Return position and quaternion x y z w; NaN for a number that is missing."""
        return [
            *(_number(self.translation, axis) for axis in _AXES[:3]),
            *(_number(self.rotation, axis) for axis in _AXES),
        ]


def are_transforms(info: TopicInfo) -> bool:
    """Return whether a topic has transforms, by the end of its name or by its type."""
    name = info.name.removesuffix(STATIC)
    return name.endswith("/tf") or info.type_name.replace(".", "/").rpartition("/")[2] in _TYPES


def transforms_of(bag: Bag, topic: str, time: TimeSource) -> Iterator[Transform]:
    """Yield the transforms of a topic in the order of recording.

    Transforms without a name of child or parent, and those of a frame in itself, are left out.
    """
    single, places = _fields_of_one(bag, topic), bag.places(topic)
    fields = [*(single or [_LIST]), *(["publish_time"] if time == "publish_time" else [])]
    for first in range(0, len(places), _BLOCK_MESSAGES):
        rows = np.arange(first, min(first + _BLOCK_MESSAGES, len(places)))
        stream = bag.read(topic, fields, rows)
        times_ns = stream.columns.get("publish_time", stream.log_time_ns)
        messages = _messages_of(stream.columns, single) if single else stream.columns[_LIST]
        for time_ns, place, message in zip(
            times_ns.tolist(), places[stream.rows].tolist(), messages, strict=True
        ):
            yield from transforms_in(message, topic, time, time_ns, place)


def transforms_in(
    message: Any, topic: str, time: TimeSource, time_ns: int, place: Sequence[int] = ()
) -> Iterator[Transform]:
    """Yield the transforms of a message that is a transform, or has a list of them."""
    if not isinstance(message, list) and (found := _field(message, _LIST)) is not None:
        message = found
    elif _field(message, _CHILD) is not None:
        message = [message]
    for each in message if isinstance(message, Iterable) else ():
        child = _field(each, _CHILD)
        form = _FORMS[0] if _field(each, "header") is not None else _FORMS[1]
        parent = value_at(each, form[0])
        if not (isinstance(child, str) and isinstance(parent, str)):
            continue
        child, parent = child.removeprefix("/"), parent.removeprefix("/")
        if not child or not parent or child == parent:
            continue
        own_ns = time_ns if time != "header" else _stamp(each, form[1], topic, child)
        parts = (value_at(each, path) for path in form[2:])
        yield Transform(child, parent, own_ns, place, *parts)


def _fields_of_one(bag: Bag, topic: str) -> list[str]:
    """Return the fields to read if each message is one transform; empty if it is a list of them."""
    known = list(bag.topics[topic].fields)
    if not known:
        # JSON without a schema.
        paths = [form[0] for form in _FORMS]
        first = bag.read(topic, [_CHILD, *paths], np.zeros(1, np.int64)).columns
        known = [name for name, column in first.items() if isinstance(column[0], str)]
    if _CHILD not in known:
        return []
    parent, stamp, translation, rotation = _FORMS[_FORMS[1][0] in known]
    axes = [f"{translation}.{axis}" for axis in _AXES[:3]]
    return [_CHILD, parent, stamp, *axes, *(f"{rotation}.{axis}" for axis in _AXES)]


def _messages_of(columns: dict[str, Any], fields: list[str]) -> Iterator[list[dict[str, Any]]]:
    """Yield messages of one transform each, as lists of nested dicts."""
    for values in zip(*(columns[name].tolist() for name in fields), strict=True):
        message: dict[str, Any] = {}
        for path, value in zip(fields, values, strict=True):
            *groups, name = path.split(".")
            inner = message
            for group in groups:
                inner = inner.setdefault(group, {})
            inner[name] = value
        yield [message]


def _field(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name, None)


def _stamp(message: Any, path: str, topic: str, child: str) -> int:
    found = value_at(message, path)
    if not isinstance(found, int):
        raise UsageError(
            f"{topic}: a transform of frame '{child}' has no {path}: use `time: log_time`"
        )
    return found


def _number(parts: Any, axis: str) -> float:
    try:
        return float(_field(parts, axis))
    except (TypeError, ValueError):
        return math.nan


Floats = NDArray[np.float64]

_LOCK = 1e-6
"""Cosine of the pitch below which roll and yaw cannot be distinguished."""


def unit(quaternions: Floats) -> Floats:
    """Return quaternions of length 1; NaN for quaternions of length 0 or with infinite numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        sizes = np.linalg.norm(quaternions, axis=1, keepdims=True)
    is_valid = (sizes > 0) & np.isfinite(sizes)
    nothing = np.full_like(quaternions, np.nan)
    found: Floats = np.divide(quaternions, sizes, out=nothing, where=is_valid)
    return found


def euler_of(quaternions: Floats) -> Floats:
    """Return (N, 3) roll, pitch and yaw in radians; NaN for invalid quaternions.

    The rotation is that about the fixed axes x, y, z in this order, as in REP 103, so its matrix is
    Rz(yaw) Ry(pitch) Rx(roll). If the pitch is 90 degrees up or down, only the sum or difference of
    roll and yaw is known, and yaw is 0.
    """
    x, y, z, w = unit(quaternions).T
    # The first column of the matrix, and its elements [1, 1], [1, 2], [2, 1] and [2, 2].
    forward = (1 - 2 * (y * y + z * z), 2 * (w * z + x * y), 2 * (x * z - w * y))
    middle, above = 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    below, last = 2 * (w * x + y * z), 1 - 2 * (x * x + y * y)
    level = np.hypot(forward[0], forward[1])
    is_locked = level < _LOCK
    roll = np.where(is_locked, np.arctan2(-above, middle), np.arctan2(below, last))
    yaw = np.where(is_locked, 0.0, np.arctan2(forward[1], forward[0]))
    return np.column_stack([roll, np.arctan2(-forward[2], level), yaw])


def yaw_of(quaternions: Floats) -> Floats:
    """Return the (N,) yaw in radians, see `euler_of`; NaN for invalid quaternions."""
    return euler_of(quaternions)[:, 2]


def upper(quaternions: Floats) -> Floats:
    """Return the quaternion with w >= 0 of each rotation, because q and -q are the same rotation.

    If w is 0, the first number that is not 0 is positive.
    """
    ordered = quaternions[:, [3, 0, 1, 2]]
    first = np.take_along_axis(ordered, (ordered != 0).argmax(axis=1)[:, np.newaxis], axis=1)
    # Adding 0 turns -0.0 into 0.0.
    return np.where(first < 0, -quaternions, quaternions) + 0.0


def rotated(quaternions: Floats, vectors: Floats) -> Floats:
    """Rotate vectors (N, 3)."""
    axis, w = quaternions[:, :3], quaternions[:, 3:]
    across = 2 * np.cross(axis, vectors)
    return vectors + w * across + np.cross(axis, across)


def product(first: Floats, second: Floats) -> Floats:
    """Return the rotation by `second`, followed by the rotation by `first`."""
    axis, w = first[:, :3], first[:, 3:]
    other, v = second[:, :3], second[:, 3:]
    vector = w * other + v * axis + np.cross(axis, other)
    return np.hstack([vector, w * v - (axis * other).sum(axis=1, keepdims=True)])


def between(first: Floats, second: Floats, share: Floats) -> Floats:
    """Interpolate along the shorter arc (slerp); `share` (N, 1) is 0 at `first`, 1 at `second`."""
    cosine = (first * second).sum(axis=1, keepdims=True)
    second, cosine = np.where(cosine < 0, -second, second), np.abs(cosine).clip(max=1.0)
    angle = np.arccos(cosine)
    with np.errstate(invalid="ignore", divide="ignore"):
        weights = [np.sin((1 - share) * angle), np.sin(share * angle)] / np.sin(angle)
    close = np.broadcast_to(angle < 1e-6, weights[0].shape)
    low, high = np.where(close, 1 - share, weights[0]), np.where(close, share, weights[1])
    return low * first + high * second


TF = "/tf"
PLANAR = ("x", "y", "yaw")


class Edge(NamedTuple):
    """Poses of a frame in its parent: times (M,), positions (M, 3), quaternions (M, 4) x y z w.

    The (M, 2) places are those of the messages; see `Bag.places`.
    """

    times_ns: NDArray[np.int64]
    places: NDArray[np.int64]
    positions: Floats
    quaternions: Floats
    is_static: bool

    def at(self, rows: NDArray[np.int64]) -> Edge:
        """Return the poses `rows`."""
        return self._replace(
            times_ns=self.times_ns[rows],
            places=self.places[rows],
            positions=self.positions[rows],
            quaternions=self.quaternions[rows],
        )


class _Poses:
    """Poses of a frame in the order of reading, as compact arrays."""

    def __init__(self) -> None:
        self.is_static = True
        self._integers, self._numbers = array("q"), array("d")

    def add(self, time_ns: int, place: Sequence[int], pose: Sequence[float]) -> None:
        """Add a pose: position, and quaternion x y z w."""
        self._integers.extend((time_ns, *place))
        self._numbers.extend(pose)

    def edge(self) -> Edge:
        """Return the poses in the order of recording; a pose with an invalid number is NaN."""
        integers = np.array(self._integers, np.int64).reshape(-1, 3)
        numbers = np.array(self._numbers, np.float64).reshape(-1, 7)
        order = np.lexsort((integers[:, 2], integers[:, 1]))
        integers, numbers = integers[order], numbers[order]
        positions, quaternions = numbers[:, :3], unit(numbers[:, 3:])
        is_bad = ~np.isfinite(np.hstack([positions, quaternions])).all(axis=1)
        positions[is_bad], quaternions[is_bad] = np.nan, np.nan
        return Edge(integers[:, 0], integers[:, 1:], positions, quaternions, self.is_static)


class Transforms:
    """Tree of the coordinate frames of a bag."""

    def __init__(
        self,
        bag: Bag,
        time: TimeSource = "log_time",
        *,
        topic: str = TF,
        frames: Iterable[str] | None = None,
    ) -> None:
        """Read the transforms."""
        self.topic = topic.removesuffix(STATIC)
        self._parents: dict[str, list[str]] = {}
        targets = None if frames is None else {_plain(frame) for frame in frames}
        found = None
        while found is None:
            found = self._read(bag, time, targets)
        self._recorded = {child: poses.edge() for child, poses in found.items()}
        self._edges = {
            child: edge.at(time_order(edge.times_ns)) for child, edge in self._recorded.items()
        }

    def _read(
        self, bag: Bag, time: TimeSource, targets: set[str] | None
    ) -> dict[str, _Poses] | None:
        """Read the poses of the targets and their ancestors, and add to the parents of all frames.

        Returns:
            Poses by frame; None if poses of a frame were left out that turned out to be an
            ancestor. The next call then reads them.
        """
        found: dict[str, _Poses] = {}
        left_out: set[str] = set()
        used = None if targets is None else self._ancestors(targets)
        # Static transforms are read first, because they reveal many ancestors early.
        for topic in (self.topic + STATIC, self.topic):
            if topic not in bag.topics or not bag.topics[topic].count:
                continue
            for each in transforms_of(bag, topic, time):
                parents = self._parents.setdefault(each.child, [])
                if each.parent not in parents:
                    parents.append(each.parent)
                    if used is not None and each.child in used:
                        used |= self._ancestors({each.parent})
                        if used & left_out:
                            return None
                if used is not None and each.child not in used:
                    left_out.add(each.child)
                    continue
                poses = found.setdefault(each.child, _Poses())
                poses.is_static &= topic.endswith(STATIC)
                poses.add(each.time_ns, each.place, each.pose())
        return found

    def _ancestors(self, frames: set[str]) -> set[str]:
        """Return frames and all their known ancestors."""
        found, new = set(frames), set(frames)
        while new:
            new = {parent for child in new for parent in self._parents.get(child, ())} - found
            found |= new
        return found

    def streams(self, frame: str, fixed: str) -> dict[str, Recorded]:
        """Return the moving transforms between two frames, in the order of recording, by name."""
        path = [child for part in self._path(frame, fixed) for child in part]
        for child in path:
            if np.isnan(self._recorded[child].positions).all():
                raise UsageError(
                    f"{self.topic} gives frame '{child}' no valid pose in"
                    f" '{self._parents[child][0]}': each one has a quaternion of length 0, or a"
                    " number that is not finite"
                )
        return {
            self._name(child): self._recorded[child]
            for child in path
            if not self._recorded[child].is_static
        }

    def within(self, run: Run) -> Transforms:
        """Return the transforms of a run; a static transform is the last one of its recording."""
        found = copy(self)
        found._edges = {}
        for child, edge in self._recorded.items():
            if self._name(child) in run.streams:
                found._edges[child] = edge.at(run.streams[self._name(child)].rows)
            else:
                first, stop = np.searchsorted(edge.places[:, 0], run.files)
                found._edges[child] = edge.at(np.arange(first, stop)[-1:])
        return found

    def pose(
        self,
        frame: str,
        fixed: str,
        steps_ns: NDArray[np.int64],
        align: str,
        tolerance_s: float | None,
        parts: Sequence[str] = PLANAR,
        gap_s: float = math.inf,
    ) -> tuple[Floats, Floats]:
        """Return the pose of a frame in another frame at the times of steps.

        The pose is composed of the transforms between the two frames. Static transforms are valid
        at all times.

        Args:
            frame: Frame whose pose is returned.
            fixed: Reference frame of the pose.
            steps_ns: (N,) times of the steps.
            align: Selection of each transform: `last`, `nearest` or `linear` (interpolated).
            tolerance_s: Maximum age of a transform in seconds; older transforms count as missing.
            parts: K parts of the pose: `x y z roll pitch yaw qx qy qz qw`; see `Quantity.parts`.
            gap_s: Longest gap, in seconds, across which a transform is interpolated or taken from a
                later message.

        Returns:
            (N, K) parts in meters, radians and numbers, NaN where missing; and (N,) age in seconds
            of the transform that is farthest in time, negative if that transform is later than the
            step.
        """
        count = len(steps_ns)
        age_s = np.zeros(count)
        poses = []
        for part in self._path(frame, fixed):
            position, turn = np.zeros((count, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
            for name in part:
                at, rotation, age = _at(self._edges[name], steps_ns, align, tolerance_s, gap_s)
                position, turn = at + rotated(rotation, position), product(rotation, turn)
                is_older = np.isnan(age) | (np.abs(age) > np.abs(age_s))
                age_s = np.where(is_older, age, age_s)
            poses.append((position, turn))
        (at, turn), (origin, back) = poses
        inverse = back * [-1.0, -1.0, -1.0, 1.0]
        position, rotation = rotated(inverse, at - origin), product(inverse, turn)
        columns = np.hstack([position, euler_of(rotation), upper(rotation)])
        names = ("x", "y", "z", "roll", "pitch", "yaw", "qx", "qy", "qz", "qw")
        return columns[:, [names.index(part) for part in parts]], age_s

    def _path(self, frame: str, fixed: str) -> tuple[list[str], list[str]]:
        """Return the frames from each of two frames up to their common ancestor, without it."""
        frame, fixed = _plain(frame), _plain(fixed)
        above, below = self._chain(frame), self._chain(fixed)
        common = next((each for each in above if each in below), None)
        if common is not None:
            path = above[: above.index(common)], below[: below.index(common)]
            circle = next((each for part in path for each in part if self._is_circular(each)), None)
            if circle is None:
                return path
            raise UsageError(f"{self.topic} has a cycle at frame '{circle}'")
        known = sorted({*self._parents, *(each for one in self._parents.values() for each in one)})
        for end in (above[-1], below[-1]):
            parents = sorted(self._parents.get(end, []))
            if len(parents) > 1 and {frame, fixed} <= set(known):
                raise UsageError(
                    f"{self.topic} gives frame '{end}' several parents: {', '.join(parents)}"
                )
            if len(parents) == 1:
                raise UsageError(f"{self.topic} has a cycle at frame '{end}'")
        raise UsageError(
            f"{self.topic} has no path from frame '{frame}' to '{fixed}'; frames:"
            f" {', '.join(known[:12])}"
        )

    def _chain(self, frame: str) -> list[str]:
        """Return a frame and its ancestors, up to a frame with several parents or to a cycle."""
        chain = [frame]
        while len(parents := self._parents.get(chain[-1], [])) == 1 and parents[0] not in chain:
            chain.append(parents[0])
        return chain

    def _is_circular(self, frame: str) -> bool:
        """Return whether a frame is its own ancestor."""
        chain = self._chain(frame)
        return self._parents.get(chain[-1], []) == [frame]

    def _name(self, child: str) -> str:
        return f"frame '{child}' in {self.topic}"


def transform_topic(bag: Bag, wanted: str | None) -> str:
    """Return the topic of transforms that a quantity uses: the moving one, if the bag has both."""
    found = {info.name: info.count for info in bag.topics.values() if are_transforms(info)}
    known = sorted({name.removesuffix(STATIC) for name, count in found.items() if count})
    listed = f"topics of transforms: {', '.join(known[:8]) or 'none'}"
    base = TF if wanted is None else wanted.removesuffix(STATIC)
    if wanted is None and known and TF not in known:
        if len(known) > 1:
            raise UsageError(f"several topics have transforms: choose one with `tf`; {listed}")
        base = known[0]
    topic = base if base in bag.topics else base + STATIC
    if topic not in bag.topics:
        raise UsageError(f"no topic {base}; {listed}")
    if topic not in found:
        raise UsageError(f"{topic} ({bag.topics[topic].type_name}) has no transforms; {listed}")
    return topic_of(bag, topic)


def _plain(frame: str) -> str:
    """Return the name of a frame as in the bag, where a leading `/` is ignored as well."""
    return frame.removeprefix("/")


def _at(
    edge: Edge,
    steps_ns: NDArray[np.int64],
    align: str,
    tolerance_s: float | None,
    gap_s: float,
) -> tuple[Floats, Floats, Floats]:
    """Return the pose of a frame in its parent at the times of steps: position, rotation, age."""
    if not len(edge.times_ns):
        nothing = np.full((len(steps_ns), 4), np.nan)
        return nothing[:, :3], nothing, nothing[:, 0]
    if edge.is_static:
        count = len(steps_ns)
        still = (np.tile(each[-1], (count, 1)) for each in (edge.positions, edge.quaternions))
        return (*still, np.zeros(count))  # type: ignore[return-value]
    if align == "nearest":
        match = nearest(edge.times_ns, steps_ns, tolerance_s, gap_s)
    else:
        match = last(edge.times_ns, steps_ns, tolerance_s)
    rows, is_none = np.maximum(match.rows, 0), match.rows == NONE
    positions, turns = edge.positions[rows], edge.quaternions[rows]
    age_s = match.age_s
    if align == "linear":
        after = np.minimum(rows + 1, len(edge.times_ns) - 1)
        span = np.maximum(edge.times_ns[after] - edge.times_ns[rows], 1)
        share = np.clip((steps_ns - edge.times_ns[rows]) / span, 0.0, 1.0)[:, np.newaxis]
        is_between = edge.times_ns[rows] != steps_ns
        is_none |= is_between & ((after == rows) | (span > gap_s * NS_PER_S))
        wait_s = (edge.times_ns[after] - steps_ns) / NS_PER_S
        if tolerance_s is not None:
            is_none |= is_between & (wait_s > tolerance_s)
        # As for fields, the age is that of the nearer one of the two poses.
        age_s = np.where(is_between & (wait_s < age_s), -wait_s, age_s)
        positions = positions + share * (edge.positions[after] - positions)
        turns = between(turns, edge.quaternions[after], share)
    positions, turns = positions.copy(), turns.copy()
    positions[is_none], turns[is_none] = np.nan, np.nan
    return positions, turns, np.where(is_none, np.nan, age_s)

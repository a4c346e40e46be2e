"""Reader of a log's scene: the shapes and coordinate frames at and between steps."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.record.display import SCENE, SCENE_STATIC, TF, TF_STATIC
from mcaprl.recorder.record.scene import MARKER_TYPES, Quad, Vector
from mcaprl.recorder.viewer.playback import Track

_KINDS = {number: kind for kind, number in MARKER_TYPES.items()}
_ADD = 0


@dataclass(frozen=True)
class SeenShape:
    """A marker with the attributes of `scene.Shape`. Only rotations about z are considered."""

    name: str
    kind: str
    color: Quad
    points: NDArray[np.float64]
    size: Vector
    position: Vector
    yaw_rad: float
    frame: str
    text: str


@dataclass(frozen=True)
class SeenFrame:
    """A transform with the attributes of `scene.Frame`."""

    name: str
    position: Vector
    rotation: Quad
    parent: str


@dataclass(frozen=True)
class SeenStep:
    """The scene at one step, or at a moment between this step and the next step.

    Attributes:
        step: Index of the step; the final observation has the largest index.
        time_ns: log_time of the moment.
        static: Static shapes; consecutive moments share the list object until the shapes change.
        moving: Moving shapes.
        frames: Moving and static frames.
        follow: Name of the first moving frame; empty if there is none.
    """

    step: int
    time_ns: int
    static: list[SeenShape] = field(default_factory=list)
    moving: list[SeenShape] = field(default_factory=list)
    frames: list[SeenFrame] = field(default_factory=list)
    follow: str = ""


def moments_of_episode(reader: McapReader, episode: Episode, parts: int = 1) -> Iterator[SeenStep]:
    """Yield the scene at each step of an episode."""
    if reader.channel_of(SCENE) is None:
        raise LogError(
            f"{reader.path} has no scene: add it with `mcaprl annotate {reader.path} --scene`"
        )
    track = Track(reader, topics=(SCENE, SCENE_STATIC, TF, TF_STATIC))
    before: dict[str, tuple[bytes, Any]] = {}
    for step, time_ns in _moments(episode.log_time_ns.tolist(), parts):
        for _, channel, data in track.latest(time_ns):
            if before.get(channel.topic, (b"",))[0] != data:
                read = frames_of if channel.topic in (TF, TF_STATIC) else shapes_of
                before[channel.topic] = (data, read(data))
        found = {topic: values for topic, (_, values) in before.items()}
        moving_frames = _frames_at(found.get(TF, []), time_ns)
        yield SeenStep(
            step=step,
            time_ns=time_ns,
            static=found.get(SCENE_STATIC, []),
            moving=found.get(SCENE, []),
            frames=[*moving_frames, *_frames_at(found.get(TF_STATIC, []), time_ns)],
            follow=moving_frames[0].name if moving_frames else "",
        )


def _moments(times_ns: list[int], parts: int) -> Iterator[tuple[int, int]]:
    """Yield the step and the log_time of each moment."""
    for step, (time_ns, next_ns) in enumerate(pairwise(times_ns)):
        for part in range(parts):
            yield step, time_ns + (next_ns - time_ns) * part // parts
    yield len(times_ns) - 1, times_ns[-1]


def _frames_at(stamped: list[tuple[int, SeenFrame]], time_ns: int) -> list[SeenFrame]:
    """Interpolate the coordinate frames at `time_ns`.

    Outside the range of stamps, use the nearest stamp.
    """
    by_name: dict[str, list[tuple[int, SeenFrame]]] = {}
    for stamp_ns, frame in stamped:
        by_name.setdefault(frame.name, []).append((stamp_ns, frame))
    return [_frame_at(sorted(poses, key=itemgetter(0)), time_ns) for poses in by_name.values()]


def _frame_at(poses: list[tuple[int, SeenFrame]], time_ns: int) -> SeenFrame:
    after = bisect_right(poses, time_ns, key=itemgetter(0))
    if after in (0, len(poses)):
        return poses[max(after - 1, 0)][1]
    (start_ns, start), (end_ns, end) = poses[after - 1 : after + 1]
    share = (time_ns - start_ns) / (end_ns - start_ns)
    # A quaternion and its negative are the same rotation.
    sign = math.copysign(1.0, sum(a * b for a, b in zip(start.rotation, end.rotation, strict=True)))
    x, y, z = np.array(start.position) * (1 - share) + np.array(end.position) * share
    turn = np.array(start.rotation) * (1 - share) + np.array(end.rotation) * (sign * share)
    a, b, c, d = turn / np.linalg.norm(turn)
    return replace(start, position=(x, y, z), rotation=(a, b, c, d))


def frames_of(data: bytes) -> list[tuple[int, SeenFrame]]:
    """Return the coordinate frames in a `tf2_msgs/msg/TFMessage` and their stamps in nanoseconds.

    Raises:
        CorruptLogError: The message is damaged.
    """
    tree = messages.decode(data, "tf2_msgs/msg/TFMessage")
    return [(_stamp_ns(transform), _frame(transform)) for transform in tree.transforms]


def shapes_of(data: bytes) -> list[SeenShape]:
    """Return the shapes that a `visualization_msgs/msg/MarkerArray` adds."""
    array = messages.decode(data, "visualization_msgs/msg/MarkerArray")
    return [_shape(m) for m in array.markers if m.action == _ADD and m.type in _KINDS]


def _shape(marker: Any) -> SeenShape:
    turn = marker.pose.orientation
    color = marker.color
    return SeenShape(
        name=marker.ns,
        kind=_KINDS[marker.type],
        color=(color.r, color.g, color.b, color.a),
        points=np.array([(p.x, p.y, p.z) for p in marker.points], np.float64).reshape(-1, 3),
        size=(marker.scale.x, marker.scale.y, marker.scale.z),
        position=_xyz(marker.pose.position),
        yaw_rad=2 * math.atan2(turn.z, turn.w),
        frame=marker.header.frame_id,
        text=marker.text,
    )


def _stamp_ns(transform: Any) -> int:
    stamp = transform.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _frame(transform: Any) -> SeenFrame:
    turn = transform.transform.rotation
    return SeenFrame(
        name=transform.child_frame_id,
        position=_xyz(transform.transform.translation),
        rotation=(turn.x, turn.y, turn.z, turn.w),
        parent=transform.header.frame_id,
    )


def _xyz(point: Any) -> Vector:
    return point.x, point.y, point.z

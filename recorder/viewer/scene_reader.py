"""Reader of a log's scene: the shapes and frames at each step of an episode."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.dataset.episode import Episode
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.record.display import SCENE, SCENE_STATIC, TF, TF_STATIC
from mcaprl.recorder.record.scene import MARKER_TYPES, Quad, Vector
from mcaprl.recorder.viewer.playback import Track

_KINDS = {number: kind for kind, number in MARKER_TYPES.items()}
_ADD = 0


@dataclass(frozen=True)
class SeenShape:
    """A marker as a `scene.Shape`, with only the rotation about z."""

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
    """A transform as a `scene.Frame`."""

    name: str
    position: Vector
    rotation: Quad
    parent: str


@dataclass(frozen=True)
class SeenStep:
    """The scene at one step.

    Attributes:
        step: Index of the step; the last is that of the final observation.
        static: Static shapes; the same list object until they change.
        moving: Moving shapes.
        frames: Moving and static frames.
        follow: Name of the first moving frame; empty if there is none.
    """

    step: int
    static: list[SeenShape] = field(default_factory=list)
    moving: list[SeenShape] = field(default_factory=list)
    frames: list[SeenFrame] = field(default_factory=list)
    follow: str = ""


def moments_of_episode(reader: McapReader, episode: Episode) -> Iterator[SeenStep]:
    """Yield the scene at each step of an episode.

    Raises:
        LogError: The log has no scene.
    """
    if reader.channel_of(SCENE) is None:
        raise LogError(
            f"{reader.path} has no scene: add it with `mcaprl annotate {reader.path} --scene`"
        )
    track = Track(reader, topics=(SCENE, SCENE_STATIC, TF, TF_STATIC))
    before: dict[str, tuple[bytes, Any]] = {}
    for step, time_ns in enumerate(episode.log_time_ns.tolist()):
        for _, channel, data in track.latest(time_ns):
            if before.get(channel.topic, (b"",))[0] != data:
                before[channel.topic] = (data, _decoded(channel.topic, data))
        found = {topic: parts for topic, (_, parts) in before.items()}
        moving_frames = found.get(TF, [])
        yield SeenStep(
            step=step,
            static=found.get(SCENE_STATIC, []),
            moving=found.get(SCENE, []),
            frames=[*moving_frames, *found.get(TF_STATIC, [])],
            follow=moving_frames[0].name if moving_frames else "",
        )


def _decoded(topic: str, data: bytes) -> list[Any]:
    if topic in (TF, TF_STATIC):
        tree = messages.decode(data, "tf2_msgs/msg/TFMessage")
        return [_frame(transform) for transform in tree.transforms]
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

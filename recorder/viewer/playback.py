"""Playback of logs with a clock that supports pause, speed and seek.

The indexes of the memory-mapped file locate messages, which are read on demand. Only a few
decompressed chunks are cached, so memory use does not grow with the log.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.reading import McapReader, MessageRange
from mcaprl.recorder.record.display import SCENE, SCENE_STATIC, TF, TF_STATIC
from mcaprl.recorder.record.scene import MARKER_TYPES, Quad, Vector

_CHUNKS_KEPT = 24
_Messages = Iterator[tuple[int, Channel, bytes]]


class Played(NamedTuple):
    """A message that is due.

    Attributes:
        track: Index of the message's log in the player.
        channel_id: Channel id of the topic in the log.
        time_ns: Time of the message on the player's clock.
        data: Bytes of the message, as in the file.
    """

    track: int
    channel_id: int
    time_ns: int
    data: bytes


class Track:
    """Messages of one log, which are looked up by time.

    Attributes:
        reader: Reader of the log.
        start_ns: log_time of the first message to play.
        end_ns: log_time of the last message to play.
    """

    def __init__(
        self,
        reader: McapReader,
        window_ns: tuple[int, int] | None = None,
        *,
        topics: Collection[str] | None = None,
    ) -> None:
        """Read the message indexes.

        Args:
            reader: Reader of the log.
            window_ns: First and last log_time to play; default: all.
            topics: Topics to play; default: all.

        Raises:
            CorruptLogError: An index is damaged.
        """
        self.reader = reader
        self._topics = [
            _TopicIndex(reader, channel)
            for channel in reader.channels.values()
            if topics is None or channel.topic in topics
        ]
        self._topics = [topic for topic in self._topics if topic.ranges]
        self.start_ns, self.end_ns = window_ns or (
            min((topic.starts[0] for topic in self._topics), default=0),
            max((max(topic.ends) for topic in self._topics), default=0),
        )
        self._records = lru_cache(_CHUNKS_KEPT)(self._inflated)

    def between(self, start_ns: int, stop_ns: int) -> _Messages:
        """Yield time, channel and bytes of the messages in [start_ns, stop_ns), sorted by time."""
        start_ns, stop_ns = max(start_ns, self.start_ns), min(stop_ns, self.end_ns + 1)
        found = [place for topic in self._topics for place in topic.between(start_ns, stop_ns)]
        for place in sorted(found, key=lambda place: place.time_ns):
            yield place.time_ns, place.channel, self._message(place)

    def latest(self, time_ns: int) -> _Messages:
        """Yield the latest message of each topic up to a time.

        A viewer shows these messages at that time. Messages before `start_ns` are included.
        """
        for topic in self._topics:
            place = topic.latest(min(time_ns, self.end_ns))
            if place is not None:
                yield place.time_ns, place.channel, self._message(place)

    def _message(self, place: _Place) -> bytes:
        records = self._records(place.chunk_start)
        return self.reader.message(records, place.channel, place.time_ns, place.offset)

    def _inflated(self, chunk_start: int) -> memoryview:
        if chunk_start < 0:
            return self.reader.view
        chunk = next(c for c in self.reader.chunks if c.chunk_start_offset == chunk_start)
        return self.reader.chunk_records(chunk)


class _Place(NamedTuple):
    """Location of a message in the file; `chunk_start` is -1 if the message is not in a chunk."""

    time_ns: int
    channel: Channel
    chunk_start: int
    offset: int


class _TopicIndex:
    """Index of one channel's messages, which are sorted by time within each chunk."""

    def __init__(self, reader: McapReader, channel: Channel) -> None:
        self.channel = channel
        ranges = [_by_time(part) for part in reader.message_ranges(channel) if len(part)]
        self.ranges = sorted(ranges, key=lambda part: int(part.index["log_time"][0]))
        self.starts = [int(part.index["log_time"][0]) for part in self.ranges]
        self.ends = [int(part.index["log_time"][-1]) for part in self.ranges]

    def between(self, start_ns: int, stop_ns: int) -> Iterator[_Place]:
        for part, first_ns, last_ns in zip(self.ranges, self.starts, self.ends, strict=True):
            if first_ns < stop_ns and last_ns >= start_ns:
                low, high = _rows_before(part, start_ns), _rows_before(part, stop_ns)
                yield from (self._place(part, row) for row in range(low, high))

    def latest(self, time_ns: int) -> _Place | None:
        best: _Place | None = None
        for part, first_ns in zip(self.ranges, self.starts, strict=True):
            if first_ns > time_ns:
                break
            row = _rows_before(part, time_ns + 1) - 1
            if best is None or part.index["log_time"][row] >= best.time_ns:
                best = self._place(part, row)
        return best

    def _place(self, part: MessageRange, row: int) -> _Place:
        time_ns, offset = part.index[row].tolist()
        chunk_start = -1 if part.chunk is None else part.chunk.chunk_start_offset
        return _Place(time_ns, self.channel, chunk_start, offset)


def _rows_before(part: MessageRange, time_ns: int) -> int:
    # Use uint64, because NumPy compares uint64 times with signed integers as inexact floats.
    return int(np.searchsorted(part.index["log_time"], np.uint64(max(time_ns, 0))))


def _by_time(part: MessageRange) -> MessageRange:
    times: NDArray[np.uint64] = part.index["log_time"]
    if (times[1:] >= times[:-1]).all():
        return part
    return MessageRange.of_index(part.chunk, part.index[np.argsort(times, kind="stable")])


@dataclass
class Player:
    """Playback clock of one or more logs.

    The times of the logs are shifted, so that all logs start at the start time of the first log.

    Attributes:
        tracks: Logs to play.
        speed: Number of simulated seconds per second.
        loops: Whether to restart at the end.
        playing: Whether the clock runs.
    """

    tracks: Sequence[Track]
    speed: float = 1.0
    loops: bool = False
    playing: bool = False

    def __post_init__(self) -> None:
        """Set the clock to the start."""
        self.start_ns = self.tracks[0].start_ns
        self.shifts_ns = [self.start_ns - track.start_ns for track in self.tracks]
        self.end_ns = max(t.end_ns + s for t, s in zip(self.tracks, self.shifts_ns, strict=True))
        self.time_ns = self.start_ns
        # Time before which all messages have been played.
        self._next_ns = self.start_ns

    @property
    def ended(self) -> bool:
        """Whether the clock is at the end."""
        return self.time_ns >= self.end_ns

    def seek(self, time_ns: int) -> None:
        """Set the clock to a time; the time is clipped to the range of the logs."""
        self.time_ns = min(max(time_ns, self.start_ns), self.end_ns)
        self._next_ns = self.time_ns + 1

    def current_messages(self) -> list[Played]:
        """Return the latest message of each topic, to be sent to a new viewer."""
        return self._played(lambda track, shift: track.latest(self.time_ns - shift))

    def advance(self, elapsed_s: float) -> list[Played]:
        """Advance the clock and return the messages that are due, sorted by time."""
        if not self.playing:
            return []
        self.time_ns = min(self.time_ns + round(elapsed_s * self.speed * 1e9), self.end_ns)
        first_ns, self._next_ns = self._next_ns, self.time_ns + 1
        due = self._played(lambda log, shift: log.between(first_ns - shift, self._next_ns - shift))
        if self.ended and not self.loops:
            self.playing = False
        return sorted(due, key=lambda message: message.time_ns)

    def _played(self, found: Callable[[Track, int], _Messages]) -> list[Played]:
        """Return the messages that `found` yields for each log.

        Their times are those of the player's clock.
        """
        return [
            Played(number, channel.id, time_ns + shift, data)
            for number, (track, shift) in enumerate(zip(self.tracks, self.shifts_ns, strict=True))
            for time_ns, channel, data in found(track, shift)
        ]


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
    """Return the frames in a `tf2_msgs/msg/TFMessage` and their stamps in nanoseconds."""
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

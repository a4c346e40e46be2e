"""A bag of decoded ROS messages in memory, and the same messages as a robot sends them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.bags.bag import Failure, Stream
from mcaprl.recorder.bags.decoders import RosDecoder
from mcaprl.recorder.bags.source import Definition
from mcaprl.recorder.bags.values import ABSENT, column_of, kind_at, value_at
from mcaprl.recorder.mapping.live import Topics


class Sent(NamedTuple):
    """A message: log_time in nanoseconds, topic, and nested dicts of the fields."""

    time_ns: int
    topic: str
    message: dict[str, Any]


_LINE = "=" * 80
FOXGLOVE_GRID = f"""\
builtin_interfaces/Time timestamp
string frame_id
geometry_msgs/Pose pose
uint32 column_count
foxglove_msgs/Vector2 cell_size
uint32 row_stride
uint32 cell_stride
foxglove_msgs/PackedElementField[] fields
uint8[] data
{_LINE}
MSG: foxglove_msgs/Vector2
float64 x
float64 y
{_LINE}
MSG: foxglove_msgs/PackedElementField
string name
uint32 offset
uint8 type
{_LINE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
{_LINE}
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
{_LINE}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
{_LINE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
_TEXTS = {"foxglove_msgs/msg/Grid": FOXGLOVE_GRID}


def definition(type_name: str) -> Definition:
    """Return the definition of a standard ROS 2 type, or of a grid of Foxglove."""
    text = _TEXTS.get(type_name) or RosDecoder(type_name, "").text()
    return Definition(type_name, "cdr", "ros2msg", text.encode())


class StreamBag(Topics):
    """Bag of messages in the order of recording, which are encoded and decoded by rosbags."""

    def __init__(self, types: Mapping[str, str], sent: Sequence[Sent]) -> None:
        """Encode and decode the messages."""
        super().__init__({topic: definition(kind) for topic, kind in types.items()})
        self.paths: tuple[Path, ...] = (Path("stream.bag"),)
        self.recordings: tuple[int, ...] = (0,)
        self.sent = [
            each._replace(message=decoder.decode(decoder.encode(each.message)))
            for each in sent
            for decoder in [self.decoders[each.topic]]
        ]

    def _rows(self, topic: str) -> list[int]:
        return [row for row, each in enumerate(self.sent) if each.topic == topic]

    def times(self, topic: str) -> NDArray[np.int64]:
        return np.array([self.sent[row].time_ns for row in self._rows(topic)], np.int64)

    def places(self, topic: str) -> NDArray[np.int64]:
        rows = self._rows(topic)
        return np.column_stack([np.zeros(len(rows), np.int64), np.array(rows, np.int64)])

    def read(
        self, topic: str, fields: Sequence[str], rows: NDArray[np.int64] | None = None
    ) -> Stream:
        times_ns, every = self.times(topic), self._rows(topic)
        chosen = np.arange(len(times_ns)) if rows is None else rows
        kinds, columns, absent = self.topics[topic].fields, {}, {}
        for name in fields:
            messages = [self.sent[every[row]] for row in chosen.tolist()]
            values = [
                each.time_ns if name == "publish_time" else value_at(each.message, name)
                for each in messages
            ]
            columns[name] = column_of(values, kind_at(kinds, name))
            absent[name] = np.array([value is ABSENT for value in values], bool)
        absent = {name: flags for name, flags in absent.items() if flags.any()}
        return Stream(times_ns[chosen], columns, chosen, (), absent)

    def failures(self, topic: str) -> Iterator[Failure]:
        return iter(())

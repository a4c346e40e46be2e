"""A bag: topics with messages, whatever format and encoding they have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class Stream(NamedTuple):
    """Messages of a topic as columns.

    Attributes:
        log_time_ns: (N,) log_time of each message.
        columns: Column of each field by its dotted path: (N,) numbers, (N, K) numbers of arrays
            of equal length, otherwise (N,) objects: texts, bytes, lists.
    """

    log_time_ns: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class TopicInfo:
    """Facts of a topic.

    Attributes:
        name: Name of the topic.
        type_name: Message type, such as `nav_msgs/msg/Odometry`.
        encoding: Encoding of the messages: `cdr`, `ros1`, `protobuf` or `json`.
        count: Number of messages.
        first_ns: log_time of the first message; 0 without messages.
        last_ns: log_time of the last message; 0 without messages.
        fields: Kind of each leaf field by its dotted path, such as `float64`, `float32[36]`,
            `uint8[]`, `string` or `time`; empty if unknown.
        constants: Constants of the type, by name.
        problem: Reason why the messages cannot be read; empty if they can.
    """

    name: str
    type_name: str
    encoding: str
    count: int
    first_ns: int
    last_ns: int
    fields: dict[str, str]
    constants: dict[str, int]
    problem: str = ""


class Bag(Protocol):
    """One or more files, read as one bag.

    Attributes:
        paths: Files of the bag.
        topics: Facts of each topic by name.
    """

    paths: tuple[Path, ...]
    topics: dict[str, TopicInfo]

    def times(self, topic: str) -> NDArray[np.int64]:
        """Return the (N,) log_times of a topic, in file order."""

    def read(
        self, topic: str, fields: Sequence[str], rows: NDArray[np.int64] | None = None
    ) -> Stream:
        """Read fields of a topic.

        Args:
            topic: Name of the topic.
            fields: Dotted paths of fields; `publish_time` is the time of publication in
                nanoseconds.
            rows: Positions of the messages in `times`, in the order to return; default: all.

        Raises:
            LogError: A message cannot be read.
            UnknownNameError: There is no such topic or field.
        """

    def close(self) -> None:
        """Close the files."""


def open_bag(data: str | Path | Sequence[str | Path]) -> Bag:
    """Open a bag.

    Args:
        data: MCAP file, rosbag2 folder, ROS 1 bag, or a glob or sequence of these.

    Raises:
        LogError: A file is missing, damaged, or not a bag.
    """
    raise NotImplementedError

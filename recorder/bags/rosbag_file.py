"""Topics of rosbag2 databases and ROS 1 bags, read by rosbags."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from mcaprl.errors import LogError
from mcaprl.recorder.bags.source import Definition, RawMessage, TopicSource

_ENCODINGS = {MessageDefinitionFormat.MSG: "ros2msg", MessageDefinitionFormat.IDL: "ros2idl"}


class RosbagFile:
    """A ROS 1 bag, a rosbag2 database, or a rosbag2 folder with `metadata.yaml`.

    Attributes:
        path: Path of the file or folder.
        topics: Sources of each topic by its name, one source for each connection.
        complete: True: a bag that was cut off cannot be opened.
    """

    complete = True

    def __init__(self, path: Path, *, distribution: str = "") -> None:
        """Open a bag.

        Raises:
            LogError: The bag is damaged, or its format is unknown.
        """
        self.path = path
        is_ros1 = path.suffix == ".bag"
        try:
            self._reader: Any = Reader1(path) if is_ros1 else Reader2(path)
            self._reader.open()
        # rosbags raises errors of many types for a damaged file.
        except Exception as error:
            raise LogError(f"{path} cannot be read as a bag: {error}") from error
        if is_ros1:
            _sort_by_place(self._reader)
        self.topics: dict[str, list[TopicSource]] = {}
        for connection in self._reader.connections:
            sources = self.topics.setdefault(connection.topic, [])
            sources.append(
                _RosbagTopic(self._reader, path, connection, distribution, is_ros1=is_ros1)
            )

    @property
    def first_ns(self) -> int:
        """Lowest log_time of all messages; 2^63 - 1 if there are none."""
        return int(self._reader.start_time)

    def close(self) -> None:
        """Close the files."""
        self._reader.close()


def _sort_by_place(reader: Any) -> None:
    """Sort the messages of a ROS 1 bag by their places in the file.

    rosbags sorts them by time, but the clock of a simulation that restarts goes back.
    """
    for index in reader.indexes.values():
        index.sort(key=lambda entry: (entry.chunk_pos, entry.offset))


class _RosbagTopic:
    """Messages of one connection."""

    def __init__(
        self,
        reader: Any,
        path: Path,
        connection: Connection,
        distribution: str,
        *,
        is_ros1: bool,
    ) -> None:
        self._reader, self._path, self._connection = reader, path, connection
        self._is_ros1 = is_ros1
        # Connection to the SQLite file, in which messages have ids in the order of recording. A
        # folder with compressed messages has none, and is read in the order of time.
        self._database = None if is_ros1 else getattr(reader.storage, "dbconn", None)
        found = connection.msgdef
        known = "ros1msg" if is_ros1 else _ENCODINGS.get(found.format, "")
        encoding = "ros1" if is_ros1 else "cdr"
        text = found.data.encode()
        self.definition = Definition(connection.msgtype, encoding, known, text, distribution)
        # Position of the next message, and the iterator that will yield this message.
        self._next = 0
        self._pass: Iterator[tuple[int, bytes]] = iter(())

    @property
    def times_ns(self) -> NDArray[np.int64]:
        return self._index[:, 0]

    @property
    def positions(self) -> NDArray[np.int64]:
        return self._index[:, 1]

    @cached_property
    def _index(self) -> NDArray[np.int64]:
        """(N, 2) log_time and position in the file of each message."""
        with self._named():
            if self._is_ros1:
                number = {pos: k for k, pos in enumerate(sorted(self._reader.chunks))}
                entries = self._reader.indexes[self._connection.id]
                # A chunk has fewer than 2^32 bytes.
                rows = [
                    (each.time, number[each.chunk_pos] * 2**32 + each.offset) for each in entries
                ]
            elif self._database is not None:
                rows = self._rows("timestamp, id")
            else:
                rows = [(time_ns, time_ns) for time_ns, _ in self._messages()]
            return np.array(list(rows), np.int64).reshape(-1, 2)

    def raw(self, rows: NDArray[np.int64]) -> Iterator[RawMessage]:
        if len(rows) and (int(rows[0]) < self._next or self._next == 0):
            self._next, self._pass = 0, self._messages()
        for row in rows.tolist():
            for time_ns, data in self._pass:
                self._next += 1
                if self._next > row:
                    # ROS 1 bags and the rosbag2 databases of distributions before Jazzy store no
                    # publication time.
                    yield RawMessage(time_ns, data)
                    break

    def columns(
        self, fields: Sequence[str], rows: NDArray[np.int64] | None
    ) -> dict[str, NDArray[Any]] | None:
        return None

    def _messages(self) -> Iterator[tuple[int, bytes]]:
        """Yield log_time and data of each message, in the order of `_index`."""
        with self._named():
            if self._database is not None:
                yield from self._rows("timestamp, data")
            else:
                for _, time_ns, data in self._reader.messages(connections=[self._connection]):
                    yield time_ns, data

    def _rows(self, columns: str) -> Any:
        assert self._database is not None, "the bag is a database"
        return self._database.execute(
            f"SELECT {columns} FROM messages WHERE topic_id = ? ORDER BY id",
            (self._connection.id,),
        )

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Convert errors of rosbags to errors that name file and topic."""
        try:
            yield
        except LogError:
            raise
        # rosbags raises errors of many types for a damaged file.
        except Exception as error:
            raise LogError(
                f"{self._path}: messages of {self._connection.topic} cannot be read: {error}"
            ) from error

"""ROS 1 bags, read by rosbags, and databases of rosbag2."""

from __future__ import annotations

import bz2
import sqlite3
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import lz4.frame
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Chunk, Header, RecordType

from mcaprl.errors import LogError
from mcaprl.limits import MAX_CHUNK_BYTES
from mcaprl.recorder.bags.source import Definition, SequentialTopic, TopicSource


class Database:
    """SQLite database of rosbag2, of any distribution.

    Attributes:
        topics: Sources of each topic by its name.
    """

    def __init__(self, path: Path, distribution: str) -> None:
        """Open a database and read its topics."""
        # `immutable`: neither locks nor journals are written.
        uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        self._connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
        try:
            self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_CHUNK_BYTES)
            # Texts may have any bytes.
            self._connection.text_factory = bytes
            self.topics = self._topics(path, distribution)
        except BaseException:
            self.close()
            raise

    @property
    def first_ns(self) -> int:
        """Lowest log_time of all messages; 2^63 - 1 if there are none."""
        rows = self._connection.execute(
            "SELECT min(timestamp) FROM messages WHERE typeof(timestamp) = 'integer'"
        )
        found = next(rows)[0]
        return 2**63 - 1 if found is None else int(found)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def _topics(self, path: Path, distribution: str) -> dict[str, list[TopicSource]]:
        for table in ("messages", "topics"):
            if not self._columns(table):
                raise LogError(f"the table {table} is missing")
        definitions: dict[str, tuple[str, bytes]] = {}
        if {"topic_type", "encoding", "encoded_message_definition"} <= self._columns(
            "message_definitions"
        ):
            for name, encoding, text in self._connection.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                definitions.setdefault(_text(name), (_text(encoding), _text(text).encode()))
        if not distribution and "ros_distro" in self._columns("schema"):
            rows = self._connection.execute("SELECT ros_distro FROM schema LIMIT 1")
            distribution = next((_text(row[0]) for row in rows), "")
        found: dict[str, list[TopicSource]] = {}
        for number, *texts in self._connection.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            name, kind, encoding = map(_text, texts)
            definition = Definition(kind, encoding, *definitions.get(kind, ("", b"")), distribution)
            topic = _DatabaseTopic(path, name, definition, self._connection, number)
            found.setdefault(name, []).append(topic)
        return found

    def _columns(self, table: str) -> set[str]:
        """Return the columns of a table; empty if there is no such table."""
        # A view could compute any number of rows.
        rows = self._connection.execute(
            "SELECT sql FROM sqlite_master WHERE type = 'table' AND name = ?", (table,)
        )
        if not any(_text(row[0]).upper().startswith("CREATE TABLE") for row in rows):
            return set()
        return {_text(row[1]) for row in self._connection.execute(f"PRAGMA table_info({table})")}


def _text(value: Any) -> str:
    """Return a text, which may be stored as bytes."""
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


class _DatabaseTopic(SequentialTopic):
    """Messages of one row of the table `topics`; their ids are in the order of recording."""

    def __init__(
        self,
        path: Path,
        topic: str,
        definition: Definition,
        connection: sqlite3.Connection,
        number: int,
    ) -> None:
        super().__init__(path, topic, definition)
        self._connection, self._number = connection, number

    def _places(self) -> Iterator[tuple[int, int]]:
        for time_ns, number in self._rows("timestamp, id"):
            if not isinstance(time_ns, int) or not isinstance(number, int):
                raise LogError("a timestamp is not an integer")
            yield time_ns, number

    def _messages(self) -> Iterator[tuple[int, bytes]]:
        for time_ns, data in self._rows("timestamp, data"):
            # What is not bytes, such as a number, is a message that cannot be decoded.
            yield time_ns, data if isinstance(data, bytes) else b""

    def _rows(self, columns: str) -> Iterator[Any]:
        return self._connection.execute(
            f"SELECT {columns} FROM messages WHERE topic_id = ? ORDER BY id", (self._number,)
        )


class RosbagFile:
    """A ROS 1 bag, or a rosbag2 database.

    Attributes:
        path: Path of the file.
        topics: Sources of each topic by its name, one source for each connection.
        first_ns: Lowest log_time of all messages; 2^63 - 1 if there are none.
        complete: True: a bag that was cut off cannot be opened.
    """

    complete = True

    def __init__(self, path: Path, *, distribution: str = "") -> None:
        """Open a bag."""
        self.path = path
        is_ros1 = path.suffix == ".bag"
        try:
            self._file = _Ros1Bag(path) if is_ros1 else Database(path, distribution)
            self.first_ns = self._file.first_ns
        # rosbags raises errors of many types for a damaged file.
        except Exception as error:
            raise LogError(f"{path} cannot be read as a bag: {error}") from error
        self.topics = self._file.topics

    def close(self) -> None:
        """Close the files."""
        self._file.close()


class _Ros1Bag:
    """ROS 1 bag; see `RosbagFile`."""

    def __init__(self, path: Path) -> None:
        self._reader = _Ros1Reader(path)
        self._reader.open()
        # rosbags sorts the messages by time, but the clock of a simulation that restarts goes back.
        for index in self._reader.indexes.values():
            index.sort(key=lambda entry: (entry.chunk_pos, entry.offset))
        self.topics: dict[str, list[TopicSource]] = {}
        for connection in self._reader.connections:
            sources = self.topics.setdefault(connection.topic, [])
            sources.append(_Ros1Topic(path, self._reader, connection))

    @property
    def first_ns(self) -> int:
        return int(self._reader.start_time)

    def close(self) -> None:
        self._reader.close()


class _Ros1Reader(Reader):
    """Reader of rosbags that decompresses no more bytes of a chunk than the chunk declares."""

    def read_chunk(self) -> Chunk:
        """Read the header of a chunk."""
        assert self.bio is not None, "the reader is open"
        start = self.bio.tell()
        header = Header.read(self.bio, RecordType.CHUNK)
        compression, size = header.get_string("compression"), header.get_uint32("size")
        self.bio.seek(start)
        chunk = super().read_chunk()
        if compression == "none":
            return chunk
        return chunk._replace(decompressor=partial(_decompressed, compression, size))


def _decompressed(compression: str, size: int, data: bytes) -> bytes:
    """Decompress a chunk of `size` bytes."""
    if size > MAX_CHUNK_BYTES:
        raise LogError(f"a chunk declares {size} bytes; the limit is {MAX_CHUNK_BYTES}")
    decompressor: Any = (
        bz2.BZ2Decompressor() if compression == "bz2" else lz4.frame.LZ4FrameDecompressor()
    )
    found: bytes = decompressor.decompress(data, max_length=size + 1)
    if len(found) != size:
        more = "more than " if len(found) > size else ""
        raise LogError(f"a chunk declares {size} bytes, but has {more}{min(len(found), size)}")
    return found


class _Ros1Topic(SequentialTopic):
    """Messages of one connection of a ROS 1 bag."""

    def __init__(self, path: Path, reader: Reader, connection: Connection) -> None:
        text = connection.msgdef.data.encode()
        definition = Definition(connection.msgtype, "ros1", "ros1msg", text)
        super().__init__(path, connection.topic, definition)
        self._reader, self._connection = reader, connection

    def _places(self) -> Iterator[tuple[int, int]]:
        number = {place: k for k, place in enumerate(sorted(self._reader.chunks))}
        for each in self._reader.indexes[self._connection.id]:
            # A chunk has fewer than 2^32 bytes.
            yield each.time, number[each.chunk_pos] * 2**32 + each.offset

    def _messages(self) -> Iterator[tuple[int, bytes]]:
        for _, time_ns, data in self._reader.messages(connections=[self._connection]):
            yield time_ns, data

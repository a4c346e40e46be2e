"""Topics of one file and their raw messages: MCAP files, ROS 1 bags, databases of rosbag2."""

from __future__ import annotations

import bz2
import hashlib
import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import lz4.frame
import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Chunk, Header, RecordType

from mcaprl.errors import LogError
from mcaprl.limits import MAX_CHUNK_BYTES
from mcaprl.recorder.format.reading import (
    MESSAGE_HEADER,
    ROS_TO_NUMPY,
    McapReader,
    MessageRange,
    Topic,
    definitions_of,
    full_name,
)


@dataclass(frozen=True)
class Definition:
    """Type of the messages of a topic.

    Attributes:
        type_name: Name of the type.
        encoding: Encoding of the messages.
        schema_encoding: Encoding of the schema; empty without a schema.
        schema: Definition of the type.
        distribution: ROS distribution that the bag names; empty if it names none.
    """

    type_name: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = b""
    distribution: str = ""

    @property
    def described(self) -> tuple[str, str, bytes]:
        """Encoding, name and data of the schema."""
        return self.schema_encoding, self.type_name, self.schema


class RawMessage(NamedTuple):
    """A message as the bytes that the file contains, or why they cannot be decompressed."""

    publish_ns: int
    data: bytes
    problem: str = ""


class TopicSource(Protocol):
    """Messages of a topic in one file.

    Attributes:
        definition: Type of the messages.
        metadata: Metadata of the channel, such as the quality of service.
        times_ns: (N,) log_times in file order.
        positions: (N,) positions in the file, which can be compared with those of other sources of
            the file.
    """

    definition: Definition
    metadata: dict[str, str]

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """(N,) log_times in file order."""

    @property
    def positions(self) -> NDArray[np.int64]:
        """(N,) positions in the file."""

    def raw(self, rows: NDArray[np.int64]) -> Iterator[RawMessage]:
        """Yield the messages at the positions `rows` (K,), which are distinct and ascending."""

    def columns(
        self, fields: Sequence[str], rows: NDArray[np.int64] | None
    ) -> dict[str, NDArray[Any]] | None:
        """Return fields as columns without decoding messages one by one; None if impossible."""


class SequentialTopic(ABC):
    """Topic of a file whose messages are read one after the other."""

    def __init__(self, path: Path, topic: str, definition: Definition) -> None:
        """Store the path of the file and the name of the topic, for error messages."""
        self.definition, self.metadata = definition, dict[str, str]()
        self._where = f"{path}: messages of {topic} cannot be read"
        # Position of the next message, and the iterator that will yield this message.
        self._next = 0
        self._pass: Iterator[tuple[int, bytes]] = iter(())

    @abstractmethod
    def _places(self) -> Iterator[tuple[int, int]]:
        """Yield log_time and position in the file of each message."""

    @abstractmethod
    def _messages(self) -> Iterator[tuple[int, bytes]]:
        """Yield log_time and data of each message, in the order of `_places`."""

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """(N,) log_times in file order."""
        return self._index[:, 0]

    @property
    def positions(self) -> NDArray[np.int64]:
        """(N,) positions in the file."""
        return self._index[:, 1]

    @cached_property
    def _index(self) -> NDArray[np.int64]:
        """(N, 2) log_time and position in the file of each message."""
        with self._named():
            return np.array(list(self._places()), np.int64).reshape(-1, 2)

    def raw(self, rows: NDArray[np.int64]) -> Iterator[RawMessage]:
        """Yield the messages at the positions `rows` (K,), which are distinct and ascending."""
        if len(rows) and (int(rows[0]) < self._next or self._next == 0):
            self._next, self._pass = 0, self._messages()
        for row in rows.tolist():
            with self._named():
                while self._next <= row:
                    time_ns, data = next(self._pass)
                    self._next += 1
            # ROS 1 bags and the rosbag2 databases of distributions before Jazzy store no
            # publication time.
            yield RawMessage(time_ns, data)

    def columns(
        self, fields: Sequence[str], rows: NDArray[np.int64] | None
    ) -> dict[str, NDArray[Any]] | None:
        """Return None: messages are decoded one by one."""
        return None

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Convert errors of other libraries to errors that name file and topic."""
        try:
            yield
        # rosbags and sqlite3 raise errors of many types for a damaged file.
        except Exception as error:
            raise LogError(f"{self._where}: {error}") from error


_BYTES = ("uint8", "byte", "octet")


class McapFile:
    """One MCAP file.

    Attributes:
        path: Path of the file.
        topics: Sources of each topic by its name, one source for each channel.
        complete: Whether the file ends with a footer; if not, it was cut off or is being written.
    """

    def __init__(self, path: Path, *, distribution: str = "") -> None:
        """Open a file."""
        self.path = path
        self._reader = reader = McapReader(path)
        self.complete = reader.complete
        self.topics: dict[str, list[TopicSource]] = {}
        for channel in reader.channels.values():
            sources = self.topics.setdefault(channel.topic, [])
            sources.append(_McapTopic(reader, channel, distribution))

    @property
    def first_ns(self) -> int:
        """Lowest log_time of all messages; 0 if there are none."""
        every = [each.times_ns for sources in self.topics.values() for each in sources]
        return min((int(times_ns.min()) for times_ns in every if len(times_ns)), default=0)

    @property
    def checksum(self) -> str:
        """Hash of the chunks; see `McapReader`."""
        return self._reader.checksum

    def close(self) -> None:
        """Do nothing: a file that is mapped into memory need not be closed."""


class _McapTopic:
    """Messages of one channel."""

    def __init__(self, reader: McapReader, channel: Channel, distribution: str) -> None:
        self._reader, self._channel, self.metadata = reader, channel, channel.metadata
        schema = reader.schemas.get(channel.schema_id)
        name, encoding, data = ("", "", b"")
        if schema is not None:
            name, encoding, data = schema.name, schema.encoding, schema.data
        self.definition = Definition(name, channel.message_encoding, encoding, data, distribution)

    @cached_property
    def _ranges(self) -> list[MessageRange]:
        return [part for part in self._reader.message_ranges(self._channel) if len(part)]

    @cached_property
    def times_ns(self) -> NDArray[np.int64]:
        parts = [part.index["log_time"] for part in self._ranges]
        # Unsigned times above the signed ones must not become negative.
        found = np.concatenate(parts) if parts else np.empty(0, np.uint64)
        return np.minimum(found, np.uint64(np.iinfo(np.int64).max)).astype(np.int64)

    @property
    def positions(self) -> NDArray[np.int64]:
        # Unchunked messages come after all chunks, as in `_ranges`. A chunk has fewer than 2^32
        # bytes.
        chunks = self._reader.chunks
        number = {chunk.chunk_start_offset: k for k, chunk in enumerate(chunks)}
        parts = [
            (number[part.chunk.chunk_start_offset] if part.chunk else len(chunks)) * 2**32
            + part.index["offset"].astype(np.int64)
            for part in self._ranges
        ]
        return np.concatenate(parts) if parts else np.empty(0, np.int64)

    def raw(self, rows: NDArray[np.int64]) -> Iterator[RawMessage]:
        stops = np.cumsum([len(part) for part in self._ranges])
        highs = np.searchsorted(rows, stops)
        low = 0
        for part, stop, high in zip(self._ranges, stops.tolist(), highs.tolist(), strict=True):
            if high > low:
                records = self._reader.records_of(part)
                for entry in part.index[rows[low:high] - (stop - len(part))]:
                    time_ns, offset = entry.tolist()
                    data = self._reader.message(records, self._channel, time_ns, offset)
                    head = np.frombuffer(records, MESSAGE_HEADER, 1, offset)
                    yield RawMessage(int(head["publish_time"][0]), data)
            low = high

    def columns(
        self, fields: Sequence[str], rows: NDArray[np.int64] | None
    ) -> dict[str, NDArray[Any]] | None:
        if not self._is_defined:
            return None
        topic = self._columnar
        if topic is None or not all(_is_column(topic.kinds.get(field, "")) for field in fields):
            return None
        try:
            return dict(topic.read(list(fields), rows))
        # Arrays of different lengths cannot form a column; they are decoded one by one.
        except LogError:
            return None

    @cached_property
    def _is_defined(self) -> bool:
        """Whether the file defines the type: the columnar reader knows no other definitions."""
        found = self.definition
        if found.encoding != "cdr" or found.schema_encoding not in ("ros2msg", "ros2idl"):
            return False
        text = found.schema.decode(errors="replace")
        try:
            return definitions_of(full_name(found.type_name), text, found.schema_encoding).is_own
        except LogError:
            return False

    @cached_property
    def _columnar(self) -> Topic | None:
        """Columnar reader of the topic; None if it cannot be used or there are several channels."""
        try:
            found = Topic(self._reader, self._channel.topic)
        except LogError:
            return None
        return found if found.channels == 1 else None


def _is_column(kind: str) -> bool:
    """Return whether a field is read as a column.

    Columns are numbers, strings, times, and arrays of numbers or strings. Messages with other
    fields, such as bytes and lists of messages, are decoded one by one.
    """
    element, bracket, _ = kind.partition("[")
    if bracket:
        return element == "string" or (element in ROS_TO_NUMPY and element not in _BYTES)
    return element in ROS_TO_NUMPY or element in ("string", "time")


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

    @property
    def entries(self) -> Iterator[tuple[Any, ...]]:
        """Topic, time and size of each message."""
        return self._connection.execute(
            "SELECT topic_id, timestamp, length(data) FROM messages ORDER BY id"
        )

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

    @property
    def checksum(self) -> str:
        """SHA-256 of what is listed of each message."""
        digest = hashlib.sha256(" ".join(self.topics).encode())
        for entry in self._file.entries:
            digest.update(repr(tuple(entry)).encode())
        return digest.hexdigest()

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

    @property
    def entries(self) -> Iterator[tuple[Any, ...]]:
        """Connection, time and place of each message."""
        for number, index in self._reader.indexes.items():
            yield from ((number, *entry) for entry in index)

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

"""SQLite databases of rosbag2."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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

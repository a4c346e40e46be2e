"""A topic of one file: the definition of its type, and its raw messages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError


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


class RawMessage(NamedTuple):
    """A message as the bytes that the file contains, or why they cannot be decompressed."""

    publish_ns: int
    data: bytes
    problem: str = ""


class TopicSource(Protocol):
    """Messages of a topic in one file.

    Attributes:
        definition: Type of the messages.
        times_ns: (N,) log_times in file order.
        positions: (N,) positions in the file, which can be compared with those of other sources of
            the file.
    """

    definition: Definition

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
        self.definition = definition
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

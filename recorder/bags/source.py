"""A topic of one file: the definition of its type, and its raw messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


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
    """A message as the bytes that the file contains."""

    publish_ns: int
    data: bytes


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

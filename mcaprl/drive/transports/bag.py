"""A bag that is played as fast as possible, for a dry run."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from io import BufferedWriter, FileIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import Writer

from mcaprl.drive.transports import Receive, Wire
from mcaprl.errors import UsageError
from mcaprl.files import check_target
from mcaprl.recorder.bags.bag import open_bag

PREFIX = "/mcaprl"  # Prefix of the topics of what would have been commanded


class Compared(NamedTuple):
    """A field of the command, as it was and as it would have been.

    Attributes:
        field: Path of the field, such as `/cmd_vel.linear.x`.
        steps: Number of commands that are compared.
        logged: Mean of the logged commands.
        commanded: Mean of the policy's commands.
        difference: Root mean square of the difference.
        correlation: Correlation coefficient; NaN if one of them never changes.
    """

    field: str
    steps: int
    logged: float
    commanded: float
    difference: float
    correlation: float


class BagTransport:
    """Messages of a bag, on the clock of the bag; commands are compared with those of the bag."""

    encoding = ""

    def __init__(
        self,
        bag: str | Path,
        *,
        definitions: Sequence[str | Path] = (),
        record: str | Path | None = None,
        overwrite: bool = False,
    ) -> None:
        """Open the bag; `record` is an MCAP file for the commands of both."""
        if record is not None:
            check_target(Path(record), overwrite=overwrite)
        self._bag = open_bag(bag, definitions=definitions)
        self._name, self._record, self._now_ns = str(bag), record, 0
        self._commanded: dict[str, Any] = {}
        self._pairs: dict[str, list[tuple[float, float]]] = {}
        self._writer: Writer | None = None

    def open(
        self, inputs: Mapping[str, Wire], outputs: Mapping[str, Wire], receive: Receive
    ) -> None:
        """Check the topics."""
        missing = [topic for topic in inputs if topic not in self._bag.topics]
        if missing:
            raise UsageError(f"{self._name} has no topic {', '.join(missing)}")
        self._topics = [topic for topic in {**inputs, **outputs} if topic in self._bag.topics]
        self._outputs, self._channels = outputs, dict[str, int]()
        if self._record is not None:
            self._stream = BufferedWriter(FileIO(self._record, "w"))
            self._writer = Writer(self._stream)
            self._writer.start("")
            for topic, wire in outputs.items():
                kind = wire.definition
                schema = self._writer.register_schema(
                    kind.type_name, kind.schema_encoding, kind.schema
                )
                for name in (topic, PREFIX + topic):
                    self._channels[name] = self._writer.register_channel(
                        name, kind.encoding, schema
                    )

    def messages(self) -> Iterator[tuple[str, Any, int]]:
        """Yield topic, message and log_time in the order of recording."""
        for topic, now_ns, _, message in self._bag.messages(self._topics):
            self._now_ns = now_ns
            if topic in self._outputs:
                if self._writer is not None:
                    self._write(topic, self._outputs[topic].encode(message))
                self._compare(topic, message)
            yield topic, message, now_ns

    def publish(self, topic: str, data: bytes) -> None:
        """Store a command, to compare it with the next one of the bag."""
        self._write(PREFIX + topic, data)
        self._commanded[topic] = self._outputs[topic].decode(data)

    @property
    def compared(self) -> list[Compared]:
        """Each field of the commands that is not always zero."""
        found = []
        for field, pairs in sorted(self._pairs.items()):
            logged, own = np.array(pairs).T
            if logged.any() or own.any():
                is_known = logged.std() > 0 and own.std() > 0
                correlation = np.corrcoef(logged, own)[0, 1] if is_known else np.nan
                rms = np.sqrt(np.mean((logged - own) ** 2))
                values = (logged.mean(), own.mean(), rms, correlation)
                found.append(Compared(field, len(pairs), *map(float, values)))
        return found

    def check(self) -> None:
        """Accept all types: the driver checks each message."""

    def now_ns(self) -> int:
        """Return the log_time of the last message, nanoseconds."""
        return self._now_ns

    def close(self) -> None:
        """Close the bag and the file."""
        self._bag.close()
        if self._writer is not None:
            self._writer.finish()
            self._stream.close()

    def _write(self, name: str, data: bytes) -> None:
        if self._writer is not None:
            now_ns = self._now_ns
            self._writer.add_message(self._channels[name], now_ns, data, now_ns)

    def _compare(self, topic: str, logged: Any) -> None:
        own = self._commanded.pop(topic, None)
        for field, value in _numbers(topic, own) if own is not None else ():
            other = dict(_numbers(topic, logged)).get(field)
            if other is not None and ".header." not in field:
                self._pairs.setdefault(field, []).append((other, value))


def _numbers(path: str, message: Any) -> Iterator[tuple[str, float]]:
    """Yield path and value of each number in a message of any library."""
    if isinstance(message, bool | int | float | np.number | np.bool_):
        yield path, float(message)
    elif isinstance(message, list | np.ndarray):
        for k, each in enumerate(message):
            yield from _numbers(f"{path}[{k}]", each)
    elif isinstance(message, dict):
        for name, each in message.items():
            yield from _numbers(f"{path}.{name}", each)
    elif dataclasses.is_dataclass(message):
        for each in dataclasses.fields(message):
            yield from _numbers(f"{path}.{each.name}", getattr(message, each.name))

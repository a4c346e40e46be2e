"""Bag of any supported format: its topics and their messages in any supported encoding."""

from __future__ import annotations

import fnmatch
import hashlib
import heapq
import operator
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, UnknownNameError, UsageError
from mcaprl.limits import MAX_TIME_NS
from mcaprl.recorder.bags.decoders import MessageDecoder, RosDecoder, decoder_of, merged
from mcaprl.recorder.bags.files import DefinitionFiles, find_bags, open_recordings
from mcaprl.recorder.bags.source import Definition, McapFile, RawMessage, RosbagFile, TopicSource
from mcaprl.recorder.bags.values import (
    ABSENT,
    NAMES,
    NUMBERS,
    column_of,
    general_path,
    kind_at,
    steps_of,
    value_at,
)
from mcaprl.recorder.format.reading import ROS1
from mcaprl.texts import counted, printable

if TYPE_CHECKING:
    from mcaprl.recorder.format.writing import McapWriter

_PUBLISH_TIME = "publish_time"
_OWN_TOPICS = "/rl/"
_COPIED_BYTES = 2**20
"""Size at which copied messages are written as a chunk."""
_SHOWN = 8
"""Number of topics and files that the text of a bag shows."""


class Failure(NamedTuple):
    """A message that cannot be decoded: its index in `Bag.times`, its log_time, and why."""

    row: int
    log_time_ns: int
    reason: str


class BagMessage(NamedTuple):
    """A decoded message, with its times in nanoseconds."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    message: Any


class Stream(NamedTuple):
    """Messages of a topic as columns.

    Attributes:
        log_time_ns: (N,) log_time of each message.
        columns: Column of each field by its path: (N,) numbers, (N, K) numbers if all
            values are arrays of K numbers, otherwise (N,) objects (strings, bytes or lists).
        rows: (N,) index of each message in `Bag.times`. Messages that cannot be decoded are left
            out.
        failures: Messages that were left out.
        absent: (N,) flags of the messages that omit a field, as JSON can, by its path; without
            the fields that no message omits.
    """

    log_time_ns: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]
    rows: NDArray[np.int64]
    failures: tuple[Failure, ...] = ()
    absent: Mapping[str, NDArray[np.bool_]] = MappingProxyType({})


@dataclass(frozen=True)
class TopicInfo:
    """Description of a topic.

    Attributes:
        name: Name of the topic.
        type_name: Message type, such as `nav_msgs/msg/Odometry`.
        encoding: Encoding of the messages: `cdr`, `ros1`, `protobuf` or `json`.
        count: Number of messages.
        first_ns: log_time of the first message; 0 if there are no messages.
        last_ns: log_time of the last message; 0 if there are no messages.
        fields: Kind of each leaf field by its dotted path, such as `float64`, `float32[36]`,
            `uint8[]`, `string` or `time`; empty if unknown. A leaf field in an array of messages
            has a path such as `motors[].q`, and a kind that ends with `[]` for each such array.
        constants: Constants of the type, by name.
        problem: Reason why the messages cannot be read; empty if they can be read.
        is_open: Whether messages can have other fields than `fields`, as JSON can.
        unreadable: Reason by dotted path for each field of the type that cannot be read.
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
    is_open: bool = False
    unreadable: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        """Return name, type, number of messages, and the problem if there is one."""
        problem = f", cannot be read: {self.problem}" if self.problem else ""
        kind = self.type_name or self.encoding
        return f"{self.name}: {kind}, {counted(self.count, 'message')}{problem}"

    def may_have(self, path: str) -> bool:
        """Return whether messages may have a field.

        Messages in JSON, for example, may have other fields than their schema lists.
        """
        return not self.fields or self.is_open or self.lists(path)

    def lists(self, path: str) -> bool:
        """Return whether the type has a field, as far as it is known."""
        # Slices of arrays can be omitted.
        wanted = general_path(path).replace("[]", "")
        known = {name.replace("[]", ""): kind for name, kind in self.fields.items()}
        if wanted in known:
            return True
        names = [step for step in steps_of(path.removesuffix(NAMES)) if isinstance(step, str)]
        outer = [".".join(names[:count]) for count in range(1, len(names))]
        return any(_is_open(name, known) for name in outer)


def _is_open(name: str, known: Mapping[str, str]) -> bool:
    """Return whether a field contains fields that are not known."""
    kind = known.get(name, "string")
    element = kind.partition("[")[0]
    if element.rstrip("0123456789") in NUMBERS or element in ("string", "bytes", "time"):
        return False
    # Keys of maps are not known.
    is_map = element.endswith("Entry")
    return is_map or not any(each.startswith(f"{name}.") for each in known)


class Bag(Protocol):
    """One or more recordings, read as one bag.

    A recording is a file, or the files that a `metadata.yaml` lists as the parts of a split bag.

    Attributes:
        paths: Files of the bag. The files of a recording follow each other.
        recordings: Index of the recording of each file, not descending.
        cut: Files that were cut off, or are still being written.
    """

    paths: tuple[Path, ...]
    recordings: tuple[int, ...]
    cut: tuple[Path, ...]

    @property
    def topics(self) -> Mapping[str, TopicInfo]:
        """Description of each topic by name."""

    def times(self, topic: str) -> NDArray[np.int64]:
        """Return the (N,) log_times of a topic, in the order of recording."""

    def places(self, topic: str) -> NDArray[np.int64]:
        """Return the (N, 2) places of a topic's messages: index of the file, position in the file.

        The places are ascending, and those of different topics can be compared.
        """

    def read(
        self, topic: str, fields: Sequence[str], rows: NDArray[np.int64] | None = None
    ) -> Stream:
        """Read fields of a topic; messages that cannot be decoded are left out.

        Args:
            topic: Name of the topic.
            fields: Paths of fields, see `bags.values`; `publish_time` is the time of publication in
                nanoseconds.
            rows: Indices into `times` of the messages to read, in output order; default: all.
        """

    def failures(self, topic: str) -> Iterator[Failure]:
        """Decode all messages of a topic one by one, and yield those that cannot be decoded."""

    def definition(self, topic: str) -> Definition:
        """Return the type of a topic's messages, with the text that defines it."""

    def again(self) -> Bag:
        """Open the bag again, as the arguments of `open_bag` name it."""

    def close(self) -> None:
        """Close the files."""


class _Topic:
    """One topic of a bag, joined from all files and channels in the order of recording."""

    def __init__(
        self,
        name: str,
        sources: Sequence[tuple[int, TopicSource]],
        others: DefinitionFiles | None = None,
    ) -> None:
        """Store the sources, each with the index of its file, and the user's definitions."""
        self.name = name
        self._given, self._others = sources, others

    @property
    def sources(self) -> list[TopicSource]:
        """Sources with messages."""
        return [source for _, source in self._used]

    @cached_property
    def _used(self) -> list[tuple[int, TopicSource]]:
        """Sources with messages, each with the index of its file."""
        if len(self._given) == 1:
            return list(self._given)
        return [each for each in self._given if len(each[1].times_ns)] or list(self._given[:1])

    @cached_property
    def _order(self) -> NDArray[np.int64]:
        """(N, 4) file, position in the file, source and row in the source of each message."""
        parts = [
            np.column_stack(np.broadcast_arrays(file, source.positions, k, np.arange(count)))
            for k, (file, source) in enumerate(self._used)
            for count in [len(source.times_ns)]
        ]
        rows = np.concatenate(parts).astype(np.int64)
        # A single source is already in the order of recording. `columns` reads it in this order.
        return rows if len(parts) == 1 else rows[np.lexsort((rows[:, 1], rows[:, 0]))]

    @property
    def places(self) -> NDArray[np.int64]:
        return self._order[:, :2]

    @cached_property
    def times_ns(self) -> NDArray[np.int64]:
        times_ns = np.empty(len(self._order), np.int64)
        for k, (_, source) in enumerate(self._used):
            found = source.times_ns
            wrong = (found <= -MAX_TIME_NS) | (found >= MAX_TIME_NS)
            if wrong.any():
                raise LogError(f"{self.name}: message {wrong.argmax()} has an impossible log_time")
            mine = self._order[:, 2] == k
            times_ns[mine] = found[self._order[mine, 3]]
        return times_ns

    @cached_property
    def _decoders(self) -> dict[Definition, MessageDecoder]:
        """Decoder of each definition: files and channels may define the type differently."""
        found = dict.fromkeys(source.definition for _, source in self._used)
        kinds = sorted({each.type_name for each in found})
        if len(kinds) > 1:
            raise LogError(f"the topic has messages of several types: {', '.join(kinds)}")
        return {
            each: decoder_of(
                each.encoding,
                each.type_name,
                each.schema_encoding,
                each.schema,
                distribution=each.distribution,
                others=self._others,
            )
            for each in found
        }

    @cached_property
    def info(self) -> TopicInfo:
        found, problem = self._used[0][1].definition, ""
        fields, constants = dict[str, str](), dict[str, int]()
        decoders = list[MessageDecoder]()
        try:
            decoders = list(self._decoders.values())
            fields, constants = merged(decoders)
        except (LogError, UsageError) as error:
            problem = str(error)
        times_ns = self.times_ns
        return TopicInfo(
            name=self.name,
            type_name=found.type_name,
            encoding=found.encoding,
            count=len(times_ns),
            first_ns=int(times_ns.min()) if len(times_ns) else 0,
            last_ns=int(times_ns.max()) if len(times_ns) else 0,
            fields=fields,
            constants=constants,
            problem=problem,
            is_open=any(each.is_open for each in decoders),
            unreadable={path: why for each in decoders for path, why in each.unreadable.items()},
        )

    def read(
        self, fields: Sequence[str], rows: NDArray[np.int64] | None, *, strict: bool
    ) -> Stream:
        chosen = np.arange(len(self.times_ns)) if rows is None else rows
        if len(self._used) == 1 and _PUBLISH_TIME not in fields:
            columns = self._used[0][1].columns(fields, rows)
            if columns is not None:
                return Stream(
                    self.times_ns[chosen], {name: columns[name] for name in fields}, chosen
                )
        wanted, places = np.unique(chosen, return_inverse=True)
        values, failures = self._values(fields, wanted)
        if failures and (strict or (rows is None and len(failures) == len(wanted))):
            row, time_ns, reason = failures[0]
            raise LogError(f"{self.name}: message {row} at {time_ns} ns: {reason}")
        if failures:
            is_bad = np.isin(wanted, [each.row for each in failures])
            chosen, places = chosen[~is_bad[places]], places[~is_bad[places]]
        kinds, columns, absent = {**self.info.fields, _PUBLISH_TIME: "time"}, {}, {}
        for name, column in values.items():
            used = [column[place] for place in places.tolist()]
            columns[name] = column_of(used, kind_at(kinds, name))
            is_absent = np.array([value is ABSENT for value in used], bool)
            if is_absent.any():
                absent[name] = is_absent
        return Stream(self.times_ns[chosen], columns, chosen, tuple(failures), absent)

    def _values(
        self, fields: Sequence[str], rows: NDArray[np.int64]
    ) -> tuple[dict[str, list[Any]], list[Failure]]:
        """Return the values of fields in the messages `rows`, which are distinct and ascending."""
        values: dict[str, list[Any]] = {name: [None] * len(rows) for name in fields}
        failures = []
        chosen = self._order[rows]
        for k, (_, source) in enumerate(self._used):
            decoder = self._decoders[source.definition]
            mine = np.flatnonzero(chosen[:, 2] == k)
            for row, raw in zip(mine.tolist(), source.raw(chosen[mine, 3]), strict=True):
                try:
                    message = _decoded(decoder, raw)
                    for name, column in values.items():
                        is_time = name == _PUBLISH_TIME
                        column[row] = raw.publish_ns if is_time else value_at(message, name)
                except LogError as error:
                    number = int(rows[row])
                    failures.append(Failure(number, int(self.times_ns[number]), str(error)))
        return values, sorted(failures)

    def raw(self) -> Iterator[tuple[int, TopicSource, RawMessage]]:
        """Yield log_time, source and bytes of each message, in the order of recording."""
        sources = self.sources
        messages = [
            zip(source.times_ns.tolist(), source.raw(np.arange(len(source.times_ns))), strict=False)
            for source in sources
        ]
        for k in self._order[:, 2].tolist():
            time_ns, raw = next(messages[k])
            yield time_ns, sources[k], raw

    def payloads(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, bytes]]:
        chosen = self._order[rows]
        for k, (_, source) in enumerate(self._used):
            mine = np.flatnonzero(chosen[:, 2] == k)
            for row, raw in zip(rows[mine].tolist(), source.raw(chosen[mine, 3]), strict=True):
                if not raw.problem:
                    yield row, raw.data

    def messages(self) -> Iterator[BagMessage]:
        """Yield the messages that can be decoded, in the order of recording."""
        for time_ns, source, raw in self.raw():
            decoder = self._decoders[source.definition]
            with suppress(LogError):
                yield BagMessage(self.name, time_ns, raw.publish_ns, _decoded(decoder, raw))

    def definition(self, source: TopicSource | None = None) -> Definition:
        found = (source or self._used[0][1]).definition
        if found.schema or found.encoding not in ("cdr", "ros1"):
            return found
        decoder = self._decoders[found]
        if not isinstance(decoder, RosDecoder):
            return found
        encoding = ROS1 if found.encoding == "ros1" else "ros2msg"
        return replace(found, schema_encoding=encoding, schema=decoder.text().encode())

    def failures(self) -> Iterator[Failure]:
        for k, (_, source) in enumerate(self._used):
            decoder = self._decoders[source.definition]
            rows = np.flatnonzero(self._order[:, 2] == k)
            places = self._order[rows, 3]
            for row, raw in zip(rows.tolist(), source.raw(places), strict=True):
                try:
                    _decoded(decoder, raw)
                except LogError as error:
                    yield Failure(row, int(self.times_ns[row]), str(error))


def _decoded(decoder: MessageDecoder, raw: RawMessage) -> Any:
    """Return a decoded message."""
    if raw.problem:
        raise LogError(raw.problem)
    return decoder.decode(raw.data)


class _Infos(Mapping[str, TopicInfo]):
    """Mapping from topic name to `TopicInfo`; the type of a topic is parsed at the first access."""

    def __init__(self, topics: Mapping[str, _Topic]) -> None:
        self._topics = topics

    def __getitem__(self, name: str) -> TopicInfo:
        return self._topics[name].info

    def __iter__(self) -> Iterator[str]:
        return iter(self._topics)

    def __len__(self) -> int:
        return len(self._topics)


class OpenBag:
    """Bag whose files are open, as `open_bag` returns it; a context manager that closes them.

    Attributes:
        paths: Files of the bag. The files of a recording follow each other.
        recordings: Index of the recording of each file, not descending.
        names: Path of each recording: that of its file, or of the folder of a split bag.
        cut: Files that were cut off, or are still being written.
        again: Function that opens the bag again, as its arguments name it.
        topics: Description of each topic by name: `type_name`, `encoding`, `count`, `first_ns`,
            `last_ns`, `fields` (kind of each leaf field by its dotted path), `constants`, and
            `problem`, which is not empty if the topic cannot be read.
    """

    def __init__(
        self,
        recordings: Mapping[str, Sequence[McapFile | RosbagFile]],
        opened: ExitStack,
        definitions: DefinitionFiles | None,
        again: Callable[[], OpenBag],
        *,
        strict: bool,
    ) -> None:
        """Join the topics of open files; `opened` closes them."""
        self._opened, self._strict, self.again = opened, strict, again
        ordered = [(name, list(files)) for name, files in recordings.items()]
        # The first times are not needed, and not read, if there is one file.
        if sum(len(files) for _, files in ordered) > 1:
            # The parts of a split bag cover successive time ranges.
            ordered = [(name, sorted(files, key=_first_ns)) for name, files in ordered]
            ordered.sort(key=lambda each: _first_ns(each[1][0]))
        self._files = files = [file for _, each in ordered for file in each]
        self.names = tuple(Path(name) for name, _ in ordered)
        self.paths = tuple(file.path for file in files)
        self.recordings = tuple(number for number, (_, each) in enumerate(ordered) for _ in each)
        self.cut = tuple(file.path for file in files if not file.complete)
        names = dict.fromkeys(name for file in files for name in file.topics)
        self._topics = {
            name: _Topic(
                name,
                [(k, each) for k, file in enumerate(files) for each in file.topics.get(name, [])],
                definitions,
            )
            for name in sorted(names)
        }
        self.topics: Mapping[str, TopicInfo] = _Infos(self._topics)

    def __enter__(self) -> Self:
        """Return the bag."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the files."""
        self.close()

    def __repr__(self) -> str:
        """Return the files, and the first topics with their types."""
        names = list(self._topics)[:_SHOWN]
        topics = [f"  {self.topics[name]}" for name in names]
        more = [f"  and {len(self._topics) - _SHOWN} more"] if len(self._topics) > _SHOWN else []
        where = ", ".join(map(str, self.paths[:_SHOWN]))
        return printable("\n".join([f"Bag {where}: {len(self._topics)} topics", *topics, *more]))

    def times(self, topic: str) -> NDArray[np.int64]:
        """Return the (N,) log_times of a topic in nanoseconds, in the order of recording.

        Raises:
            UnknownNameError: There is no such topic.
        """
        return self._topic(topic).times_ns

    def places(self, topic: str) -> NDArray[np.int64]:
        """Return the (N, 2) places of a topic's messages: index of the file, position in the file.

        Raises:
            UnknownNameError: There is no such topic.
        """
        return self._topic(topic).places

    def read(
        self,
        topic: str,
        fields: Sequence[str] | None = None,
        rows: NDArray[np.int64] | None = None,
    ) -> Stream:
        """Read fields of a topic as columns; messages that cannot be decoded are left out.

        Args:
            topic: Name of the topic.
            fields: Paths of fields, such as `twist.linear.x` or `motors[0:12].q`; `publish_time`
                is the time of publication in nanoseconds. Default: all leaf fields.
            rows: Indexes into `times` of the messages to read, in output order, so that a topic
                that is larger than the memory is read in parts; default: all.

        Returns:
            Named tuple of `log_time_ns` (N,) and `columns`: the column of each field by its path,
            which has (N,) numbers, (N, K) numbers if all values are arrays of K numbers, otherwise
            (N,) objects such as strings, bytes and lists. `rows` has the (N,) indexes of the
            messages in `times`, and `failures` the messages that cannot be decoded.

        Raises:
            LogError: The topic or a file cannot be read, or no message can be decoded.
            UnknownNameError: There is no such topic or field.
            UsageError: No fields are given, and the topic has no schema that lists them.
        """
        if fields is None:
            fields = self._leaf_fields(topic)
        if rows is not None:
            rows = np.asarray(rows, np.int64)
        found = self._readable(topic)
        for name in fields:
            if name in found.info.unreadable:
                raise LogError(f"{topic}: {found.info.unreadable[name]}")
            if name != _PUBLISH_TIME and not found.info.may_have(name):
                raise UnknownNameError(f"field of {topic}", name, found.info.fields)
        return found.read(fields, rows, strict=self._strict)

    def _leaf_fields(self, topic: str) -> list[str]:
        fields = self._readable(topic).info.fields
        if not fields:
            raise UsageError(
                f"the fields of {topic} are unknown, because it has no schema: name them"
            )
        # The fields of the messages in an array are within the field of the array.
        return [name for name in fields if "[" not in name]

    def messages(self, topics: Sequence[str] | None = None) -> Iterator[BagMessage]:
        """Yield decoded messages in the order of recording; those that cannot be are left out.

        Args:
            topics: Topics of the messages; default: all that can be read.

        Yields:
            Named tuples of `topic`, `log_time_ns`, `publish_time_ns`, and `message`: an object with
            the fields as attributes, or a dict (JSON).

        Raises:
            LogError: A topic or a file cannot be read.
            UnknownNameError: There is no such topic.
        """
        if topics is None:
            topics = [name for name, info in self.topics.items() if not info.problem]
        found = [self._readable(name) for name in topics]
        each = [zip(map(tuple, one.places.tolist()), one.messages(), strict=False) for one in found]
        merged_ = heapq.merge(*each, key=operator.itemgetter(0))
        yield from (message for _, message in merged_)

    def definition(self, topic: str) -> Definition:
        """Return the type of a topic's messages, with the text that defines it.

        Raises:
            LogError: The topic cannot be read.
            UnknownNameError: There is no such topic.
        """
        return self._readable(topic).definition()

    def failures(self, topic: str) -> Iterator[Failure]:
        """Decode all messages of a topic one by one, and yield those that cannot be decoded.

        Raises:
            LogError: The file is damaged, or no message of the topic can be decoded.
        """
        return self._readable(topic).failures()

    def payloads(self, topic: str, rows: NDArray[np.int64]) -> Iterator[tuple[int, bytes]]:
        """Yield index and bytes of each of the messages `rows`, which are distinct and ascending.

        Messages that cannot be decompressed are left out. If the topic has several channels or
        files, the messages of one come after those of the other.

        Raises:
            LogError: The file is damaged.
        """
        return self._topic(topic).payloads(rows)

    def checksum(self, recording: int) -> str:
        """Return the SHA-256 of what the files of a recording list of their messages."""
        files = zip(self._files, self.recordings, strict=True)
        sums = [file.checksum for file, number in files if number == recording]
        return hashlib.sha256(" ".join(sums).encode()).hexdigest()

    def close(self) -> None:
        """Close the files."""
        self._opened.close()

    def _readable(self, name: str) -> _Topic:
        found = self._topic(name)
        if found.info.problem:
            raise LogError(f"{name} cannot be read: {found.info.problem}")
        return found

    def _topic(self, name: str) -> _Topic:
        if name not in self._topics:
            raise UnknownNameError("topic", name, self._topics)
        return self._topics[name]


OpenBag.__module__ = "mcaprl"


def matching_topics(topics: Iterable[str], patterns: Sequence[str], where: str = "") -> list[str]:
    """Return the topics of a bag that patterns such as `/camera/*` select, sorted by name.

    Topics below `/rl/`, which a log writes itself, are left out.

    Raises:
        UnknownNameError: A pattern has no topic; `where` says where the pattern is from.
    """
    names = [name for name in topics if not name.startswith(_OWN_TOPICS)]
    chosen = set[str]()
    for pattern in patterns:
        found = [name for name in names if fnmatch.fnmatchcase(name, pattern)]
        if not found:
            raise UnknownNameError(f"topic{where}", pattern, names)
        chosen |= {*found}
    return sorted(chosen)


def copy_topics(
    paths: Sequence[Path],
    definitions: Sequence[str | Path],
    patterns: Sequence[str],
    mcap: McapWriter,
    where: str = "",
) -> None:
    """Copy topics of a bag to another file: bytes, schemas and times, in the order of log_time.

    The messages in memory are bounded; their index is not.

    Args:
        paths: Files of the bag.
        definitions: Files and folders with definitions of ROS types that the bag lacks.
        patterns: Names of topics, or patterns such as `/camera/*`; see `matching_topics`.
        mcap: Writer of the file.
        where: Where the patterns are from, for errors.

    Raises:
        UnknownNameError: A pattern has no topic.
        LogError: The bag cannot be read, or the type of a topic is not known.
    """
    with open_bag(paths, definitions=definitions) as bag:
        topics = [bag._topics[name] for name in matching_topics(bag._topics, patterns, where)]
        ids, undone = dict[TopicSource, int](), 0
        for topic in topics:
            for source in topic.sources:
                try:
                    kind = topic.definition(source)
                except LogError as error:
                    raise LogError(f"{topic.name} cannot be kept: {error}") from error
                if len(topic.times_ns) and topic.times_ns.min() < 0:
                    raise LogError(f"{topic.name} cannot be kept: it has times before 1970")
                ids[source] = mcap.add_topic(
                    topic.name, kind.encoding, kind.described, source.metadata
                )
        messages: list[tuple[int, int, bytes]] = []
        published, size = list[int](), 0
        for time_ns, source, raw in heapq.merge(
            *(topic.raw() for topic in topics), key=operator.itemgetter(0)
        ):
            if raw.problem:
                undone += 1
                continue
            messages.append((ids[source], time_ns, raw.data))
            published.append(raw.publish_ns)
            size += len(raw.data)
            if size > _COPIED_BYTES:
                mcap.write_messages(messages, published)
                messages, published, size = [], [], 0
        mcap.write_messages(messages, published)
        if undone:
            warnings.warn(
                f"{counted(undone, 'message')} cannot be decompressed, and are not kept",
                stacklevel=2,
            )


def _first_ns(file: McapFile | RosbagFile) -> int:
    return file.first_ns


def open_bag(
    data: str | Path | Sequence[str | Path],
    *,
    definitions: Sequence[str | Path] = (),
    strict: bool = False,
) -> OpenBag:
    """Open a bag: MCAP files, rosbag2 folders and databases, and ROS 1 bags.

    Files that rosbag2 compressed as a whole are decompressed to a temporary folder. If a topic
    cannot be read, its `problem` is not empty; all other topics can still be read.

    Args:
        data: A file, a folder, a glob, or a sequence of these. A folder is a bag, or contains
            bags, also in its folders. Recordings are read in the order of their first messages.
        definitions: Files and folders with definitions of ROS types that the bag lacks: packages,
            workspaces of packages, or files of types.
        strict: Whether a message that cannot be decoded is an error; by default, it is left out,
            and is one of the `failures` of what `read` returns.

    Returns:
        The open bag; `with mcaprl.open_bag(data) as bag` closes its files.

    Raises:
        LogError: A file is missing, damaged, or not a bag.
        UsageError: There is no such file or folder of definitions, or it has none.
    """
    others = DefinitionFiles(definitions) if definitions else None
    names = [data] if isinstance(data, str | Path) else data
    places = [Path(name).absolute() for name in names]
    again = partial(open_bag, places, definitions=definitions, strict=strict)
    with ExitStack() as opened:
        recordings = open_recordings(find_bags(data), opened)
        return OpenBag(recordings, opened.pop_all(), others, again, strict=strict)

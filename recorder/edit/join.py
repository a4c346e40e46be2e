"""Several logs joined into one; the times of a log that is moved are delayed in its messages."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Metadata
from rosbags.interfaces import Nodetype

from mcaprl.errors import CorruptLogError, LogError, SpaceError, UsageError
from mcaprl.files import replacing
from mcaprl.recorder.dataset.log_reader import described
from mcaprl.recorder.dataset.open import find_logs
from mcaprl.recorder.edit.piece import Edited, FinishedLog
from mcaprl.recorder.format.behavior import FIELDS
from mcaprl.recorder.format.messages import EPISODE_TYPE
from mcaprl.recorder.format.metadata import (
    DEFAULT_STEP_DURATION_NS,
    METADATA_NAME,
    SAME_WHEN_APPENDED,
    LogMetadata,
    same_env,
)
from mcaprl.recorder.format.reading import (
    ROS_TO_NUMPY,
    McapReader,
    Topic,
    definitions_of,
    full_name,
)
from mcaprl.recorder.format.schema import STEP_TOPIC
from mcaprl.recorder.format.selected_copy import NewTopics, Source, Times, copy_selected, times_of

_NS_PER_S = 10**9
_TIME = "builtin_interfaces/msg/Time"
_HEAD_BYTES = 4
# Margin before and after the file's log_times, nanoseconds. If a time in a message is outside of
# this range, it belongs to another clock or is not set.
_MARGIN_NS = 10 * _NS_PER_S
# Byte offset of the start and end times in a message of `/rl/episode`. The CDR header and
# `total_reward` precede them.
_EPISODE_TIMES = 12
_SIZES = {name: int(code[-1]) for name, code in ROS_TO_NUMPY.items()}
_MAX_SECONDS = 2**31 - 1
Fields = Mapping[str, Any]


class Delay:
    """Callable that adds a delay to the timestamps in messages."""

    # These are those of `/rl/episode` and fields of type `builtin_interfaces/Time`, if a value is
    # in the range of the file's log_times, extended by 10 s on each side.

    def __init__(self, reader: McapReader, span: tuple[int, int], delay_ns: int) -> None:
        """Find the timestamps in the message types of all channels."""
        self._reader, self._delay_ns = reader, delay_ns
        self._span = span[0] - _MARGIN_NS, span[1] + _MARGIN_NS
        self._changes: dict[int, Callable[[memoryview], None] | None] = {}
        for channel in reader.channels.values():
            if sum(map(len, reader.message_ranges(channel))):
                self._changes[channel.id] = self._change_of(channel)

    def __call__(self, channel: Channel, time_ns: int, payload: memoryview) -> None:
        """Change the timestamps of one message in place."""
        change = self._changes[channel.id]
        if change is None:
            return
        try:
            change(payload)
        except (struct.error, IndexError, KeyError) as error:
            raise CorruptLogError(
                f"{self._reader.path}: the message of {channel.topic} at log_time {time_ns} does"
                " not fit its type"
            ) from error

    def _change_of(self, channel: Channel) -> Callable[[memoryview], None] | None:
        """Return the function that delays the timestamps in messages; None if they have none."""
        schema = self._reader.schemas.get(channel.schema_id)
        if (
            schema is None
            or channel.message_encoding != "cdr"
            or schema.encoding not in ("ros2msg", "ros2idl")
        ):
            raise LogError(
                f"{self._reader.path}: the times in the messages of {channel.topic} cannot"
                f" be delayed, because their encoding is {channel.message_encoding!r}, not 'cdr'"
            )
        name = full_name(schema.name)
        if name == EPISODE_TYPE:
            return self._move_episode
        text = schema.data.decode(errors="replace")
        found = definitions_of(name, text, schema.encoding)
        types = found.types
        for reason in found.unreadable.values():
            raise LogError(f"{self._reader.path}: {channel.topic}: {reason}")
        if _TIME not in types:
            return None
        return lambda payload: self._move(payload, name, types)

    def _move_episode(self, payload: memoryview) -> None:
        order = _order_of(payload)
        start, end = struct.unpack_from(f"{order}2q", payload, _EPISODE_TIMES)
        times = (start + self._delay_ns, end + self._delay_ns)
        struct.pack_into(f"{order}2q", payload, _EPISODE_TIMES, *times)

    def _move(self, payload: memoryview, name: str, types: Fields) -> None:
        walk = _Walk(payload, types)
        walk.skip((Nodetype.NAME, name))
        first, last = self._span
        for place in walk.times:
            seconds, nanoseconds = struct.unpack_from(f"{walk.order}iI", payload, place)
            stamp_ns = seconds * _NS_PER_S + nanoseconds
            if first <= stamp_ns <= last:
                new = divmod(stamp_ns + self._delay_ns, _NS_PER_S)
                if new[0] > _MAX_SECONDS:
                    raise LogError("the times would be after the year 2038: join fewer logs")
                struct.pack_into(f"{walk.order}iI", payload, place, *new)


class _Walk:
    """Cursor that moves through one CDR message and collects the offsets of its timestamps."""

    def __init__(self, data: memoryview, types: Fields) -> None:
        self.order, self.times = _order_of(data), list[int]()
        self._data, self._types, self._place = data, types, _HEAD_BYTES

    def skip(self, description: Any) -> None:
        """Move past a field."""
        kind, what = description
        if kind == Nodetype.BASE:
            self._skip_base(what[0], 1)
        elif kind == Nodetype.NAME:
            self._skip_messages(what, 1)
        else:
            (element, inner), count = what
            if kind == Nodetype.SEQUENCE:
                count = self._count()
            if element == Nodetype.BASE:
                self._skip_base(inner[0], count)
            else:
                self._skip_messages(inner, count)

    def _skip_base(self, name: str, count: int) -> None:
        if name != "string":
            self._advance(_SIZES[name], count)
            return
        for _ in range(count):
            self._advance(1, self._count())

    def _skip_messages(self, name: str, count: int) -> None:
        if name == _TIME:
            for _ in range(count):
                self._align(4)
                self.times.append(self._place)
                self._advance(4, 2)
            return
        fields = tuple(self._types[name][1])
        flat = _flat(tuple(description for _, description in fields))
        if flat is not None:
            self._advance(flat[0], flat[1] * count)
            return
        for _ in range(count):
            for _, description in fields:
                self.skip(description)

    def _count(self) -> int:
        self._align(4)
        (value,) = struct.unpack_from(f"{self.order}I", self._data, self._place)
        self._place += 4
        return int(value)

    def _align(self, size: int) -> None:
        self._place += -(self._place - _HEAD_BYTES) % size

    def _advance(self, size: int, count: int) -> None:
        # CDR has no alignment padding before the elements of an empty sequence.
        if count:
            self._align(size)
        self._place += size * count
        if self._place > len(self._data):
            raise IndexError


@lru_cache(maxsize=256)
def _flat(descriptions: tuple[Any, ...]) -> tuple[int, int] | None:
    """Return the bytes of a field, and the number of fields, if all are numbers of one size."""
    names = {what[0] if kind == Nodetype.BASE else None for kind, what in descriptions}
    sizes = {_SIZES.get(name or "") for name in names}
    if len(sizes) != 1 or None in sizes:
        return None
    return int(sizes.pop() or 0), len(descriptions)


def _order_of(payload: memoryview) -> str:
    return "<" if payload[1] & 1 else ">"


# Each `/rl/` topic has messages of only one type, so that it can be read as columns.
_OUR_TOPICS = "/rl/"


def merge_logs(
    paths: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    shift: bool = False,
    overwrite: bool = False,
) -> Edited:
    """Join the episodes and all other messages of logs; see `mcaprl.merge`."""
    found = find_logs(paths)
    logs = [FinishedLog(path) for path in found]
    if len(found) < 2:
        # `find_logs` returns a file that is listed several times once.
        count = 1 if isinstance(paths, str | Path) else len(paths)
        times = {1: "", 2: f": {found[0]} was given twice"}
        same = times.get(count, f": {found[0]} was given {count} times")
        raise UsageError(f"merge needs two or more logs, not {len(found)}{same}")
    metadata = _common_metadata([log for log in logs if log.has_steps])
    delays = _delays(logs, metadata, shift=shift)
    topics, sources = NewTopics(), []
    strings = None if metadata is None else _strings(logs, metadata)
    replaced = {} if strings is None else {STEP_TOPIC: strings}
    for log, delay_ns in zip(logs, delays, strict=True):
        source = Source(log.reader, topics.add(log.reader, replaced), delay_ns=delay_ns)
        if delay_ns:
            source.change = Delay(log.reader, log.span_of_messages(), delay_ns)
        sources.append(source)
    _leave_out_repeated(logs, sources)
    records, attachments = _other_records(logs, strings)
    top_level = [*records, *topics.records(), *attachments]
    with replacing(Path(out), LogError, overwrite=overwrite) as unfinished:
        # Copy the MCAP profile from a file with episodes, because files of other programs may have
        # a different profile.
        like = next((log.reader for log in logs if log.has_steps), None)
        copied = copy_selected(sources, unfinished, top_level, like=like)
    episodes = sum(len(log.lengths) for log in logs)
    steps = sum(int(log.lengths.sum()) for log in logs)
    return Edited(Path(out), episodes, steps, copied.messages, copied.whole, copied.rewritten)


def _common_metadata(logs: Sequence[FinishedLog]) -> LogMetadata | None:
    """Return the joined log's metadata; None without any. Fields that may differ become empty."""
    found = [described(log.reader) for log in logs]
    described_ones = [(log, one) for log, one in zip(logs, found, strict=True) if one is not None]
    if not described_ones:
        _check_types(logs, are_described=False)
        return None
    without = [log.path for log, one in zip(logs, found, strict=True) if one is None]
    if without:
        raise LogError(
            f"{without[0]} has no metadata, but {described_ones[0][0].path} has metadata"
        )
    (first, metadata), *others = described_ones
    for log, other in others:
        _check_same(first.path, metadata, log.path, other)
    _check_types(logs, are_described=True)
    _check_behavior([log for log, _ in described_ones])
    common = LogMetadata.common([one for _, one in described_ones])
    # Older logs store the id of the environment without its module. If a log stores the id with
    # the module, this id is the longest.
    return replace(common, env_id=max((one.env_id for _, one in described_ones), key=len))


def _strings(logs: Sequence[FinishedLog], metadata: LogMetadata) -> dict[str, str]:
    """Return the metadata record of all logs; if their records differ, encode `metadata`."""
    found = [log.reader.metadata.get(METADATA_NAME) for log in logs if log.has_steps]
    first = found[0]
    if first is not None and all(one == first for one in found):
        return first
    return metadata.to_strings()


def _check_same(first: Path, one: LogMetadata, second: Path, other: LogMetadata) -> None:
    found = one.to_strings(), other.to_strings()
    for name in SAME_WHEN_APPENDED:
        here, there = (strings.get(name, "not known") for strings in found)
        if not (same_env(here, there) if name == "env_id" else here == there):
            kind = SpaceError if name.endswith("_space") else LogError
            raise kind(
                f"{first} and {second} differ in {name}: {here:.200} and {there:.200}; they"
                " cannot be one log"
            )


def _check_behavior(logs: Sequence[FinishedLog]) -> None:
    """Raise LogError if an earlier version recorded some of the logs with another column."""
    known: dict[str, Path] = {}
    for log in logs:
        fields = Topic(log.reader, STEP_TOPIC).fields
        known |= {field.name: log.path for field in FIELDS if field.name in fields}
    if len(known) > 1:
        (first, one), (second, other) = known.items()
        raise LogError(
            f"{one} has {first}, as earlier versions recorded it, but {other} has {second}; they"
            f" cannot be one log: save the older one again with mcaprl.open({str(one)!r}).save(OUT)"
        )


def _check_types(logs: Sequence[FinishedLog], *, are_described: bool) -> None:
    """Raise LogError if the messages of a `/rl/` topic have different types in two logs."""
    known: dict[str, tuple[Path, object]] = {}
    for log in logs:
        for channel in log.reader.channels.values():
            topic = channel.topic
            if not topic.startswith(_OUR_TOPICS) or (topic == STEP_TOPIC and are_described):
                continue
            schema = log.reader.schemas.get(channel.schema_id)
            kind = None if schema is None else (schema.name, schema.data)
            found = (kind, channel.metadata if are_described else None)
            path, first = known.setdefault(topic, (log.path, found))
            if found != first:
                raise LogError(
                    f"{path} and {log.path} have messages of different types on {topic}; they"
                    " cannot be one log"
                )


def _delays(logs: Sequence[FinishedLog], metadata: LogMetadata | None, *, shift: bool) -> list[int]:
    """Return the delay of each log: the number of nanoseconds to add to the times of the log."""
    gap = DEFAULT_STEP_DURATION_NS if metadata is None else metadata.step_duration_ns
    delays, spans, end = [], np.empty((0, 2), np.int64), -1
    for number, log in enumerate(logs):
        delay, (first, last) = 0, log.span_of_messages()
        if log.has_steps and _overlap(spans, log.spans):
            if not shift:
                raise LogError(
                    f"the episodes of {log.path} overlap in time with those of"
                    f" {_overlapped(logs[:number], log)}; pass `shift=True` to"
                    f" delay {log.path} until the earlier logs have ended"
                )
            delay = end + max(gap, 1) - first
        if log.has_steps:
            spans = np.concatenate([spans, log.spans + delay])
        delays.append(delay)
        end = max(end, last + delay)
    return delays


def _overlap(spans: Times, others: Times) -> bool:
    every = np.concatenate([spans, others])
    every = every[np.argsort(every[:, 0], kind="stable")]
    return bool((every[1:, 0] <= every[:-1, 1]).any())


def _overlapped(logs: Sequence[FinishedLog], log: FinishedLog) -> Path:
    """Return the path of the first log in `logs` that has episodes at the times of `log`."""
    found = [one.path for one in logs if one.has_steps and _overlap(one.spans, log.spans)]
    return (found or [one.path for one in logs if one.has_steps])[0]


def _leave_out_repeated(logs: Sequence[FinishedLog], sources: Sequence[Source]) -> None:
    """Exclude from each source the messages that an earlier source also has."""
    # These have equal times and bytes. The parts of a split log all contain the messages that are
    # valid in all of them, such as the static scene.
    bounds = [log.span_of_messages() for log in logs]
    starts_ends = [
        (first + source.delay_ns, last + source.delay_ns)
        for (first, last), source in zip(bounds, sources, strict=True)
    ]
    without: list[dict[int, Times]] = [{} for _ in sources]
    for early, late in itertools.combinations(range(len(sources)), 2):
        (first, last), (other_first, other_last) = starts_ends[early], starts_ends[late]
        if max(first, other_first) > min(last, other_last):
            continue
        for channel_id, times in _repeated(sources[early], sources[late]).items():
            known = without[late].get(channel_id, times)
            without[late][channel_id] = np.union1d(known, times)
    for source, found in zip(sources, without, strict=True):
        source.without = found


def _repeated(source: Source, other: Source) -> dict[int, Times]:
    """Find the messages that are in both sources: log_times in `other` by its channel ids."""
    by_new = {new: old for old, new in source.ids.items()}
    found = {}
    for old, new in other.ids.items():
        if new not in by_new:
            continue
        here = source.reader.channels[by_new[new]]
        there = other.reader.channels[old]
        shared = np.intersect1d(
            times_of(source.reader, here) + source.delay_ns,
            times_of(other.reader, there) + other.delay_ns,
        )
        if not len(shared):
            continue
        one = _payloads(source.reader, here, shared - source.delay_ns)
        two = _payloads(other.reader, there, shared - other.delay_ns)
        equal = [
            time - other.delay_ns
            for time in shared.tolist()
            if one[time - source.delay_ns] == two[time - other.delay_ns]
        ]
        if equal:
            found[old] = np.array(equal, np.int64)
    return found


def _payloads(reader: McapReader, channel: Channel, times: Times) -> dict[int, list[bytes]]:
    """Return the payloads of the messages at each of these log_times."""
    found: dict[int, list[bytes]] = {}
    for part in reader.message_ranges(channel):
        index = part.index[np.isin(part.index["log_time"].astype(np.int64), times)]
        if len(index):
            records = reader.records_of(part)
            for time_ns, offset in index.tolist():
                message = reader.message(records, channel, time_ns, offset)
                found.setdefault(time_ns, []).append(message)
    return found


def _other_records(
    logs: Sequence[FinishedLog], strings: dict[str, str] | None
) -> tuple[list[Metadata], list[Attachment]]:
    """Return the metadata records and attachments of all logs, without duplicates."""
    records: list[Metadata] = []
    attachments: list[Attachment] = []
    if strings is not None:
        records.append(Metadata(METADATA_NAME, strings))
    for record in (record for log in logs for record in log.top_level):
        if isinstance(record, Metadata) and record not in records:
            if strings is None or record.name != METADATA_NAME:
                records.append(record)
        elif isinstance(record, Attachment) and not any(
            (one.name, one.media_type, one.data) == (record.name, record.media_type, record.data)
            for one in attachments
        ):
            attachments.append(record)
    return records, attachments

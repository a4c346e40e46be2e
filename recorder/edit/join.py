"""Several logs joined into one."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Channel, Metadata

from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.files import replacing
from mcaprl.recorder.dataset.log_reader import described
from mcaprl.recorder.dataset.open import find_logs
from mcaprl.recorder.edit.source import Edited, FinishedLog
from mcaprl.recorder.edit.stamps import Delay
from mcaprl.recorder.format.metadata import (
    DEFAULT_STEP_DURATION_NS,
    METADATA_NAME,
    SAME_WHEN_APPENDED,
    LogMetadata,
    same_env,
)
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.selected_copy import (
    NewTopics,
    Source,
    Times,
    copy_selected,
    times_of,
)
from mcaprl.recorder.format.topics import STEP_TOPIC

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
    """Return the metadata of the joined log; None if none of the logs has metadata.

    If a field differs between the logs and is allowed to differ, it is empty in the result.

    Raises:
        SpaceError: The spaces differ.
        LogError: Another field differs that must be equal, or only some logs have metadata.
    """
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
    here, there = one.to_strings(), other.to_strings()
    for name in SAME_WHEN_APPENDED:
        same = here[name] == there[name]
        if not (same_env(here[name], there[name]) if name == "env_id" else same):
            kind = SpaceError if name.endswith("_space") else LogError
            raise kind(
                f"{first} and {second} differ in {name}: {here[name]:.200} and"
                f" {there[name]:.200}; they cannot be one log"
            )


def _check_types(logs: Sequence[FinishedLog], *, are_described: bool) -> None:
    """Raise LogError if the messages of a `/rl/` topic have different types in two logs.

    Args:
        logs: Logs of episodes.
        are_described: Whether the logs have metadata. If they do, the type of `/rl/step` is not
            compared, because it follows from the spaces, and the metadata of the other channels
            must be equal, too.
    """
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
    """Return the delay of each log: the number of nanoseconds to add to the times of the log.

    Raises:
        LogError: Episodes of two logs overlap in time, and `shift` is not set.
    """
    gap = DEFAULT_STEP_DURATION_NS if metadata is None else metadata.step_duration_ns
    delays, spans, end = [], np.empty((0, 2), np.int64), -1
    for number, log in enumerate(logs):
        delay, (first, last) = 0, log.span_of_messages()
        if log.has_steps and _overlap(spans, log.spans):
            if not shift:
                raise LogError(
                    f"the episodes of {log.path} overlap in time with those of"
                    f" {_overlapped(logs[:number], log)}; pass --shift (shift=True in Python) to"
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
    """Exclude from each source the messages that an earlier source also has.

    Two messages of a channel are the same if their times and bytes are equal. If a log was split,
    several parts contain the messages that are valid in all of them, such as the static scene.
    """
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
    """Find the messages that are in both sources.

    The result maps channel ids in `other` to the log_times of these messages in `other`.
    """
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

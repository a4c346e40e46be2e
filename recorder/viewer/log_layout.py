"""The layout of an existing log, from its topics, schemas and first coordinate frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mcaprl.errors import CorruptLogError
from mcaprl.files import parse_json
from mcaprl.recorder.dataset.log_reader import describe
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.reading import McapReader, Topic
from mcaprl.recorder.record.display import TELEMETRY, TF, ShownTopics
from mcaprl.recorder.record.layout import LAYOUT_NAME, layout_of


def layout_of_log(
    reader: McapReader, topics: Sequence[str] | None = None, shown: ShownTopics | None = None
) -> dict[str, Any]:
    """Return a layout that shows the topics of a log and plots its series."""
    if topics is None:
        topics = sorted({channel.topic for channel in reader.channels.values()})
    if shown is not None:
        return layout_of(describe(reader), topics, shown.telemetry_names, shown.follow_frame)
    telemetry = [name for name in Topic(reader, TELEMETRY).fields if name != "encapsulation"]
    return layout_of(describe(reader), topics, telemetry, _first_frame(reader))


def attached_layout(reader: McapReader) -> dict[str, Any]:
    """Return the layout attached to a log, or a new one if there is none."""
    attached = reader.attachment(LAYOUT_NAME)
    if attached is None:
        return layout_of_log(reader)
    try:
        found = parse_json(attached)
    except ValueError as error:
        raise CorruptLogError(f"{reader.path}: attachment {LAYOUT_NAME}: {error}") from error
    if not (isinstance(found, dict) and isinstance(found.get("configById", {}), dict)):
        raise CorruptLogError(f"{reader.path}: attachment {LAYOUT_NAME} is not a layout")
    return found


def _first_frame(reader: McapReader) -> str:
    """Return the name of the first moving coordinate frame; empty if there is none."""
    channel = reader.channel_of(TF)
    first = next(reader.messages(channel), None) if channel is not None else None
    if first is None:
        return ""
    found = messages.decode(first[1], "tf2_msgs/msg/TFMessage").transforms
    return str(found[0].child_frame_id) if found else ""

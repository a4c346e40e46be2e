"""The layout of an existing log, from its topics, schemas and first frame."""

from __future__ import annotations

import json
from typing import Any

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.dataset.log_reader import describe
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.reading import McapReader, Topic
from mcaprl.recorder.record.display import TELEMETRY, TF
from mcaprl.recorder.record.layout import LAYOUT_NAME, layout_of


def layout_of_log(reader: McapReader) -> dict[str, Any]:
    """What to look at in a log, and which series to plot.

    Raises:
        LogError: the file has no transitions, or is damaged.
    """
    topics = sorted({channel.topic for channel in reader.channels.values()})
    telemetry = [name for name in Topic(reader, TELEMETRY).fields if name != "encapsulation"]
    return layout_of(describe(reader), topics, telemetry, _first_frame(reader))


def attached_layout(reader: McapReader) -> dict[str, Any]:
    """The layout that a log carries; one made for it where it carries none.

    Raises:
        CorruptLogError: the attachment is damaged.
    """
    attached = reader.attachment(LAYOUT_NAME)
    if attached is None:
        return layout_of_log(reader)
    try:
        found: dict[str, Any] = json.loads(attached)
    except ValueError as error:
        raise CorruptLogError(f"{reader.path}: attachment {LAYOUT_NAME} is no JSON") from error
    return found


def _first_frame(reader: McapReader) -> str:
    """The frame that moves first in the tree; empty if none does."""
    channel = reader.channel_of(TF)
    first = next(reader.messages(channel), None) if channel is not None else None
    if first is None:
        return ""
    found = messages.decode(first[1], "tf2_msgs/msg/TFMessage").transforms
    return str(found[0].child_frame_id) if found else ""

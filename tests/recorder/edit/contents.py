"""All messages of a log, as the `mcap` library reads them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from mcap.reader import make_reader

Message = tuple[str, int, int, bytes]
"""Topic, log_time, publish_time and data."""


def messages_of(path: Path) -> Counter[Message]:
    """Count the messages of a file by their content, and check all CRCs."""
    with path.open("rb") as file:
        return Counter(
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        )

"""Messages of a running environment, each sent to viewers at its log_time."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from mcap.records import Schema
from numpy.typing import NDArray

from mcaprl.recorder.format.log_writer import Message, MessageSink
from mcaprl.recorder.viewer.foxglove_server import ViewerServer

_PERIOD_S = 1 / 30


class LiveSink(MessageSink):
    """A sink with a thread that sends messages to viewers at their log_times, in write order.

    The latest messages of the topics in `kept` are also sent to each new viewer.
    """

    def __init__(self, viewers: ViewerServer, kept: Sequence[str]) -> None:
        """Create a sink without channels.

        Args:
            viewers: Server of the viewers.
            kept: Topics whose latest message is also sent to each new viewer.
        """
        self._viewers, self._kept = viewers, kept
        self._channels: list[Any] = []
        self._kept_ids: set[int] = set()
        self._latest: dict[int, bytes] = {}
        self._waiting: deque[Message] = deque()
        self._has_newcomers = False
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Start to send messages."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread, send the messages that are due, and drop all later messages."""
        if self._thread.is_alive():
            self._stop.set()
            self._thread.join()
        self._send_due()

    def has_viewers(self) -> bool:
        """Return whether a viewer subscribes to any topic."""
        return any(channel.has_sinks() for channel in self._channels)

    def welcome(self) -> None:
        """Send the latest message of each topic in `kept` to all viewers, including new viewers."""
        self._has_newcomers = True

    def send(self, channel_id: int, time_ns: int, data: bytes) -> None:
        """Send a message now, before all messages in the queue."""
        self._channels[channel_id].log(data, log_time=time_ns)

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Do nothing: viewers do not use metadata."""

    def add_channel(
        self, topic: str, schema_name: str, schema_text: str, metadata: dict[str, str] | None = None
    ) -> int:
        """Advertise a topic and return its channel id."""
        schema = Schema(len(self._channels) + 1, schema_text.encode(), "ros2msg", schema_name)
        self._channels.append(self._viewers.add_channel(topic, schema))
        channel_id = len(self._channels) - 1
        if topic in self._kept:
            self._kept_ids.add(channel_id)
        return channel_id

    def write_rows(self, rows: NDArray[Any]) -> None:
        """Queue message records of one channel, to be sent at their log_times."""
        self.write_messages(
            [
                (int(row["channel_id"]), int(row["log_time"]), row["payload"].tobytes())
                for row in rows
            ]
        )

    def write_messages(self, messages: Sequence[Message]) -> None:
        """Queue messages, to be sent at their log_times."""
        with self._lock:
            self._waiting.extend(messages)

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            self._send_due()

    def _send_due(self) -> None:
        now_ns = time.time_ns()
        if self._has_newcomers:
            self._has_newcomers = False
            for channel_id, data in self._latest.items():
                self.send(channel_id, now_ns, data)
        while self._waiting and self._waiting[0][1] <= now_ns:
            with self._lock:
                channel_id, time_ns, data = self._waiting.popleft()
            if channel_id in self._kept_ids:
                self._latest[channel_id] = data
            self.send(channel_id, time_ns, data)

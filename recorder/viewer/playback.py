"""Playback of logs with a clock that supports pause, speed and seek.

The indexes of the memory-mapped file locate messages, which are read on demand. Only a few
decompressed chunks are cached, so memory use does not grow with the log.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from mcaprl.recorder.format.reading import McapReader, MessageRange

_CHUNKS_KEPT = 24
_Messages = Iterator[tuple[int, Channel, bytes]]


class Played(NamedTuple):
    """A message that is due.

    Attributes:
        track: Index of the message's log in the player.
        channel_id: Channel id of the topic in the log.
        time_ns: Time of the message on the player's clock.
        data: Bytes of the message, as in the file.
    """

    track: int
    channel_id: int
    time_ns: int
    data: bytes


class Track:
    """Messages of one log, which are looked up by time.

    Attributes:
        reader: Reader of the log.
        start_ns: log_time of the first message to play.
        end_ns: log_time of the last message to play.
    """

    def __init__(
        self,
        reader: McapReader,
        window_ns: tuple[int, int] | None = None,
        *,
        topics: Collection[str] | None = None,
    ) -> None:
        """Read the message indexes.

        Args:
            reader: Reader of the log.
            window_ns: First and last log_time to play; default: all.
            topics: Topics to play; default: all.

        Raises:
            CorruptLogError: An index is damaged.
        """
        self.reader = reader
        self._topics = [
            _TopicIndex(reader, channel)
            for channel in reader.channels.values()
            if topics is None or channel.topic in topics
        ]
        self._topics = [topic for topic in self._topics if topic.ranges]
        self.start_ns, self.end_ns = window_ns or (
            min((topic.starts[0] for topic in self._topics), default=0),
            max((max(topic.ends) for topic in self._topics), default=0),
        )
        self._records = lru_cache(_CHUNKS_KEPT)(self._inflated)

    def between(self, start_ns: int, stop_ns: int) -> _Messages:
        """Yield time, channel and bytes of the messages in [start_ns, stop_ns), sorted by time."""
        start_ns, stop_ns = max(start_ns, self.start_ns), min(stop_ns, self.end_ns + 1)
        found = [place for topic in self._topics for place in topic.between(start_ns, stop_ns)]
        for place in sorted(found, key=lambda place: place.time_ns):
            yield place.time_ns, place.channel, self._message(place)

    def latest(self, time_ns: int) -> _Messages:
        """Yield the latest message of each topic up to a time.

        A viewer shows these messages at that time. Messages before `start_ns` are included.
        """
        for topic in self._topics:
            place = topic.latest(min(time_ns, self.end_ns))
            if place is not None:
                yield place.time_ns, place.channel, self._message(place)

    def _message(self, place: _Place) -> bytes:
        records = self._records(place.chunk_start)
        return self.reader.message(records, place.channel, place.time_ns, place.offset)

    def _inflated(self, chunk_start: int) -> memoryview:
        if chunk_start < 0:
            return self.reader.view
        chunk = next(c for c in self.reader.chunks if c.chunk_start_offset == chunk_start)
        return self.reader.chunk_records(chunk)


class _Place(NamedTuple):
    """Location of a message in the file; `chunk_start` is -1 if the message is not in a chunk."""

    time_ns: int
    channel: Channel
    chunk_start: int
    offset: int


class _TopicIndex:
    """Index of one channel's messages, which are sorted by time within each chunk."""

    def __init__(self, reader: McapReader, channel: Channel) -> None:
        self.channel = channel
        ranges = [_by_time(part) for part in reader.message_ranges(channel) if len(part)]
        self.ranges = sorted(ranges, key=lambda part: int(part.index["log_time"][0]))
        self.starts = [int(part.index["log_time"][0]) for part in self.ranges]
        self.ends = [int(part.index["log_time"][-1]) for part in self.ranges]

    def between(self, start_ns: int, stop_ns: int) -> Iterator[_Place]:
        for part, first_ns, last_ns in zip(self.ranges, self.starts, self.ends, strict=True):
            if first_ns < stop_ns and last_ns >= start_ns:
                low, high = _rows_before(part, start_ns), _rows_before(part, stop_ns)
                yield from (self._place(part, row) for row in range(low, high))

    def latest(self, time_ns: int) -> _Place | None:
        best: _Place | None = None
        for part, first_ns in zip(self.ranges, self.starts, strict=True):
            if first_ns > time_ns:
                break
            row = _rows_before(part, time_ns + 1) - 1
            if best is None or part.index["log_time"][row] >= best.time_ns:
                best = self._place(part, row)
        return best

    def _place(self, part: MessageRange, row: int) -> _Place:
        time_ns, offset = part.index[row].tolist()
        chunk_start = -1 if part.chunk is None else part.chunk.chunk_start_offset
        return _Place(time_ns, self.channel, chunk_start, offset)


def _rows_before(part: MessageRange, time_ns: int) -> int:
    # Use uint64, because NumPy compares uint64 times with signed integers as inexact floats.
    return int(np.searchsorted(part.index["log_time"], np.uint64(max(time_ns, 0))))


def _by_time(part: MessageRange) -> MessageRange:
    times: NDArray[np.uint64] = part.index["log_time"]
    if (times[1:] >= times[:-1]).all():
        return part
    return MessageRange.of_index(part.chunk, part.index[np.argsort(times, kind="stable")])


@dataclass
class Player:
    """Playback clock of one or more logs.

    The times of the logs are shifted, so that all logs start at the start time of the first log.

    Attributes:
        tracks: Logs to play.
        speed: Number of simulated seconds per second.
        loops: Whether to restart at the end.
        playing: Whether the clock runs.
    """

    tracks: Sequence[Track]
    speed: float = 1.0
    loops: bool = False
    playing: bool = False

    def __post_init__(self) -> None:
        """Set the clock to the start."""
        self.start_ns = self.tracks[0].start_ns
        self.shifts_ns = [self.start_ns - track.start_ns for track in self.tracks]
        self.end_ns = max(t.end_ns + s for t, s in zip(self.tracks, self.shifts_ns, strict=True))
        self.time_ns = self.start_ns
        # Time before which all messages have been played.
        self._next_ns = self.start_ns

    @property
    def ended(self) -> bool:
        """Whether the clock is at the end."""
        return self.time_ns >= self.end_ns

    def seek(self, time_ns: int) -> None:
        """Set the clock to a time; the time is clipped to the range of the logs."""
        self.time_ns = min(max(time_ns, self.start_ns), self.end_ns)
        self._next_ns = self.time_ns + 1

    def current_messages(self) -> list[Played]:
        """Return the latest message of each topic, to be sent to a new viewer."""
        return self._played(lambda track, shift: track.latest(self.time_ns - shift))

    def advance(self, elapsed_s: float) -> list[Played]:
        """Advance the clock and return the messages that are due, sorted by time."""
        if not self.playing:
            return []
        self.time_ns = min(self.time_ns + round(elapsed_s * self.speed * 1e9), self.end_ns)
        first_ns, self._next_ns = self._next_ns, self.time_ns + 1
        due = self._played(lambda log, shift: log.between(first_ns - shift, self._next_ns - shift))
        if self.ended and not self.loops:
            self.playing = False
        return sorted(due, key=lambda message: message.time_ns)

    def _played(self, found: Callable[[Track, int], _Messages]) -> list[Played]:
        """Return the messages that `found` yields for each log.

        Their times are those of the player's clock.
        """
        return [
            Played(number, channel.id, time_ns + shift, data)
            for number, (track, shift) in enumerate(zip(self.tracks, self.shifts_ns, strict=True))
            for time_ns, channel, data in found(track, shift)
        ]

"""Files for all combinations of MCAP's optional features, written from the specification.

The variants are those of MCAP's own conformance tests: six contents, each with all combinations of
features that apply to it, 416 files in total. Records are written byte by byte, so that they can be
padded: a reader must ignore extra bytes at the end of any record.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

MAGIC = b"\x89MCAP0\r\n"
# A reader that mistakes the padding for an index entry fails, because the padding is longer.
PADDING = b"\x01" + b"\xff" * 37
FEATURES = ("ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad")
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET = range(9, 15)
DATA_END = 15
SUMMARIZED = ("chx", "rsh", "rch", "mdx", "ax", "st")
"""Features with records in the summary section."""


class Message(NamedTuple):
    """Message of the only channel."""

    sequence: int
    log_time: int
    publish_time: int
    data: bytes


class Content(NamedTuple):
    """Contents of a file."""

    name: str
    messages: tuple[Message, ...] = ()
    has_schema: bool = True
    attachment: bytes | None = None
    metadata: dict[str, str] | None = None


CONTENTS = (
    Content("NoData"),
    Content("OneAttachment", attachment=b"\x01\x02\x03"),
    Content("OneMetadata", metadata={"foo": "bar"}),
    Content("OneMessage", (Message(10, 2, 1, b"\x01\x02\x03"),)),
    Content("OneSchemalessMessage", (Message(10, 2, 1, b"\x01\x02\x03"),), has_schema=False),
    Content("TenMessages", tuple(Message(k, k, k, bytes([k])) for k in range(10))),
)


def variants() -> Iterator[tuple[Content, frozenset[str]]]:
    """Yield each content with each set of features that applies to it."""
    for content in CONTENTS:
        for chosen in itertools.product((False, True), repeat=len(FEATURES)):
            features = frozenset(itertools.compress(FEATURES, chosen))
            if _makes_sense(content, features):
                yield content, features


def _makes_sense(content: Content, features: frozenset[str]) -> bool:
    if not content.messages and features & {"ch", "mx", "chx", "rsh", "rch"}:
        return False
    if features & {"mx", "chx"} and "ch" not in features:
        return False
    return not (
        ("rsh" in features and not content.has_schema)
        or ("ax" in features and content.attachment is None)
        or ("mdx" in features and content.metadata is None)
        or ("sum" in features and not features & set(SUMMARIZED))
    )


def build(content: Content, features: frozenset[str]) -> bytes:
    """Return the bytes of a file."""
    return _File(content, features).build()


class _File:
    def __init__(self, content: Content, features: frozenset[str]) -> None:
        self._content, self._features = content, features
        self._padding = PADDING if "pad" in features else b""
        self._out = bytearray(MAGIC)

    def build(self) -> bytes:
        content, features = self._content, self._features
        self._put(HEADER, _text("") + _text(""))
        indexes: dict[str, bytes] = {}
        if content.messages:
            indexes |= self._put_messages()
        if content.attachment is not None:
            offset, data = len(self._out), content.attachment
            body = struct.pack("<QQ", 2, 1) + _text("myFile") + _text("application/octet-stream")
            body += struct.pack("<Q", len(data)) + data + struct.pack("<I", 0)
            self._put(ATTACHMENT, body)
            place = struct.pack("<QQQQQ", offset, len(self._out) - offset, 2, 1, len(data))
            indexes["ax"] = place + _text("myFile") + _text("application/octet-stream")
        if content.metadata is not None:
            offset = len(self._out)
            self._put(METADATA, _text("myMetadata") + _map(content.metadata))
            place = struct.pack("<QQ", offset, len(self._out) - offset)
            indexes["mdx"] = place + _text("myMetadata")
        self._put(DATA_END, struct.pack("<I", 0))
        start = len(self._out)
        groups = self._put_summary(indexes)
        offsets = 0
        if "sum" in features:
            offsets = len(self._out)
            for opcode, first, length in groups:
                self._put(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, first, length))
        summary = start if groups else 0
        self._put(FOOTER, struct.pack("<QQI", summary, offsets, 0), padding=b"")
        return bytes(self._out + MAGIC)

    def _put_messages(self) -> dict[str, bytes]:
        """Write schema, channel and messages, with or without a chunk; return the chunk index."""
        content = self._content
        parts = [(SCHEMA, self._schema())] if content.has_schema else []
        parts.append((CHANNEL, self._channel()))
        if "ch" not in self._features:
            for opcode, body in parts:
                self._put(opcode, body)
            for message in content.messages:
                self._put(MESSAGE, _message(message), padding=b"")
            return {}
        records = bytearray()
        for opcode, body in parts:
            records += _record(opcode, body + self._padding)
        entries = []
        for message in content.messages:
            entries.append((message.log_time, len(records)))
            records += _record(MESSAGE, _message(message))
        times = [message.log_time for message in content.messages]
        body = struct.pack("<QQQI", min(times), max(times), len(records), 0)
        body += _text("") + struct.pack("<Q", len(records)) + records
        start = len(self._out)
        self._put(CHUNK, body)
        end = len(self._out)
        offsets = b""
        if "mx" in self._features:
            index = b"".join(struct.pack("<QQ", *entry) for entry in entries)
            offsets = struct.pack("<HQ", 1, end)
            self._put(MESSAGE_INDEX, struct.pack("<HI", 1, len(index)) + index)
        found = struct.pack("<QQQQ", min(times), max(times), start, end - start)
        found += struct.pack("<I", len(offsets)) + offsets
        found += struct.pack("<Q", len(self._out) - end) + _text("")
        return {"chx": found + struct.pack("<QQ", len(records), len(records))}

    def _put_summary(self, indexes: dict[str, bytes]) -> list[tuple[int, int, int]]:
        """Write the groups of the summary; return the opcode, start and length of each group."""
        found = {
            "rsh": (SCHEMA, self._schema()),
            "rch": (CHANNEL, self._channel()),
            "st": (STATISTICS, self._statistics()),
            "mdx": (METADATA_INDEX, indexes.get("mdx", b"")),
            "ax": (ATTACHMENT_INDEX, indexes.get("ax", b"")),
            "chx": (CHUNK_INDEX, indexes.get("chx", b"")),
        }
        groups = []
        for feature, (opcode, body) in found.items():
            if feature in self._features:
                start = len(self._out)
                self._put(opcode, body)
                groups.append((opcode, start, len(self._out) - start))
        return groups

    def _schema(self) -> bytes:
        return struct.pack("<H", 1) + _text("Example") + _text("c") + _block(b"\x04\x05\x06")

    def _channel(self) -> bytes:
        schema_id = 1 if self._content.has_schema else 0
        start = struct.pack("<HH", 1, schema_id) + _text("example") + _text("a")
        return start + _map({"foo": "bar"})

    def _statistics(self) -> bytes:
        content = self._content
        count = len(content.messages)
        times = [message.log_time for message in content.messages] or [0]
        body = struct.pack("<QHIIIIQQ", count, content.has_schema and count > 0, count > 0,
            content.attachment is not None, content.metadata is not None,
            "ch" in self._features, min(times), max(times))  # fmt: skip
        counts = struct.pack("<HQ", 1, count) if count else b""
        return body + struct.pack("<I", len(counts)) + counts

    def _put(self, opcode: int, body: bytes, padding: bytes | None = None) -> None:
        self._out += _record(opcode, body + (self._padding if padding is None else padding))


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _message(message: Message) -> bytes:
    head = (1, message.sequence, message.log_time, message.publish_time)
    return struct.pack("<HIQQ", *head) + message.data


def _text(text: str) -> bytes:
    return _block(text.encode())


def _block(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _map(pairs: dict[str, Any]) -> bytes:
    return _block(b"".join(_text(key) + _text(value) for key, value in pairs.items()))

"""Mutations of MCAP files: functions that accept the bytes of a file and a random generator."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Iterator

import zstandard
from mcap.opcode import Opcode

Mutation = Callable[[bytes, random.Random], bytes]
LENGTHS = (0, 1, 8, 2**16, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1)
BOMB = zstandard.compress(bytes(2**28))


def records_of(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Return offset, opcode and total length of each record of a valid file."""
    offset = 8
    while offset < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, offset)
        yield offset, opcode, 9 + length
        offset += 9 + length


def flipped(data: bytes, chance: random.Random) -> bytes:
    """Flip some bits."""
    spoilt = bytearray(data)
    for _ in range(chance.choice([1, 1, 1, 2, 8, 64])):
        spoilt[chance.randrange(len(spoilt))] ^= 1 << chance.randrange(8)
    return bytes(spoilt)


def overwritten(data: bytes, chance: random.Random) -> bytes:
    """Overwrite a range of bytes with noise or zeros."""
    start, length = chance.randrange(len(data)), chance.choice([1, 4, 100, 5000])
    noise = bytes(length) if chance.random() < 0.5 else chance.randbytes(length)
    return data[:start] + noise[: len(data) - start] + data[start + length :]


def cut(data: bytes, chance: random.Random) -> bytes:
    """Truncate the file."""
    return data[: chance.randrange(len(data))]


def spliced(data: bytes, chance: random.Random) -> bytes:
    """Remove or duplicate a range of bytes."""
    start, stop = sorted(chance.randrange(len(data)) for _ in range(2))
    if chance.random() < 0.5:
        return data[:start] + data[stop:]
    return data[:stop] + data[start:]


def wrong_length(data: bytes, chance: random.Random) -> bytes:
    """Write a wrong length over the length of a record, or over a part of its content."""
    start, _, length = chance.choice(list(records_of(data)))
    spoilt, claimed = bytearray(data), chance.choice(LENGTHS)
    place = start + chance.choice([1, 1, chance.randrange(1, max(2, min(length - 8, 60)))])
    if chance.random() < 0.5:
        spoilt[place : place + 8] = struct.pack("<Q", claimed)
    else:
        spoilt[place : place + 4] = struct.pack("<I", claimed % 2**32)
    return bytes(spoilt[: len(data)])


def bombed(data: bytes, chance: random.Random) -> bytes:
    """Replace the data of a chunk with small data that decompress to 256 MiB."""
    chunks = [record for record in records_of(data) if record[1] == Opcode.CHUNK]
    start, _, length = chance.choice(chunks)
    claimed = chance.choice([100, 2**20, 2**28 - 1, 2**28, 2**28 + 1, 2**40])
    content = struct.pack("<QQQII", 0, 2**63, claimed, 0, 4) + b"zstd"
    content += struct.pack("<Q", len(BOMB)) + BOMB
    bomb = struct.pack("<BQ", Opcode.CHUNK, len(content)) + content
    return data[:start] + bomb + data[start + length :]


def reordered(data: bytes, chance: random.Random) -> bytes:
    """Shuffle the records and remove the summary."""
    records = [record for record in records_of(data) if record[1] not in _SUMMARY_RECORDS]
    if chance.random() < 0.5:
        chance.shuffle(records)
    else:
        first, second = sorted(chance.randrange(len(records)) for _ in range(2))
        records[first], records[second] = records[second], records[first]
    return data[:8] + _joined(data, records)


def without_some(data: bytes, chance: random.Random) -> bytes:
    """Remove all records of one opcode: schemas, channels, the footer, ..."""
    kind = chance.choice(list(Opcode))
    return data[:8] + _joined(data, [r for r in records_of(data) if r[1] != kind]) + data[-8:]


def _joined(data: bytes, records: list[tuple[int, int, int]]) -> bytes:
    return b"".join(data[start : start + length] for start, _, length in records)


_SUMMARY_RECORDS = (
    Opcode.DATA_END,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
    Opcode.FOOTER,
)
MUTATIONS: tuple[Mutation, ...] = (
    flipped,
    overwritten,
    cut,
    spliced,
    wrong_length,
    bombed,
    reordered,
    without_some,
)

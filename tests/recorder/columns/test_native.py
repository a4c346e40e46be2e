"""The compiled copy of messages: bytes worked by hand, invalid arguments, and damaged messages."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import mcaprl
from mcaprl.errors import McaprlError
from mcaprl.recorder.columns import records
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import INDEX_ENTRY, MESSAGE_HEADER, message_record
from mcaprl.recorder.columns.topic import Topic
from tests.conftest import need
from tests.support.paths import FUZZ_CORPUS, GOLDEN

HEADER = MESSAGE_HEADER.itemsize
SIZE = HEADER + 12
CHANNEL = 7
HEAD = struct.pack("<BQH", 5, SIZE - 9, CHANNEL)
COUNT = 300
"""Number of messages, more than two blocks."""


def copy_fields(*arguments: Any) -> bool:
    need(records.copy_fields is not None, "the C extension was not built")
    return records.copy_fields(*arguments)


def message(k: int) -> bytes:
    """Return message k: a constant, a number, and an array of two bytes."""
    return message_record(CHANNEL, k, 1000 + k, struct.pack("<HdBB", 9, k / 4, k % 256, 255))


def messages(gap: int = 0) -> tuple[bytearray, NDArray[Any]]:
    """Return all messages and their index, with `gap` other bytes before each message."""
    records = bytearray(b"".join(b"\xee" * gap + message(k) for k in range(COUNT)))
    index = np.zeros(COUNT, INDEX_ENTRY)
    index["log_time"] = 1000 + np.arange(COUNT)
    index["offset"] = gap + np.arange(COUNT) * (SIZE + gap)
    return records, index


def columns() -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    return np.zeros(COUNT), np.zeros((COUNT, 2), np.uint8)


def copied(records: Any, index: NDArray[Any], size: int = SIZE) -> bool:
    numbers, pairs = columns()
    expected = [(0, HEAD), (HEADER, b"\x09\0")]
    return copy_fields(
        records, index, size, expected, [(HEADER + 2, numbers), (HEADER + 10, pairs)], 0
    )


@pytest.mark.parametrize("gap", [0, 5])
def test_fields_are_copied(gap: int) -> None:
    records, index = messages(gap)
    numbers, pairs = columns()
    targets = [(HEADER + 2, numbers), (HEADER + 10, pairs)]
    assert copy_fields(records, index, SIZE, [(0, HEAD), (HEADER, b"\x09\0")], targets, 0)
    assert numbers.tolist() == [k / 4 for k in range(COUNT)]
    assert pairs.tolist() == [[k % 256, 255] for k in range(COUNT)]


def test_messages_are_copied_to_the_rows_from_the_given_one() -> None:
    records, index = messages()
    numbers, pairs = np.full(COUNT, -1.0), np.zeros((COUNT, 2), np.uint8)
    assert copy_fields(records, index[5:8], SIZE, [], [(HEADER + 2, numbers)], 2)
    assert numbers[:6].tolist() == [-1, -1, 5 / 4, 6 / 4, 7 / 4, -1]
    assert copy_fields(records, index[:1], SIZE, [], [(HEADER + 10, pairs)], COUNT - 1)
    assert pairs[-2:].tolist() == [[0, 0], [0, 255]]
    for row in (1, COUNT, 2**62):
        with pytest.raises(ValueError, match="too few rows"):
            copy_fields(records, index, SIZE, [], [(HEADER + 2, numbers)], row)
    for row in (-1, 2**63 - 1):
        with pytest.raises(ValueError, match="the row is not valid"):
            copy_fields(records, index, SIZE, [], [], row)


@pytest.mark.parametrize("size", [*range(1, 40), 127, 128, 129, 1000])
def test_fields_of_any_size_are_copied(size: int) -> None:
    payloads = np.random.default_rng(size).integers(0, 256, (COUNT, 3 + size), np.uint8)
    records = b"".join(
        message_record(CHANNEL, k, k, row.tobytes()) for k, row in enumerate(payloads)
    )
    index, length = np.zeros(COUNT, INDEX_ENTRY), len(records) // COUNT
    index["log_time"], index["offset"] = np.arange(COUNT), np.arange(COUNT) * length
    fields = np.zeros((COUNT, size), np.uint8)
    assert copy_fields(records, index, length, [], [(HEADER + 3, fields)], 0)
    assert (fields == payloads[:, 3:]).all()
    # All bytes of one message are expected in another one, except one byte.
    expected = bytearray(payloads[7, 3:].tobytes())
    assert copy_fields(records, index[7:8], length, [(HEADER + 3, expected)], [], 0)
    for place in range(size):
        expected[place] ^= 0x80
        assert not copy_fields(records, index[7:8], length, [(HEADER + 3, expected)], [], 0)
        expected[place] ^= 0x80


@given(st.integers(0, COUNT - 1), st.sampled_from([*range(11), *range(15, 23), HEADER]))
def test_a_changed_byte_of_any_message_is_found(k: int, place: int) -> None:
    """The bytes are those of opcode, length, channel, log_time and the constant."""
    records, index = messages()
    records[k * SIZE + place] ^= 1
    assert not copied(records, index)


@pytest.mark.parametrize("offset", [COUNT * SIZE - SIZE + 1, COUNT * SIZE, 2**63, 2**64 - 1])
def test_an_offset_outside_of_the_chunk_is_found(offset: int) -> None:
    records, index = messages()
    index["offset"][COUNT - 1] = offset
    assert not copied(records, index)


def test_a_chunk_that_is_shorter_than_a_message_is_found() -> None:
    records, index = messages()
    assert not copied(records[: SIZE - 1], index)
    assert not copied(b"", index)


def test_fields_outside_of_the_record_are_refused() -> None:
    records, index = messages()
    numbers, pairs = columns()
    invalid: list[tuple[list[tuple[int, Any]], list[tuple[int, Any]]]] = [
        ([(-1, HEAD)], []),
        ([(SIZE - 10, HEAD)], []),
        ([(2**62, HEAD)], []),
        ([], [(-1, numbers)]),
        ([], [(SIZE - 7, numbers)]),
        ([], [(SIZE - 1, pairs)]),
    ]
    for expected, targets in invalid:
        with pytest.raises(ValueError, match="not within the record"):
            copy_fields(records, index, SIZE, expected, targets, 0)
    for few in (numbers[:-1], np.zeros(())):
        with pytest.raises(ValueError, match="too few rows"):
            copy_fields(records, index, SIZE, [], [(0, few)], 0)
    with pytest.raises(ValueError, match="no messages"):
        copy_fields(records, index[:0], SIZE, [], [], 0)
    with pytest.raises(ValueError, match="too short"):
        copy_fields(records, index, 22, [], [], 0)


def test_arguments_of_other_types_are_refused() -> None:
    records, index = messages()
    numbers, pairs = columns()
    numbers.flags.writeable = False
    with pytest.raises(ValueError, match="read-only"):
        copy_fields(records, index, SIZE, [], [(0, numbers)], 0)
    with pytest.raises(ValueError, match="contiguous"):
        copy_fields(records, index, SIZE, [], [(0, np.zeros((COUNT, 2))[:, 0])], 0)
    for expected in ((), [0], [(0, "text")], [("0", HEAD)]):
        with pytest.raises(TypeError):
            copy_fields(records, index, SIZE, expected, [(0, pairs)], 0)


@pytest.mark.parametrize(
    "path", [*sorted(GOLDEN.glob("*.mcap")), *sorted(FUZZ_CORPUS.iterdir())], ids=lambda p: p.name
)
def test_numpy_reads_the_same(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both read the same values, and report the same problems or the same error."""
    need(records.copy_fields is not None, "the C extension was not built")
    # The inputs of the fuzzer have other names.
    (tmp_path / "log.mcap").write_bytes(path.read_bytes())

    def read() -> list[str]:
        found = []
        try:
            found += [str(one) for one in mcaprl.check(tmp_path / "log.mcap").problems]
            reader = McapReader(tmp_path / "log.mcap")
            for name in sorted({channel.topic for channel in reader.channels.values()}):
                topic = Topic(reader, name)
                plain = [field for field, dtype in topic.fields.items() if dtype.kind != "O"]
                for wanted in (plain, list(topic.fields)):
                    found += [f"{k} {v.tolist()}" for k, v in topic.read(wanted).items()]
        except McaprlError as error:
            found.append(str(error))
        return found

    compiled = read()
    monkeypatch.setattr(records, "copy_fields", None)
    assert read() == compiled

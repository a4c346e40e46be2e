"""Files that are damaged or are not logs cause a clear error, and never return a wrong value."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import zstandard
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import Writer

import mcaprl
from mcaprl.errors import CorruptLogError, LogError, NoStepsError, NotMcapError
from mcaprl.recorder.columns.chunks import chunk_records
from mcaprl.recorder.columns.reader import McapReader, end_of
from mcaprl.recorder.columns.records import gather, message_rows
from mcaprl.recorder.format.schema import message_dtype
from mcaprl.recorder.repair.check import check_log
from tests.support.recordings import record

BOX = spaces.Box(-1, 1, (2,), np.float32)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("good") / "log.mcap"
    record(path, BOX, spaces.Discrete(2), [40, 50, 60])
    return path.read_bytes()


def test_a_file_that_is_not_mcap(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("hello")
    with pytest.raises(NotMcapError, match="is not an MCAP file"):
        mcaprl.open(path)
    path.write_text("")
    with pytest.raises(NotMcapError, match="it is empty"):
        mcaprl.open(path)


@pytest.mark.filterwarnings("ignore:.*was cut off or is still being written")
def test_empty_and_damaged_message_indexes(good: bytes, log_path: Path) -> None:
    """Some writers store an empty index for each channel that a chunk does not contain."""
    log_path.write_bytes(good)
    reader = McapReader(log_path)
    after_first, data_end = end_of(reader.chunks[0]), reader.data_end
    expected = mcaprl.open(log_path).fingerprint
    head = [struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6, channel, 0) for channel in (1, 2)]
    parts = [part for part in head if int.from_bytes(part[9:11], "little") not in _channels(reader)]
    assert parts
    log_path.write_bytes(good[:after_first] + b"".join(parts) + good[after_first:data_end])
    assert mcaprl.open(log_path).fingerprint == expected
    for record_, what in (
        (struct.pack("<BQB", Opcode.MESSAGE_INDEX, 1, 0), "message index at byte"),
        (_unchunked() + struct.pack("<BQB", Opcode.DATA_END, 1, 0), "does not match its CRC"),
    ):
        log_path.write_bytes(good[:after_first] + record_)
        with pytest.raises(CorruptLogError, match=what):
            mcaprl.open(log_path)
        assert check_log(log_path)


def _channels(reader: McapReader) -> set[int]:
    """Return the ids of the channels in the first chunk."""
    return set(reader.chunks[0].message_index_offsets)


def _unchunked() -> bytes:
    return struct.pack("<BQHIQQ", Opcode.MESSAGE, 22, 1, 0, 0, 0)


def test_mcap_without_steps(log_path: Path) -> None:
    writer = Writer(str(log_path))
    writer.start()
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
    writer.register_channel("/chatter", "cdr", schema)
    writer.finish()
    with pytest.raises(NoStepsError, match=r"no topic /rl/step.*\(topics: /chatter\)"):
        mcaprl.open(log_path)


def test_log_without_episodes(log_path: Path) -> None:
    record(log_path, BOX, spaces.Discrete(2), [])
    with pytest.raises(NoStepsError, match="no finished episode"):
        mcaprl.open(log_path)


def test_a_later_format_version_is_refused(log_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as later:
        later.setattr("mcaprl.recorder.format.metadata.FORMAT_VERSION", "2")
        record(log_path, BOX, spaces.Discrete(2), [2])
    with pytest.raises(LogError, match=r"format version 2; mcaprl .* reads 1"):
        mcaprl.open(log_path)


def test_good_log_has_no_problems(log_path: Path, good: bytes) -> None:
    log_path.write_bytes(good)
    assert check_log(log_path) == []


@settings(max_examples=300)
@given(data=st.data())
def test_a_flipped_bit_is_found(
    tmp_path_factory: pytest.TempPathFactory, good: bytes, data: st.DataObject
) -> None:
    """`check` reports each flipped bit. `open` returns the recorded data or raises our errors."""
    where = data.draw(st.integers(0, 8 * len(good) - 1))
    broken = bytearray(good)
    broken[where // 8] ^= 1 << where % 8
    path = tmp_path_factory.getbasetemp() / "flipped.mcap"
    path.write_bytes(broken)
    assert check_log(path), f"bit {where % 8} of byte {where // 8}"
    _reads_right_or_refuses(path, good)


@settings(max_examples=100)
@given(data=st.data())
def test_the_finished_episodes_of_a_cut_file_are_read(
    tmp_path_factory: pytest.TempPathFactory, good: bytes, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "cut.mcap"
    path.write_bytes(good[: data.draw(st.integers(1, len(good) - 1))])
    assert check_log(path)
    _reads_right_or_refuses(path, good)


def _reads_right_or_refuses(path: Path, good: bytes) -> None:
    whole = path.with_name("whole.mcap")
    whole.write_bytes(good)
    expected = mcaprl.open(whole)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = mcaprl.open(path)
    except mcaprl.McaprlError:
        return
    steps = len(found)
    assert found.observations.tobytes() == expected.observations[:steps].tobytes()
    assert found.rewards.tobytes() == expected.rewards[:steps].tobytes()
    assert found.actions.tobytes() == expected.actions[:steps].tobytes()


def test_a_decompression_bomb_is_refused() -> None:
    bomb = zstandard.compress(bytes(2**28))
    assert len(bomb) < 50_000
    chunk = _chunk(bomb, claimed=100)
    with pytest.raises(CorruptLogError, match=r"its header declares 100$"):
        chunk_records(memoryview(chunk), 0)
    with pytest.raises(CorruptLogError, match="the limit is"):
        chunk_records(memoryview(_chunk(bomb, claimed=2**40)), 0)


def _chunk(data: bytes, claimed: int) -> bytes:
    name = b"zstd"
    content = struct.pack("<QQQII", 0, 0, claimed, 0, len(name)) + name
    content += struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", Opcode.CHUNK, len(content)) + content


@pytest.mark.parametrize("offset", [2**62, 2**64 - 1, 10_000])
def test_index_outside_its_chunk(offset: int) -> None:
    dtype = message_dtype("float64 x\n")
    assert dtype is not None
    rows = message_rows(3, dtype, 1)
    index = np.array([(0, 0), (0, offset)], [("log_time", "<u8"), ("offset", "<u8")])
    with pytest.raises(CorruptLogError, match="outside its chunk"):
        gather(memoryview(rows.tobytes()), index, rows.dtype)


@settings(max_examples=50)
@given(st.permutations(range(12)), st.integers(0, 5))
def test_gather_of_any_order(order: list[int], gap: int) -> None:
    """Gather messages in any order, with and without other bytes between them."""
    dtype = message_dtype("uint32 x\n")
    assert dtype is not None
    rows = message_rows(12, dtype, 1)
    rows["payload"]["x"] = np.arange(12)
    chunk = b"".join(b"\xff" * gap + row.tobytes() for row in rows)
    offsets = [gap + number * (rows.itemsize + gap) for number in order]
    index = np.array([(0, o) for o in offsets], [("log_time", "<u8"), ("offset", "<u8")])
    assert gather(memoryview(chunk), index, rows.dtype)["payload"]["x"].tolist() == list(order)


def test_duplicate_channels_are_refused(log_path: Path) -> None:
    writer = Writer(str(log_path))
    writer.start("ros2")
    schema = writer.register_schema("a/msg/B", "ros2msg", b"float64 x\n")
    for _ in range(2):
        writer.register_channel("/rl/step", "cdr", schema)
    writer.finish()
    with pytest.raises(LogError, match="2 channels"):
        McapReader(log_path).channel_of("/rl/step")

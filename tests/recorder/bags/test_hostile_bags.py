"""Bags with metadata, databases, compressed files and messages that nobody's recorder writes."""

from __future__ import annotations

import bz2
import os
import random
import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard

from mcaprl.errors import LogError, McaprlError
from mcaprl.recorder.bags import files
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.decoders import decoder_of
from mcaprl.recorder.bags.files import read_metadata
from tests.recorder.bags.test_definition_files import write_database
from tests.recorder.bags.test_protobuf import STATE, message_class, schema_of
from tests.support.bags import (
    STEPS,
    STORE2,
    messages,
    numbers,
    speed,
    write_channels,
    write_rosbag1,
    write_rosbag2,
)

ROOT = "rosbag2_bagfile_information"
BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 9)}]\n"
    for before, name in zip("abcdefghi", "bcdefghij", strict=True)
)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (f"{ROOT}: {{relative_file_paths: 5}}", "relative_file_paths is not a list"),
        (f"{ROOT}: {{relative_file_paths: [[a]], ros_distro: [a]}}", "ros_distro is not a text"),
        (f"{ROOT}: {{compression_mode: {{a: b}}}}", "compression_mode is not a text"),
        (f"{BOMB}{ROOT}: {{ros_distro: *j}}", "aliases are not supported"),
        (f"{BOMB}{ROOT}: {{relative_file_paths: *j}}", "aliases are not supported"),
        (f"{ROOT}: {'[' * 100_000}", "nested in more than 20 levels"),
        (f"{ROOT}: {'{a: ' * 100_000}", "nested in more than 20 levels"),
        (f"{ROOT}: {'- ' * 100_000}", "not the metadata"),
        (f"{ROOT}: {{[a]: b}}", "a key is not a text"),
        ("[]", f"it has no {ROOT}"),
        ("", f"it has no {ROOT}"),
        (f"{ROOT}: 'open", "not the metadata"),
        ("#" * (2**21 + 1), "it has more than 2097152 bytes"),
        ("\0", "not the metadata"),
    ],
)
def test_wrong_metadata_is_one_error(text: str, reason: str, tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path / "bag")
    (folder / "metadata.yaml").write_text(text)
    with pytest.raises(LogError, match=reason):
        open_bag(folder)


def test_values_of_metadata_are_texts(tmp_path: Path) -> None:
    path = tmp_path / "metadata.yaml"
    path.write_text(
        f"{ROOT}:\n  version: 2024-13-45\n  files: [{{path: a}}]\n  relative_file_paths:\n"
        "    - a.mcap\n    - !!int abc\n  ros_distro: humble\n  compression_mode: ''\n"
        "other: {a: 1}\n"
    )
    assert read_metadata(path) == {
        "relative_file_paths": ["a.mcap", "abc"],
        "ros_distro": "humble",
        "compression_mode": "",
    }
    path.write_bytes(b"\xff")
    with pytest.raises(LogError, match="not the metadata"):
        read_metadata(path)


def edited(path: Path, *statements: str) -> Path:
    """Write a database with the topics /a and /b of one Float64 each, and edit it."""
    rows = [(f"/{name}", "std_msgs/msg/Float64", [struct.pack("<d", 1.5)]) for name in "ab"]
    write_database(path, rows)
    with closing(sqlite3.connect(path)) as file:
        for statement in statements:
            file.execute(statement)
        file.commit()
    return path


DEFINITIONS = (
    "CREATE TABLE message_definitions(topic_type TEXT, encoding TEXT,"
    " encoded_message_definition TEXT)"
)


@pytest.mark.parametrize(
    ("statements", "names", "bad"),
    [
        (["UPDATE messages SET data = 5 WHERE topic_id = 1"], "/a /b", "cannot decode 0 bytes"),
        (["UPDATE messages SET data = NULL WHERE topic_id = 1"], "/a /b", "cannot decode 0 bytes"),
        (["UPDATE messages SET timestamp = 'x' WHERE topic_id = 1"], "/a /b", "not an integer"),
        (["UPDATE messages SET timestamp = 1e300 WHERE topic_id = 1"], "/a /b", "not an integer"),
        (["UPDATE topics SET name = x'ff41' WHERE id = 1"], "\ufffdA /b", ""),
        (["UPDATE topics SET type = x'ff41' WHERE id = 1"], "/a /b", "its definition is missing"),
        (["UPDATE topics SET serialization_format = 7 WHERE id = 1"], "/a /b", "encoding '7'"),
        (
            [DEFINITIONS, "INSERT INTO message_definitions VALUES('std_msgs/msg/Float64',"
             " 'unknown', '')"], "/a /b", "",
        ),
        (
            ["UPDATE topics SET type = 'p/msg/P' WHERE id = 1", DEFINITIONS,
             "INSERT INTO message_definitions VALUES('p/msg/P', 'unknown', x'ff')"],
            "/a /b", "its definition is missing",
        ),
        (
            ["UPDATE topics SET type = 'p/msg/P' WHERE id = 1", DEFINITIONS,
             "INSERT INTO message_definitions VALUES('p/msg/P', 'ros2msg', x'ff')"],
            "/a /b", "does not parse",
        ),
    ],
)  # fmt: skip
def test_odd_values_in_a_database_cost_only_their_topic(
    statements: list[str], names: str, bad: str, tmp_path: Path
) -> None:
    with closing(open_bag(edited(tmp_path / "odd #1?.db3", *statements))) as bag:
        assert set(bag.topics) == set(names.split())
        assert bag.read("/b", ["data"]).columns["data"].tolist() == [1.5]
        first = names.split()[0]
        if not bad:
            assert bag.read(first, ["data"]).columns["data"].tolist() == [1.5]
            return
        with pytest.raises(LogError, match=rf"{first}.* {bad}"):
            bag.read(first, ["data"])


@pytest.mark.parametrize(
    "statements",
    [
        ["DROP TABLE topics"],
        [
            "DROP TABLE messages",
            "CREATE VIEW messages AS WITH RECURSIVE r(id) AS (SELECT 1 UNION ALL SELECT id FROM r)"
            " SELECT id, 1 AS topic_id, 1 AS timestamp, x'00' AS data FROM r",
        ],
        ["ALTER TABLE topics RENAME COLUMN type TO kind"],
    ],
)
def test_databases_of_other_forms_are_refused(statements: list[str], tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be read as a bag"):
        open_bag(edited(tmp_path / "a.db3", *statements))


def test_compressed_files_are_decompressed_within_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = write_channels(tmp_path / "a.mcap", [numbers("/x", [(0, 1), (1, 2)])])
    data = plain.read_bytes()
    packed = tmp_path / "b.mcap.zstd"
    one = zstandard.ZstdCompressor().compress(data)
    stream = zstandard.ZstdCompressor().compressobj()
    # The size is in the first frame, in none, or the file has two frames.
    halves = [zstandard.ZstdCompressor().compress(part) for part in (data[:200], data[200:])]
    forms = (one, stream.compress(data) + stream.flush(), b"".join(halves))
    for form in forms:
        packed.write_bytes(form)
        with closing(open_bag(packed)) as bag:
            assert bag.read("/x", ["data"]).columns["data"].tolist() == [1, 2]
    monkeypatch.setattr(files, "MAX_UNPACKED_BYTES", len(data) - 1)
    monkeypatch.setattr(files, "MAX_UNPACKED_RATIO", 1)
    for form in forms:
        packed.write_bytes(form)
        with pytest.raises(LogError, match=r"b.mcap.zstd has more than \d+ bytes when it is decom"):
            open_bag(packed)
    monkeypatch.setattr(files, "MAX_UNPACKED_RATIO", 100)
    monkeypatch.setattr(files, "_FREE_SHARE", 0)
    with pytest.raises(LogError, match="is larger than 0 bytes when it is decompressed"):
        open_bag(packed)
    packed.write_bytes(b"not zstd")
    with pytest.raises(LogError, match=r"b.mcap.zstd cannot be decompressed"):
        open_bag(packed)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_messages_that_are_compressed_one_by_one(
    storage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_rosbag2(tmp_path / "bag", storage, "MESSAGE")
    with closing(open_bag(folder)) as bag:
        found = bag.read("/odom", ["twist.twist.linear.x"]).columns["twist.twist.linear.x"]
        assert found.tolist() == [speed(k) for k in range(STEPS)]
    monkeypatch.setattr(files, "MAX_CHUNK_BYTES", 100)
    with closing(open_bag(folder)) as bag, pytest.raises(LogError, match="more than 100 bytes"):
        bag.read("/odom", ["twist.twist.linear.x"])


def chunked(path: Path, compression: str, data: bytes, declared: int) -> Path:
    """Compress the only chunk of a ROS 1 bag, and declare a size of it."""
    raw = write_rosbag1(path).read_bytes()

    def record(head: dict[str, bytes], body: bytes) -> bytes:
        fields = b"".join(
            struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value
            for name, value in head.items()
        )
        return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(body)) + body

    start = raw.index(b"op=\x05")
    begin = raw.rindex(struct.pack("<I", 4), 0, start)
    # The header of a chunk has the fields compression, op and size, in any order.
    head = raw.index(b"compression=none")
    begin = min(begin, head - 4) - 4
    (length,) = struct.unpack_from("<I", raw, begin)
    (size,) = struct.unpack_from("<I", raw, begin + 4 + length)
    end = begin + 8 + length + size
    body = raw[end - size : end]
    pack = bz2.compress if compression == "bz2" else lz4.frame.compress
    new = record(
        {
            "compression": compression.encode(),
            "op": b"\x05",
            "size": struct.pack("<I", declared if declared else len(body)),
        },
        pack(data or body),
    )
    shift = len(new) - (end - begin)
    index = raw.index(b"index_pos=") + len(b"index_pos=")
    (old,) = struct.unpack_from("<Q", raw, index)
    moved = raw[:index] + struct.pack("<Q", old + shift) + raw[index + 8 :]
    path.write_bytes(moved[:begin] + new + moved[end:])
    return path


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_chunks_of_ros1_bags_have_the_declared_size(compression: str, tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    with closing(open_bag(chunked(path, compression, b"", 0))) as bag:
        found = bag.read("/odom", ["twist.twist.linear.x"]).columns["twist.twist.linear.x"]
        assert found.tolist() == [speed(k) for k in range(STEPS)]
    for data, declared, reason in (
        (bytes(10**7), 1000, "declares 1000 bytes, but has more than 1000"),
        (bytes(1000), 2000, "declares 2000 bytes, but has 1000"),
        (bytes(1000), 2**32 - 1, "declares 4294967295 bytes; the limit is 268435456"),
    ):
        path.unlink()
        with (
            closing(open_bag(chunked(path, compression, data, declared))) as bag,
            pytest.raises(LogError, match=rf"a.bag: messages of /odom .*{reason}"),
        ):
            bag.read("/odom", ["twist.twist.linear.x"])


def decoders() -> dict[str, tuple[Any, bytes]]:
    """Return a decoder and a valid message of each encoding."""
    every = {topic: message for topic, _, message in messages(STORE2)}
    found = {}
    for topic in ("/odom", "/tf", "/joints"):
        kind = every[topic].__msgtype__
        data = bytes(STORE2.serialize_cdr(every[topic], kind))
        found[topic] = (decoder_of("cdr", kind, "ros2msg", b""), data)
    state = message_class("demo.State", STATE)(maybe=1, motors=[{"q": 1}], wrapped={"value": 2})
    proto = decoder_of("protobuf", "demo.State", "protobuf", schema_of(STATE))
    wide = decoder_of("cdr", "p/msg/W", "ros2msg", b"float64[] x\nstring s\nwstring w\n")
    return {
        **found,
        "protobuf": (proto, state.SerializeToString()),
        "wide": (wide, b"\0\1\0\0\1\0\0\0" + bytes(12) + b"\2\0\0\0a\0"),
        "json": (decoder_of("json", "", "", b""), b'{"a": {"b": [1, "x", null, 2.5e3]}}'),
        "ros1": (decoder_of("ros1", "geometry_msgs/msg/Pose", "ros1msg", b""), bytes(56)),
    }


def mutated(data: bytes, chance: random.Random) -> bytes:
    found = bytearray(data)
    for _ in range(chance.randrange(4)):
        found[chance.randrange(len(found))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF, 34, 91))
    kind = chance.randrange(4)
    if kind == 0:
        return bytes(found[: chance.randrange(len(found) + 1)])
    if kind == 1:
        place = chance.randrange(len(found))
        return bytes(found[:place] + chance.randbytes(chance.randrange(9)) + found[place:])
    return bytes(found) if kind == 2 else chance.randbytes(chance.randrange(200))


def test_damaged_messages_are_decoded_or_refused() -> None:
    chance = random.Random(1)
    for decoder, data in decoders().values():
        decoder.decode(data)
        for _ in range(400):
            try:
                decoder.decode(mutated(data, chance))
            except McaprlError:
                continue


SCHEMAS = {
    ("cdr", "ros2msg"): b"float64 x\np/B[2] b\nstring<=5 s \"a\"\n"
    + b"=" * 80 + b"\nMSG: p/B\nint8 X=3\n",
    ("cdr", "ros2idl"): b"#ifndef A\nmodule p { module msg { struct A {"
    b" sequence<double, 3> x; }; }; };\n#endif",
    ("ros1", "ros1msg"): b"Header header\ntime t\nfloat64[] x",
    ("protobuf", "protobuf"): schema_of(STATE),
    ("json", "jsonschema"): b'{"properties": {"x": {"$ref": "#/$defs/A"}},'
    b' "$defs": {"A": {"type": "number"}}}',
}  # fmt: skip


@pytest.mark.parametrize("encoding", SCHEMAS)
def test_damaged_definitions_are_read_or_refused(encoding: tuple[str, str]) -> None:
    chance = random.Random(2)
    kind = "demo.State" if encoding[0] == "protobuf" else "p/msg/A"
    for _ in range(120):
        data = mutated(SCHEMAS[encoding], chance)
        try:
            decoder = decoder_of(encoding[0], kind, encoding[1], data)
            decoder.decode(chance.randbytes(30))
        except McaprlError:
            continue


def test_pipes_are_refused(tmp_path: Path) -> None:
    for name in ("a.mcap", "a.db3", "a.bag", "a.mcap.zstd"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(LogError, match=f"{name}: it is not a regular file"):
            open_bag(tmp_path / name)


def test_a_damaged_compressed_message_costs_one_message(tmp_path: Path) -> None:
    bag = write_rosbag2(tmp_path / "bag", "sqlite3", "MESSAGE")
    (path,) = bag.glob("*.db3")
    with closing(sqlite3.connect(path)) as database:
        database.execute(
            "UPDATE messages SET data = x'28b52ffd00' WHERE id ="
            " (SELECT id FROM messages WHERE topic_id ="
            " (SELECT id FROM topics WHERE name = '/odom') ORDER BY id LIMIT 1 OFFSET 3)"
        )
        database.commit()
    # A part that is given without its folder has the metadata of the folder, too.
    for data in (bag, path):
        with closing(open_bag(data)) as found:
            stream = found.read("/odom", ["twist.twist.linear.x"])
            assert stream.rows.tolist() == [0, 1, 2, *range(4, STEPS)]
            assert [each.row for each in stream.failures] == [3]
            assert [each.row for each in found.failures("/odom")] == [3]
            assert "cannot be decompressed" in stream.failures[0].reason

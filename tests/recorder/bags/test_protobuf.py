"""Protobuf messages: fields that are not set, imports in any order, maps, and large types."""

from __future__ import annotations

import importlib
import itertools
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from mcaprl.errors import LogError
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.decoders import value_at
from mcaprl.recorder.bags.protobuf import ProtobufDecoder
from mcaprl.recorder.mapping.read import read_bag
from tests.support.bags import START_NS

descriptor_pb2, descriptor_pool, message_factory, wrappers_pb2 = (
    importlib.import_module(f"google.protobuf.{name}")
    for name in ("descriptor_pb2", "descriptor_pool", "message_factory", "wrappers_pb2")
)
Field: Any = descriptor_pb2.FieldDescriptorProto
DOUBLE, INT, STRING, MESSAGE = Field.TYPE_DOUBLE, Field.TYPE_INT32, Field.TYPE_STRING, 11
WRAPPERS, TIMESTAMP = "google/protobuf/wrappers.proto", "google/protobuf/timestamp.proto"


def field(name: str, number: int, kind: Any, **others: Any) -> Any:
    if isinstance(kind, str):
        return Field(name=name, number=number, type=MESSAGE, type_name=kind, **others)
    return Field(name=name, number=number, type=kind, **others)


def message(name: str, *fields: Any, **others: Any) -> Any:
    return descriptor_pb2.DescriptorProto(name=name, field=fields, **others)


def file(name: str, *messages: Any, imports: tuple[str, ...] = (), **others: Any) -> Any:
    others.setdefault("syntax", "proto3")
    return descriptor_pb2.FileDescriptorProto(
        name=name, package="demo", message_type=messages, dependency=imports, **others
    )


def schema_of(*files: Any) -> bytes:
    return bytes(descriptor_pb2.FileDescriptorSet(file=files).SerializeToString())


def message_class(kind: str, *files: Any) -> Any:
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(wrappers_pb2.DESCRIPTOR.serialized_pb)
    for each in files:
        pool.Add(each)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(kind))


STATE = file(
    "state.proto",
    message("Motor", field("q", 1, DOUBLE), field("t", 2, INT, proto3_optional=True, oneof_index=0),
            oneof_decl=[{"name": "_t"}]),
    message(
        "State",
        field("plain", 1, DOUBLE),
        field("maybe", 2, DOUBLE, proto3_optional=True, oneof_index=1),
        field("left", 3, DOUBLE, oneof_index=0),
        field("right", 4, DOUBLE, oneof_index=0),
        field("wrapped", 5, ".google.protobuf.DoubleValue"),
        field("motor", 6, ".demo.Motor"),
        field("motors", 7, ".demo.Motor", label=Field.LABEL_REPEATED),
        oneof_decl=[{"name": "side"}, {"name": "_maybe"}],
    ),
    imports=(WRAPPERS,),
)  # fmt: skip
PATHS = ("plain", "maybe", "left", "right", "wrapped", "wrapped.value", "motor.q", "motor.t")


def test_fields_that_are_not_set_are_missing() -> None:
    state = message_class("demo.State", STATE)
    decoder = ProtobufDecoder("demo.State", schema_of(STATE))
    empty = decoder.decode(b"")
    # A field of proto3 without presence is 0, but only in a message that is set.
    assert [value_at(empty, path) for path in PATHS] == [0, *[None] * 7]
    zeros = state(plain=0, maybe=0, right=0, wrapped={"value": 0}, motor={})
    found = decoder.decode(zeros.SerializeToString())
    assert [value_at(found, path) for path in PATHS] == [0, 0, None, 0, 0, 0, 0, None]
    full = state(plain=1, maybe=2, left=3, wrapped={"value": 4}, motor={"q": 5, "t": 6})
    found = decoder.decode(full.SerializeToString())
    assert [value_at(found, path) for path in PATHS] == [1, 2, 3, None, 4, 4, 5, 6]
    found = decoder.decode(state(motors=[{"q": 1}, {"q": 2, "t": 3}]).SerializeToString())
    assert [(each.q, each.t) for each in found.motors] == [(1, None), (2, 3)]


@pytest.mark.parametrize("syntax", ["proto2", "editions"])
def test_fields_of_proto2_and_editions_have_presence(syntax: str) -> None:
    more = {"edition": descriptor_pb2.EDITION_2023} if syntax == "editions" else {}
    old = file(
        "old.proto",
        message("Old", field("x", 1, DOUBLE, label=1), field("n", 2, INT, label=1)),
        syntax=syntax,
        **more,
    )
    decoder = ProtobufDecoder("demo.Old", schema_of(old))
    found = decoder.decode(message_class("demo.Old", old)(n=0).SerializeToString())
    assert (value_at(found, "x"), value_at(found, "n")) == (None, 0)


def test_missing_values_of_a_mapping_replace_fields_that_are_not_set(tmp_path: Path) -> None:
    state = message_class("demo.State", STATE)
    rows: list[Any] = [
        {"maybe": 5.0, "motor": {"q": 7.0}},
        {},
        {"wrapped": {"value": 0.0}},
        {"motor": {}},
    ]
    path = write(tmp_path / "p.mcap", "demo.State", schema_of(STATE), [state(**r) for r in rows])
    names = {"maybe": "maybe", "wrapped": "wrapped.value", "motor": "motor.q"}
    mapping = {
        "clock": {"topic": "/s"},
        "observation": {
            name: {"field": f"/s.{field}", "missing": -1} for name, field in names.items()
        },
        "action": {"fields": ["/s.plain"], "edges": [[0.5]]},
        "reward": "maybe + motor",
    }
    data = read_bag(path, mapping).dataset
    assert data.observations.tolist() == [[5, -1, 7], [-1, -1, -1], [-1, 0, -1]]
    assert data.rewards.tolist() == [12, -2, -2]


def write(path: Path, kind: str, schema: bytes, messages: list[Any]) -> Path:
    with path.open("wb") as opened:
        writer = Writer(opened)
        writer.start()
        number = writer.register_schema(kind, "protobuf", schema)
        channel = writer.register_channel("/s", "protobuf", number)
        for k, each in enumerate(messages):
            time_ns = START_NS + k * 10**8
            writer.add_message(channel, time_ns, each.SerializeToString(), time_ns)
        writer.finish()
    return path


def test_files_in_any_order_and_without_well_known_imports() -> None:
    point = file("point.proto", message("Point", field("x", 1, DOUBLE)))
    pose = file(
        "pose.proto",
        message(
            "Pose", field("at", 1, ".demo.Point"), field("time", 2, ".google.protobuf.Timestamp")
        ),
        # Only options use the last file, which is missing.
        imports=("point.proto", TIMESTAMP, "rules.proto"),
    )
    for files in ((pose, point), (point, pose), (pose, point, point)):
        decoder = ProtobufDecoder(".demo.Pose", schema_of(*files))
        assert decoder.fields == {"at.x": "float64", "time": "time"}
    with pytest.raises(LogError, match=r"schema of demo\.Pose cannot be used"):
        ProtobufDecoder("demo.Pose", schema_of(pose))
    other = file("point.proto", message("Point", field("y", 1, DOUBLE)))
    with pytest.raises(LogError, match=r"two versions of point\.proto"):
        ProtobufDecoder("demo.Pose", schema_of(pose, point, other))
    one = file("one.proto", message("One"), imports=("two.proto",))
    two = file("two.proto", message("Two"), imports=("one.proto",))
    with pytest.raises(LogError, match="its files import each other"):
        ProtobufDecoder("demo.One", schema_of(one, two))


def test_fields_of_arrays_and_maps() -> None:
    entry = message(
        "MotorsEntry", field("key", 1, STRING), field("value", 2, ".demo.Motor"),
        options={"map_entry": True},
    )  # fmt: skip
    robot = file(
        "robot.proto",
        message("Motor", field("q", 1, DOUBLE), field("all", 2, DOUBLE, label=3)),
        message(
            "Robot",
            field("legs", 1, ".demo.Motor", label=3),
            field("motors", 2, ".demo.Robot.MotorsEntry", label=3),
            nested_type=[entry],
        ),
    )
    decoder = ProtobufDecoder("demo.Robot", schema_of(robot))
    assert decoder.fields == {
        "legs": "demo.Motor[]",
        "legs[].q": "float64[]",
        "legs[].all": "float64[][]",
        "motors": "demo.Robot.MotorsEntry[]",
        "motors[].key": "string[]",
        "motors[].value.q": "float64[]",
        "motors[].value.all": "float64[][]",
    }
    data = message_class("demo.Robot", robot)()
    for name, q in (("z", 1.0), ("a", 2.0), ("k", 3.0)):
        data.motors[name].q = q
    found = decoder.decode(data.SerializeToString()).motors
    # The order of a map has no meaning: entries are in the order of their keys.
    assert [(each.key, each.value.q) for each in found] == [("a", 2.0), ("k", 3.0), ("z", 1.0)]


def test_enum_names_with_several_values_are_left_out() -> None:
    def enum(name: str, **values: int) -> Any:
        every = [{"name": key, "number": value} for key, value in values.items()]
        return {"name": name, "value": every}

    parts = [
        message("A", field("e", 1, DOUBLE), enum_type=[enum("E", OFF=0, ON=1)]),
        message("B", field("e", 1, DOUBLE), enum_type=[enum("E", OFF=0, ON=2)]),
    ]
    for part in parts:
        part.field[0].type, part.field[0].type_name = 14, f".demo.{part.name}.E"
    both = message("Both", field("a", 1, ".demo.A"), field("b", 2, ".demo.B"))
    decoder = ProtobufDecoder("demo.Both", schema_of(file("e.proto", *parts, both)))
    assert decoder.constants == {"OFF": 0}


def test_types_with_too_many_fields_are_refused_quickly() -> None:
    names = [f"T{k}" for k in range(41)]
    parts = [
        message(name, field("a", 1, f".demo.{after}"), field("b", 2, f".demo.{after}"))
        for name, after in itertools.pairwise(names)
    ]
    fan = file("fan.proto", *parts, message("T40", field("x", 1, DOUBLE)))
    with pytest.raises(LogError, match="T0 has more than 10000 fields"):
        ProtobufDecoder("demo.T0", schema_of(fan))
    mutual = [
        message(f"M{k}", *(field(f"m{j}", j + 1, f".demo.M{j}") for j in range(12)))
        for k in range(12)
    ]
    with pytest.raises(LogError, match="M0 has more than 10000 fields"):
        ProtobufDecoder("demo.M0", schema_of(file("mutual.proto", *mutual)))
    names = [f"D{k}" for k in range(90)]
    parts = [
        message(name, field("a", 1, f".demo.{after}")) for name, after in itertools.pairwise(names)
    ]
    deep = file("deep.proto", *parts, message("D89", field("x", 1, DOUBLE)))
    with pytest.raises(LogError, match="D0: messages are nested in more than 64 levels"):
        ProtobufDecoder("demo.D0", schema_of(deep))
    tree = message("Node", field("x", 1, DOUBLE), field("next", 2, ".demo.Node"))
    decoder = ProtobufDecoder("demo.Node", schema_of(file("tree.proto", tree)))
    # A type may contain itself; the fields of its inner messages are not listed.
    assert decoder.fields == {"x": "float64", "next.x": "float64"}


def test_times_beyond_64_bits_are_missing(tmp_path: Path) -> None:
    stamped = file(
        "s.proto",
        message("S", field("time", 1, ".google.protobuf.Timestamp"), field("x", 2, DOUBLE)),
        imports=(TIMESTAMP,),
    )
    # Field 1 has 2^62 seconds as a varint of 9 bytes; field 2 is 1.0.
    seconds = b"\x08" + b"\x80" * 8 + b"\x40"
    data = b"\x0a" + bytes([len(seconds)]) + seconds + b"\x11" + np.float64(1).tobytes()
    decoder = ProtobufDecoder("demo.S", schema_of(stamped))
    assert not isinstance(value_at(decoder.decode(data), "time"), int)

    class Raw:
        SerializeToString = staticmethod(lambda: data)

    path = write(tmp_path / "s.mcap", "demo.S", schema_of(stamped), [Raw])
    with closing(open_bag(path)) as bag:
        found = bag.read("/s", ["x", "time"]).columns
        assert found["x"].tolist() == [1.0]
        assert len(found["time"]) == 1

"""JSON messages and schemas: references, alternatives, unlisted fields, and deep nesting."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer
from pydantic import BaseModel

from mcaprl.errors import LogError
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.decoders import JsonDecoder
from mcaprl.recorder.mapping.align import field_path
from tests.support.bags import START_NS

NUMBER = {"type": "number"}


def fields_of(schema: Any) -> dict[str, str]:
    return JsonDecoder(json.dumps(schema).encode()).fields


class Point(BaseModel):
    x: float
    label: str | None = None


class Robot(BaseModel):
    at: Point
    goal: Point | None = None
    path: list[Point] = []
    speeds: list[float] = []
    grid: list[list[int]] = []
    mode: int | None = None
    child: Robot | None = None


def test_schemas_of_pydantic() -> None:
    fields = fields_of(Robot.model_json_schema())
    assert {path: kind for path, kind in fields.items() if not path.startswith("child")} == {
        "at.x": "float64",
        "at.label": "string",
        "goal.x": "float64",
        "goal.label": "string",
        "path": "object[]",
        "path[].x": "float64[]",
        "path[].label": "string[]",
        "speeds": "float64[]",
        "grid": "int64[][]",
        "mode": "int64",
    }


@pytest.mark.parametrize(
    ("schema", "fields"),
    [
        ({"$ref": "#/definitions/A", "definitions": {"A": {"properties": {"x": NUMBER}}}}, "x"),
        ({"properties": {"a": {"$ref": "#/b~1c/%7E0/0"}}, "b/c": {"~": [NUMBER]}}, ""),
        ({"allOf": [{"properties": {"x": NUMBER}}, {"properties": {"y": NUMBER}}]}, "x y"),
        ({"properties": {"x": {"type": ["null", "number"]}}}, "x"),
        ({"properties": {"x": {"oneOf": [NUMBER, {"type": "null"}]}}}, "x"),
        ({"$id": "urn:a", "$defs": {"N": NUMBER}, "properties": {"x": {"$ref": "urn:a#/$defs/N"}}},
         "x"),
    ],
)  # fmt: skip
def test_references_and_alternatives(schema: Any, fields: str) -> None:
    expected = dict.fromkeys(fields.split(), "float64")
    if not fields:
        # `%7E0` is `~0`, which is `~`.
        expected = {"a": "float64"}
    assert fields_of(schema) == expected


def test_schemas_that_contain_themselves_or_are_wrong() -> None:
    assert fields_of({"$ref": "#"}) == {}
    assert fields_of({"properties": {"x": NUMBER, "next": {"$ref": "#"}}}) == {"x": "float64"}
    one = {"properties": {"two": {"$ref": "#/$defs/Two"}, "x": NUMBER}}
    two = {"properties": {"one": {"$ref": "#/$defs/One"}, "y": NUMBER}}
    assert fields_of({"$ref": "#/$defs/One", "$defs": {"One": one, "Two": two}}) == {
        "two.y": "float64",
        "x": "float64",
    }
    odd = {"a": {"type": [{}, 3]}, "b": {"$ref": 5}, "c": {"allOf": 3, "items": [1]}, "d": True}
    assert set(fields_of({"properties": odd})) == {"a", "b", "c", "d"}
    wide = {
        f"T{k}": {"properties": {n: {"$ref": f"#/$defs/T{k + 1}"} for n in "ab"}} for k in range(60)
    }
    with pytest.raises(LogError, match="more than 10000 fields"):
        fields_of({"$ref": "#/$defs/T0", "$defs": {**wide, "T60": NUMBER}})


def test_the_messages_show_fields_that_the_schema_does_not_list(tmp_path: Path) -> None:
    path = tmp_path / "json.mcap"
    schema = {"properties": {"speed": NUMBER}}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        number = writer.register_schema("S", "jsonschema", json.dumps(schema).encode())
        channel = writer.register_channel("/s", "json", number)
        for k in range(2):
            text = json.dumps({"speed": k, "pose": {"x": 2 * k}})
            writer.add_message(channel, START_NS + k, text.encode(), START_NS)
        writer.finish()
    with closing(open_bag(path)) as bag:
        assert bag.topics["/s"].is_open
        assert bag.topics["/s"].fields == {"speed": "float64"}
        assert field_path(bag, "/s.pose.x").field == "pose.x"
        assert bag.read("/s", ["pose.x"]).columns["pose.x"].tolist() == [0, 2]


@pytest.mark.parametrize("data", [b"[" * 100_000, b'{"a":' * 100_000, b"1" * 5000, b"[1]", b"\xff"])
def test_messages_and_schemas_that_are_not_objects(data: bytes) -> None:
    with pytest.raises(LogError, match=f"^{len(data)} bytes are"):
        JsonDecoder(b"").decode(data)
    if data != b"[1]":
        with pytest.raises(LogError, match="JSON schema cannot be read"):
            JsonDecoder(data)

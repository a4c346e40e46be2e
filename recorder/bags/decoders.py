"""Decoders of messages to objects, and conversion of their fields to columns."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Protocol

from mcaprl.errors import LogError
from mcaprl.recorder.bags.json_messages import JsonDecoder
from mcaprl.recorder.bags.protobuf import ProtobufDecoder
from mcaprl.recorder.bags.ros import RosDecoder
from mcaprl.recorder.bags.values import NUMBERS, are_bytes
from mcaprl.recorder.bags.values import column_of as column_of
from mcaprl.recorder.bags.values import value_at as value_at
from mcaprl.recorder.format.reading import TypeSource


class MessageDecoder(Protocol):
    """Decoder of the messages of one type.

    Attributes:
        fields: Kind of each leaf field by its dotted path; empty if unknown.
        constants: Constants of the type by name.
        unreadable: Reason by dotted path for each field that cannot be read.
        is_open: Whether messages can have other fields than these.
    """

    fields: dict[str, str]
    constants: dict[str, int]
    unreadable: dict[str, str]
    is_open: bool

    def decode(self, data: bytes) -> Any:
        """Decode a message to an object or a dict."""


def decoder_of(
    encoding: str,
    type_name: str,
    schema_encoding: str,
    schema: bytes,
    *,
    distribution: str = "",
    others: TypeSource | None = None,
) -> MessageDecoder:
    """Return the decoder of a type."""
    found = _outcome(encoding, type_name, schema_encoding, schema, distribution, others)
    if isinstance(found, LogError):
        raise LogError(str(found))
    return found


@lru_cache(maxsize=256)
def _outcome(
    encoding: str,
    type_name: str,
    schema_encoding: str,
    schema: bytes,
    distribution: str,
    others: TypeSource | None,
) -> MessageDecoder | LogError:
    """Return the decoder, or the reason why there is none: many topics may have the same type."""
    try:
        match encoding, schema_encoding:
            # rosbag2 writes the encoding `unknown` if it did not find the definition.
            case ("cdr", "ros2msg" | "ros2idl" | "" | "unknown") | ("ros1", "ros1msg" | ""):
                is_known = schema_encoding not in ("", "unknown")
                default = "ros1msg" if encoding == "ros1" else "ros2msg"
                return RosDecoder(
                    type_name,
                    schema.decode(errors="replace") if is_known or encoding == "ros1" else "",
                    encoding=schema_encoding if is_known else default,
                    distribution=distribution,
                    others=others,
                )
            case "protobuf", "protobuf":
                return ProtobufDecoder(type_name, schema)
            case "json", _:
                return JsonDecoder(schema if schema_encoding == "jsonschema" else b"")
            case _:
                return LogError(
                    f"messages of encoding '{encoding}' with a schema of encoding"
                    f" '{schema_encoding}' are not supported; supported: cdr, ros1, protobuf, json"
                )
    except LogError as error:
        return error


def merged(decoders: Sequence[MessageDecoder]) -> tuple[dict[str, str], dict[str, int]]:
    """Return the fields and constants of a type that has one or more definitions.

    A field may be missing in some definitions. Constants with several values are omitted.
    """
    fields, values = dict[str, str](), dict[str, set[int]]()
    for decoder in decoders:
        for path, kind in decoder.fields.items():
            known = fields.setdefault(path, kind)
            # Of the elements of an array of messages, the messages decide.
            if "[" not in path and _shape(known) != _shape(kind):
                raise LogError(
                    f"the type has several definitions: {path} is {known} in one and {kind} in"
                    " another: read the files one by one"
                )
        for name, value in decoder.constants.items():
            values.setdefault(name, set()).add(value)
    if not all(decoder.fields for decoder in decoders):
        fields = {}
    return fields, {name: min(found) for name, found in values.items() if len(found) == 1}


def _shape(kind: str) -> tuple[str, bool]:
    """Return what decides how `column_of` reads a kind: numbers of all sizes are equal."""
    element, bracket, _ = kind.partition("[")
    is_number = element.rstrip("0123456789") in NUMBERS and not are_bytes(kind)
    return "number" if is_number else element, bool(bracket)

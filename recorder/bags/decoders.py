"""Decoders of messages to objects, and conversion of their fields to columns."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.bags.json_messages import JsonDecoder
from mcaprl.recorder.bags.protobuf import ProtobufDecoder
from mcaprl.recorder.bags.ros import RosDecoder
from mcaprl.recorder.format.reading import TypeSource

_NS_PER_S = 10**9
_NUMBERS = (
    "int",
    "uint",
    "float",
    "double",
    "bool",
    "byte",
    "char",
    "sint",
    "fixed",
    "sfixed",
    "enum",
)


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
        """Decode a message to an object or a dict.

        Raises:
            LogError: The bytes do not fit the type.
        """


def decoder_of(
    encoding: str,
    type_name: str,
    schema_encoding: str,
    schema: bytes,
    *,
    distribution: str = "",
    others: TypeSource | None = None,
) -> MessageDecoder:
    """Return the decoder of a type.

    Args:
        encoding: Encoding of the messages: `cdr`, `ros1`, `protobuf` or `json`.
        type_name: Name of the type.
        schema_encoding: Encoding of the schema; empty without a schema.
        schema: Definition of the type.
        distribution: ROS distribution that the bag names.
        others: Definitions of ROS types that the bag lacks.

    Raises:
        LogError: The encoding is not supported, or the definition cannot be used.
    """
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

    Raises:
        LogError: A field is a number in one definition, and something else in another.
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
    is_number = element.rstrip("0123456789") in _NUMBERS and not _are_bytes(kind)
    return "number" if is_number else element, bool(bracket)


def _are_bytes(kind: str) -> bool:
    return kind == "bytes" or kind.startswith(("uint8[", "byte[", "octet["))


def value_at(message: Any, path: str) -> Any:
    """Return a field of a decoded message by its dotted path; None if it is missing.

    Times and durations are converted to nanoseconds.
    """
    found = message
    for name in path.split("."):
        found = found.get(name) if isinstance(found, dict) else getattr(found, name, None)
        if found is None:
            return None
    return _nanoseconds(found)


def _nanoseconds(value: Any) -> Any:
    """Convert a time to nanoseconds; return any other value unchanged."""
    for second, rest in (("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec")):
        if isinstance(value, dict):
            if value.keys() == {second, rest}:
                return int(value[second]) * _NS_PER_S + int(value[rest])
        elif hasattr(value, second) and hasattr(value, rest):
            time_ns = int(getattr(value, second)) * _NS_PER_S + int(getattr(value, rest))
            return time_ns if abs(time_ns) < 2**63 else None
    return value


def column_of(values: Sequence[Any], kind: str) -> NDArray[Any]:
    """Return the values of a field as a column; see `bag.Stream`.

    Args:
        values: Value of the field in each message; None if a message lacks the field.
        kind: Kind of the field as in `bag.TopicInfo`; empty if unknown.
    """
    if _are_bytes(kind):
        return _objects([_bytes_of(value) for value in values])
    if kind == "time":
        return np.array([0 if value is None else value for value in values], np.int64)
    if all(isinstance(value, bool | int | np.integer | np.bool_) for value in values):
        return np.array(values) if len(values) else np.empty(0)
    if all(value is None or isinstance(value, bool | int | float | np.number) for value in values):
        return np.array([math.nan if value is None else value for value in values], np.float64)
    if any(value is None or isinstance(value, str | bytes | dict) for value in values):
        return _objects(values)
    return _vectors(values)


def _vectors(values: Sequence[Any]) -> NDArray[Any]:
    """Return arrays of K numbers as one (N, K) array, and all other values as objects."""
    try:
        arrays = [np.asarray(value) for value in values]
    except (ValueError, TypeError):
        return _objects(values)
    shapes = {array.shape for array in arrays}
    if len(shapes) == 1 and arrays[0].ndim == 1 and all(a.dtype.kind in "biuf" for a in arrays):
        return np.stack(arrays)
    return _objects(values)


def _bytes_of(value: Any) -> Any:
    if isinstance(value, str):
        return base64.b64decode(value)
    return value if value is None else bytes(value)


def _objects(values: Iterable[Any]) -> NDArray[Any]:
    values = list(values)
    column = np.empty(len(values), object)
    column[:] = values
    return column

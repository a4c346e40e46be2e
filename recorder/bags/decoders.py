"""Decoders of messages to objects, and conversion of their fields to columns."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, import_extra
from mcaprl.recorder.bags.ros import RosDecoder

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
# Names of the parts of a time in ROS 2, protobuf, Foxglove's JSON, and JSON of ROS 1.
_TIMES = (("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec"), ("secs", "nsecs"))
_JSON_KINDS = {"number": "float64", "integer": "int64", "boolean": "bool", "string": "string"}


class MessageDecoder(Protocol):
    """Decoder of the messages of one type.

    Attributes:
        fields: Kind of each leaf field by its dotted path; empty if unknown.
        constants: Constants of the type by name.
    """

    fields: dict[str, str]
    constants: dict[str, int]

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
) -> MessageDecoder:
    """Return the decoder of a type.

    Args:
        encoding: Encoding of the messages: `cdr`, `ros1`, `protobuf` or `json`.
        type_name: Name of the type.
        schema_encoding: Encoding of the schema; empty without a schema.
        schema: Definition of the type.
        distribution: ROS distribution that the bag names.

    Raises:
        LogError: The encoding is not supported, or the definition cannot be used.
    """
    match encoding, schema_encoding:
        case ("cdr", "ros2msg" | "ros2idl" | "") | ("ros1", "ros1msg" | ""):
            kind = schema_encoding or ("ros1msg" if encoding == "ros1" else "ros2msg")
            text = schema.decode(errors="replace")
            return RosDecoder(type_name, text, encoding=kind, distribution=distribution)
        case "protobuf", "protobuf":
            return ProtobufDecoder(type_name, schema)
        case "json", _:
            return JsonDecoder(schema if schema_encoding == "jsonschema" else b"")
        case _:
            raise LogError(
                f"messages of encoding '{encoding}' with a schema of encoding '{schema_encoding}'"
                " are not supported; supported: cdr, ros1, protobuf, json"
            )


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
            if _shape(known) != _shape(kind):
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


class ProtobufDecoder:
    """Decoder of a protobuf type, from a serialized FileDescriptorSet."""

    def __init__(self, type_name: str, schema: bytes) -> None:
        """Build the message class.

        Raises:
            LogError: The schema is not a FileDescriptorSet with the type.
            MissingExtraError: protobuf is not installed.
        """
        pools = import_extra("google.protobuf.descriptor_pool", "bags")
        descriptors = import_extra("google.protobuf.descriptor_pb2", "bags")
        factory = import_extra("google.protobuf.message_factory", "bags")
        try:
            files = descriptors.FileDescriptorSet.FromString(schema)
            pool = pools.DescriptorPool()
            for file in files.file:
                pool.Add(file)
            self._descriptor = pool.FindMessageTypeByName(type_name)
            self._class = factory.GetMessageClass(self._descriptor)
        # protobuf raises errors of many types for a wrong schema.
        except Exception as error:
            raise LogError(f"the schema of {type_name} cannot be used: {error}") from error
        self.fields, self.constants = dict[str, str](), dict[str, int]()
        self._collect(self._descriptor, "", ())

    def decode(self, data: bytes) -> Any:
        """Decode a message."""
        try:
            return self._class.FromString(data)
        except Exception as error:
            raise LogError(
                f"cannot decode {len(data)} bytes as {self._descriptor.name}: {error}"
            ) from error

    def _collect(self, descriptor: Any, prefix: str, parents: tuple[str, ...]) -> None:
        """Collect the leaf fields and enum constants; skip types that are nested in themselves."""
        for field in descriptor.fields:
            path = f"{prefix}{field.name}"
            inner = field.message_type
            repeated = "[]" if field.is_repeated else ""
            if field.enum_type is not None:
                self.constants |= {each.name: each.number for each in field.enum_type.values}
            if inner is None:
                self.fields[path] = _protobuf_kind(field) + repeated
            elif inner.full_name in ("google.protobuf.Timestamp", "google.protobuf.Duration"):
                self.fields[path] = f"time{repeated}"
            elif repeated:
                self.fields[path] = f"{inner.full_name}[]"
            elif inner.full_name not in parents:
                self._collect(inner, f"{path}.", (*parents, inner.full_name))


def _protobuf_kind(field: Any) -> str:
    names = {1: "float64", 2: "float32", 8: "bool", 9: "string", 12: "bytes", 14: "enum"}
    names |= {3: "int64", 16: "int64", 18: "int64", 4: "uint64", 6: "uint64"}
    return names.get(field.type, "uint32" if field.type in (7, 13) else "int32")


class JsonDecoder:
    """Decoder of JSON objects, with or without a JSON schema."""

    def __init__(self, schema: bytes) -> None:
        """Collect the fields of the JSON schema; without a schema, the fields are unknown."""
        self.fields, self.constants = dict[str, str](), dict[str, int]()
        try:
            found = json.loads(schema) if schema.strip() else {}
        except ValueError as error:
            raise LogError(f"the JSON schema cannot be read: {error}") from error
        if isinstance(found, dict):
            self._collect(found, "")

    def decode(self, data: bytes) -> Any:
        """Decode a message."""
        try:
            return json.loads(data)
        except ValueError as error:
            raise LogError(f"{len(data)} bytes are not JSON: {error}") from error

    def _collect(self, schema: dict[str, Any], prefix: str) -> None:
        properties = schema.get("properties")
        for name, each in properties.items() if isinstance(properties, dict) else ():
            if not isinstance(each, dict):
                continue
            path, kind = f"{prefix}{name}", each.get("type")
            inner = each.get("properties")
            if isinstance(inner, dict) and {"sec", "nsec"} == set(inner):
                self.fields[path] = "time"
            elif isinstance(inner, dict):
                self._collect(each, f"{path}.")
            elif kind == "array":
                item = each.get("items")
                item_kind = item.get("type") if isinstance(item, dict) else None
                self.fields[path] = f"{_JSON_KINDS.get(str(item_kind), 'object')}[]"
            else:
                is_bytes = each.get("contentEncoding") == "base64"
                self.fields[path] = "bytes" if is_bytes else _JSON_KINDS.get(str(kind), "object")


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
    for second, rest in _TIMES:
        if isinstance(value, dict):
            if value.keys() == {second, rest}:
                return int(value[second]) * _NS_PER_S + int(value[rest])
        elif hasattr(value, second) and hasattr(value, rest):
            return int(getattr(value, second)) * _NS_PER_S + int(getattr(value, rest))
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

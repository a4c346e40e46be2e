"""Decoders of messages of ROS, JSON and protobuf, and conversion of their fields to columns.

The definitions of ROS types come from the bag, or else from the user's definition files, or else
from a ROS distribution. Wide strings are encoded as the DDS of the robot does: their characters
have two or four bytes. Both forms are tried for each message; the right one is that in which the
message ends where the data end, and all characters are valid.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from operator import attrgetter
from typing import Any, Final, Protocol
from urllib.parse import unquote

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from mcaprl.errors import LogError
from mcaprl.limits import MAX_DEFINITION_BYTES, MAX_TYPE_DEPTH, MAX_TYPE_FIELDS
from mcaprl.recorder.bags.protobuf import ProtobufDecoder
from mcaprl.recorder.bags.values import NUMBERS, are_bytes
from mcaprl.recorder.bags.values import column_of as column_of
from mcaprl.recorder.bags.values import value_at as value_at
from mcaprl.recorder.format.reading import (
    ROS1,
    UNREADABLE,
    TypeSource,
    definitions_of,
    full_name,
    leaf_kinds,
)

_KINDS: Final = {"number": "float64", "integer": "int64", "boolean": "bool", "string": "string"}
_OBJECT: Final = "object"
_Schema = dict[str, Any]


class JsonDecoder:
    """Decoder of JSON objects, with or without a JSON schema.

    Attributes:
        fields: Kind of each leaf field of the schema by its dotted path; see `bag.TopicInfo`.
        constants: Constants of the type; always empty.
        unreadable: Reason by dotted path for each field that cannot be read.
        is_open: Whether messages can have other fields than these.
    """

    is_open = True

    def __init__(self, schema: bytes) -> None:
        """Collect the fields of the JSON schema; without a schema, the fields are unknown."""
        self.fields, self.constants = dict[str, str](), dict[str, int]()
        self.unreadable: dict[str, str] = {}
        self._visited = 0
        if len(schema) > MAX_DEFINITION_BYTES:
            raise LogError(
                f"the JSON schema has {len(schema)} bytes; at most {MAX_DEFINITION_BYTES} are read"
            )
        try:
            found = json.loads(schema) if schema.strip() else {}
        except (ValueError, RecursionError) as error:
            raise LogError(f"the JSON schema cannot be read: {error}") from error
        self._root = found if isinstance(found, dict) else {}
        self._collect(self._root, "", "", ())

    def encode(self, message: Any) -> bytes:
        """Encode a dict."""
        return json.dumps(message).encode()

    def decode(self, data: bytes) -> Any:
        """Decode a message to a dict."""
        try:
            found = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise LogError(f"{len(data)} bytes are not JSON: {error}") from error
        if not isinstance(found, dict):
            raise LogError(f"{len(data)} bytes are JSON, but not an object with fields")
        return found

    def _collect(self, schema: Any, path: str, brackets: str, parents: tuple[int, ...]) -> None:
        """Collect the leaf fields of a schema, which is that of the field `path`.

        `brackets` is the end of the kind of all fields: `[]` for each array that contains them.
        Schemas that are nested in themselves are skipped.
        """
        self._visit()
        used = set[int]()
        parts = list(self._parts(schema, used))
        if len(parents) >= MAX_TYPE_DEPTH or not used.isdisjoint(parents):
            return
        found = _joined(parts)
        parents, inner = (*parents, *used), found.get("properties")
        if isinstance(inner, dict) and {"sec", "nsec"} == set(inner) and path:
            self.fields[path] = f"time{brackets}"
        elif isinstance(inner, dict):
            for name, each in inner.items():
                self._collect(each, f"{path}.{name}" if path else name, brackets, parents)
        elif path and (found.get("type") == "array" or "items" in found):
            repeated, items = f"[]{brackets}", f"{path}[]"
            self.fields[path] = f"{_OBJECT}{repeated}"
            self._collect(found.get("items"), items, repeated, parents)
            # The kind of simple elements is that of the array.
            self.fields[path] = self.fields.pop(items, self.fields[path])
        elif path:
            self.fields[path] = f"{_kind(found)}{brackets}"

    def _visit(self) -> None:
        self._visited += 1
        if self._visited > MAX_TYPE_FIELDS:
            raise LogError(f"the JSON schema has more than {MAX_TYPE_FIELDS} fields")

    def _parts(self, schema: Any, used: set[int]) -> Iterator[_Schema]:
        """Yield a schema and all that apply to the same value, and add their ids to `used`."""
        needed = [schema]
        while needed:
            each = needed.pop()
            if not isinstance(each, dict) or id(each) in used:
                continue
            self._visit()
            used.add(id(each))
            yield each
            needed += self._target(each.get("$ref"))
            every = each.get("allOf")
            needed += every if isinstance(every, list) else []
            for key in ("anyOf", "oneOf"):
                options = each.get(key)
                if isinstance(options, list):
                    others = [option for option in options if not _is_null(option)]
                    # Of several alternatives, the messages show which one they use.
                    needed += others if len(others) == 1 else []

    def _target(self, pointer: Any) -> list[Any]:
        """Return the schema that a reference such as `#/$defs/Pose` points to."""
        base, mark, rest = pointer.partition("#") if isinstance(pointer, str) else ("", "", "")
        if not mark or base not in ("", self._root.get("$id")):
            return []
        found: Any = self._root
        for part in unquote(rest).split("/")[1:]:
            name = part.replace("~1", "/").replace("~0", "~")
            if isinstance(found, list) and name.isdigit() and int(name) < len(found):
                found = found[int(name)]
            elif isinstance(found, dict) and name in found:
                found = found[name]
            else:
                return []
        return [found]


def _joined(parts: list[_Schema]) -> _Schema:
    """Return the schema with the keys of all parts, of which earlier ones come first."""
    found: _Schema = {}
    properties: _Schema = {}
    for part in parts:
        for key, value in part.items():
            found.setdefault(key, value)
        inner = part.get("properties")
        for name, value in inner.items() if isinstance(inner, dict) else ():
            found["properties"] = properties
            properties.setdefault(name, value)
    kinds = found.get("type")
    if isinstance(kinds, list):
        others = {kind for kind in kinds if isinstance(kind, str) and kind != "null"}
        found["type"] = "number" if others == {"number", "integer"} else ""
        found["type"] = others.pop() if len(others) == 1 else found["type"]
    return found


def _is_null(schema: Any) -> bool:
    return isinstance(schema, dict) and schema.get("type") == "null"


def _kind(schema: _Schema) -> str:
    """Return the kind of a value that is neither an object with fields nor an array."""
    if schema.get("contentEncoding") == "base64":
        return "bytes"
    kind = schema.get("type")
    values = schema.get("enum")
    if kind is None and isinstance(values, list) and values:
        kind = "string" if all(isinstance(value, str) for value in values) else None
    return _KINDS.get(str(kind), _OBJECT)


_WIDE = "wstring"
_LARGEST = {"uint16": 0xFFFF, "uint32": 0x10FFFF}
"""Types of the characters, with the largest valid character of each."""


class WideForms:
    """Forms of a type with wide strings.

    Attributes:
        paths: Dotted path of each wide string.
        types: Constants and fields of each type, without the wide strings.
    """

    def __init__(self, types: Mapping[str, Any], name: str) -> None:
        """Find the wide strings."""
        self._name, self._all = name, types
        self.paths = tuple(_paths(types, name, ""))
        self.types = {key: _replaced(found, None) for key, found in types.items()}
        self._stores: dict[str, Typestore] = {}

    def decode(self, data: bytes) -> Any | None:
        """Decode a message; return None if no form, or several, fit the bytes."""
        found = []
        for character, largest in _LARGEST.items():
            try:
                message = self._store(character).deserialize_cdr(data, self._name)
            # rosbags raises errors of many types; each means that the bytes do not fit the form.
            except Exception:
                continue
            texts = [attrgetter(path)(message).tolist() for path in self.paths]
            if all(0 < each <= largest for text in texts for each in text):
                found.append((texts, message))
        # Texts that are equal in both forms are followed by the same bytes.
        return found[0][1] if found and all(found[0][0] == texts for texts, _ in found) else None

    def _store(self, character: str) -> Typestore:
        if character not in self._stores:
            store = get_typestore(Stores.EMPTY)
            new = {key: _replaced(found, character) for key, found in self._all.items()}
            store.register({key: each for key, each in new.items() if key not in store.fielddefs})
            self._stores[character] = store
        return self._stores[character]


def _paths(types: Mapping[str, Any], name: str, prefix: str) -> list[str]:
    found = []
    for field, (kind, what) in types[name][1]:
        if kind == Nodetype.NAME:
            found += _paths(types, str(what), f"{prefix}{field}.")
        elif kind == Nodetype.BASE and what[0] == _WIDE:
            found.append(f"{prefix}{field}")
        elif kind == Nodetype.BASE:
            _check(what[0] not in UNREADABLE)
        else:
            _check(not _has(types, what[0]))
    return found


def _has(types: Mapping[str, Any], description: Any) -> bool:
    """Return whether a field contains types whose encoding is not known."""
    kind, what = description
    if kind == Nodetype.BASE:
        return what[0] in UNREADABLE
    if kind == Nodetype.NAME:
        return any(_has(types, each) for _, each in types[what][1])
    return _has(types, what[0])


def _check(is_possible: bool) -> None:
    if not is_possible:
        raise ValueError("an array or another type has an unknown encoding")


def _replaced(found: Any, character: str | None) -> Any:
    """Replace wide strings by arrays of characters; without a type of these, remove them."""
    constants, fields = found
    array = (Nodetype.SEQUENCE, ((Nodetype.BASE, (character, 0)), 0))
    is_wide = [kind == Nodetype.BASE and what[0] == _WIDE for _, (kind, what) in fields]
    return constants, [
        (name, array if wide else description)
        for (name, description), wide in zip(fields, is_wide, strict=True)
        if character is not None or not wide
    ]


class RosDecoder:
    """Decoder of one ROS type.

    Attributes:
        fields: Kind of each leaf field by its dotted path; see `bag.TopicInfo`.
        constants: Constants of the type by name.
        unreadable: Reason by dotted path for each field that cannot be read.
        is_open: Whether messages can have other fields than these.
    """

    is_open = False

    def __init__(
        self,
        type_name: str,
        text: str,
        *,
        encoding: str = "ros2msg",
        distribution: str = "",
        others: TypeSource | None = None,
    ) -> None:
        """Parse the definition."""
        self._is_ros1 = encoding == ROS1
        self._name = full_name(type_name)
        self._definitions = definitions_of(self._name, text, encoding, distribution, others)
        self.constants = self._definitions.constants
        self.unreadable, types = self._definitions.unreadable, self._definitions.types
        self._wide: WideForms | None = None
        if self.unreadable and not self._is_ros1:
            with suppress(ValueError):
                self._wide = WideForms(self._definitions.whole, self._name)
        if self._wide is not None:
            # The fields after wide strings can be found.
            self.unreadable = {path: self.unreadable[path] for path in self._wide.paths}
            types = self._wide.types
        self.fields = leaf_kinds(types, self._name, inner=True)

    def text(self) -> str:
        """Return the definition of the type and of all types in it."""
        return self._definitions.text(is_ros1=self._is_ros1)

    def encode(self, message: Any) -> bytes:
        """Encode a dict, or an object with an attribute for each field."""
        return self._definitions.encode(message, is_ros1=self._is_ros1)

    def decode(self, data: bytes) -> Any:
        """Decode a message to an object with an attribute for each field."""
        whole = None if self._wide is None else self._wide.decode(data)
        return self._definitions.decode(data, is_ros1=self._is_ros1) if whole is None else whole


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

    def encode(self, message: Any) -> bytes:
        """Encode a message, which may also be a dict."""


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

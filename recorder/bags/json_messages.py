"""Decoder of JSON messages, with or without a JSON schema."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Final
from urllib.parse import unquote

from mcaprl.errors import LogError
from mcaprl.limits import MAX_DEFINITION_BYTES, MAX_TYPE_DEPTH, MAX_TYPE_FIELDS

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

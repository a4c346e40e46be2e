"""Sizes of ROS types: nested types and arrays can make them huge, although their text is short."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype

from mcaprl.errors import LogError
from mcaprl.limits import (
    MAX_FIXED_MESSAGES,
    MAX_MESSAGES_PER_BYTE,
    MAX_TYPE_DEPTH,
    MAX_TYPE_FIELDS,
)

TIME_TYPES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
UNREADABLE = ("wstring", "wchar", "float128", "fixed")
"""Types whose encoding is not known."""
ARRAYS = (Nodetype.ARRAY, Nodetype.SEQUENCE)


def check_size(types: Mapping[str, Any], name: str) -> None:
    """Check the size of a type and of all types that are nested in it.

    Raises:
        LogError: A type contains itself, or is too large.
    """
    _Sizes(types).of(name, ())


def element_of(description: Any) -> tuple[Any, Any]:
    """Return kind and type of a field, or of the elements of an array."""
    kind, what = description
    return what[0] if kind in ARRAYS else (kind, what)


class _Size(NamedTuple):
    """Size of a type.

    Attributes:
        leaves: Number of leaf fields, with those in arrays of messages.
        depth: Number of levels of nested messages.
        messages: Number of nested messages in the smallest message of the type.
        least_bytes: Number of bytes of the smallest message of the type, without padding.
    """

    leaves: int
    depth: int
    messages: int
    least_bytes: int


class _Sizes:
    """Sizes of types, each computed once: their leaf fields can be exponential in their number."""

    def __init__(self, types: Mapping[str, Any]) -> None:
        self._types = types
        self._known: dict[str, _Size] = {}
        self._fixed = 0

    def of(self, name: str, parents: tuple[str, ...]) -> _Size:
        """Return the size of a type that is nested in the types `parents`.

        Raises:
            LogError: The type contains itself, or is too large.
        """
        if name in parents:
            raise LogError(f"type {name} contains itself")
        if len(parents) >= MAX_TYPE_DEPTH:
            raise LogError(
                f"{parents[0]}: messages are nested in more than {MAX_TYPE_DEPTH} levels"
            )
        if name not in self._known:
            path = (*parents, name)
            parts = [self._field(field, each, path) for field, each in self._types[name][1]]
            leaves, depths, messages, least_bytes = zip(*parts, strict=True) if parts else ((),) * 4
            found = _Size(
                max(sum(leaves), 1), 1 + max(depths, default=0), 1 + sum(messages), sum(least_bytes)
            )
            self._check(name, found)
            self._known[name] = found
        if len(parents) + self._known[name].depth > MAX_TYPE_DEPTH:
            raise LogError(
                f"{parents[0]}: messages are nested in more than {MAX_TYPE_DEPTH} levels"
            )
        return self._known[name]

    def _check(self, name: str, size: _Size) -> None:
        if size.leaves > MAX_TYPE_FIELDS:
            raise LogError(f"type {name} has more than {MAX_TYPE_FIELDS} fields in nested messages")
        if size.messages > MAX_TYPE_DEPTH + MAX_MESSAGES_PER_BYTE * size.least_bytes:
            raise LogError(
                f"type {name} has {size.messages} nested messages in {size.least_bytes} bytes: at"
                f" most {MAX_MESSAGES_PER_BYTE} for each byte are read"
            )
        if self._fixed > MAX_FIXED_MESSAGES:
            raise LogError(
                f"type {name} has fixed arrays of {self._fixed} messages or strings; at most"
                f" {MAX_FIXED_MESSAGES} are read"
            )

    def _field(self, field: str, description: Any, parents: tuple[str, ...]) -> _Size:
        kind, what = description
        element_kind, element = element_of(description)
        if element_kind == Nodetype.BASE:
            size = _Size(1, 0, 0, _BYTES.get(element[0], 1))
        else:
            size = self.of(str(element), parents)
            size = size._replace(leaves=size.leaves + (3 if element in TIME_TYPES else 1))
        if kind == Nodetype.ARRAY:
            count = what[1]
            is_unrolled = element_kind == Nodetype.NAME or element[0] in ("string", *UNREADABLE)
            self._fixed += count if is_unrolled else 0
            return size._replace(
                messages=count * size.messages, least_bytes=count * size.least_bytes
            )
        if kind == Nodetype.SEQUENCE:
            if size.messages > MAX_MESSAGES_PER_BYTE * max(size.least_bytes, 1):
                raise LogError(
                    f"{parents[-1]}: {field} is a sequence of messages with too few bytes"
                )
            return size._replace(messages=0, least_bytes=4)
        return size


_BYTES = {"string": 4, "wstring": 4} | {
    f"{kind}{bits}": bits // 8 for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64, 128)
}

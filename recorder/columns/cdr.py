"""Field positions in CDR messages of any ROS 2 type.

If two messages of a type have equal lengths, their strings and sequences nearly always have equal
lengths, too. A `Layout`, created from an example message, contains these lengths and a NumPy
structured dtype. Messages that match the layout are read as one array; rosbags decodes all others,
with the same values.

A CDR message starts with a 4-byte encapsulation header, whose second byte is the byte order. After
the header, each number is aligned to its size, relative to the end of the header. A string is a
uint32 length and that number of bytes, the last of which is 0; a sequence is a uint32 count and its
elements. Up to three bytes of padding may follow.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
from mcap.records import Schema
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.columns.definitions import (
    TIME_TYPES,
    clear_definitions,
    definitions_of,
    full_name,
    leaf_kinds,
)

# The encapsulation header of little-endian plain CDR, bytes 00 01 00 00, as a uint32.
ENCAPSULATION = 0x0100
ENCAPSULATION_BYTES = 4
ROS_TO_NUMPY = {
    "float64": "<f8",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "int32": "<i4",
    "uint32": "<u4",
    "int16": "<i2",
    "uint16": "<u2",
    "int8": "i1",
    "uint8": "u1",
    "byte": "u1",
    "char": "u1",
    "bool": "u1",
}
"""NumPy type code of each ROS primitive type."""

MAX_PADDING_BYTES = 3
# First two bytes of the encapsulation header of plain CDR; the last two have no effect.
BIG_ENDIAN, LITTLE_ENDIAN = b"\0\0", b"\0\1"
# Messages with more fields than this, including nested fields, are decoded one by one.
_MAX_PARTS = 256
_MAX_LAYOUTS = 64


@dataclass(frozen=True)
class Layout:
    """Positions of the requested fields in messages whose strings and lists have equal lengths."""

    # Structured dtype of the requested fields and of `constants`; all other bytes of a message are
    # padding.
    dtype: np.dtype[Any]
    # Values that are equal in all messages of the layout: the byte order, and the length of each
    # string and sequence.
    constants: dict[str, int]

    def fits(self, payloads: NDArray[Any]) -> bool:
        """Return whether all messages have this layout."""
        return bool(self.matching(payloads).all())

    def fits_one(self, message: bytes) -> bool:
        """Return whether a message of the dtype's length has this layout, faster than `fits`."""
        code, constants = self._packed
        return code.unpack_from(message) == constants

    @cached_property
    def _packed(self) -> tuple[struct.Struct, tuple[bytes, ...]]:
        """Format that reads the constants of a message as bytes, and their expected bytes."""
        fields: Any = self.dtype.fields
        code, end = "<", 0
        # `constants` is in the order of the positions.
        for name in self.constants:
            dtype, start = fields[name][:2]
            code += f"{start - end}x{dtype.itemsize}s"
            end = start + dtype.itemsize
        values = (np.array(value, fields[name][0]) for name, value in self.constants.items())
        return struct.Struct(code), tuple(value.tobytes() for value in values)

    @cached_property
    def constant_bytes(self) -> list[tuple[int, bytes]]:
        """Offset in the message, and bytes, of each constant."""
        fields: Any = self.dtype.fields
        places = (fields[name][1] for name in self.constants)
        return list(zip(places, self._packed[1], strict=True))

    def places_of(self, columns: Mapping[str, NDArray[Any]]) -> list[int] | None:
        """Return the offset of each column's field; None if a field is converted when copied."""
        fields: Any = self.dtype.fields
        places = []
        for name, column in columns.items():
            dtype, place = fields[name][:2]
            if dtype.base != column.dtype or dtype.shape != column.shape[1:]:
                return None
            places.append(place)
        return places

    def matching(self, payloads: NDArray[Any]) -> NDArray[np.bool_]:
        """Return a mask of the messages that have this layout."""
        found = np.ones(len(payloads), bool)
        for name, value in self.constants.items():
            found &= payloads[name] == value
        return found


class MessageType:
    """Message type parsed from a schema."""

    def __init__(self, name: str, text: str, encoding: str = "ros2msg") -> None:
        """Parse a ROS 2 definition; see `definitions_of`."""
        self.name = name = full_name(name)
        self._layouts: dict[tuple[object, ...], Layout | None] = {}
        self._definitions = definitions_of(name, text, encoding)
        self._fields = self._definitions.fields

    @cached_property
    def dtypes(self) -> dict[str, np.dtype[Any]]:
        """Dtype of each top-level field; `object` but for numbers, their arrays, and times."""
        return {name: _dtype_of(description) for name, description in self._fields.items()}

    @cached_property
    def kinds(self) -> dict[str, str]:
        """Kind of each leaf field by its dotted path; see `definitions.leaf_kinds`."""
        return leaf_kinds(self._definitions.types, self.name)

    @property
    def unreadable(self) -> dict[str, str]:
        """Reason by dotted path for each field that cannot be read."""
        return self._definitions.unreadable

    @cached_property
    def leaf_dtypes(self) -> dict[str, np.dtype[Any]]:
        """Dtype of each leaf field by its dotted path: int64 of times, `object` of texts, lists."""
        found = {path: kind.split("[")[0] for path, kind in self.kinds.items()}
        codes = {"time": "i8", **ROS_TO_NUMPY}
        return {path: np.dtype(codes.get(kind, object)) for path, kind in found.items()}

    def decode(self, data: bytes) -> Any:
        """Decode one message to an object with an attribute for each field."""
        try:
            return self._definitions.decode(data)
        except LogError as error:
            raise CorruptLogError(str(error)) from error

    def known_layout(self, length: int, wanted: Collection[str]) -> Layout | None:
        """Return the latest layout for messages of this length; None if there is none."""
        return self._layouts.get((length, *wanted))

    def layout(self, example: bytes, wanted: Collection[str]) -> Layout | None:
        """Return the layout of an example message; None if the message has no layout."""
        # Layouts are cached: building one takes as long as decoding a few messages.
        key = (len(example), *wanted)
        known = self._layouts.get(key)
        if known is None or not known.fits_one(example):
            known = self._new_layout(example, wanted)
            if len(self._layouts) >= _MAX_LAYOUTS:
                self._layouts.clear()
            self._layouts[key] = known
        return known

    def _new_layout(self, example: bytes, wanted: Collection[str]) -> Layout | None:
        if example[:2] not in (BIG_ENDIAN, LITTLE_ENDIAN):
            return None
        walk = _Walk(example)
        try:
            for name, description in self._fields.items():
                self._pass(walk, description, name, wanted)
        except (struct.error, _NoLayout):
            return None
        # The length of fields that cannot be read is unknown.
        most = len(example) if self._definitions.unreadable else walk.position + MAX_PADDING_BYTES
        if not walk.position <= len(example) <= most:
            return None
        return walk.layout()

    def _pass(self, walk: _Walk, description: Any, path: str, wanted: Collection[str] = ()) -> None:
        """Move past one field, and record the positions of the paths in `wanted`."""
        kind, what = description
        name = path if path in wanted else None
        match kind:
            case Nodetype.BASE if what[0] == "string":
                walk.take(f"S{walk.length()}", 1, name, scalar=True)
            case Nodetype.BASE:
                walk.take(_number(what[0]), 1, name, scalar=True)
            case Nodetype.NAME if name is not None and what in TIME_TYPES:
                walk.take_time(name, wanted)
            case Nodetype.NAME:
                # Build the paths of nested fields only if one of them is in `wanted`.
                within = wanted if any(each.startswith(f"{path}.") for each in wanted) else ()
                for inner, found in self._definitions.types[what][1]:
                    self._pass(walk, found, f"{path}.{inner}" if within else path, within)
            case Nodetype.ARRAY | Nodetype.SEQUENCE:
                element, count = what
                if kind == Nodetype.SEQUENCE:
                    count = walk.length()
                if element[0] == Nodetype.BASE and element[1][0] != "string":
                    walk.take(_number(element[1][0]), count, name)
                    return
                if name is not None and element[0] == Nodetype.BASE:
                    walk.take_texts(name, count)
                    return
                if name is not None:
                    # Messages that contain a list of messages have no layout. They are decoded one
                    # by one.
                    raise _NoLayout
                for _ in range(count):
                    self._pass(walk, element, path)


class _Walk:
    """Cursor that moves through one message and records the positions of fields."""

    def __init__(self, data: bytes) -> None:
        """Start after the encapsulation header."""
        self.position = ENCAPSULATION_BYTES
        self._data = data
        self._order: Literal["<", ">"] = "<" if data[:2] == LITTLE_ENDIAN else ">"
        self._parts = 0
        self._constants = {"_encapsulation": int.from_bytes(data[:2], "little")}
        self._fields: dict[str, tuple[Any, int]] = {"_encapsulation": ("<u2", 0)}

    def take(self, code: str, count: int, name: str | None, *, scalar: bool = False) -> None:
        """Move past `count` numbers or one string, and record the position under `name`."""
        self._parts += 1
        if self._parts > _MAX_PARTS:
            raise _NoLayout
        dtype = np.dtype(code).newbyteorder(self._order)
        alignment = 1 if dtype.kind == "S" else dtype.itemsize
        # There is no padding before the elements of an empty sequence.
        if count:
            self.position += -(self.position - ENCAPSULATION_BYTES) % alignment
        if self.position + count * dtype.itemsize > len(self._data):
            raise _NoLayout
        if name is not None:
            self._fields[name] = (dtype if scalar else (dtype, (count,)), self.position)
        self.position += count * dtype.itemsize

    def take_time(self, name: str, wanted: Collection[str]) -> None:
        """Move past a time. Record it as one field, and also `sec` and `nanosec` if requested."""
        self.position += -(self.position - ENCAPSULATION_BYTES) % 4
        start, self.position = self.position, self.position + 8
        if self.position > len(self._data):
            raise _NoLayout
        parts = [("sec", f"{self._order}i4"), ("nanosec", f"{self._order}u4")]
        self._fields[name] = (np.dtype(parts), start)
        for number, (part, code) in enumerate(parts):
            if f"{name}.{part}" in wanted:
                self._fields[f"{name}.{part}"] = (code, start + 4 * number)

    def take_texts(self, name: str, count: int) -> None:
        """Move past an array of strings; record it as a structured field, one item per string."""
        start, codes, offsets = self.position, [], []
        for _ in range(count):
            size = self.length()
            codes.append(f"S{size}")
            offsets.append(self.position - start)
            self.take(codes[-1], 1, None, scalar=True)
        parts: Any = {
            "names": [str(number) for number in range(count)],
            "formats": codes,
            "offsets": offsets,
            "itemsize": self.position - start,
        }
        self._fields[name] = (np.dtype(parts), start)

    def length(self) -> int:
        """Read the length of a string or sequence, and make it a constant of the layout."""
        name = f"_length_{len(self._constants)}"
        self.take("u4", 1, name, scalar=True)
        (value,) = struct.unpack_from(f"{self._order}I", self._data, self.position - 4)
        if value > len(self._data):
            raise _NoLayout
        self._constants[name] = value
        return int(value)

    def layout(self) -> Layout:
        """Return the layout of the recorded fields."""
        formats, offsets = zip(*self._fields.values(), strict=True)
        dtype = np.dtype(
            {
                "names": list(self._fields),
                "formats": list(formats),
                "offsets": list(offsets),
                "itemsize": len(self._data),
            }
        )
        return Layout(dtype, self._constants)


class _NoLayout(Exception):
    """Error for a message that is too short for its type or has too many fields."""


def message_type(schema: Schema) -> MessageType:
    """Return the message type of a schema. Each schema is parsed only once."""
    if schema.encoding not in ("ros2msg", "ros2idl"):
        raise LogError(f"schema {schema.name} has encoding {schema.encoding!r}, not 'ros2msg'")
    return _parsed(schema.name, schema.data.decode(errors="replace"), schema.encoding)


_parsed = lru_cache(maxsize=64)(MessageType)


def clear_types() -> None:
    """Clear the cache of parsed types, so that a benchmark includes the time of parsing."""
    _parsed.cache_clear()
    clear_definitions()


def _dtype_of(description: Any) -> np.dtype[Any]:
    kind, what = description
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        kind, what = what[0]
    if kind == Nodetype.NAME and what in TIME_TYPES and description[0] == Nodetype.NAME:
        return np.dtype(np.int64)
    if kind != Nodetype.BASE:
        return np.dtype(object)
    return np.dtype(ROS_TO_NUMPY.get(what[0], object))


def _number(ros_name: str) -> str:
    code = ROS_TO_NUMPY.get(ros_name)
    if code is None:
        raise _NoLayout
    return code

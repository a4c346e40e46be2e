"""Decoder of protobuf messages.

A field with presence that is not set is missing, and so are all fields of a message that is not
set: fields of proto2, `optional` fields, members of a `oneof`, and messages. Other fields of proto3
have their default value.
"""

from __future__ import annotations

import graphlib
import importlib
from collections.abc import Callable
from functools import partial
from operator import attrgetter
from typing import Any, Final

from mcaprl.errors import LogError, import_extra
from mcaprl.limits import MAX_TYPE_DEPTH, MAX_TYPE_FIELDS

_PACKAGE: Final = "google.protobuf"
_TIMES: Final = (f"{_PACKAGE}.Timestamp", f"{_PACKAGE}.Duration")
_KNOWN_FILES: Final = {
    f"google/protobuf/{name}.proto": f"{_PACKAGE}.{name}_pb2"
    for name in (
        "any",
        "api",
        "descriptor",
        "duration",
        "empty",
        "field_mask",
        "source_context",
        "struct",
        "timestamp",
        "type",
        "wrappers",
    )
}
"""Modules with the definitions that come with protobuf."""
_MAX_SECONDS: Final = 2**63 // 10**9 - 1
_KINDS: Final = {
    1: "float64",
    2: "float32",
    3: "int64",
    4: "uint64",
    6: "uint64",
    7: "uint32",
    8: "bool",
    9: "string",
    12: "bytes",
    13: "uint32",
    14: "enum",
    16: "int64",
    18: "int64",
}
"""Kind by number of the field's type; all other types are int32."""


class ProtobufDecoder:
    """Decoder of a protobuf type, from a serialized FileDescriptorSet.

    Attributes:
        fields: Kind of each leaf field by its dotted path; see `bag.TopicInfo`. A wrapper, such as
            `google.protobuf.DoubleValue x`, has the paths `x` and `x.value`. A map is an array of
            messages with the fields `key` and `value`, in the order of the keys.
        constants: Values of the enums by name; names with several values are left out.
        unreadable: Reason by dotted path for each field that cannot be read.
        is_open: Whether messages can have other fields than these.
    """

    is_open = False

    def __init__(self, type_name: str, schema: bytes) -> None:
        """Build the message class.

        Raises:
            LogError: The schema is not a FileDescriptorSet with the type, or the type is too large.
            MissingExtraError: protobuf is not installed.
        """
        factory = import_extra(f"{_PACKAGE}.message_factory", "bags")
        self._name = type_name.removeprefix(".")
        try:
            descriptor = _pool(schema).FindMessageTypeByName(self._name)
            self._class = factory.GetMessageClass(descriptor)
        except LogError as error:
            raise LogError(f"the schema of {type_name} cannot be used: {error}") from error
        # protobuf raises errors of many types for a wrong schema.
        except Exception as error:
            raise LogError(f"the schema of {type_name} cannot be used: {error}") from error
        self._readers = _Readers(descriptor, {})
        self.fields, self.unreadable = dict[str, str](), dict[str, str]()
        self._values, self._visited = dict[str, set[int]](), 0
        self._collect(descriptor, "", "", ())
        self.constants = {
            name: min(numbers) for name, numbers in self._values.items() if len(numbers) == 1
        }

    def decode(self, data: bytes) -> Any:
        """Decode a message to an object with an attribute for each field; None if it is not set.

        Raises:
            LogError: The bytes do not fit the type.
        """
        try:
            return _Message(self._readers, self._class.FromString(data))
        # protobuf's own error is DecodeError; other errors come from invalid strings.
        except Exception as error:
            raise LogError(f"cannot decode {len(data)} bytes as {self._name}: {error}") from error

    def _collect(
        self, descriptor: Any, prefix: str, brackets: str, parents: tuple[str, ...]
    ) -> None:
        """Collect the leaf fields and enum constants; skip types that are nested in themselves.

        `brackets` is the end of the kind of all fields: `[]` for each array that contains them.
        """
        for field in descriptor.fields:
            self._visited += 1
            if self._visited > MAX_TYPE_FIELDS:
                raise LogError(
                    f"type {self._name} has more than {MAX_TYPE_FIELDS} fields in nested messages"
                )
            path, inner = f"{prefix}{field.name}", field.message_type
            repeated = f"[]{brackets}" if field.is_repeated else brackets
            if field.enum_type is not None:
                for each in field.enum_type.values:
                    self._values.setdefault(each.name, set()).add(each.number)
            if inner is None:
                self.fields[path] = _KINDS.get(field.type, "int32") + repeated
            elif inner.full_name in _TIMES:
                self.fields[path] = f"time{repeated}"
            else:
                if field.is_repeated:
                    self.fields[path] = f"{inner.full_name}{repeated}"
                    path = f"{path}[]"
                elif _is_wrapper(inner):
                    self.fields[path] = _KINDS.get(inner.fields[0].type, "int32") + repeated
                if len(parents) >= MAX_TYPE_DEPTH:
                    raise LogError(
                        f"type {self._name}: messages are nested in more than"
                        f" {MAX_TYPE_DEPTH} levels"
                    )
                if inner.full_name not in parents:
                    self._collect(inner, f"{path}.", repeated, (*parents, inner.full_name))


def _pool(schema: bytes) -> Any:
    """Return a pool with the files of a FileDescriptorSet, which can be in any order.

    Files that come with protobuf may be missing, and those of which nothing is used.

    Raises:
        LogError: Files import each other, or a file has two versions.
    """
    descriptors = import_extra(f"{_PACKAGE}.descriptor_pb2", "bags")
    files: dict[str, Any] = {}
    for file in descriptors.FileDescriptorSet.FromString(schema).file:
        if files.setdefault(file.name, file) != file:
            raise LogError(f"it has two versions of {file.name}")
    needed = [name for file in files.values() for name in file.dependency]
    while needed:
        name = needed.pop()
        if name not in files and name in _KNOWN_FILES:
            module = importlib.import_module(_KNOWN_FILES[name])
            files[name] = descriptors.FileDescriptorProto.FromString(
                module.DESCRIPTOR.serialized_pb
            )
            needed += files[name].dependency
    pool = import_extra(f"{_PACKAGE}.descriptor_pool", "bags").DescriptorPool()
    try:
        order = list(
            graphlib.TopologicalSorter(
                {name: list(file.dependency) for name, file in files.items()}
            ).static_order()
        )
    except graphlib.CycleError as error:
        raise LogError("its files import each other") from error
    missing = [name for name in order if name not in files]
    for name in order:
        if name in files:
            pool.Add(_without(files[name], missing))
    return pool


def _without(file: Any, missing: list[str]) -> Any:
    """Return a file without the imports of missing files, which may be needed by options only."""
    if not set(file.dependency) & set(missing):
        return file
    kept = [name for name in file.dependency if name not in missing]
    found = type(file)()
    found.CopyFrom(file)
    for indexes in ("public_dependency", "weak_dependency"):
        names = [file.dependency[k] for k in getattr(file, indexes)]
        getattr(found, indexes)[:] = [kept.index(name) for name in names if name in kept]
    found.dependency[:] = kept
    return found


def _is_wrapper(descriptor: Any) -> bool:
    """Return whether a type is a wrapper such as `google.protobuf.DoubleValue`."""
    return bool(descriptor.file.name == "google/protobuf/wrappers.proto")


class _Readers(dict[str, Callable[[Any], Any]]):
    """Functions that read the fields of a type's messages by name, built when they are needed.

    A function returns None if the field is not set.
    """

    def __init__(self, descriptor: Any, types: dict[str, _Readers]) -> None:
        """Store the descriptor and the types that are known so far by name, which are shared."""
        self._fields = dict(descriptor.fields_by_name)
        self._types = types
        self._is_time = descriptor.full_name in _TIMES
        types[descriptor.full_name] = self

    def __missing__(self, name: str) -> Callable[[Any], Any]:
        if name not in self._fields:
            raise AttributeError(name)
        self[name] = found = self._reader(self._fields[name])
        return found

    def _reader(self, field: Any) -> Callable[[Any], Any]:
        name, inner, value = field.name, field.message_type, attrgetter(field.name)
        if self._is_time and name == "seconds":
            return _seconds
        if field.is_repeated and inner is not None and inner.GetOptions().map_entry:
            return self._entries(value, inner.fields_by_name["value"])
        wrapped = None if inner is None else self._wrapped(inner)
        if field.is_repeated and wrapped is not None:
            return lambda message: [wrapped(each) for each in value(message)]
        if not field.has_presence:
            return value
        if wrapped is None:
            return lambda message: value(message) if message.HasField(name) else None
        return lambda message: wrapped(value(message)) if message.HasField(name) else None

    def _wrapped(self, descriptor: Any) -> Callable[[Any], Any]:
        """Return the function that wraps a nested message."""
        if _is_wrapper(descriptor):
            return lambda message: _boxed(message.value)
        found = self._types.get(descriptor.full_name)
        return partial(_Message, _Readers(descriptor, self._types) if found is None else found)

    def _entries(self, value: Callable[[Any], Any], field: Any) -> Callable[[Any], Any]:
        """Return the function that reads a map; its order in the message has no meaning."""
        inner = field.message_type
        wrapped = (lambda each: each) if inner is None else self._wrapped(inner)

        def entries(message: Any) -> list[Any]:
            found = value(message)
            return [_Entry(key, wrapped(found[key])) for key in sorted(found)]

        return entries


class _Message:
    """Message whose fields are attributes; a field that is not set is None."""

    __slots__ = ("_message", "_readers")

    def __init__(self, readers: _Readers, message: Any) -> None:
        self._readers, self._message = readers, message

    def __getattr__(self, name: str) -> Any:
        return self._readers[name](self._message)


class _Entry:
    """Entry of a map."""

    __slots__ = ("key", "value")

    def __init__(self, key: Any, value: Any) -> None:
        self.key, self.value = key, value


_BOXES: Final[dict[type, Callable[[Any], Any]]] = {
    kind: type(f"_{kind.__name__}", (kind,), {"value": property(kind)})
    for kind in (int, float, str, bytes)
}
"""Types of the values of wrappers: the value itself is also the attribute `value`."""


def _boxed(value: Any) -> Any:
    return _BOXES[int if isinstance(value, bool) else type(value)](value)


def _seconds(message: Any) -> int:
    """Return the seconds of a time.

    Raises:
        LogError: The time in nanoseconds has more than 64 bits.
    """
    if abs(message.seconds) > _MAX_SECONDS:
        raise LogError(f"a time of {message.seconds} s is not within the years 1678 to 2262")
    return int(message.seconds)

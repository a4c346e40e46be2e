"""Decoder of protobuf messages.

A field with presence that is not set is missing, and so are all fields of a message that is not
set: fields of proto2, `optional` fields, members of a `oneof`, and messages. Other fields of proto3
have their default value.
"""

from __future__ import annotations

import graphlib
import importlib
from collections.abc import Callable
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
        """Build the message class."""
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
        self._wrapped = _Classes().of(descriptor)
        self.fields, self.unreadable = dict[str, str](), dict[str, str]()
        self._values, self._visited = dict[str, set[int]](), 0
        self._collect(descriptor, "", "", ())
        self.constants = {
            name: min(numbers) for name, numbers in self._values.items() if len(numbers) == 1
        }

    def decode(self, data: bytes) -> Any:
        """Decode a message to an object with an attribute for each field; None if it is not set."""
        try:
            return self._wrapped(self._class.FromString(data))
        # protobuf's own error is DecodeError; other errors come from invalid strings.
        except Exception as error:
            raise LogError(f"cannot decode {len(data)} bytes as {self._name}: {error}") from error

    def wrapped(self, message: Any) -> Any:
        """Return a protobuf message as `decode` does."""
        return self._wrapped(message)

    def encode(self, message: Any) -> bytes:
        """Encode a protobuf message, one that `decode` returned, or a dict."""
        message = getattr(message, "_of_protobuf", message)
        if isinstance(message, dict):
            parser = import_extra(f"{_PACKAGE}.json_format", "bags")
            message = parser.ParseDict(message, self._class())
        found: bytes = message.SerializeToString()
        return found

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


class _Message:
    """Message whose fields are attributes; a field that is not set is None."""

    __slots__ = ("_of_protobuf",)

    def __init__(self, message: Any) -> None:
        self._of_protobuf = message


class _Classes(dict[str, type[_Message]]):
    """Subclass of `_Message` for each type, with a property for each field."""

    def of(self, descriptor: Any) -> type[_Message]:
        """Return the class of a type; its nested types get their classes when they are used."""
        found = self.get(descriptor.full_name)
        if found is None:
            properties = {
                field.name: property(self._reader(field))
                for field in descriptor.fields
                if not field.name.startswith("__")
            }
            members = {"__slots__": (), **properties}
            found = self[descriptor.full_name] = type("_Message", (_Message,), members)
        return found

    def _reader(self, field: Any) -> Callable[[Any], Any]:
        name, inner = field.name, field.message_type
        value = attrgetter(f"_of_protobuf.{name}")
        if inner is None:
            if not field.has_presence:
                return value
            return lambda message: value(message) if message._of_protobuf.HasField(name) else None
        if field.is_repeated and inner.GetOptions().map_entry:
            return self._entries(value, inner.fields_by_name["value"].message_type)
        if field.is_repeated:
            return lambda message: list(map(self._wrapper(inner), value(message)))
        return self._nested(name, inner)

    def _nested(self, name: str, descriptor: Any) -> Callable[[Any], Any]:
        """Return the function that reads a message, with a class that is built when it is used."""
        wrapper: Callable[[Any], Any] | None = None

        def nested(message: Any) -> Any:
            nonlocal wrapper
            if not message._of_protobuf.HasField(name):
                return None
            if wrapper is None:
                wrapper = self._wrapper(descriptor)
            return wrapper(getattr(message._of_protobuf, name))

        return nested

    def _wrapper(self, descriptor: Any) -> Callable[[Any], Any]:
        """Return the function that wraps a message of a type."""
        if _is_wrapper(descriptor):
            return lambda message: _boxed(message.value)
        return self.of(descriptor)

    def _entries(self, value: Callable[[Any], Any], descriptor: Any) -> Callable[[Any], Any]:
        """Return the function that reads a map; its order in the message has no meaning."""

        def entries(message: Any) -> list[Any]:
            found = value(message)
            if descriptor is None:
                return [_Entry(key, found[key]) for key in sorted(found)]
            wrapper = self._wrapper(descriptor)
            return [_Entry(key, wrapper(found[key])) for key in sorted(found)]

        return entries


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

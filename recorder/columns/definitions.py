"""Definitions of ROS types, from a file or, if the file lacks them, from a ROS distribution."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from mcaprl.errors import LogError

TIME_TYPES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
ROS1 = "ros1msg"
# The definition of a service event may lack the definitions of the request and the response. By
# default, events contain neither requests nor responses, and can be read without these definitions.
_EVENT, _PARTS = "_Event", ("_Request", "_Response")
_UNKNOWN: Any = ([], [("unknown", (Nodetype.BASE, ("uint8", 0)))])
_IDL_LINE = "=" * 80 + "\n"


def full_name(name: str) -> str:
    """Return the name of a type in the form that rosbags uses.

    >>> full_name("geometry_msgs/Twist"), full_name("std_srvs/srv/Trigger_Event")
    ('geometry_msgs/msg/Twist', 'std_srvs/srv/msg/Trigger_Event')
    """
    folder, slash, last = name.rpartition("/")
    return name if not slash or folder.endswith("/msg") else f"{folder}/msg/{last}"


class Definitions:
    """A type and all types that are nested in it.

    Attributes:
        name: Full name of the type.
        types: Constants and fields of each type by its full name, as rosbags describes them.
    """

    def __init__(self, name: str, types: dict[str, Any]) -> None:
        """Store the parsed definitions; see `definitions_of`."""
        self.name = name
        self.types = types

    @property
    def fields(self) -> dict[str, Any]:
        """Description of each field of the type by its name."""
        return dict(self.types[self.name][1])

    @property
    def constants(self) -> dict[str, int]:
        """Integer constants of the type by name."""
        return {name: value for name, _, value in self.types[self.name][0] if type(value) is int}

    @cached_property
    def _store(self) -> Typestore:
        """Type store of rosbags. Creating the store takes milliseconds: it generates code."""
        store = get_typestore(Stores.EMPTY)
        new = {key: found for key, found in self.types.items() if key not in store.fielddefs}
        store.register(new)
        return store

    def decode(self, data: bytes, *, is_ros1: bool = False) -> Any:
        """Decode a message to an object with an attribute for each field.

        Raises:
            LogError: The bytes do not fit the type, or no code can be generated for it.
        """
        try:
            decoded = self._store.deserialize_ros1 if is_ros1 else self._store.deserialize_cdr
            return decoded(data, self.name)
        # rosbags raises errors of many types; each means that the bytes do not fit the type.
        except Exception as error:
            raise LogError(f"cannot decode {len(data)} bytes as {self.name}: {error}") from error


@lru_cache(maxsize=256)
def definitions_of(
    name: str, text: str, encoding: str = "ros2msg", distribution: str = ""
) -> Definitions:
    """Return a type and all types that are nested in it.

    If both the file and the distribution define a type, the file's definition is used.

    Args:
        name: Full name of the type.
        text: Definition with its nested types; empty if the file has none.
        encoding: `ros2msg`, `ros2idl` or `ros1msg`.
        distribution: ROS distribution of the file, such as `humble`; empty if unknown.

    Raises:
        LogError: The definition does not parse, or a type is not defined.
    """
    own = _parsed(name, text, encoding) if text.strip() else {}
    needed, types = [name], dict[str, Any]()
    while needed:
        each = needed.pop()
        if each not in types:
            found = own.get(each) or _known(distribution, encoding == ROS1).fielddefs.get(each)
            if name.endswith(_EVENT) and each.endswith(_PARTS) and not (found and found[1]):
                found = _UNKNOWN
            if found is None:
                what = "its definition" if each == name else f"the definition of nested type {each}"
                raise LogError(f"{name}: {what} is missing, and the ROS distribution lacks it")
            types[each] = found
            for field, description in found[1]:
                _refuse_wide(name, field, description)
                needed += _nested(description)
    return Definitions(name, types)


def leaf_kinds(types: Mapping[str, Any], name: str, prefix: str = "") -> dict[str, str]:
    """Return the kind of each leaf field of a type by its dotted path.

    Kinds of numbers, strings and arrays are, for example, `float64`, `string`, `float32[36]` and
    `uint8[]`. Times and durations have the kind `time`; their fields `sec` and `nanosec` are leaf
    fields as well. The kind of an array of messages is, for example, `geometry_msgs/msg/Point[]`.

    Args:
        types: Definitions of the type and all nested ones; see `Definitions.types`.
        name: Full name of the type.
        prefix: Path of the field that has this type, with a final dot; empty at the top level.
    """
    found = {}
    for field, description in types[name][1]:
        kind, what = description
        path = f"{prefix}{field}"
        if kind != Nodetype.NAME:
            found[path] = _kind(description)
        elif what in TIME_TYPES:
            found |= {path: "time", f"{path}.sec": "int32", f"{path}.nanosec": "uint32"}
        else:
            found |= leaf_kinds(types, str(what), f"{path}.")
    return found


def _kind(description: Any) -> str:
    kind, what = description
    if kind == Nodetype.BASE:
        return str(what[0])
    if kind == Nodetype.NAME:
        return str(what)
    element, count = what
    return f"{_kind(element)}[{count if kind == Nodetype.ARRAY else ''}]"


@lru_cache(maxsize=4)
def _known(distribution: str, is_ros1: bool) -> Typestore:
    stores = {store.value: store for store in Stores}
    latest = Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST
    return get_typestore(stores.get(f"ros2_{distribution}", latest))


def _parsed(name: str, text: str, encoding: str) -> dict[str, Any]:
    try:
        if encoding != "ros2idl":
            return dict(get_types_from_msg(text, name))
        if not text.startswith(f"{_IDL_LINE}IDL: "):
            return dict(get_types_from_idl(text))
        # The text contains several definitions, each preceded by a line with the type name.
        parts = [part.split("\n", 1)[1] for part in text.split(_IDL_LINE) if part.strip()]
        return {key: found for part in parts for key, found in get_types_from_idl(part).items()}
    # rosbags raises errors of many types when a definition does not parse.
    except Exception as error:
        raise LogError(f"the definition of {name} does not parse: {error}") from error


def _refuse_wide(name: str, field: str, description: Any) -> None:
    kind, what = description
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        kind, what = what[0]
    # `get_types_from_msg` parses `wstring` as the name of a message type.
    word = what[0] if kind == Nodetype.BASE else str(what).rpartition("/")[2]
    if word == "wstring":
        raise LogError(
            f"{name}: field {field} is a wide string, whose encoding depends on the DDS of the"
            " robot: record a string instead"
        )


def _nested(description: Any) -> list[str]:
    kind, what = description
    if kind == Nodetype.NAME:
        return [str(what)]
    return _nested(what[0]) if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else []

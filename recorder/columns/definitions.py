"""Definitions of ROS types: those of a file, or else those of a ROS distribution."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from mcaprl.errors import LogError

TIME_TYPES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
ROS1 = "ros1msg"
# Definitions of a service's events may lack those of its request and response. The events can be
# read nevertheless if they contain neither, which is the default of ROS.
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


def store_of(name: str, text: str, encoding: str = "ros2msg", distribution: str = "") -> Typestore:
    """Return a store with a type and all types that are nested in it.

    Definitions of the file have precedence over those of the distribution.

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
                raise LogError(f"{name}: {what} is missing and not known")
            types[each] = found
            for field, description in found[1]:
                _refuse_wide(name, field, description)
                needed += _nested(description)
    store = get_typestore(Stores.EMPTY)
    try:
        store.register({key: found for key, found in types.items() if key not in store.fielddefs})
        # Generates code, which finds errors that parsing does not.
        store.get_msgdef(name)
    # The library raises errors of many types.
    except Exception as error:
        raise LogError(f"the definition of {name} cannot be used: {error}") from error
    return store


def leaf_kinds(store: Typestore, name: str, prefix: str = "") -> dict[str, str]:
    """Return the kind of each leaf field of a type by its dotted path.

    Kinds are `float64`, `string`, `float32[36]`, `uint8[]` and so on; `time` for times and
    durations, whose two parts are leaves as well; and the type's name for arrays of messages.
    """
    found = {}
    for field, description in store.fielddefs[name][1]:
        kind, what = description
        path = f"{prefix}{field}"
        if kind != Nodetype.NAME:
            found[path] = _kind(description)
        elif what in TIME_TYPES:
            found |= {path: "time", f"{path}.sec": "int32", f"{path}.nanosec": "uint32"}
        else:
            found |= leaf_kinds(store, str(what), f"{path}.")
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
        # Several definitions, each after a line with its name.
        parts = [part.split("\n", 1)[1] for part in text.split(_IDL_LINE) if part.strip()]
        return {key: found for part in parts for key, found in get_types_from_idl(part).items()}
    # The library raises errors of many types when a definition does not parse.
    except Exception as error:
        raise LogError(f"the definition of {name} does not parse: {error}") from error


def _refuse_wide(name: str, field: str, description: Any) -> None:
    kind, what = description
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        kind, what = what[0]
    # `get_types_from_msg` takes the word for a message.
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

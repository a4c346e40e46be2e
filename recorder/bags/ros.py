"""Decoding of ROS messages by the definitions in a bag, or else by those of a distribution."""

from __future__ import annotations

from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from mcaprl.errors import LogError

TIME_TYPES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_IDL_LINE = "=" * 80 + "\n"


class RosDecoder:
    """Decoder of one ROS type.

    Attributes:
        fields: Kind of each leaf field by its dotted path; see `bag.TopicInfo`.
        constants: Constants of the type by name.
    """

    def __init__(
        self, type_name: str, text: str, *, encoding: str = "ros2msg", distribution: str = ""
    ) -> None:
        """Parse the definition.

        Args:
            type_name: Name of the type, such as `nav_msgs/msg/Odometry`.
            text: Definition with its nested types; empty if the bag has none.
            encoding: `ros2msg`, `ros2idl` or `ros1msg`.
            distribution: ROS distribution that the bag names, such as `humble`.

        Raises:
            LogError: The definition does not parse, or a type is not defined.
        """
        self._is_ros1 = encoding == "ros1msg"
        self._name = _full_name(type_name)
        known = get_typestore(_store_of(distribution, is_ros1=self._is_ros1))
        own = _parsed(self._name, text, encoding) if text.strip() else {}
        self._store = _store_with(self._name, own, known)
        constants, _ = self._store.fielddefs[self._name]
        self.constants = {name: value for name, _, value in constants if isinstance(value, int)}
        self.fields = dict(self._leaves(self._name, ""))

    def decode(self, data: bytes) -> Any:
        """Decode a message to an object with an attribute for each field.

        Raises:
            LogError: The bytes do not fit the type.
        """
        try:
            if self._is_ros1:
                return self._store.deserialize_ros1(data, self._name)
            return self._store.deserialize_cdr(data, self._name)
        # The library raises errors of many types; each means that the bytes do not fit.
        except Exception as error:
            raise LogError(f"{len(data)} bytes are not a {self._name}: {error}") from error

    def _leaves(self, type_name: str, prefix: str) -> list[tuple[str, str]]:
        found = []
        for name, description in self._store.fielddefs[type_name][1]:
            kind, what = description
            path = f"{prefix}{name}"
            if kind != Nodetype.NAME:
                found.append((path, _kind(description)))
            elif what in TIME_TYPES:
                found += [(path, "time"), (f"{path}.sec", "int32"), (f"{path}.nanosec", "uint32")]
            else:
                found += self._leaves(str(what), f"{path}.")
        return found


def _kind(description: Any) -> str:
    kind, what = description
    if kind == Nodetype.BASE:
        return str(what[0])
    if kind == Nodetype.NAME:
        return str(what)
    element, count = what
    return f"{_kind(element)}[{count if kind == Nodetype.ARRAY else ''}]"


def _full_name(name: str) -> str:
    """Return a name with its middle part, which ROS 1 and some writers leave out."""
    package, _, rest = name.partition("/")
    return name if "/" in rest or not rest else f"{package}/msg/{rest}"


def _store_of(distribution: str, *, is_ros1: bool) -> Stores:
    if is_ros1:
        return Stores.ROS1_NOETIC
    names = {store.value: store for store in Stores}
    return names.get(f"ros2_{distribution}", Stores.LATEST)


def _parsed(name: str, text: str, encoding: str) -> dict[str, Any]:
    try:
        if encoding == "ros2idl":
            if not text.startswith(f"{_IDL_LINE}IDL: "):
                return dict(get_types_from_idl(text))
            # Several definitions, each after a line with its name.
            parts = [part.split("\n", 1)[1] for part in text.split(_IDL_LINE) if part.strip()]
            return {key: found for part in parts for key, found in get_types_from_idl(part).items()}
        return dict(get_types_from_msg(text, name))
    # The library raises errors of many types when a definition does not parse.
    except Exception as error:
        raise LogError(f"the definition of {name} does not parse: {error}") from error


def _store_with(name: str, own: dict[str, Any], known: Typestore) -> Typestore:
    """Return a store with a type and all types nested in it, the bag's own definitions first.

    Raises:
        LogError: A type is defined neither in the bag nor in the distribution.
    """
    needed, types = [name], dict[str, Any]()
    while needed:
        each = needed.pop()
        if each in types:
            continue
        found = own.get(each) or known.fielddefs.get(each)
        if found is None:
            what = "its definition" if each == name else f"the definition of the nested type {each}"
            raise LogError(f"{name}: {what} is missing in the bag and not known")
        types[each] = found
        needed += [inner for field in found[1] for inner in _nested(field[1])]
    store = get_typestore(Stores.EMPTY)
    fresh = {key: found for key, found in types.items() if key not in store.fielddefs}
    try:
        store.register(fresh)
        # Generates the code, which finds errors that parsing does not.
        store.get_msgdef(name)
    except Exception as error:
        raise LogError(f"the definition of {name} cannot be used: {error}") from error
    return store


def _nested(description: Any) -> list[str]:
    kind, what = description
    if kind == Nodetype.NAME:
        return [str(what)]
    return _nested(what[0]) if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else []

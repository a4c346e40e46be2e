"""Definitions of ROS types: from the file, from definition files, or from a ROS distribution."""

from __future__ import annotations

import keyword
import re
from collections.abc import Hashable, Mapping
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import Any, NamedTuple, Protocol

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from mcaprl.errors import LogError
from mcaprl.limits import (
    MAX_DEFINITION_BYTES,
    MAX_FIXED_MESSAGES,
    MAX_MESSAGES_PER_BYTE,
    MAX_TYPE_DEPTH,
    MAX_TYPE_FIELDS,
)

_LINE = "=" * 80
_SEPARATOR = re.compile(r"^={3,}[ \t]*$", re.MULTILINE)
# The parser of rosbags lacks bounded wide strings and constants that are wide strings.
_WIDE_BOUND = re.compile(r"\bwstring[ \t]*<=[ \t]*\d+")
_WIDE_CONSTANT = re.compile(r"^[ \t]*wstring[ \t]+\w+[ \t]*=.*$", re.MULTILINE)
_COMMENT_LINES = re.compile(r"^[ \t]*(?:#.*)?\n", re.MULTILINE)
_IDL_NAME = re.compile(r"\A\s*IDL:[^\n]*\n")
# An open string or comment goes on to the end, so that a search takes linear time.
_STRING = r'"(?:\\.|[^"\\])*(?:"|\Z)'
_COMMENT = re.compile(rf"({_STRING})|//[^\n]*|/\*.*?(?:\*/|\Z)", re.DOTALL)
_ANNOTATION = re.compile(rf'@\s*[\w:]+(?:\s*\((?:{_STRING}|[^()"])*\))?', re.DOTALL)
_OPERATOR = re.compile(r"[-+*/%&|^~]|::")
_PRODUCT = re.compile(r"\*[\s~+-]*[A-Za-z_]")
_DIRECTIVE = re.compile(r"[ \t]*#[ \t]*(\w*)[ \t]*(.*)")
_DEFINED = re.compile(r"(!?)\s*defined\s*\(?\s*(\w+)\s*\)?\s*")
_SHIFT = re.compile(r"<<(?!\s*\d{1,2}\b)")
_NESTED = re.compile(r"\bsequence\s*<\s*sequence\b")


def full_name(name: str) -> str:
    """Return the name of a type in the form that rosbags uses.

    >>> full_name("geometry_msgs/Twist"), full_name("std_srvs/srv/Trigger_Event")
    ('geometry_msgs/msg/Twist', 'std_srvs/srv/msg/Trigger_Event')
    """
    folder, slash, last = name.rpartition("/")
    return name if not slash or folder.endswith(("/msg", "/action")) else f"{folder}/msg/{last}"


def parsed_types(name: str, text: str, encoding: str) -> dict[str, Any]:
    """Parse a definition: constants and fields of each type by name, as rosbags describes them."""
    text = text.replace("\r\n", "\n").replace("\r", "\n").strip("\ufeff\0")
    try:
        if encoding != "ros2idl":
            text = _WIDE_CONSTANT.sub("", _WIDE_BOUND.sub("wstring", text))
            text = _COMMENT_LINES.sub("", text)
            _check_length(text.count("\n"))
            return _renamed(get_types_from_msg(_SEPARATOR.sub(_LINE, text), name))
        # The text may have several parts, each preceded by a line with the name of its type.
        parts = [_IDL_NAME.sub("", part) for part in _SEPARATOR.split(text)]
        plain = [each for part in parts if (each := _plain_idl(part)).strip()]
        # The parser of rosbags takes 1 ms for each operator, and much less for all else.
        every = [part.count(";") + 4 * len(_OPERATOR.findall(part)) for part in plain]
        _check_length(sum(every) // 4)
        types = {key: found for part in plain for key, found in get_types_from_idl(part).items()}
        return _renamed(types)
    except LogError as error:
        raise LogError(f"the definition of {name} does not parse: {error}") from error
    # rosbags raises errors of many types when a definition does not parse, with the whole text.
    except Exception as error:
        words = " ".join(str(error).split()) or type(error).__name__
        raise LogError(f"the definition of {name} does not parse: {words[:300]}") from error


def _check_length(count: int) -> None:
    """Check the number of lines or declarations; the parser of rosbags takes 0.2 ms for each."""
    if count > MAX_TYPE_FIELDS:
        raise LogError(f"it has more than {MAX_TYPE_FIELDS} fields and constants")


def _renamed(types: Mapping[str, Any]) -> dict[str, Any]:
    """Return types with full names."""
    return {
        full_name(name): (constants, [(field, _plain(each)) for field, each in fields])
        for name, (constants, fields) in types.items()
    }


def _plain(description: Any) -> Any:
    kind, what = description
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return kind, (_plain(what[0]), what[1])
    if kind != Nodetype.NAME:
        return description
    # `get_types_from_msg` parses `wstring` as the name of a message type.
    is_wide = str(what).rpartition("/")[2] == "wstring"
    return (Nodetype.BASE, ("wstring", 0)) if is_wide else (kind, full_name(str(what)))


def _plain_idl(text: str) -> str:
    """Return IDL without comments, annotations and preprocessor lines."""
    text = _preprocessed(_COMMENT.sub(lambda match: match[1] or " ", text))
    # Annotations, such as units and default values, do not change the encoding of a message.
    text = _ANNOTATION.sub(" ", text)
    code = re.sub(_STRING, '""', text, flags=re.DOTALL)
    # The parser of rosbags takes a time that is exponential in the number of nested parentheses.
    if "(" in code:
        raise LogError("expressions in parentheses are not supported")
    if _PRODUCT.search(code):
        raise LogError("products of constants are not supported")
    if _SHIFT.search(code):
        raise LogError("shifts by more than 99 bits are not supported")
    if _NESTED.search(code):
        raise LogError("sequences of sequences are not supported")
    return text


def _preprocessed(text: str) -> str:
    """Evaluate `#define`, `#ifdef` and the like; `#include` and other directives are left out."""
    if "#" not in text:
        return text
    defined, found, branches = set[str](), list[str](), list[bool]()
    for line in text.replace("\\\n", " ").split("\n"):
        match = _DIRECTIVE.match(line)
        if match is None:
            found += [line] if all(branches) else []
            continue
        word, rest = match[1], match[2].strip()
        if word in ("if", "ifdef", "ifndef"):
            branches.append(_condition(word, rest, defined))
        elif word in ("else", "elif", "endif") and not branches:
            raise LogError(f"#{word} has no #if")
        elif word == "else":
            branches[-1] = not branches[-1]
        elif word == "elif":
            raise LogError("#elif is not supported")
        elif word == "endif":
            branches.pop()
        elif word in ("define", "undef") and all(branches):
            name = re.split(r"\W", rest, maxsplit=1)[0]
            (defined.add if word == "define" else defined.discard)(name)
    return "\n".join(found)


def _condition(word: str, rest: str, defined: set[str]) -> bool:
    """Return the value of a condition, for the names that are defined."""
    if word != "if":
        return (rest.split(" ")[0] in defined) == (word == "ifdef")
    match = _DEFINED.fullmatch(rest)
    if match is not None:
        return (match[2] in defined) != bool(match[1])
    if rest.isdigit():
        return int(rest) != 0
    raise LogError(f"the condition #if {rest} cannot be evaluated")


TIME_TYPES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
UNREADABLE = ("wstring", "wchar", "float128", "fixed")  # Types whose encoding is not known
ARRAYS = (Nodetype.ARRAY, Nodetype.SEQUENCE)
ROS1 = "ros1msg"
# The definition of a service event may lack the definitions of the request and the response. By
# default, events contain neither requests nor responses, and can be read without these definitions.
_EVENT, _PARTS = "_Event", ("_Request", "_Response")
_UNKNOWN: Any = ([], [("unknown", (Nodetype.BASE, ("uint8", 0)))])
# A ROS 2 message without fields has one byte.
_EMPTY: Any = ([], [("structure_needs_at_least_one_member", (Nodetype.BASE, ("uint8", 0)))])


class TypeSource(Hashable, Protocol):
    """Definitions of types that a file lacks."""

    def types_of(self, name: str) -> Any | None:
        """Return constants and fields of the type with this full name; None if it is unknown."""


class Definitions:
    """A type and all types that are nested in it."""

    def __init__(self, name: str, types: dict[str, Any], *, is_own: bool = True) -> None:
        """Check the parsed definitions; see `definitions_of`."""
        self.name, self.is_own = name, is_own  # `is_own`: whether the file defines all types
        check_size(types, name)
        # Reason by dotted path for each field that cannot be read: a wide string, and all fields
        # after it.
        self.unreadable: dict[str, str] = {}
        self.whole = types  # As `types`, with the fields that cannot be read
        # Constants and fields of each type by its full name, as rosbags describes them, without the
        # fields that cannot be read.
        self.types = _readable(types, name, self.unreadable)

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
        for key, (_, fields) in new.items():
            for field in fields:
                # rosbags appends _ to a field name such as `from`, which is a word of Python.
                if keyword.iskeyword(field[0]):
                    setattr(store.types[key], field[0], property(attrgetter(f"{field[0]}_")))
        return store

    def decode(self, data: bytes, *, is_ros1: bool = False) -> Any:
        """Decode a message to an object with an attribute for each field."""
        try:
            if self.unreadable:
                return self._beginning(data, is_ros1=is_ros1)
            decoded = self._store.deserialize_ros1 if is_ros1 else self._store.deserialize_cdr
            return decoded(data, self.name)
        # rosbags raises errors of many types; each means that the bytes do not fit the type.
        except Exception as error:
            why = str(error) or type(error).__name__
            raise LogError(f"cannot decode {len(data)} bytes as {self.name}: {why}") from error

    def text(self, *, is_ros1: bool = False) -> str:
        """Return the definition of the type and of all types in it."""
        return self._store.generate_msgdef(self.name, ros_version=1 if is_ros1 else 2)[0]

    def md5(self) -> str:
        """Return the hash by which nodes of ROS 1 compare types."""
        return self._store.generate_msgdef(self.name, ros_version=1)[1]

    def encode(self, message: Any, *, is_ros1: bool = False) -> bytes:
        """Encode a dict, or an object with an attribute for each field; absent fields are zeros."""
        store = self._store
        try:
            encoded = store.serialize_ros1 if is_ros1 else store.serialize_cdr
            return bytes(encoded(_built(store, self.name, message), self.name))
        # rosbags and NumPy raise errors of many types for values that do not fit.
        except Exception as error:
            why = str(error) or type(error).__name__
            raise LogError(f"a message cannot be encoded as {self.name}: {why}") from error

    def _beginning(self, data: bytes, *, is_ros1: bool) -> Any:
        """Decode the fields before the first that cannot be read."""
        found: Any = self._store.get_msgdef(self.name)
        if is_ros1:
            return found.deserialize_ros1(data, 0, found.cls, self._store)[0]
        if data[:2] not in (b"\0\0", b"\0\1"):
            raise ValueError("the encapsulation is not that of plain CDR")
        decode = found.deserialize_cdr_le if data[1] else found.deserialize_cdr_be
        return decode(data[4:], 0, found.cls, self._store)[0]


def definitions_of(
    name: str,
    text: str,
    encoding: str = "ros2msg",
    distribution: str = "",
    others: TypeSource | None = None,
) -> Definitions:
    """Return a type and its nested types: those of the file, of `others`, of the distribution."""
    if len(text) > MAX_DEFINITION_BYTES:
        raise LogError(
            f"the definition of {name} has {len(text)} characters; at most"
            f" {MAX_DEFINITION_BYTES} are read"
        )
    found = _outcome(name, text, encoding, distribution, others)
    if isinstance(found, LogError):
        raise LogError(str(found))
    return found


@lru_cache(maxsize=256)
def _outcome(
    name: str, text: str, encoding: str, distribution: str, others: TypeSource | None
) -> Definitions | LogError:
    """Return the definitions, or the reason why there are none: many topics may have the same."""
    try:
        return _collected(name, text, encoding, distribution, others)
    except LogError as error:
        return error


clear_definitions = _outcome.cache_clear


def _collected(
    name: str, text: str, encoding: str, distribution: str, others: TypeSource | None
) -> Definitions:
    own = parsed_types(name, text, encoding) if text.strip() else {}
    needed, types = [name], dict[str, Any]()
    while needed:
        each = needed.pop()
        if each not in types:
            found = own.get(each) or (others.types_of(each) if others is not None else None)
            found = found or _known(distribution, encoding == ROS1).fielddefs.get(each)
            if name.endswith(_EVENT) and each.endswith(_PARTS) and not (found and found[1]):
                found = _UNKNOWN
            if found is None:
                what = "its definition" if each == name else f"the definition of nested type {each}"
                where = "the ROS distribution lacks it"
                if others is not None:
                    where = f"{others} and the ROS distribution lack it"
                raise LogError(f"{name}: {what} is missing, and {where}")
            if not found[1] and encoding != ROS1:
                found = (found[0], _EMPTY[1])
            types[each] = found
            needed += [nested for _, field in found[1] for nested in _nested(field)]
    return Definitions(name, types, is_own=types.keys() <= own.keys())


def leaf_kinds(
    types: Mapping[str, Any], name: str, prefix: str = "", *, inner: bool = False
) -> dict[str, str]:
    """Return the kind of each leaf field of a type by its dotted path."""
    # Kinds are such as `float64`, `string`, `float32[36]`, `uint8[]`, `geometry_msgs/msg/Point[]`,
    # and `time` for times and durations, whose `sec` and `nanosec` are leaf fields as well.
    found = dict[str, str]()
    for field, description in types[name][1]:
        found |= _field_kinds(types, description, f"{prefix}{field}", inner=inner)
    return found


def _field_kinds(
    types: Mapping[str, Any], description: Any, path: str, *, inner: bool
) -> dict[str, str]:
    kind, what = description
    if kind in ARRAYS:
        found = {path: _kind(description)}
        if inner and what[0][0] == Nodetype.NAME:
            parts = _field_kinds(types, what[0], f"{path}[]", inner=True)
            found |= {each: f"{part}[]" for each, part in parts.items() if each != f"{path}[]"}
        return found
    if kind == Nodetype.BASE:
        return {path: _kind(description)}
    if what in TIME_TYPES:
        return {path: "time", f"{path}.sec": "int32", f"{path}.nanosec": "uint32"}
    return leaf_kinds(types, str(what), f"{path}.", inner=inner)


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


def _nested(description: Any) -> list[str]:
    kind, what = element_of(description)
    return [str(what)] if kind == Nodetype.NAME else []


def _readable(types: dict[str, Any], name: str, unreadable: dict[str, str]) -> dict[str, Any]:
    """Return the types without the fields that cannot be read, which are added to `unreadable`."""
    # The encoding of a wide string depends on the DDS of the robot, so that the positions of all
    # fields after it are unknown.
    found = dict(types)
    is_wide: dict[str, bool] = {}

    def has_wide(description: Any) -> bool:
        kind, what = element_of(description)
        if kind == Nodetype.BASE:
            return what[0] in UNREADABLE
        if what not in is_wide:
            is_wide[what] = any(has_wide(field) for _, field in types[what][1])
        return is_wide[what]

    def cut(owner: str, prefix: str, reason: str) -> str:
        """Remove all fields of a type from the first that cannot be read; return the reason."""
        kept = []
        for field, description in types[owner][1]:
            path, was_readable = f"{prefix}{field}", not reason
            if was_readable and not has_wide(description):
                kept.append((field, description))
                continue
            kind, what = description
            if was_readable and kind == Nodetype.NAME:
                reason = cut(str(what), f"{path}.", "")
                kept += [(field, description)] if found[what][1] else []
                continue
            if was_readable:
                reason = (
                    f"{name}: field {path} contains a {_wide_word(types, description)}, whose"
                    " encoding depends on the DDS of the robot: it and all fields after it cannot"
                    " be read; record a string or a number instead"
                )
            unreadable.update(
                dict.fromkeys(_field_kinds(types, description, path, inner=True), reason)
            )
        found[owner] = (types[owner][0], kept)
        return reason

    if has_wide((Nodetype.NAME, name)):
        reason = cut(name, "", "")
        if not found[name][1]:
            raise LogError(reason)
    return found


def _wide_word(types: Mapping[str, Any], description: Any) -> str:
    """Return the first type in a field that cannot be read."""
    kind, what = element_of(description)
    if kind == Nodetype.BASE:
        return str(what[0]) if what[0] in UNREADABLE else ""
    words = (_wide_word(types, field) for _, field in types[what][1])
    return next((word for word in words if word), "")


def check_size(types: Mapping[str, Any], name: str) -> None:
    """Check the size of a type and of all types that are nested in it."""
    _Sizes(types).of(name, ())


def element_of(description: Any) -> tuple[Any, Any]:
    """Return kind and type of a field, or of the elements of an array."""
    kind, what = description
    return what[0] if kind in ARRAYS else (kind, what)


class _Size(NamedTuple):
    """Size of a type."""

    leaves: int  # Number of leaf fields, with those in arrays of messages
    depth: int  # Number of levels of nested messages
    messages: int  # Number of nested messages in the smallest message of the type
    least_bytes: int  # Number of bytes of the smallest message of the type, without padding


class _Sizes:
    """Sizes of types, each computed once: their leaf fields can be exponential in their number."""

    def __init__(self, types: Mapping[str, Any]) -> None:
        self._types = types
        self._known: dict[str, _Size] = {}
        self._fixed = 0

    def of(self, name: str, parents: tuple[str, ...]) -> _Size:
        """Return the size of a type that is nested in the types `parents`."""
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


def _built(store: Typestore, name: str, values: Any) -> Any:
    """Return a message of rosbags with the values of a dict, or of a message of another library."""
    if getattr(values, "__msgtype__", None) == name:
        return values
    found = {}
    for field, description in store.fielddefs[name][1]:
        value = values.get(field) if isinstance(values, Mapping) else getattr(values, field, None)
        own = f"{field}_" if keyword.iskeyword(field) else field
        found[own] = _value(store, description, value)
    return store.types[name](**found)


# Names of the parts of a time in ROS 1, and in rospy.
_SECONDS = {"sec": "secs", "nanosec": "nsecs"}


def _value(store: Typestore, description: Any, value: Any) -> Any:
    kind, what = description
    if kind == Nodetype.BASE:
        default: Any = "" if what[0] in ("string", "wstring") else what[0] == "bool" and False
        value = default if value is None else value
        return value[0] if isinstance(value, bytes) and what[0] in ("byte", "octet") else value
    if kind == Nodetype.NAME:
        if hasattr(value, "secs"):
            value = {ours: getattr(value, theirs) for ours, theirs in _SECONDS.items()}
        return _built(store, what, {} if value is None else value)
    element, count = what
    if element[0] == Nodetype.BASE and element[1][0] not in ("string", "wstring"):
        dtype = {"byte": "uint8", "octet": "uint8", "char": "uint8"}.get(*[element[1][0]] * 2)
        is_fixed = kind == Nodetype.ARRAY
        if value is None:
            return np.zeros(count if is_fixed else 0, dtype)
        is_bytes = isinstance(value, bytes | bytearray | memoryview)
        found = np.frombuffer(value, np.uint8) if is_bytes else np.asarray(value, dtype)
        return found.astype(dtype, copy=False)
    given = value if value is not None else [None] * (count if kind == Nodetype.ARRAY else 0)
    return [_value(store, element, each) for each in given]

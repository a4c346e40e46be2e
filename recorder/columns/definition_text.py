"""Parser of the texts of ROS definitions: `ros2msg`, `ros1msg` and `ros2idl`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_idl, get_types_from_msg

from mcaprl.errors import LogError
from mcaprl.limits import MAX_TYPE_FIELDS

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
    """Parse a definition.

    Returns:
        Constants and fields of each type by its name, as rosbags describes them.
    """
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

"""JSON and YAML files: read in bounds, and checked against the types of dataclasses.

A file can be nested too deeply for the stack, expand without end by aliases, or contain a number
or date that its parser cannot convert. Each of these is one error here, for all files.
"""

from __future__ import annotations

import json
import math
import types
from collections.abc import Callable, Iterable
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

from mcaprl.errors import McaprlError, UsageError, import_extra
from mcaprl.limits import MAX_DOCUMENT_VALUES, MAX_METADATA_BYTES
from mcaprl.storage.locks import read_file
from mcaprl.texts import encodable

_MAX_DEPTH = 100
_TOO_DEEP = f"it is nested more than {_MAX_DEPTH} levels deep"
_SHOWN = 200
_SCALARS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    Any: "a value",
}


def parse_json(text: str | bytes) -> Any:
    """Parse JSON; refuse texts that are nested more deeply than the files of this package."""
    try:
        found = json.loads(text)
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error
    # Each level takes two brackets, so most texts are too short to be nested too deeply.
    if len(text) > 2 * _MAX_DEPTH:
        _check_nesting(found, math.inf)
    return found


def read_json(path: Path, error_type: type[McaprlError], kind: type[Any] | None = None) -> Any:
    """Read a JSON file."""
    try:
        found = parse_json(read_file(path))
        return found if kind is None else as_type(kind, found)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise error_type(f"{path} cannot be read: {error}") from error


def read_yaml(path: Path, extra: str, *, with_lines: bool = False) -> Any:
    """Read a YAML 1.2 file, which may also be JSON."""
    yaml = import_extra("ruamel.yaml", extra)
    parser = yaml.YAML(typ="rt") if with_lines else yaml.YAML(typ="safe", pure=True)
    try:
        content = read_file(path)
        if len(content) > MAX_METADATA_BYTES:
            raise UsageError(f"{path} has more than {MAX_METADATA_BYTES} bytes")
        found = parser.load(content.decode())
        _check_nesting(found, MAX_DOCUMENT_VALUES)
        return found
    except UsageError:
        raise
    except OSError as error:
        reason = f"cannot be read: {error.strerror}" if error.strerror else str(error)
        raise UsageError(f"{path}: {reason}") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path} is not UTF-8 text: {error.reason}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path}:{mark.line + 1}" if mark else str(path)
        raise UsageError(f"{where}: not YAML: {getattr(error, 'problem', error)}") from error
    # The library raises any exception for impossible numbers, dates, keys and merges.
    except Exception as error:
        reason = _TOO_DEEP if isinstance(error, RecursionError) else str(error)[:_SHOWN]
        raise UsageError(f"{path}: a value cannot be read: {reason}") from error


def _check_nesting(found: object, most: float) -> None:
    """Check the depth of nested dicts and lists, and the number of values, with all aliases."""
    level, count = [found] if isinstance(found, dict | list) else [], 0
    for _ in range(_MAX_DEPTH + 1):
        if not level:
            return
        count += sum(map(len, level))
        if count > most:
            raise ValueError(f"it has more than {most:,} values, with all aliases")
        inner = (part.values() if isinstance(part, dict) else part for part in level)
        level = [part for parts in inner for part in parts if isinstance(part, dict | list)]
    raise ValueError(_TOO_DEEP)


def as_type(kind: Any, found: object, name: str = "it") -> Any:
    """Return parsed JSON as a type: a dataclass, NamedTuple, dict, list, tuple, number or text."""
    # Whole numbers have at most 64 bits. A missing float is null in JSON, and becomes NaN. Further
    # keys of a JSON object are not read.
    parts = get_args(kind)
    if get_origin(kind) is types.UnionType:
        return None if found is None else as_type(parts[0], found, name)
    if is_dataclass(kind) or hasattr(kind, "_field_defaults"):
        return _as_record(kind, found, name)
    match get_origin(kind) or kind:
        case builtin if builtin is dict:
            values = _checked(found, isinstance(found, dict), name, "an object").items()
            return {key: as_type(parts[1], each, f"{name}: {key}") for key, each in values}
        case builtin if builtin is list:
            return _items(list, [parts[0], ...], found, name)
        case builtin if builtin is tuple:
            return _items(tuple, parts, found, name)
        case origin if origin is Literal:
            return _checked(found, found in parts, name, f"one of {', '.join(parts)}")
    return _as_scalar(kind, found, name)


def _as_record(kind: Any, found: object, name: str) -> Any:
    tree, given = _checked(found, isinstance(found, dict), name, "an object"), {}
    optional = getattr(kind, "_field_defaults", None)
    if optional is None:
        optional = {
            each.name
            for each in fields(kind)
            if (each.default, each.default_factory) != (MISSING, MISSING)
        }
    for key, part in get_type_hints(kind).items():
        if key in tree:
            given[key] = as_type(part, tree[key], key)
        elif key not in optional:
            raise ValueError(f"{name} has no {key}")
    return kind(**given)


def _items(collect: Callable[[Iterable[Any]], Any], kinds: Any, found: object, name: str) -> Any:
    """Return the items of a list, of which each has a type; `...` repeats the first type."""
    values = _checked(found, isinstance(found, list), name, "a list")
    if kinds[-1] is ...:
        kinds = kinds[:1] * len(values)
    _checked(found, len(values) == len(kinds), name, f"a list of {len(kinds)}")
    return collect(as_type(kind, each, name) for kind, each in zip(kinds, values, strict=True))


def _as_scalar(kind: Any, found: object, name: str) -> Any:
    holds = kind is Any or isinstance(found, kind)
    if kind is float:
        if found is None:
            return math.nan
        holds = isinstance(found, int | float) and not isinstance(found, bool)
        holds = holds and (isinstance(found, float) or abs(cast(int, found)) < 2**63)
    elif kind is int:
        holds = holds and not isinstance(found, bool) and -(2**63) <= cast(int, found) < 2**64
    _checked(found, holds, name, _SCALARS[kind])
    if kind is str:
        return encodable(cast(str, found))
    return float(cast(float, found)) if kind is float else found


def _checked(found: object, holds: bool, name: str, wanted: str) -> Any:
    """Return a value; raise ValueError if it is not what is wanted."""
    if not holds:
        raise ValueError(f"{name} must be {wanted}, got {str(found)[:_SHOWN]!r}")
    return found

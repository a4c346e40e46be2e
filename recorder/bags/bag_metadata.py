"""Reader of the `metadata.yaml` of a rosbag2 folder.

Only the few values that are used are read, and all of them are texts: no YAML type is constructed,
and aliases, which can multiply the size of a value, are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from mcaprl.errors import LogError, import_extra
from mcaprl.limits import MAX_METADATA_BYTES, MAX_METADATA_DEPTH

_ROOT: Final = "rosbag2_bagfile_information"
_TEXTS: Final = ("compression_mode", "ros_distro")
_LISTS: Final = ("relative_file_paths",)


def read_metadata(path: Path) -> dict[str, Any]:
    """Read the metadata of a bag.

    Returns:
        `relative_file_paths`, a list of texts, and the texts `compression_mode` and `ros_distro`;
        those that the file has.

    Raises:
        LogError: The file cannot be read, is not YAML, is too large, or has a value of another
            type.
        MissingExtraError: The packages of the `bags` extra are not installed.
    """
    yaml = import_extra("ruamel.yaml", "bags")
    try:
        if not path.is_file():
            raise LogError("not a regular file")
        with path.open("rb") as file:
            data = file.read(MAX_METADATA_BYTES + 1)
        if len(data) > MAX_METADATA_BYTES:
            raise LogError(f"it has more than {MAX_METADATA_BYTES} bytes")
        return _values(yaml.YAML(typ="safe").parse(data.decode("utf-8")))
    # ruamel.yaml raises errors of many types for a wrong file.
    except Exception as error:
        why = getattr(error, "problem", None) or getattr(error, "strerror", None) or error
        raise LogError(f"{path} is not the metadata of a rosbag2 bag: {why}") from error


def _values(events: Iterator[Any]) -> dict[str, Any]:
    """Return the used values of a document, given as the events of a YAML parser.

    Raises:
        LogError: A value has another type, or is nested too deeply.
    """
    found: dict[str, Any] = {}
    # Keys of the mappings that contain the current value. The key of a list is None, and so is that
    # of a mapping before its next key.
    keys: list[str | None] = []
    are_lists: list[bool] = []
    for event in events:
        name = type(event).__name__
        if name == "AliasEvent":
            raise LogError("aliases are not supported")
        is_key = bool(are_lists) and not are_lists[-1] and keys[-1] is None
        if name in ("MappingStartEvent", "SequenceStartEvent"):
            if is_key:
                raise LogError("a key is not a text")
            _check_type(keys, name)
            keys.append(None)
            are_lists.append(name == "SequenceStartEvent")
            if len(keys) > MAX_METADATA_DEPTH:
                raise LogError(f"it is nested in more than {MAX_METADATA_DEPTH} levels")
            continue
        if name == "ScalarEvent" and is_key:
            keys[-1] = str(event.value)
            continue
        if name == "ScalarEvent":
            _check_type(keys, name)
            _store(found, keys, str(event.value))
        elif name in ("MappingEndEvent", "SequenceEndEvent"):
            keys.pop()
            are_lists.pop()
        if are_lists and not are_lists[-1]:
            keys[-1] = None
    if _ROOT not in found:
        raise LogError(f"it has no {_ROOT}")
    return {name: value for name, value in found.items() if name != _ROOT}


def _check_type(keys: list[str | None], event: str) -> None:
    """Check the type of the value with these keys, which begins with an event."""
    if len(keys) != 2 or keys[0] != _ROOT:
        return
    expected = "SequenceStartEvent" if keys[1] in _LISTS else "ScalarEvent"
    if keys[1] in (*_LISTS, *_TEXTS) and event != expected:
        raise LogError(f"{keys[1]} is not {'a list' if keys[1] in _LISTS else 'a text'}")


def _store(found: dict[str, Any], keys: list[str | None], text: str) -> None:
    if keys[:1] != [_ROOT]:
        return
    found[_ROOT] = True
    if len(keys) == 2 and keys[1] in _TEXTS:
        found[str(keys[1])] = text
    elif len(keys) == 3 and keys[1] in _LISTS and keys[2] is None:
        found.setdefault(str(keys[1]), []).append(text)

"""Reader of the `metadata.yaml` of a rosbag2 folder.

Only the few values that are used are read, and all of them are texts: no YAML type is constructed,
and aliases, which can multiply the size of a value, are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
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
    """Return the used values of a document, given as the events of a YAML parser."""
    # The first two events begin the stream and the document. An empty stream has no third one.
    start = next(islice(events, 2, None), None)
    tree = _value(events, start) if start else None
    found = tree.get(_ROOT) if isinstance(tree, dict) else None
    if found is None:
        raise LogError(f"it has no {_ROOT}")
    used: dict[str, Any] = {}
    for name in (*_TEXTS, *_LISTS):
        if isinstance(found, dict) and name in found:
            kind, expected = (list, "a list") if name in _LISTS else (str, "a text")
            if not isinstance(found[name], kind):
                raise LogError(f"{name} is not {expected}")
            texts = [each for each in found[name] if isinstance(each, str)]
            if texts or kind is str:
                used[name] = found[name] if kind is str else texts
    return used


def _value(events: Iterator[Any], event: Any, depth: int = 0) -> Any:
    """Return the text, list or dict that begins with an event."""
    name = type(event).__name__
    if depth > MAX_METADATA_DEPTH:
        raise LogError(f"it is nested in more than {MAX_METADATA_DEPTH} levels")
    if name == "AliasEvent":
        raise LogError("aliases are not supported")
    if name == "ScalarEvent":
        return str(event.value)
    values = []
    while not type(event := next(events)).__name__.endswith("EndEvent"):
        values.append(_value(events, event, depth + 1))
        if name == "MappingStartEvent":
            if not isinstance(values[-1], str):
                raise LogError("a key is not a text")
            values[-1] = values[-1], _value(events, next(events), depth + 1)
    return values if name == "SequenceStartEvent" else dict(values)

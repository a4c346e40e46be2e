"""Messages of ROS 2 with wide strings, whose encoding depends on the DDS of the robot.

The characters have two or four bytes. Both forms are tried for each message; the right one is that
in which the message ends where the data end, and all characters are valid.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from mcaprl.recorder.format.reading import UNREADABLE

_WIDE = "wstring"
_LARGEST = {"uint16": 0xFFFF, "uint32": 0x10FFFF}
"""Types of the characters, with the largest valid character of each."""


class WideForms:
    """Forms of a type with wide strings.

    Attributes:
        paths: Dotted path of each wide string.
        types: Constants and fields of each type, without the wide strings.
    """

    def __init__(self, types: Mapping[str, Any], name: str) -> None:
        """Find the wide strings."""
        self._name, self._all = name, types
        self.paths = tuple(_paths(types, name, ""))
        self.types = {key: _replaced(found, None) for key, found in types.items()}
        self._stores: dict[str, Typestore] = {}

    def decode(self, data: bytes) -> Any | None:
        """Decode a message; return None if no form, or several, fit the bytes."""
        found = []
        for character, largest in _LARGEST.items():
            try:
                message = self._store(character).deserialize_cdr(data, self._name)
            # rosbags raises errors of many types; each means that the bytes do not fit the form.
            except Exception:
                continue
            texts = [attrgetter(path)(message).tolist() for path in self.paths]
            if all(0 < each <= largest for text in texts for each in text):
                found.append((texts, message))
        # Texts that are equal in both forms are followed by the same bytes.
        return found[0][1] if found and all(found[0][0] == texts for texts, _ in found) else None

    def _store(self, character: str) -> Typestore:
        if character not in self._stores:
            store = get_typestore(Stores.EMPTY)
            new = {key: _replaced(found, character) for key, found in self._all.items()}
            store.register({key: each for key, each in new.items() if key not in store.fielddefs})
            self._stores[character] = store
        return self._stores[character]


def _paths(types: Mapping[str, Any], name: str, prefix: str) -> list[str]:
    found = []
    for field, (kind, what) in types[name][1]:
        if kind == Nodetype.NAME:
            found += _paths(types, str(what), f"{prefix}{field}.")
        elif kind == Nodetype.BASE and what[0] == _WIDE:
            found.append(f"{prefix}{field}")
        elif kind == Nodetype.BASE:
            _check(what[0] not in UNREADABLE)
        else:
            _check(not _has(types, what[0]))
    return found


def _has(types: Mapping[str, Any], description: Any) -> bool:
    """Return whether a field contains types whose encoding is not known."""
    kind, what = description
    if kind == Nodetype.BASE:
        return what[0] in UNREADABLE
    if kind == Nodetype.NAME:
        return any(_has(types, each) for _, each in types[what][1])
    return _has(types, what[0])


def _check(is_possible: bool) -> None:
    if not is_possible:
        raise ValueError("an array or another type has an unknown encoding")


def _replaced(found: Any, character: str | None) -> Any:
    """Replace wide strings by arrays of characters; without a type of these, remove them."""
    constants, fields = found
    array = (Nodetype.SEQUENCE, ((Nodetype.BASE, (character, 0)), 0))
    is_wide = [kind == Nodetype.BASE and what[0] == _WIDE for _, (kind, what) in fields]
    return constants, [
        (name, array if wide else description)
        for (name, description), wide in zip(fields, is_wide, strict=True)
        if character is not None or not wide
    ]

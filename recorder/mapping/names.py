"""Elements of arrays by their names, such as the joints of a robot."""

from __future__ import annotations

import difflib
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import TopicInfo
from mcaprl.recorder.bags.path_steps import NAMES, path_text, steps_of
from mcaprl.recorder.bags.values import PARALLEL, Lack, as_array, element_of, texts_of
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.paths import FieldPath, Floats, path_in, rows_of


class Named(NamedTuple):
    """Values of M messages.

    Attributes:
        values: (M,) or (M, K) numbers, or (M,) texts.
        present: (M,) or (M, K) flags of the values that are updates; of the others, the values
            before are valid. None if all are.
    """

    values: NDArray[Any]
    present: NDArray[np.bool_] | None


def names_field(info: TopicInfo, path: FieldPath, quantity: Quantity) -> str:
    """Return the field with the names of a path's elements; empty if there are none."""
    if quantity.names and path.elements is not None:
        raise UsageError(f"{path}: `names` selects the elements; remove the index or slice")
    if quantity.names_from is not None:
        field = path_in(path.topic, quantity.names_from)
        if not info.may_have(field.field):
            raise UsageError(f"{path.topic} ({info.type_name}) has no field '{field.field}'")
        return path_text(field.steps)
    if quantity.names is not None and not quantity.names:
        return ""
    found = _beside(info, path)
    if quantity.names and not found:
        raise UsageError(
            f"{path} has no names beside it; set `names_from` to the field that contains them"
        )
    return found


def _beside(info: TopicInfo, path: FieldPath) -> str:
    """Return the array of names that the type has beside an array, or in a message around it.

    If the type does not show it, this is the path of the names that the messages contain.
    """
    steps = steps_of(path.field)
    kind = info.fields.get(path.field)
    if kind is None or info.encoding == "json":
        return f"{path.field}{NAMES}"
    if "[" not in kind:
        return ""
    for count in range(len(steps) - 1, -1, -1):
        for name in PARALLEL:
            field = path_text((*steps[:count], name))
            if info.fields.get(field, "").startswith("string["):
                return field
    return ""


def by_names(
    path: FieldPath, column: NDArray[Any], texts: NDArray[Any], wanted: str | list[str]
) -> Named:
    """Return the elements with the wanted names.

    Args:
        path: Path of the field, for error messages.
        column: (M, K) numbers, or (M,) arrays of numbers.
        texts: (M,) lists of the names of the elements; None where a message has none.
        wanted: Names, or one name.

    Returns:
        Numbers (M, K) of K names, with the messages that contain them; (M,) for one name.
    """
    names = [wanted] if isinstance(wanted, str) else wanted
    values = np.full((len(column), len(names)), np.nan)
    present = np.zeros(values.shape, bool)
    known: dict[str, None] = {}
    for each, rows in _orders(column, texts).items():
        known |= dict.fromkeys(each)
        places = {name: place for place, name in enumerate(each)}
        for number, name in enumerate(names):
            if name not in places:
                continue
            if each.count(name) > 1:
                raise UsageError(f"{path}: message {rows[0]} has the name '{name}' twice")
            values[rows, number] = _elements(path, column, rows, places[name])
            present[rows, number] = True
    for name, is_found in zip(names, present.T, strict=True):
        if len(column) and not is_found.any():
            near = difflib.get_close_matches(name, known, n=3, cutoff=0.4) or list(known)[:8]
            what = f"nearest: {', '.join(near)}" if near else "no message has names"
            raise UsageError(f"{path}: no message has an element '{name}'; {what}")
    return Named(values[:, 0], present[:, 0]) if isinstance(wanted, str) else Named(values, present)


def _orders(column: NDArray[Any], texts: NDArray[Any]) -> dict[tuple[str, ...], list[int]]:
    """Return the messages with each order of the names.

    Messages whose names are not those of the elements are left out.
    """
    found: dict[tuple[str, ...], list[int]] = {}
    length = column.shape[1] if column.ndim > 1 else None
    for row, names in enumerate(texts):
        listed = _flat_texts(names)
        if listed is None:
            continue
        if len(listed) == (_length(column[row]) if length is None else length):
            found.setdefault(tuple(listed), []).append(row)
    return found


def _flat_texts(value: Any) -> list[str] | None:
    """Return a string, an array of strings, or an array of such arrays as one list."""
    if isinstance(value, str):
        return [value]
    found = texts_of(value)
    if found is None and isinstance(value, list):
        parts = [texts_of(each) for each in value]
        return None if None in parts else [text for part in parts for text in part or ()]
    return found


def _length(value: Any) -> int:
    """Return the number of numbers in a value, which may be an array of arrays; -1 if unknown."""
    flat = _flat(value)
    return -1 if flat is None else len(flat)


def _flat(value: Any) -> Floats | None:
    found = None if value is None else as_array(value)
    if found is not None:
        return found.reshape(-1)
    # The lengths of the inner arrays differ.
    if not isinstance(value, list):
        return None
    parts = [np.empty(0) if each is None else as_array(each) for each in value]
    return (
        None
        if any(part is None for part in parts)
        else np.concatenate([np.ravel(part) for part in parts if part is not None] or [np.empty(0)])
    )


def _elements(path: FieldPath, column: NDArray[Any], rows: list[int], place: int) -> Any:
    if column.dtype.kind != "O":
        return column[rows, place] if column.ndim > 1 else column[rows]
    found = []
    for row in rows:
        flat = _flat(column[row])
        if flat is None:
            rows_of(column[[row]], str(path))
        found.append(np.nan if flat is None else flat[place])
    return found


def check_order(path: FieldPath, column: NDArray[Any], texts: NDArray[Any]) -> None:
    """Check that the names of the elements that a path selects do not change.

    Names of which a message has another number than it has elements are not those of the elements.

    Args:
        path: Path of the field.
        column: Values of the whole field.
        texts: (M,) names of its elements.
    """
    orders: dict[tuple[str, ...], int] = {}
    length = column.shape[1] if column.ndim > 1 else None
    last: Any = None
    for row, names in enumerate(texts):
        count = _length(column[row]) if length is None else length
        # Nearly always, the names are those of the message before.
        if count < 1 or (length is not None and names == last):
            continue
        last = names
        listed = _flat_texts(names)
        if listed is None or len(listed) != count:
            return
        if path.elements is not None:
            found = element_of(listed, path.elements)
            listed = [] if isinstance(found, Lack) else _flat_texts(found) or []
        if listed:
            # An element that omits the field has no name here.
            known = next(iter(orders), ())
            if len(known) == len(listed):
                listed = [name or old for name, old in zip(listed, known, strict=True)]
            orders.setdefault(tuple(listed), row)
    if len(orders) > 1:
        (one, first), (other, second) = list(orders.items())[:2]
        wanted = _listed(dict.fromkeys([*one, *other]))
        raise UsageError(
            f"{path}: the names of the elements change: [{_listed(one)}] in message {first},"
            f" [{_listed(other)}] in message {second}: select them by `names: [{wanted}]`"
        )


def _listed(names: Collection[str]) -> str:
    return ", ".join(list(names)[:12]) + (", ..." if len(names) > 12 else "")

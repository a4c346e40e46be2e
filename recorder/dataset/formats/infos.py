"""Infos in the formats that need a value in each row.

In a row for which the environment returned no info, a float is stored as NaN, and a string as the
empty string. If integers or flags have such rows, all their values are stored as floats, with NaN
in these rows. The dtype and the rows without an info are also stored, so that infos are read back
unchanged.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.dataset.dataset import Dataset

# Floats cannot represent larger integers exactly.
_MAX_EXACT = 2**53


class StoredInfo(NamedTuple):
    """An info with a value in each of F rows.

    Attributes:
        values: (F, *shape) numbers, flags or strings.
        is_missing: (F,) bool; whether the environment returned no info for the row.
        dtype: Data type of the info.
    """

    values: NDArray[Any]
    is_missing: NDArray[np.bool_]
    dtype: np.dtype[Any]

    def rows(self, rows: Any) -> StoredInfo:
        """Return this info with only the given rows."""
        return self._replace(values=self.values[rows], is_missing=self.is_missing[rows])


def infos_of(dataset: Dataset) -> Mapping[str, Any]:
    """Return masked arrays (F, *shape) by dotted name, one row for each observation."""
    return dataset.infos


def stored_infos(infos: Mapping[str, Any]) -> tuple[dict[str, StoredInfo], list[str]]:
    """Return the infos to store by name, and one sentence for each info that is left out."""
    found, lost = {}, []
    for name, values in infos.items():
        stored = _stored(values)
        if isinstance(stored, str):
            lost.append(f"the info '{name}' is left out, because {stored}")
        else:
            found[name] = stored
    return found, lost


def masked(
    values: NDArray[Any], is_missing: NDArray[np.bool_], dtype: np.dtype[Any] | None = None
) -> np.ma.MaskedArray[Any, Any]:
    """Return an info as the environment returned it. This is the inverse of `stored_infos`.

    Args:
        values: (F, *shape) stored values.
        is_missing: (F,) bool; whether the row has no info.
        dtype: Data type of the info; default: the dtype of the values.
    """
    dtype = values.dtype if dtype is None else dtype
    mask = np.broadcast_to(is_missing.reshape(-1, *[1] * (values.ndim - 1)), values.shape)
    if dtype.kind == "U" and values.dtype.kind == "U":
        # A description may declare texts of any length.
        dtype = values.dtype
    if values.dtype.kind == "f" and dtype.kind != "f":
        values = np.where(mask, 0, values)
    with np.errstate(all="ignore"):
        return np.ma.MaskedArray(values.astype(dtype), mask.copy())


def info_type(text: str) -> np.dtype[Any]:
    """Return the dtype with this name.

    Raises:
        ValueError: The dtype is unknown, or is not one of numbers, flags or text.
    """
    try:
        dtype = np.dtype(text)
    except TypeError as error:
        raise ValueError(f"unknown dtype {text!r}") from error
    if dtype.kind not in "biufU":
        raise ValueError(f"dtype {text!r}")
    return dtype


def nested_names(names: Iterable[str]) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """Split each dotted name into the names of nested groups and of an array.

    Returns:
        The parts of each name, and one sentence for each name that cannot be split.
    """
    found: dict[str, tuple[str, ...]] = {}
    lost = []
    every = set(names)
    for name in sorted(every):
        parts = tuple(name.split("."))
        is_group = any(other.startswith(f"{name}.") for other in every)
        if is_group or not all(parts) or re.search(r"[/\0\ud800-\udfff]", name):
            reason = "its name is not valid in HDF5"
            if is_group:
                reason = f"another name starts with '{name}.'"
            lost.append(f"the info '{name}' is left out, because {reason}")
        else:
            found[name] = parts
    return found, lost


def _stored(values: Any) -> StoredInfo | str:
    """Return the info to store, or the reason why it cannot be stored."""
    data = np.ma.getdata(values)
    mask = np.ma.getmaskarray(values)
    is_missing = np.zeros(len(data), bool)
    if mask.size:
        is_missing[:] = mask.reshape(len(data), -1).any(axis=1)
    if data.dtype.kind not in "biufU":
        return f"values of dtype {data.dtype} cannot be stored"
    if data.dtype.kind == "U":
        if any(re.search(r"[\0\ud800-\udfff]", text) for text in data[~is_missing].ravel()):
            return "a text is not UTF-8"
        filled = np.where(mask, "", data)
    elif not is_missing.any():
        filled = data
    elif data.dtype.kind == "f":
        filled = np.where(mask, np.nan, data).astype(data.dtype)
    elif data.dtype.kind in "iu" and _is_large(data[~is_missing]):
        return "some rows are missing, and the integers are too large for floats"
    else:
        filled = np.where(mask, np.nan, data.astype(np.float64))
    return StoredInfo(filled, is_missing, data.dtype)


def _is_large(values: NDArray[Any]) -> bool:
    return bool(values.size) and max(int(values.max()), -int(values.min())) > _MAX_EXACT

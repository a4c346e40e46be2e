"""Infos in the formats that need a value in each row.

In a row for which the environment returned no info, a float is stored as NaN, and a string as the
empty string. If integers or flags have such rows, all their values are stored as floats, with NaN
in these rows.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

NO_NAME = r"[/\0\ud800-\udfff]"
"""Pattern of the characters that names in archives and HDF5 files do not have."""
# Floats cannot represent larger integers exactly.
_MAX_EXACT = 2**53


def stored_infos(infos: Mapping[str, Any]) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Return the values (F, *shape) to store by name, and a sentence for each info left out."""
    found, lost = {}, []
    for name, values in infos.items():
        stored = _stored(values)
        if isinstance(stored, str):
            lost.append(f"the info '{name}' is left out, because {stored}")
        else:
            found[name] = stored
    return found, lost


def missing_rows(values: Any) -> NDArray[np.bool_]:
    """Return flags (F,): whether the environment returned no info for the row."""
    mask = np.ma.getmaskarray(values)
    found = np.zeros(len(mask), bool)
    if mask.size:
        found[:] = mask.reshape(len(mask), -1).any(axis=1)
    return found


def masked(values: NDArray[Any], is_missing: NDArray[np.bool_]) -> np.ma.MaskedArray[Any, Any]:
    """Return an info (F, *shape) whose rows are masked where `is_missing` (F,) is set."""
    mask = np.broadcast_to(is_missing.reshape(-1, *[1] * (values.ndim - 1)), values.shape)
    return np.ma.MaskedArray(values, mask.copy())


def info_type(text: str) -> np.dtype[Any]:
    """Return the dtype with this name."""
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
        if is_group or not all(parts) or re.search(NO_NAME, name):
            reason = "its name is not valid in HDF5"
            if is_group:
                reason = f"another name starts with '{name}.'"
            lost.append(f"the info '{name}' is left out, because {reason}")
        else:
            found[name] = parts
    return found, lost


def _stored(values: Any) -> NDArray[Any] | str:
    """Return the values to store, or the reason why they cannot be stored."""
    data, mask, is_missing = np.ma.getdata(values), np.ma.getmaskarray(values), missing_rows(values)
    if data.dtype.kind not in "biufU":
        return f"values of dtype {data.dtype} cannot be stored"
    if data.dtype.kind == "U":
        if any(re.search(r"[\0\ud800-\udfff]", text) for text in data[~is_missing].ravel()):
            return "a text is not UTF-8"
        return np.where(mask, "", data)
    if not is_missing.any():
        return data
    if data.dtype.kind == "f":
        return np.where(mask, np.nan, data).astype(data.dtype)
    if data.dtype.kind in "iu" and _is_large(data[~is_missing]):
        return "some rows are missing, and the integers are too large for floats"
    return np.where(mask, np.nan, data.astype(np.float64))


def _is_large(values: NDArray[Any]) -> bool:
    return bool(values.size) and max(int(values.max()), -int(values.min())) > _MAX_EXACT

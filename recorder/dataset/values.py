"""Checks of arrays from other sources: each value must be one that its column can contain.

All functions name the array and the first wrong row in their errors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import SpaceError
from mcaprl.recorder.format.behavior import LOG_DENSITY, PROBABILITY, BehaviorField
from mcaprl.recorder.format.spaces import outside
from mcaprl.texts import shortened

_MAX_SHOWN = 40


def numbers(name: str, values: Any) -> NDArray[Any]:
    """Return flags, integers or floats as an array."""
    if isinstance(values, np.ma.MaskedArray) and np.ma.getmaskarray(values).any():
        raise SpaceError(f"{name} has no value in row {_first(np.ma.getmaskarray(values))}")
    try:
        array = np.asarray(values)
    # PyTorch raises these errors for tensors on a GPU or with a gradient.
    except (TypeError, ValueError, RuntimeError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise SpaceError(f"{name} cannot be converted to an array: {reason}") from error
    if array.dtype.kind in "biuf":
        return array
    what = f"{name} has dtype {array.dtype}, but they must be numbers"
    if array.dtype.kind == "O":
        is_number = [isinstance(value, int | float | np.number | np.bool_) for value in array.flat]
        wrong = ~np.array(is_number, bool).reshape(array.shape)
        if not wrong.any():
            raise SpaceError(f"{what}: convert the array of objects with astype")
        raise SpaceError(f"{what}: {_row(array, wrong)}")
    raise SpaceError(f"{what}: {_row(array, np.ones(array.shape, bool))}")


def flags(name: str, values: Any, *, first_row: int = 0) -> NDArray[np.bool_]:
    """Return 0 and 1, or False and True, as flags."""
    array = numbers(name, values)
    wrong = (array != 0) & (array != 1)
    if wrong.any():
        raise SpaceError(f"{name} are not flags: {_row(array, wrong, first_row)}, expected 0 or 1")
    return array.astype(np.bool_)


def rewards_of(name: str, values: Any) -> NDArray[np.float64]:
    """Return rewards as float64."""
    return exactly(name, numbers(name, values), np.dtype(np.float64))


def behavior_of(
    field: BehaviorField,
    probs: Any,
    log_probs: Any,
    *,
    place: str = "",
    is_table: bool = False,
    first_row: int = 0,
) -> NDArray[np.float32] | None:
    """Return probabilities or log densities of actions in the meaning of `field`; NaN is unknown.

    Args:
        field: Meaning of the result.
        probs: Probabilities; None if there are none. Earlier versions stored those of all actions.
        log_probs: Logarithms of probabilities or densities; None if there are none.
        place: Text before the names of the arrays, for errors.
        is_table: Whether errors name the columns of a table, instead of arrays.
        first_row: Row of the first value, for errors.
    """
    for given, values in ((PROBABILITY, probs), (LOG_DENSITY, log_probs)):
        if values is None:
            continue
        name = f"{place}{given.name if is_table else given.plural}"
        array = numbers(name, values)
        wrong, expected = given.is_impossible(array), given.expected
        if given == LOG_DENSITY and field == PROBABILITY:
            wrong |= field.is_impossible(np.exp(array.astype(np.float64)))
            expected = f"the logarithm of {field.expected}"
        if wrong.any():
            raise SpaceError(f"{name}: {_row(array, wrong, first_row)}, expected {expected}")
    return field.column(probs, log_probs)


def behavior_of_arrays(
    field: BehaviorField, probs: Any, log_probs: Any
) -> NDArray[np.float32] | None:
    """Return the behavior column of a caller's arrays; None if there are none."""
    if probs is not None:
        field.probs(np.empty(0, np.float32))
        if log_probs is not None:
            raise SpaceError("pass behavior_probs or behavior_log_probs, not both")
    found = behavior_of(field, probs, log_probs)
    return None if found is None else found.copy()


def check_finite(name: str, values: NDArray[Any], *, first_row: int = 0) -> None:
    """Check that no value is NaN or infinite."""
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        wrong = ~np.isfinite(values)
        raise SpaceError(f"{name}: {_row(values, wrong, first_row)}, which is not finite")


def check_inside(
    name: str, values: NDArray[Any], space: spaces.Space[Any], *, first_row: int = 0
) -> None:
    """Check that values are in a Discrete, MultiDiscrete or MultiBinary space."""
    if isinstance(space, spaces.Box):
        return
    wrong = outside(space, values)
    if wrong.any():
        raise SpaceError(f"{name}: {_row(values, wrong, first_row)}, which is outside of {space}")


def is_beyond_float32(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the finite numbers that are too large for float32."""
    found: NDArray[np.bool_] = np.isfinite(values) & (np.abs(values) > np.finfo(np.float32).max)
    return found


def exactly(where: str, array: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Copy an array to another dtype without changing any value."""
    if array.dtype == dtype:
        return array.copy()
    with np.errstate(all="ignore"):
        cast = array.astype(dtype)
        # NumPy rounds integers when it compares them with floats, so they are also cast back.
        same = (cast == array) & (cast.astype(array.dtype) == array)
    if dtype.kind == "f" and array.dtype.kind == "f":
        same |= np.isnan(cast) & np.isnan(array)
    if not same.all():
        raise SpaceError(
            f"{where} is {array.dtype} and cannot be converted exactly to {dtype}:"
            f" {_row(array, ~same)}"
        )
    return cast


def _first(wrong: NDArray[np.bool_]) -> int:
    """Return the index of the first row with a true value."""
    return int(wrong.reshape(len(wrong), -1).any(axis=1).argmax()) if wrong.ndim else 0


def _row(array: NDArray[Any], wrong: NDArray[np.bool_], first_row: int = 0) -> str:
    """Describe the first wrong value."""
    if not array.size:
        return "there are no values"
    value = array[np.unravel_index(int(wrong.argmax()), array.shape)] if array.ndim else array[()]
    shown = repr(value.item()) if isinstance(value, np.generic) else repr(value)
    return f"row {_first(wrong) + first_row} is {shortened(shown, _MAX_SHOWN)}"

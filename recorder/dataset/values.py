"""Checks of arrays from other sources: each value must be one that its column can contain.

All functions name the array and the first wrong row in their errors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import SpaceError
from mcaprl.recorder.format.probability import is_impossible
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


def probabilities_of(name: str, values: Any, *, first_row: int = 0) -> NDArray[np.float32]:
    """Return action probabilities as float32; NaN means unknown."""
    array = numbers(name, values)
    wrong = is_impossible(array)
    if wrong.any():
        raise SpaceError(f"{name}: {_row(array, wrong, first_row)}, expected a number in (0, 1]")
    return array.astype(np.float32)


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

"""Values of environments as NumPy arrays, for environments that return other types of arrays.

Simulators on a GPU return tensors of PyTorch or arrays of JAX, CuPy or Warp. Their packages are not
imported here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import SpaceError

_FINAL_NAMES = ("final_obs", "final_observation")
"""Names of the last observations in the infos of vector environments, the current name first."""


def as_array(value: Any) -> NDArray[Any]:
    """Convert a value to a NumPy array; the data is copied only if it is not in main memory."""
    if type(value) is np.ndarray:
        return value
    if hasattr(value, "detach") and hasattr(value, "cpu"):
        return _of_tensor(value.detach().cpu())
    if hasattr(value, "__dlpack__") and not hasattr(value, "__array__"):
        return np.from_dlpack(value)
    try:
        return np.asarray(value)
    except (TypeError, RuntimeError):
        # NumPy does not convert lists of tensors that are on a GPU or have gradients.
        if isinstance(value, list | tuple):
            return np.asarray([as_array(each) for each in value])
        # CuPy refuses implicit copies from the GPU.
        if not hasattr(value, "get"):
            raise
        return np.asarray(value.get())


def as_arrays(values: Any) -> Any:
    """Convert the arrays in nested dicts to NumPy arrays, and keep all other values."""
    if isinstance(values, Mapping):
        return {key: as_arrays(part) for key, part in values.items()}
    return as_array(values) if is_other_array(values) else values


def is_other_array(value: Any) -> bool:
    """Return whether a value is an array of another package than NumPy."""
    has_data = hasattr(value, "__array__") or hasattr(value, "__dlpack__")
    return has_data and not isinstance(value, np.ndarray | np.generic)


def one_each(what: str, values: NDArray[Any], count: int) -> NDArray[Any]:
    """Return one value for each of `count` environments, (N,)."""
    if values.shape == (count,):
        return values
    if values.size != count:
        cure = "; combine several rewards with a wrapper" if what == "reward" else ""
        raise SpaceError(
            f"each environment must have one {what}, but those of {count} environments have shape"
            f" {values.shape}{cure}"
        )
    return values.reshape(count)


def final_observation(
    infos: Mapping[str, Any], number: int, count: int, space: spaces.Space[Any]
) -> Any:
    """Return the last observation of one environment that was reset in the same step.

    Returns:
        The observation; None if the infos do not contain it.
    """
    for name in _FINAL_NAMES:
        mask = infos.get(f"_{name}")
        if infos.get(name) is not None and (mask is None or bool(mask[number])):
            return _row(infos[name], number, count, space)
    return None


def _row(values: Any, number: int, count: int, space: spaces.Space[Any]) -> Any:
    if isinstance(space, spaces.Dict) and isinstance(values, Mapping):
        return {
            key: _row(values[key], number, count, part)
            for key, part in space.spaces.items()
            if key in values
        }
    if isinstance(space, spaces.Tuple) and _is_batched(values, number, space):
        parts = zip(values, space.spaces, strict=True)
        return tuple(_row(part, number, count, of) for part, of in parts)
    try:
        found = len(values)
        row = values[number]
    except (TypeError, KeyError, IndexError):
        found = 0
    if found != count:
        raise SpaceError(
            f"infos['{_FINAL_NAMES[0]}'] is {values!r:.60}: it must have one item for each of the"
            f" {count} environments"
        )
    return row


def _is_batched(values: Any, number: int, space: spaces.Tuple[Any]) -> bool:
    """Return whether values are the batched parts of a Tuple, and not one tuple per environment."""
    if not isinstance(values, list | tuple) or len(values) != len(space.spaces):
        return False
    return number >= len(values) or not isinstance(values[number], list | tuple)


def _of_tensor(tensor: Any) -> NDArray[Any]:
    try:
        return np.asarray(tensor)
    except TypeError:
        # NumPy lacks some of PyTorch's float types, such as bfloat16.
        return np.asarray(tensor.float())

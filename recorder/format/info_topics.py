"""Writer of infos; `infos` describes the topics and reads them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.columns.cdr import ENCAPSULATION
from mcaprl.recorder.format.infos import INFO_TOPICS
from mcaprl.recorder.format.log_writer import LogTopics, Message
from mcaprl.recorder.format.messages import TEXT_TYPE, text_message
from mcaprl.texts import encodable

_TYPES = {
    **{np.dtype(f"{u}int{bits}"): f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)},
    np.dtype(np.float32): "float32",
    np.dtype(np.float64): "float64",
    np.dtype(np.bool_): "bool",
}
"""ROS type of each dtype."""
_ENCAPSULATION = int(ENCAPSULATION).to_bytes(4, "little")


def flat_infos(info: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the entries of an info dict and of its nested dicts, with dotted names."""
    for key, value in info.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from flat_infos(value, f"{name}.")
        else:
            yield name, value


def info_array(values: Sequence[Any] | NDArray[Any]) -> NDArray[Any] | None:
    """Return values of one info as an array (K, *shape); None if a log cannot store them."""
    try:
        found = np.array(values)
    except (ValueError, OverflowError):
        return None
    # If the types are mixed, NumPy would convert numbers to text, and flags to numbers.
    kinds = {np.asarray(value).dtype.kind for value in values}
    if len(kinds) > 1 and not (kinds == {"i", "f"} and _is_exact(found, values)):
        return None
    return found if found.dtype in _TYPES or (found.dtype.kind == "U" and found.ndim == 1) else None


def _is_exact(found: NDArray[Any], values: Sequence[Any] | NDArray[Any]) -> bool:
    return all(
        bool((one == value).all() if isinstance(value, np.ndarray) else one.item() == value)
        for one, value in zip(found, values, strict=True)
        if value is not np.nan
    )


class InfoTopics:
    """Writer of infos to a log; a topic is announced at the first value of its info.

    Attributes:
        refused: Names of the infos that were not written, with the reason.
        warned: Names of the infos for which a warning was given.
    """

    def __init__(self, log: LogTopics) -> None:
        """Create a writer that has not announced any topic yet."""
        self._log = log
        self._channels: dict[str, tuple[int, np.dtype[Any], tuple[int, ...]]] = {}
        self._topics: set[str] = set()
        self.refused: dict[str, str] = {}
        self.warned: set[str] = set()

    def write(self, infos: Mapping[str, tuple[Sequence[int], NDArray[Any]]]) -> None:
        """Write values (K, *shape) of infos with their log_times (K,), by name.

        If values do not have the type of the info's first value, they are not written, and the
        info's name is added to `refused`.
        """
        messages: list[Message] = []
        for name, (times_ns, values) in infos.items():
            if name not in self._channels:
                self._announce(name, values)
            channel, dtype, shape = self._channels[name]
            if values.dtype.kind == "U" and dtype.kind == "U":
                data = [text_message(encodable(str(value))) for value in values]
            elif values.shape[1:] == shape and _fits(values, dtype):
                data = [_ENCAPSULATION + value.tobytes() for value in values.astype(dtype)]
            else:
                what = f"{values.dtype} {values.shape[1:]} instead of {dtype} {shape}"
                self.refused[name] = f"it became {what}"
                continue
            messages += [(channel, time, each) for time, each in zip(times_ns, data, strict=True)]
        self._log.sink.write_messages(sorted(messages, key=lambda message: message[1]))

    def _announce(self, name: str, values: NDArray[Any]) -> None:
        dtype, shape = values.dtype, values.shape[1:]
        topic = INFO_TOPICS + re.sub(r"[^A-Za-z0-9_/]+", "_", name.replace(".", "/"))
        while topic in self._topics:
            topic += "_"
        self._topics.add(topic)
        metadata = {"info": encodable(name), "shape": json.dumps(shape)}
        type_name, text = _definition(dtype, shape)
        channel = self._log.sink.add_channel(topic, type_name, text, metadata)
        self._channels[name] = channel, dtype, shape


def _definition(dtype: np.dtype[Any], shape: tuple[int, ...]) -> tuple[str, str]:
    """Return the name and the definition of an info's message type."""
    if dtype.kind == "U":
        return TEXT_TYPE, "string data"
    kind = _TYPES[dtype]
    if not shape:
        name = {"uint": "UInt", "int": "Int", "float": "Float", "bool": "Bool"}
        word = kind.rstrip("0123456789")
        return f"std_msgs/msg/{name[word]}{kind.removeprefix(word)}", f"{kind} data"
    count = int(np.prod(shape))
    return f"mcaprl_msgs/msg/Info{kind.capitalize()}x{count}", f"{kind}[{count}] data"


def _fits(values: NDArray[Any], dtype: np.dtype[Any]) -> bool:
    """Return whether values can be stored in this dtype without changing them."""
    if values.dtype == dtype:
        return True
    kinds = {values.dtype.kind, dtype.kind}
    if len(kinds) > 1 and kinds & {"U", "b"}:
        return False
    with np.errstate(all="ignore"):
        cast = values.astype(dtype)
    is_float = cast.dtype.kind == values.dtype.kind == "f"
    return bool(np.array_equal(cast, values, equal_nan=is_float))

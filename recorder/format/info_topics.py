"""Writer of the infos of an environment; the module `infos` describes the topics."""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.cdr import ENCAPSULATION
from mcaprl.recorder.format.infos import INFO_TOPICS, is_exact, shape_of
from mcaprl.recorder.format.log_writer import LogWriter, Message
from mcaprl.recorder.format.messages import TEXT_TYPE, text_message
from mcaprl.texts import encodable, shortened

_TYPES = {
    **{np.dtype(f"{u}int{bits}"): f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)},
    np.dtype(np.float32): "float32",
    np.dtype(np.float64): "float64",
    np.dtype(np.bool_): "bool",
}
"""ROS type of each dtype."""
_DTYPES = {"string": np.dtype(np.str_), **{kind: dtype for dtype, kind in _TYPES.items()}}
_ENCAPSULATION = int(ENCAPSULATION).to_bytes(4, "little")
_CHUNK_BYTES = 2**20


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
        found = found.astype(found.dtype.newbyteorder("="), copy=False)
        # If the types are mixed, NumPy would convert numbers to text, and bools to numbers.
        if len({(type(value), np.asarray(value).dtype) for value in values}) > 1 and not all(
            is_exact(np.asarray(one), np.asarray(value))
            for one, value in zip(found, values, strict=True)
        ):
            return None
    except (ValueError, OverflowError):
        return None
    if found.dtype.kind == "U":
        return found if found.ndim == 1 else None
    # ROS message definitions cannot have arrays of length 0.
    return found if found.dtype in _TYPES and (found.size or not len(found)) else None


class InfoTopics:
    """Writer of infos to a log. The topic of an info is created when its first value is written.

    A recording that is appended to a log uses the log's existing topics.

    Attributes:
        refused: Names of the infos that were not written, with the reason.
        warned: Names of the infos for which a warning was given.
    """

    def __init__(self, log: LogWriter) -> None:
        """Find the infos that the log already has."""
        self._log = log
        self._channels = _channels_of(log)
        self._topics = {one.topic for one in log.mcap.channels.values()}
        self.refused: dict[str, str] = {}
        self.warned: set[str] = set()

    def write(self, infos: Mapping[str, tuple[Sequence[int], NDArray[Any]]]) -> None:
        """Write the log_times (K,) and values (K, *shape) of each info, given by name.

        If values do not have the type of the info's first value in the log, they are not written,
        and the info's name is added to `refused`.
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
                self.refused[name] = (
                    f"its values are {_described(values.dtype, values.shape[1:])}, but earlier"
                    f" values are {_described(dtype, shape)}"
                )
                continue
            messages += [(channel, time, each) for time, each in zip(times_ns, data, strict=True)]
        messages.sort(key=lambda message: message[1])
        self._write_chunks(messages)

    def _write_chunks(self, messages: Sequence[Message]) -> None:
        """Write messages in chunks of about 1 MiB, because the size of a chunk is limited."""
        chunk: list[Message] = []
        size = 0
        for message in messages:
            chunk.append(message)
            size += len(message[2])
            if size > _CHUNK_BYTES:
                self._log.sink.write_messages(chunk)
                chunk, size = [], 0
        self._log.sink.write_messages(chunk)

    def _announce(self, name: str, values: NDArray[Any]) -> None:
        dtype, shape = values.dtype, values.shape[1:]
        topic = INFO_TOPICS + re.sub(r"[^A-Za-z0-9_.]", "_", name).replace(".", "/")
        if not re.fullmatch(r"\w+(\.\w+)*", name, re.ASCII):
            # The CRC distinguishes names that differ only in characters replaced by `_`.
            topic += f"_{zlib.crc32(encodable(name).encode()):08x}"
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
    sizes = "".join(f"x{size}" for size in shape)
    return f"mcaprl_msgs/msg/Info{kind.capitalize()}{sizes}", f"{kind}[{math.prod(shape)}] data"


def _channels_of(log: LogWriter) -> dict[str, tuple[int, np.dtype[Any], tuple[int, ...]]]:
    """Return the channel, the dtype and the shape of each info that a log has, by name."""
    found = {}
    for channel in log.mcap.channels.values():
        if channel.topic.startswith(INFO_TOPICS) and "info" in channel.metadata:
            schema = log.mcap.schemas.get(channel.schema_id)
            text = schema.data.decode(errors="replace") if schema else ""
            kind = text.lstrip().partition(" ")[0].partition("[")[0]
            if kind not in _DTYPES:
                raise CorruptLogError(f"{channel.topic}: {shortened(kind, 40)!r} is not an info")
            shape = shape_of(channel.metadata.get("shape", "[]"), channel.topic)
            found[channel.metadata["info"]] = (channel.id, _DTYPES[kind], shape)
    return found


def _described(dtype: np.dtype[Any], shape: tuple[int, ...]) -> str:
    kind = "text" if dtype.kind == "U" else dtype.name
    return f"{kind} of shape {shape}" if shape else kind


def _fits(values: NDArray[Any], dtype: np.dtype[Any]) -> bool:
    """Return whether values can be stored in this dtype without changing them."""
    if "U" in (values.dtype.kind, dtype.kind):
        return False
    with np.errstate(all="ignore"):
        return is_exact(values.astype(dtype), values)

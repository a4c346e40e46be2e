"""Logs with `/rl/step` from other writers, in various encodings, mixed with other topics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TYPE = "robot_msgs/msg/Transition"
PLAIN = """\
float64 reward
int64 action
float32[3] observation
float32 behavior_prob
uint32 episode
uint32 step
bool terminated
bool truncated
bool final
"""
# The same fields in another order and with other types, mixed with strings, lists and messages.
VARIABLE = """\
std_msgs/Header header
uint32 step
float32[] observation
string note
bool final
int32 action
string[] tags
float32 reward
float64[] extra
uint16 episode
bool terminated
bool truncated
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
NOISE = "string data\n"
STEP_NS = 1_000_000


@dataclass
class Steps:
    """Records of `/rl/step`, one array per field, for episodes of the given lengths."""

    fields: dict[str, NDArray[Any]]
    times: NDArray[np.int64]

    @property
    def actual(self) -> NDArray[np.bool_]:
        """Mask of the records that are transitions."""
        return ~self.fields["final"]

    def rows(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield the time and the fields of each record."""
        for row, time_ns in enumerate(self.times.tolist()):
            yield time_ns, {name: column[row] for name, column in self.fields.items()}


def steps_of(lengths: list[int], *, start_ns: int = 10**18, seed: int = 0) -> Steps:
    """Create random values that all numeric types of PLAIN and VARIABLE represent exactly."""
    random = np.random.default_rng(seed)
    final = np.concatenate([np.arange(length + 1) == length for length in lengths])
    count = len(final)
    step = np.concatenate([np.arange(length + 1) for length in lengths])
    ends = np.append(final[1:], False)
    return Steps(
        {
            "reward": np.where(final, 0.0, random.integers(-50, 50, count) / 4),
            "action": np.where(final, 0, random.integers(0, 5, count)),
            "observation": random.integers(-99, 99, (count, 3)).astype(np.float32),
            "behavior_prob": np.where(final, np.nan, 0.25).astype(np.float32),
            "episode": np.repeat(np.arange(len(lengths)), np.array(lengths) + 1),
            "step": step,
            "terminated": ends,
            "truncated": np.zeros(count, bool),
            "final": final,
        },
        start_ns + np.arange(count) * STEP_NS,
    )


class Codec:
    """Encoder of one message type to CDR, by rosbags."""

    def __init__(self, text: str, name: str = TYPE) -> None:
        self.text, self.name = text, name
        self._store = get_typestore(Stores.EMPTY)
        self._store.register(get_types_from_msg(text, name))
        self.fields = [field for field, _ in self._store.fielddefs[name][1]]

    def encode(self, *, big_endian: bool = False, **fields: Any) -> bytes:
        message = self._store.types[self.name](**fields)
        return bytes(self._store.serialize_cdr(message, self.name, little_endian=not big_endian))

    def header(self, time_ns: int, frame: str) -> Any:
        types = self._store.types
        stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def plain_messages(steps: Steps, *, big_endian: bool = False) -> list[tuple[int, bytes]]:
    """Encode records as PLAIN."""
    codec = Codec(PLAIN)
    return [
        (time_ns, codec.encode(big_endian=big_endian, **fields)) for time_ns, fields in steps.rows()
    ]


def variable_messages(
    steps: Steps, text_of: Callable[[int], str], *, big_endian: bool = False
) -> list[tuple[int, bytes]]:
    """Encode records as VARIABLE, with row-dependent strings and without `behavior_prob`."""
    codec, found = Codec(VARIABLE), []
    for row, (time_ns, fields) in enumerate(steps.rows()):
        text = text_of(row)
        extra = {
            "header": codec.header(time_ns, text),
            "note": text,
            "tags": [text] * (len(text) % 3),
            "extra": np.arange(len(text) % 4, dtype=np.float64),
        }
        known = {name: fields[name] for name in codec.fields if name in fields}
        data = codec.encode(big_endian=big_endian, **known, **extra)
        found.append((time_ns, data))
    return found


def write_with_mcap(
    path: Path,
    messages: list[tuple[int, bytes]],
    text: str = PLAIN,
    *,
    noise: bool = True,
    channels: Callable[[int], int] = lambda row: 0,
    **options: Any,
) -> None:
    """Write a log with mcap's Writer, with a second topic whose messages vary in length."""
    writer = Writer(str(path), **{"chunk_size": 2000, **options})
    writer.start("ros2")
    schema = writer.register_schema(TYPE, "ros2msg", text.encode())
    other = writer.register_schema("std_msgs/msg/String", "ros2msg", NOISE.encode())
    noisy = writer.register_channel("/chatter", "cdr", other)
    ids: dict[int, int] = {}
    codec = Codec(NOISE, "std_msgs/msg/String")
    for row, (time_ns, data) in enumerate(messages):
        if noise:
            chatter = codec.encode(data="x" * (row % 7))
            writer.add_message(noisy, time_ns, chatter, time_ns)
        key = channels(row)
        if key not in ids:
            ids[key] = writer.register_channel("/rl/step", "cdr", schema)
        writer.add_message(ids[key], time_ns, data, time_ns)
    writer.finish()


MCAP_OPTIONS: dict[str, dict[str, Any]] = {
    "default": {},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "no-index": {"index_types": IndexType.NONE},
    "no-message-index": {"index_types": IndexType.CHUNK},
    "no-chunk-index": {"index_types": IndexType.MESSAGE},
    "topics-in-chunks": {"repeat_channels": False, "repeat_schemas": False},
    "schemas-in-chunks": {"repeat_schemas": False},
    "unchunked": {"use_chunking": False},
    "unchunked-with-crc": {"use_chunking": False, "enable_data_crcs": True},
    "plain": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
        "enable_crcs": False,
    },
}


def write_with_rosbags(folder: Path, messages: list[tuple[int, bytes]], text: str = PLAIN) -> Path:
    """Write a ROS 2 bag with rosbags, and return the path of the bag's MCAP file."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, TYPE))
    with BagWriter(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/rl/step", TYPE, typestore=store)
        for time_ns, data in messages:
            bag.write(connection, time_ns, data)
    (path,) = folder.glob("*.mcap")
    return path


def write_with_foxglove(path: Path, messages: list[tuple[int, bytes]], text: str = PLAIN) -> None:
    """Write with foxglove-sdk, mixed with another topic."""
    import foxglove

    context = foxglove.Context()
    writer = foxglove.open_mcap(path, context=context)
    schema = foxglove.Schema(name=TYPE, encoding="ros2msg", data=text.encode())
    channel = foxglove.Channel("/rl/step", schema=schema, message_encoding="cdr", context=context)
    chatter = foxglove.Channel("/chatter", message_encoding="json", context=context)
    for row, (time_ns, data) in enumerate(messages):
        chatter.log({"row": row}, log_time=time_ns)
        channel.log(data, log_time=time_ns)
    writer.close()

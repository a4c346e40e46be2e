"""ROS 2 messages of no fixed length: episodes, log lines, markers, frames.

Everything here is for topics with few messages, or that only viewers read; rosbags encodes them,
but for the three that each episode ends with: a recorder is waited for. Transitions and images go
another way (`schema`, `message_rows`).
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from mcaprl.errors import CorruptLogError

LOG_TYPE = "rcl_interfaces/msg/Log"
EPISODE_TYPE = "mcaprl_msgs/msg/Episode"
EPISODE_TEXT = """\
# One episode, told at its end.
float64 total_reward
# Nanoseconds: log_time of the episode's first and last record.
int64 start_time_ns
int64 end_time_ns
# Given to reset(); -1 if none was.
int64 seed
# NaN if the policy explores in no such way.
float64 epsilon
uint32 episode
# Transitions.
uint32 length
bool terminated
bool truncated
# Why it ended, in the simulator's words.
string reason
# Who acted.
string policy
# reset()'s options as JSON.
string options
"""
_INFO = 20
# CDR: the encapsulation header, then fields, aligned counting from behind it.
_ENCAPSULATION = b"\0\1\0\0"
_EPISODE_START, _LOG_START = struct.Struct("<dqqqdII??"), struct.Struct("<IIB")


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """ROS 2 message types, and ours."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(EPISODE_TEXT, EPISODE_TYPE))
    return store


@lru_cache
def definition(type_name: str) -> str:
    """The `ros2msg` text of a type, with those that it nests."""
    if type_name == EPISODE_TYPE:
        return EPISODE_TEXT
    return typestore().generate_msgdef(type_name, ros_version=2)[0]


def new(type_name: str, **fields: Any) -> Any:
    """Make a message; `package/msg/Type` names its type."""
    return typestore().types[type_name](**fields)


def encode(message: Any) -> bytes:
    """A message as CDR bytes."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, type_name: str) -> Any:
    """CDR bytes as a message.

    Raises:
        CorruptLogError: they do not fit the type.
    """
    try:
        return typestore().deserialize_cdr(data, type_name)
    # The library raises whatever its parsing meets; none of it is more than "does not fit".
    except Exception as error:
        raise CorruptLogError(f"{len(data)} bytes are no {type_name}: {error}") from error


def episode_message(
    *,
    total_reward: float,
    start_time_ns: int,
    end_time_ns: int,
    seed: int | None,
    epsilon: float,
    episode: int,
    length: int,
    terminated: bool,
    truncated: bool,
    reason: str,
    policy: str,
    options: str,
) -> bytes:
    """Fields of `EPISODE_TEXT` as CDR bytes; a `seed` of None is none."""
    told_seed = -1 if seed is None else seed
    times, counts = (start_time_ns, end_time_ns, told_seed), (episode, length)
    data = bytearray(_ENCAPSULATION)
    data += _EPISODE_START.pack(total_reward, *times, epsilon, *counts, terminated, truncated)
    return bytes(_with_texts(data, reason, policy, options))


def log_message(time_ns: int, text: str) -> bytes:
    """An `rcl_interfaces/msg/Log` that informs, as CDR bytes."""
    data = bytearray(_ENCAPSULATION)
    sec, nanosec = divmod(time_ns, 10**9)
    # Behind 2038, ROS's seconds start anew; the record's log_time does not.
    data += _LOG_START.pack(sec % 2**32, nanosec, _INFO)
    _with_texts(data, "mcaprl", text, "", "")
    # The line of the code that it comes from.
    data += bytes(-len(data) % 4 + 4)
    return bytes(data)


def _with_texts(data: bytearray, *texts: str) -> bytearray:
    """Append strings: length, characters and NUL, each from a multiple of four bytes on."""
    for text in texts:
        encoded = text.encode() + b"\0"
        data += bytes(-len(data) % 4)
        data += len(encoded).to_bytes(4, "little")
        data += encoded
    return data


def stamp(time_ns: int) -> Any:
    """A `builtin_interfaces/msg/Time`."""
    sec, nanosec = divmod(time_ns, 10**9)
    return new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def header(time_ns: int, frame_id: str) -> Any:
    """A `std_msgs/msg/Header`."""
    return new("std_msgs/msg/Header", stamp=stamp(time_ns), frame_id=frame_id)

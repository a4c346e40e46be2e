"""ROS 2 messages of no fixed length, by rosbags: episodes, markers, frames, log lines.

Everything here is for topics with few messages, or that only viewers read. Transitions and images
go another way (`schema`, `chunks`).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from mcaprl.errors import CorruptLogError

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


def stamp(time_ns: int) -> Any:
    """A `builtin_interfaces/msg/Time`."""
    sec, nanosec = divmod(time_ns, 10**9)
    return new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def header(time_ns: int, frame_id: str) -> Any:
    """A `std_msgs/msg/Header`."""
    return new("std_msgs/msg/Header", stamp=stamp(time_ns), frame_id=frame_id)

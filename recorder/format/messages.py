"""ROS 2 messages of variable length: episodes, log lines, markers, frames.

Rare messages are encoded by rosbags. The messages of each step and of the end of an episode are
encoded here, because this is faster and the environment waits until they are written. Transitions
and images are encoded as fixed-size rows (`schema`).
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from mcaprl.errors import CorruptLogError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

TEXT_TYPE = "std_msgs/msg/String"
LOG_TYPE = "rcl_interfaces/msg/Log"
EPISODE_TYPE = "mcaprl_msgs/msg/Episode"
EPISODE_TEXT = """\
# One episode, written at its end.
float64 total_reward
# Nanoseconds: log_time of the episode's first and last record.
int64 start_time_ns
int64 end_time_ns
# Passed to reset(); -1 if none.
int64 seed
# Probability of a random action; NaN if unknown.
float64 epsilon
uint32 episode
# Number of transitions.
uint32 length
bool terminated
bool truncated
# Reason of the end, as the environment reported it.
string reason
# Name of the policy that acted.
string policy
# Options passed to reset(), as JSON.
string options
"""
MAX_SEED = 2**64 - 2
"""Largest seed that can be stored."""
INFO, WARN = 20, 30
"""Levels of log lines."""
# In CDR, the fields follow the encapsulation header, and are aligned relative to the end of this
# header.
_ENCAPSULATION = b"\0\1\0\0"
# A NUL character ends a ROS string, so it is replaced.
_NUL, _REPLACEMENT = b"\0", "\ufffd".encode()
# Encapsulation header and all fields before the strings, which begin at a multiple of 4.
_EPISODE_START = struct.Struct("<4sdqqqdII??2x")
# Encapsulation header and all fields before the text; the name of the node is a string.
_LOG_START, _NODE = struct.Struct("<4sIIB3x12s"), b"\7\0\0\0mcaprl\0"
# Number of bytes to which a string is aligned.
_ALIGNMENT = 4
# The end of a log line: two empty strings, and the field `line`, 0.
_LOG_END = 2 * b"\1\0\0\0\0\0\0\0" + bytes(4)
_COUNT, _STAMP = struct.Struct("<I"), struct.Struct("<II")


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Return the type store with the message types of ROS 2 and mcaprl."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(EPISODE_TEXT, EPISODE_TYPE))
    return store


@lru_cache
def definition(type_name: str) -> str:
    """Return the `ros2msg` definition of a type, including nested types."""
    if type_name == EPISODE_TYPE:
        return EPISODE_TEXT
    return typestore().generate_msgdef(type_name, ros_version=2)[0]


def new(type_name: str, **fields: Any) -> Any:
    """Create a message of type `package/msg/Type`."""
    return typestore().types[type_name](**fields)


def encode(message: Any) -> bytes:
    """Encode a message as CDR bytes."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, type_name: str) -> Any:
    """Decode CDR bytes."""
    try:
        return typestore().deserialize_cdr(data, type_name)
    # rosbags raises errors of many types when the bytes do not fit the type.
    except Exception as error:
        raise CorruptLogError(f"cannot decode {len(data)} bytes as {type_name}: {error}") from error


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
    """Encode the fields of `EPISODE_TEXT` as CDR bytes."""
    start = _EPISODE_START.pack(
        _ENCAPSULATION,
        total_reward,
        start_time_ns,
        end_time_ns,
        stored_seed(seed),
        epsilon,
        episode,
        length,
        terminated,
        truncated,
    )
    return start + _texts(reason, policy, options)


def stored_seed(seed: int | None) -> int:
    """Convert a seed to a signed integer: -1 for None, and `seed - 2**64` for 2^63 or more."""
    return -1 if seed is None else seed - 2**64 * (seed >= 2**63)


def seed_of(stored: int) -> int | None:
    """Convert a signed integer from `stored_seed` back to the seed."""
    return None if stored == -1 else stored % 2**64


@lru_cache(maxsize=64)
def text_message(text: str) -> bytes:
    """Encode a `std_msgs/msg/String` as CDR bytes; the phases of episodes have few texts."""
    return _ENCAPSULATION + _string(text)


def log_message(time_ns: int, text: str, level: int = INFO) -> bytes:
    """Encode an `rcl_interfaces/msg/Log` as CDR bytes."""
    sec, nanosec = _seconds(time_ns)
    start = _LOG_START.pack(_ENCAPSULATION, sec, nanosec, level, _NODE)
    return start + _padded(_string(text)) + _LOG_END


def _string(text: str) -> bytes:
    """Encode a CDR string: length, characters and NUL.

    A NUL in the text is replaced by U+FFFD, and lone surrogates are escaped.
    """
    encoded = text.encode(errors="backslashreplace").replace(_NUL, _REPLACEMENT) + _NUL
    return len(encoded).to_bytes(4, "little") + encoded


@lru_cache
def _texts(*texts: str) -> bytes:
    """Encode the last fields of a message, which are strings."""
    *others, last = map(_string, texts)
    return b"".join(map(_padded, others)) + last


def _padded(string: bytes) -> bytes:
    return string + bytes(-len(string) % _ALIGNMENT)


def _seconds(time_ns: int) -> tuple[int, int]:
    """Return seconds and nanoseconds of a time.

    The 32-bit seconds of ROS wrap around; the log_time of the record does not.
    """
    sec, nanosec = divmod(time_ns, 10**9)
    return sec % 2**32, nanosec


class CdrWriter:
    """Encoder of one message, whose fields are added in their order.

    rosbags needs an object for each nested message, for example for each point of a line, and takes
    ten times as long.
    """

    def __init__(self) -> None:
        """Begin a message."""
        self._data = bytearray(_ENCAPSULATION)

    def add(self, data: bytes, alignment: int) -> None:
        """Add encoded fields; the first of them is aligned to this number of bytes."""
        self._data += bytes(-(len(self._data) - len(_ENCAPSULATION)) % alignment)
        self._data += data

    def add_count(self, count: int) -> None:
        """Add the length of a sequence."""
        self.add(_COUNT.pack(count), _COUNT.size)

    def add_header(self, time_ns: int, frame_id: str) -> None:
        """Add a `std_msgs/msg/Header`."""
        self.add(_STAMP.pack(*_seconds(time_ns)), _COUNT.size)
        self.add_text(frame_id)

    def add_text(self, text: str) -> None:
        """Add a string."""
        self.add(_known_string(text), _ALIGNMENT)

    def to_bytes(self) -> bytes:
        """Return the message."""
        return bytes(self._data)

    def fields(self) -> bytes:
        """Return the fields without the encapsulation header."""
        return bytes(self._data[len(_ENCAPSULATION) :])


@lru_cache
def _known_string(text: str) -> bytes:
    return _string(text)


def stamp(time_ns: int) -> Any:
    """Create a `builtin_interfaces/msg/Time`."""
    sec, nanosec = divmod(time_ns, 10**9)
    return new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def header(time_ns: int, frame_id: str) -> Any:
    """Create a `std_msgs/msg/Header`."""
    return new("std_msgs/msg/Header", stamp=stamp(time_ns), frame_id=frame_id)

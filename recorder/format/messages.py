"""ROS 2 messages of variable length: episodes, log lines, markers, frames.

Rare messages are encoded by rosbags. The messages of each step and of the end of an episode are
encoded here, because this is faster and the environment waits until they are written. Transitions
and images are encoded as fixed-size rows (`schema`).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, SpaceError
from mcaprl.files import as_type
from mcaprl.limits import MAX_TIME_NS
from mcaprl.texts import counted

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
MAX_SEED = 2**64 - 2  # Largest seed that can be stored
INFO, WARN = 20, 30  # Levels of log lines
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
    """Encode a CDR string; a NUL in it becomes U+FFFD, and lone surrogates are escaped."""
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
    """Return seconds and nanoseconds of a time; the 32-bit seconds of ROS wrap around."""
    sec, nanosec = divmod(time_ns, 10**9)
    return sec % 2**32, nanosec


class CdrWriter:
    """Encoder of one message, field by field, ten times as fast as rosbags' objects."""

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


INTERRUPTED = "interrupted"
"""End reason of an episode that was ended by the recorder instead of the environment."""


class EpisodeSummary(NamedTuple):
    """Summary of one episode: the fields of `/rl/episode`.

    Attributes:
        episode: Index of the episode in its recording, from 0.
        length: Number of transitions.
        total_reward: Sum of the rewards, added from the first to the last.
        terminated: Whether the last transition led to a terminal state.
        truncated: Whether the episode was truncated.
        start_time_ns: log_time of the first record, nanoseconds.
        end_time_ns: log_time of the final record, nanoseconds.
        reason: Reason of the end.
        policy: Name of the policy that acted.
        epsilon: Probability of a random action; NaN if unknown.
        seed: Seed passed to `reset`; None if there was none.
        options: Options passed to `reset`, as JSON; empty if there were none.
    """

    episode: int
    length: int
    total_reward: float
    terminated: bool
    truncated: bool
    start_time_ns: int
    end_time_ns: int
    reason: str = ""
    policy: str = ""
    epsilon: float = math.nan
    seed: int | None = None
    options: str = ""

    def to_message(self) -> bytes:
        """Encode the summary as an `mcaprl_msgs/msg/Episode` in CDR."""
        return episode_message(**self._asdict())

    def end_line(self) -> str:
        """Return the log line of the episode's end."""
        return (
            f"episode {self.episode} ends after {counted(self.length, 'step')}: {self.reason},"
            f" return {self.total_reward:.4g}"
        )


def summary_of(values: Mapping[str, Any]) -> EpisodeSummary:
    """Return the summary that another format stores."""
    plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in values.items()}
    try:
        found: EpisodeSummary = as_type(EpisodeSummary, plain, "the episode")
    except ValueError as error:
        raise SpaceError(f"an episode is damaged: {error}") from error
    if found.seed is not None and not 0 <= found.seed <= MAX_SEED:
        raise SpaceError(f"an episode is damaged: a log cannot store the seed {found.seed}")
    if not all(0 <= each < MAX_TIME_NS for each in (found.start_time_ns, found.end_time_ns)):
        raise SpaceError("an episode is damaged: its times are impossible")
    return found


def begin_line(episode: int, policy: str) -> str:
    """Return the log line of an episode's start."""
    return f"episode {episode} begins" + (f", {policy} acts" if policy else "")


def add_up(rewards: NDArray[np.float64], start: float = 0.0) -> float:
    """Add up rewards in order, with bit-identical results on every machine."""
    # `np.sum` adds pairwise, and `sum` compensates rounding errors since Python 3.12.
    if start:
        rewards = np.concatenate([[start], rewards])
    return add_up_each(rewards, [0], [len(rewards)])[0]


def add_up_each(
    rewards: NDArray[np.float64], starts: Iterable[int], stops: Iterable[int]
) -> list[float]:
    """Return the sum of the rewards in each range [start, stop), added up in order."""
    with np.errstate(all="ignore"):
        # Adding 0.0 turns a sum of -0.0 into 0.0.
        return [
            float(np.add.accumulate(rewards[start:stop])[-1] + 0.0) if start < stop else 0.0
            for start, stop in zip(starts, stops, strict=True)
        ]

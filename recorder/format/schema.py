"""Message types of fixed length, as ROS 2 definitions and as NumPy dtypes.

A CDR message without strings and variable arrays is a C struct: a 4-byte encapsulation header,
then the fields in order, each aligned to its size relative to the end of that header. Such a type
is a NumPy structured dtype, so a chunk of messages is one array.

The fields of `/rl/step` are sorted by decreasing size, so there is no padding:

    float64 reward              reward of this record's action; 0 in a final record
    int64 | float32[M] action   0 in a final record; constants name the discrete actions, and
                                comments the parts of a vector, with their bounds and units
    float32[N] observation      one field per leaf of a Dict space, `observation_<key>`
    float32 behavior_prob       probability of the action under the policy that took it, or NaN
      | behavior_log_prob       for actions of floats: log of the probability density, or NaN
    uint32 episode, step        counted from 0
    bool terminated, truncated  flags of the transition that starts in this record
    bool final                  whether the record contains only an episode's last observation

`/rl/learner` has one message for each transition, with the transition's log_time:

    float64 epsilon             probability of a random action; NaN if unknown
    int64 policy_version        number of updates of the policy; -1 if unknown

Observations and actions keep their dtype (float16 is widened to float32). Image observations are
`sensor_msgs/msg/Image` messages on separate topics, with the same log_time.
"""

from __future__ import annotations

import hashlib
import math
import re
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from gymnasium import spaces
from mcap.records import Channel
from numpy.typing import NDArray

from mcaprl.actions import joint_actions
from mcaprl.errors import SpaceError
from mcaprl.limits import MAX_CHUNK_BYTES
from mcaprl.recorder.columns.cdr import ENCAPSULATION, ENCAPSULATION_BYTES, ROS_TO_NUMPY
from mcaprl.recorder.columns.records import message_rows
from mcaprl.recorder.format.behavior import FIELDS, PROBABILITY, BehaviorField, behavior_field
from mcaprl.recorder.format.spaces import Leaf, action_leaf, observation_leaves

STEP_TOPIC = "/rl/step"
EPISODE_TOPIC = "/rl/episode"
LEARNER_TOPIC = "/rl/learner"
LOG_TOPIC = "/rosout"
PHASE_TOPIC = "/rl/phase"
RUNNING = "running"
"""Phase of a running episode. At its end, the phase changes to the reason of the end."""
LABELS_TOPIC = "/rl/labels"  # Labels of the running episode and step in annotated logs, as text
TELEMETRY_TOPIC, TELEMETRY_TYPE = "/telemetry", "mcaprl_msgs/msg/Telemetry"
RETURN_SO_FAR = "return_so_far"  # Sum of the rewards of the running episode, in the telemetry
# Maximum number of /rl/step rows, of images, and of bytes in one chunk.
STEPS_PER_CHUNK = 4096
IMAGES_PER_CHUNK = 100
BYTES_PER_CHUNK = 8 * 2**20
# Minimum number of rows in a buffer: the last transition, a new transition, and a spare row. The
# last transition stays in memory because it may turn out to be the end of its episode.
MIN_ROWS = 3
IMAGE_FRAME = "camera"


LEARNER_TYPE = "mcaprl_msgs/msg/Learner"
LEARNER_TEXT = """\
# Of the policy that took the action; NaN and -1 where unknown.
float64 epsilon
int64 policy_version
"""

_NUMPY_TO_ROS = {
    np.dtype(code): name
    for name, code in ROS_TO_NUMPY.items()
    if name not in ("byte", "char", "bool")
}
_FIELD = re.compile(r"(\w+)(?:\[(\d+)\])?\s+([a-z][a-z0-9_]*)")


def step_schema(
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    action_names: Mapping[int, str] | None = None,
    action_labels: Sequence[str] = (),
    behavior: BehaviorField | None = None,
) -> tuple[str, str]:
    """Return the type name and definition of `/rl/step` for a pair of spaces."""
    # The name has a hash: a viewer with several logs expects one layout for each type name.
    vectors = [leaf for leaf in observation_leaves(observation_space) if leaf.encoding is None]
    fields = [
        ("float64", 0, "reward"),
        _leaf_field(action_leaf(action_space)),
        *map(_leaf_field, vectors),
        ("float32", 0, (behavior or behavior_field(action_space)).name),
        ("uint32", 0, "episode"),
        ("uint32", 0, "step"),
        ("bool", 0, "terminated"),
        ("bool", 0, "truncated"),
        ("bool", 0, "final"),
    ]
    fields.sort(key=lambda field: -np.dtype(ROS_TO_NUMPY[field[0]]).itemsize)
    constants = {"action": action_constants(action_names or {})}
    return _named("Step", fields, constants, {"action": list(map(_one_line, action_labels))})


def earlier_step_schemas(
    observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> list[tuple[str, str]]:
    """Return names and definitions of `/rl/step` of earlier versions."""
    # The first did not name the actions, the second had the probabilities of all.
    both = observation_space, action_space
    return [step_schema(*both), step_schema(*both, behavior=PROBABILITY)]


def telemetry_schema(names: Iterable[str]) -> tuple[str, str]:
    """Return the type name and definition of a message with one float32 scalar per name."""
    names = list(names)
    for name in names:
        if not re.fullmatch(r"[a-z](_?[a-z0-9])*", name):
            raise SpaceError(
                f"telemetry name '{name}' is not a ROS field name: use lowercase letters, digits"
                " and single underscores"
            )
    return _named("Telemetry", [("float32", 0, name) for name in names])


def shortened(values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Round values to 16 significant bits, enough for plots, which compress better."""
    mantissas, exponents = np.frexp(values.astype(np.float64))
    found: NDArray[np.float64] = np.ldexp(np.rint(mantissas * 2**16), exponents - 16)
    return found


def telemetry_message(values: Iterable[float]) -> bytes:
    """Encode a message of `telemetry_schema`, with values that are `shortened`."""
    rounded = shortened(np.fromiter(values, np.float64))
    return struct.pack(f"<I{len(rounded)}f", ENCAPSULATION, *rounded.tolist())


def action_constants(names: Mapping[int, str]) -> dict[str, int]:
    """Return ROS constants that name the actions, so that viewers display `BRAKE (0)` for 0.

    >>> action_constants({0: "brake", 1: "slightly left", 2: "faster north (+x)"})
    {'BRAKE': 0, 'SLIGHTLY_LEFT': 1, 'FASTER_NORTH': 2}
    """
    # Names are converted to upper case; text in parentheses is removed, and characters other than
    # letters and digits become underscores. Names without letters have no constant.
    words: dict[str, int] = {}
    for value, name in names.items():
        word = _constant(re.sub(r"\(.*?\)", "", name)) or _constant(name)
        if word in words:
            word = _constant(f"{name} {value}")
        if word and word not in words:
            words[word] = value
    return words


def values_schema(
    action_space: spaces.Space[Any], action_names: Mapping[int, str] | None = None
) -> tuple[str, str]:
    """Return the type name and definition of `/rl/values`, a policy's evaluation of a step.

    For a finite action space with A actions:

    float32[A] q            value of each action; NaN if the policy has none
    float32[A] preference   probability of each action; softmax of q if the policy is greedy
    float32 value           value of the state: maximum of q
    float32 advantage       q of the logged action minus `value`
    float32 td_error        r + gamma max q(next) - q of the logged action
    float32 entropy         normalized entropy of `preference`: 1 if uniform
    int64 policy_action     action that the policy selects; number of the joint action, see below
    bool agrees             whether `policy_action` is the logged action

    Values of a MultiDiscrete or MultiBinary space are numbered from 0, the last element changing
    fastest, as by `numpy.ravel_multi_index`.

    For a Box with n elements:

    float32[n] policy_action   command of the policy, in units of the action
    float32[n] difference      `policy_action` minus the logged command
    float32 q                  value of the logged command; NaN if the policy has none
    float32 value              value of `policy_action`
    float32 advantage          q minus `value`
    float32 td_error           r + gamma value(next) - q
    float32 distance           root mean square of `difference`, in halves of the range of each part
    float32 log_prob           log density of the logged command; NaN if the policy has none
    """
    if (joint := joint_actions(action_space)) is not None:
        fields = [("int64", 0, "policy_action"), ("float32", joint.count, "q")]
        fields += [("float32", joint.count, "preference")]
        fields += [("float32", 0, name) for name in ("value", "advantage", "td_error", "entropy")]
        constants = {"policy_action": action_constants(action_names or {})}
        return _named("Values", [*fields, ("bool", 0, "agrees")], constants)
    count = action_leaf(action_space).size
    fields = [("float32", count, name) for name in ("policy_action", "difference")]
    fields += [("float32", 0, name) for name in COMMAND_VALUES]
    return _named("Values", fields)


COMMAND_VALUES = ("q", "value", "advantage", "td_error", "distance", "log_prob")
"""Fields of `values_schema` with one number for each step of a log with a Box action."""


def message_dtype(text: str) -> np.dtype[Any] | None:
    """Return the layout of a ROS 2 message with its `encapsulation`; None without fixed length."""
    names, offsets = ["encapsulation"], [0]
    formats: list[np.dtype[Any]] = [np.dtype("<u4")]
    end = ENCAPSULATION_BYTES
    for line in text.splitlines():
        declaration = line.split("#")[0].strip()
        if not declaration or "=" in declaration:
            continue
        match = _FIELD.fullmatch(declaration)
        if match is None or match[1] not in ROS_TO_NUMPY:
            return None
        scalar = np.dtype(ROS_TO_NUMPY[match[1]])
        start = _align(end, scalar.itemsize)
        count = 1 if match[2] is None else int(match[2])
        if count > MAX_CHUNK_BYTES:
            return None
        field = scalar if match[2] is None else np.dtype((scalar, (count,)))
        names.append(match[3])
        formats.append(field)
        offsets.append(start)
        end = start + field.itemsize
    try:
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": end})
    except (ValueError, OverflowError):
        # NumPy raises these errors if a field name is repeated or the size overflows.
        return None


def is_intact(name: str, text: bytes) -> bool:
    """Return whether a definition matches the hash in its name; True if there is no hash."""
    match = re.fullmatch(r"mcaprl_msgs/msg/(?:Step|Telemetry|Values)([0-9a-f]{8})", name)
    return match is None or match[1] == _digest(text)


def image_dtype(
    height: int, width: int, channels: int, encoding: str, frame_id: str, item_bytes: int = 1
) -> np.dtype[Any]:
    """Return the layout of a `sensor_msgs/msg/Image`, whose strings, and length, are constant."""
    layout: list[tuple[str, Any]] = [("encapsulation", "<u4"), ("sec", "<i4"), ("nanosec", "<u4")]
    used = 12

    def append(name: str, dtype: Any, alignment: int) -> None:
        nonlocal used
        start = _align(used, alignment)
        if start > used:
            layout.append((f"_pad{len(layout)}", f"V{start - used}"))
        layout.append((name, dtype))
        used = start + np.dtype(dtype).itemsize

    for name, text in (("frame_id", frame_id), ("encoding", encoding)):
        append(f"{name}_length", "<u4", 4)
        append(name, f"S{len(text) + 1}", 1)
        if name == "frame_id":
            append("height", "<u4", 4)
            append("width", "<u4", 4)
    append("is_bigendian", "u1", 1)
    append("row_bytes", "<u4", 4)
    append("data_length", "<u4", 4)
    append("data", ("u1", (height * width * channels * item_bytes,)), 1)
    return np.dtype(layout)


def fill_image_constants(
    messages: np.ndarray[Any, Any], height: int, width: int, encoding: str, frame_id: str
) -> None:
    """Set the fields that are the same in every image of a topic."""
    data_bytes = messages.dtype["data"].itemsize
    messages["encapsulation"] = ENCAPSULATION
    messages["frame_id_length"], messages["frame_id"] = len(frame_id) + 1, frame_id.encode()
    messages["encoding_length"], messages["encoding"] = len(encoding) + 1, encoding.encode()
    messages["height"], messages["width"] = height, width
    messages["row_bytes"], messages["data_length"] = data_bytes // height, data_bytes


def stored_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the dtype of a leaf in a message: float16 becomes float32, and bool becomes uint8."""
    if dtype == np.float16:
        return np.dtype("<f4")
    return np.dtype("u1") if dtype == np.bool_ else dtype.newbyteorder("<")


def _leaf_field(leaf: Leaf) -> tuple[str, int, str]:
    name = "bool" if leaf.dtype == np.bool_ else _NUMPY_TO_ROS[stored_dtype(leaf.dtype)]
    return name, leaf.size if leaf.shape else 0, leaf.name


def _named(
    prefix: str,
    fields: list[tuple[str, int, str]],
    constants: Mapping[str, Mapping[str, int]] | None = None,
    comments: Mapping[str, Sequence[str]] | None = None,
) -> tuple[str, str]:
    """Return type name and definition of a message; constants and comments precede their field."""
    lines = []
    for kind, count, name in fields:
        lines += [f"# {comment}" for comment in (comments or {}).get(name, ())]
        named = (constants or {}).get(name, {})
        lines += [f"{kind} {word}={value}" for word, value in named.items()]
        lines.append(f"{kind}{f'[{count}]' if count else ''} {name}")
    text = "".join(f"{line}\n" for line in lines)
    return f"mcaprl_msgs/msg/{prefix}{_digest(text.encode())}", text


def _one_line(text: str) -> str:
    """Return a text as a comment: printable ASCII on one line."""
    plain = " ".join(text.split()).encode("ascii", "replace").decode()
    return "".join(one if one.isprintable() else "?" for one in plain)


def _constant(name: str) -> str:
    """Return a name as a ROS constant; empty if the name contains no letter."""
    word = re.sub(r"[^A-Z0-9]+", "_", name.upper()).strip("_")
    word = word if not word[:1].isdigit() else f"ACTION_{word}"
    return word if re.search("[A-Z]", name.upper()) else ""


def _digest(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()[:8]


def _align(offset: int, alignment: int) -> int:
    """Round an offset up to the alignment, relative to the end of the encapsulation header."""
    return offset + -(offset - ENCAPSULATION_BYTES) % alignment


Write = Callable[[NDArray[Any]], None]
"""Function that writes message records of one channel as one chunk."""
# Values that all final records share. They set all fields except the observation, `episode` and
# `step`.
_FINAL = {
    "action": 0,
    "reward": 0.0,
    **{field.name: math.nan for field in FIELDS},
    "terminated": False,
    "truncated": False,
    "final": True,
}


class TopicRows:
    """Message records of one topic."""

    def __init__(self, rows: NDArray[Any], write: Write) -> None:
        """Create views of `rows`. The caller has set the constant fields."""
        payload = rows["payload"]
        # Views of the fields of all rows, by field name.
        self.fields = {name: payload[name] for name in payload.dtype.names or ()}
        self._rows, self._write, self._log_time = rows, write, rows["log_time"]

    @classmethod
    def of_text(cls, text: str, channel_id: int, most: int, write: Write) -> Self:
        """Preallocate records for messages of the type that `text` defines; their size is fixed."""
        dtype = message_dtype(text)
        assert dtype is not None, "the message has a fixed length by construction"
        rows = message_rows(_count(most, dtype), dtype, channel_id)
        rows["payload"]["encapsulation"] = ENCAPSULATION
        return cls(rows, write)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._rows)

    @property
    def channel_id(self) -> int:
        """Channel of the topic."""
        return int(self._rows["channel_id"].flat[0])

    @property
    def itemsize(self) -> int:
        """Number of bytes of one row."""
        return self._rows.itemsize

    def put(self, field: str, where: Any, values: Any) -> None:
        """Set values (K, *shape), or one scalar, of a field in K rows."""
        column = self.fields[field]
        if column.ndim > 1:
            values = np.reshape(values, (-1, column.shape[-1]))
        column[where] = values

    def from_field(self, fields: Sequence[str]) -> tuple[NDArray[np.void], np.dtype[Any]]:
        """Describe the rows from these fields on: items (N,), and a dtype for buffers."""
        # An item of the aligned dtype begins with the bytes of the part.
        payload = self._rows.dtype["payload"]
        assert payload.fields is not None, "messages have fields"
        offsets = {name: payload.fields[name][1] for name in fields}
        # CDR aligns each field relative to the end of the encapsulation header.
        first, largest = min(offsets.values()), 8
        first -= (first - ENCAPSULATION_BYTES) % largest
        size = payload.itemsize - first
        dtype = np.dtype(
            {
                "names": list(offsets),
                "formats": [payload[name] for name in offsets],
                "offsets": [offset - first for offset in offsets.values()],
                "itemsize": -(-size // largest) * largest,
            }
        )
        return part_of(self._rows, slice(self.itemsize - size, self.itemsize)), dtype

    def write(self, where: Any, times_ns: Any) -> None:
        """Set the log_time of consecutive rows, and write these rows as one chunk."""
        self._log_time[where] = times_ns
        self._write(self._rows[where])

    def write_columns(self, times_ns: NDArray[Any], columns: Mapping[str, Any]) -> None:
        """Write a message for each log_time (K,), in chunks of at most `len(self)` messages."""
        for first in range(0, len(times_ns), len(self)):
            chunk = slice(first, min(first + len(self), len(times_ns)))
            where = slice(chunk.stop - first)
            for name, column in columns.items():
                self.put(name, where, column[chunk])
            self.write(where, times_ns[chunk])


class StepRows(TopicRows):
    """Rows of `/rl/step`: the T transitions of an episode, then its final record."""

    # First, `number` sets counters and clears end flags. Then `put` sets the other fields, `finish`
    # turns the last rows into final records, and `write` adds the times.

    def number(self, where: Any, episode: Any, steps: Any) -> None:
        """Set `episode` (one or K) and `step` (K,) of rows, and clear their end flags."""
        fields = self.fields
        fields["episode"][where], fields["step"][where] = episode, steps
        for name in ("terminated", "truncated", "final"):
            fields[name][where] = False

    def finish(self, where: Any) -> None:
        """Turn rows into final records; their observation, episode and step stay unchanged."""
        for name, value in _FINAL.items():
            if name in self.fields:
                self.fields[name][where] = value


class ImageRows(TopicRows):
    """Rows of `sensor_msgs/msg/Image`, whose field `data` is the flat image as bytes."""

    @classmethod
    def of_shape(
        cls, shape: tuple[int, ...], encoding: str, channel_id: int, most: int, write: Write
    ) -> Self:
        """Preallocate rows for images of one shape; see `TopicRows.of_text` and `image_rows`."""
        height, width, channels = (*shape, 1)[:3]
        item_bytes = {"16UC1": 2, "32FC1": 4}.get(encoding, 1)
        dtype = image_dtype(height, width, channels, encoding, IMAGE_FRAME, item_bytes)
        rows = message_rows(_count(most, dtype), dtype, channel_id)
        fill_image_constants(rows["payload"], height, width, encoding, IMAGE_FRAME)
        return cls(rows, write)

    def write(self, where: Any, times_ns: Any) -> None:
        """Set log_time and header stamp of consecutive rows, and write these rows as one chunk."""
        seconds, self.fields["nanosec"][where] = np.divmod(times_ns, 10**9)
        self.fields["sec"][where] = seconds
        super().write(where, times_ns)


def part_of(rows: NDArray[Any], part: slice) -> NDArray[np.void]:
    """Return a view of these bytes of each item, as items: copied twice as fast as bytes."""
    item, itemsize = np.dtype((np.void, part.stop - part.start)), rows.itemsize
    layout = np.dtype(
        {"names": ["part"], "formats": [item], "offsets": [part.start], "itemsize": itemsize}
    )
    return rows.view(layout)["part"]


def make_final(message: NDArray[Any]) -> None:
    """Turn encoded transitions into final records, in place."""
    for name, value in _FINAL.items():
        if name in (message.dtype.names or ()):
            message[name] = value


class Part(NamedTuple):
    """Part of an episode that becomes an episode."""

    start_ns: int  # log_time of the first record
    end_ns: int  # log_time of the last record
    first_step: int  # Step of the first record, which becomes step 0
    length: int  # Number of transitions
    is_cut: bool  # Whether the episode went on after the part, or its end is missing


class Shorten:
    """Callable that changes records of `/rl/step` of parts of episodes into those of episodes."""

    def __init__(self, parts: Sequence[Part], dtypes: Mapping[int, np.dtype[Any]]) -> None:
        """Store the parts, which do not overlap, and the dtype of the messages by channel id."""
        self._parts = sorted(parts, key=lambda part: part.end_ns)
        self._dtypes = dtypes
        found = [(part.start_ns, part.end_ns) for part in self._parts]
        # (P, 2) first and last log_time of each part, increasing.
        self.spans = np.array(found, np.int64).reshape(-1, 2)

    def __call__(self, channel: Channel, time_ns: int, payload: memoryview) -> None:
        """Change one message in place: number its step, and end a part that is cut."""
        part = self._parts[int(np.searchsorted(self.spans[:, 1], time_ns))]
        row = np.frombuffer(payload, self._dtypes[channel.id], 1)
        row["step"] -= part.first_step
        if part.is_cut and row["step"] == part.length - 1:
            row["truncated"] = True
        elif part.is_cut and row["step"] == part.length:
            make_final(row)


def _count(most: int, payload: np.dtype[Any]) -> int:
    return min(most, max(MIN_ROWS, BYTES_PER_CHUNK // payload.itemsize))

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
import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from mcaprl.errors import SpaceError
from mcaprl.limits import MAX_CHUNK_BYTES
from mcaprl.recorder.columns.cdr import ENCAPSULATION, ENCAPSULATION_BYTES, ROS_TO_NUMPY
from mcaprl.recorder.format.behavior import PROBABILITY, BehaviorField, behavior_field
from mcaprl.recorder.format.spaces import Leaf, action_leaf, observation_leaves

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
    """Return the type name and definition of `/rl/step` for a pair of spaces.

    The type name contains a hash of the definition, because a viewer with several open logs expects
    one layout for each type name.

    Args:
        observation_space: Observation space of the environment.
        action_space: Action space of the environment.
        action_names: Names of the discrete actions by value, for the constants of `action`; see
            `action_constants`.
        action_labels: Descriptions of the parts of an action, for comments before `action`.
        behavior: Behavior column; default: that of the action space.

    Raises:
        SpaceError: A log cannot store these spaces.
    """
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
    """Return the type names and definitions of `/rl/step` that earlier versions wrote.

    The first does not name the actions. The second has the probabilities of all actions.
    """
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


def telemetry_message(values: Iterable[float]) -> bytes:
    """Encode a message of `telemetry_schema`.

    Values are rounded to 16 significant bits (more than four digits), which is enough for plots and
    compresses better.
    """
    mantissas, exponents = np.frexp(np.fromiter(values, np.float64))
    rounded = np.ldexp(np.rint(mantissas * 2**16), exponents - 16)
    return struct.pack(f"<I{len(rounded)}f", ENCAPSULATION, *rounded.tolist())


def action_constants(names: Mapping[int, str]) -> dict[str, int]:
    """Return ROS constants that name the actions, so that viewers display `BRAKE (0)` for 0.

    Names are converted to upper case; text in parentheses is removed, and characters other than
    letters and digits become underscores. Names without letters have no constant.

    >>> action_constants({0: "brake", 1: "slightly left", 2: "faster north (+x)"})
    {'BRAKE': 0, 'SLIGHTLY_LEFT': 1, 'FASTER_NORTH': 2}
    """
    words: dict[str, int] = {}
    for value, name in names.items():
        word = _constant(re.sub(r"\(.*?\)", "", name)) or _constant(name)
        if word in words:
            word = _constant(f"{name} {value}")
        if word and word not in words:
            words[word] = value
    return words


def values_schema(actions: int, action_names: Mapping[int, str] | None = None) -> tuple[str, str]:
    """Return the type name and definition of `/rl/values`, a policy's evaluation of a step.

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
    """
    fields = [("int64", 0, "policy_action"), ("float32", actions, "q")]
    fields += [("float32", actions, "preference")]
    fields += [("float32", 0, name) for name in ("value", "advantage", "td_error", "entropy")]
    constants = {"policy_action": action_constants(action_names or {})}
    return _named("Values", [*fields, ("bool", 0, "agrees")], constants)


def message_dtype(text: str) -> np.dtype[Any] | None:
    """Return the memory layout of a ROS 2 message, including the encapsulation header.

    Args:
        text: Definition without nested types.

    Returns:
        Structured dtype with the fields of the message and `encapsulation`; None if the message has
        no fixed length.
    """
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
    """Return the memory layout of a `sensor_msgs/msg/Image` of known size and strings.

    The strings are constant, so all messages of the topic have the same length.

    Args:
        height: Number of rows.
        width: Number of columns.
        channels: Number of values per pixel.
        encoding: Encoding, such as `mono8`.
        frame_id: Frame of the header.
        item_bytes: Number of bytes per value.
    """
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
    messages: np.ndarray[Any, Any],
    height: int,
    width: int,
    encoding: str,
    frame_id: str,
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
    """Return type name and definition of a message.

    The constants and comments of a field precede it.
    """
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

"""Logs of other writers, without metadata: spaces are inferred from `/rl/step`.

Such a log needs a topic `/rl/step` of CDR messages. The messages have the fields that `schema.py`
describes, in any order and with any numeric types. The field `behavior_prob` is optional, and other
fields are ignored. Vectors are in `observation`, or in `observation_<key>` for each key of a Dict
space; images are on topics `/rl/observation/<key>`, with the log_times of the step records. The
inferred spaces are unbounded Boxes; for integer actions, the space is Discrete up to the largest
action. If there are both `observation` and `observation_<key>` fields, `observation` becomes the
key `state`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from gymnasium import spaces

from mcaprl.errors import LogError
from mcaprl.recorder.dataset.arrays import action_space_of, box_of
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.reading import Columns, McapReader, Topic
from mcaprl.recorder.format.spaces import IMAGE_ENCODINGS, observation_leaves
from mcaprl.recorder.format.topics import STEP_TOPIC

_OBSERVATION, _STATE, _IMAGE_TOPIC = "observation", "observation_state", "/rl/observation/"


def observation_fields(fields: Iterable[str]) -> list[str]:
    """Return the names of the observation fields."""
    return [name for name in fields if name == _OBSERVATION or name.startswith(f"{_OBSERVATION}_")]


def inferred_metadata(reader: McapReader, columns: Columns) -> LogMetadata:
    """Infer a log's metadata from its contents."""
    images = sorted(
        channel.topic
        for channel in reader.channels.values()
        if channel.topic.startswith(_IMAGE_TOPIC)
    )
    vectors = observation_fields(columns)
    if not vectors and not images:
        raise LogError(
            f"{reader.path}: {STEP_TOPIC} has no field {_OBSERVATION}, and there are no images on"
            f" {_IMAGE_TOPIC}<key>"
        )
    action = columns["action"].astype(np.int64 if columns["action"].dtype.kind in "iu" else None)
    if vectors == [_OBSERVATION] and not images:
        return LogMetadata(box_of(columns[_OBSERVATION]), action_space_of(action))
    if _OBSERVATION in vectors:
        columns.setdefault(_STATE, columns.pop(_OBSERVATION))
    parts: dict[str, spaces.Space[Any]] = {
        name.removeprefix(f"{_OBSERVATION}_"): box_of(columns[name])
        for name in observation_fields(columns)
    }
    parts |= {topic.removeprefix(_IMAGE_TOPIC): _image_space(reader, topic) for topic in images}
    metadata = LogMetadata(spaces.Dict(parts), action_space_of(action))
    # Leaves are later read by name, so there must be a field or topic with the name of each leaf.
    for leaf in observation_leaves(metadata.observation_space):
        if not (reader.channels_of(leaf.topic) if leaf.encoding else leaf.name in columns):
            raise LogError(
                f"{reader.path}: the observation '{leaf.path[0]}' must be named"
                f" {leaf.topic if leaf.encoding else leaf.name}; use lower-case letters, digits and"
                " single underscores"
            )
    return metadata


def _image_space(reader: McapReader, topic: str) -> spaces.Box:
    images = Topic(reader, topic)
    if not len(images):
        raise LogError(f"{reader.path}: no images on {topic}")
    first = images.read(("height", "width", "encoding"), np.zeros(1, np.int64))
    height, width, encoding = (first[name][0] for name in ("height", "width", "encoding"))
    channels = {name: count for count, name in IMAGE_ENCODINGS.items()}.get(encoding)
    if channels is None:
        raise LogError(
            f"{reader.path}: images on {topic} are {encoding};"
            f" supported encodings: {', '.join(IMAGE_ENCODINGS.values())}"
        )
    shape = (int(height), int(width)) if channels == 1 else (int(height), int(width), channels)
    return spaces.Box(0, 255, shape, np.uint8)

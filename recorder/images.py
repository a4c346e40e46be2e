"""Image observations: the pictures of a topic that belong to the records of `/rl/step`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns import Topic
from mcaprl.recorder.log_writer import STEP_TOPIC
from mcaprl.recorder.spaces import Leaf

IMAGE_TYPE = "sensor_msgs/msg/Image"
_FIELDS = ("height", "width", "encoding", "step", "data")


def read_images(
    path: Path, topic: Topic, leaf: Leaf, times: NDArray[np.int64], *, threads: int = 1
) -> NDArray[np.uint8]:
    """(F, *shape) pictures of an image leaf, one for each of `times`.

    Raises:
        CorruptLogError: one is missing, or is of another size or encoding.
    """
    order = _order_at(path, topic, times)
    if not set(_FIELDS) <= set(topic.fields):
        raise CorruptLogError(f"{path}: messages of {topic.name} are no {IMAGE_TYPE}")
    columns = topic.read(_FIELDS, order, threads=threads)
    height, width = leaf.shape[:2]
    expected = (height, width, leaf.encoding, leaf.size // height)
    found = [columns[name] for name in _FIELDS[:-1]]
    wrong = np.logical_or.reduce([a != b for a, b in zip(found, expected, strict=True)])
    if wrong.any() or columns["data"].shape[1:] != (leaf.size,):
        row = int(np.argmax(wrong))
        told = ", ".join(
            f"{name} {column[row]}" for name, column in zip(_FIELDS, found, strict=False)
        )
        raise CorruptLogError(
            f"{path}: the image on {topic.name} at log_time {times[row]} has {told}"
            f" and {columns['data'].shape[1]} bytes; the space says {height}x{width}"
            f" {leaf.encoding}"
        )
    return columns["data"].reshape(-1, *leaf.shape)


def _order_at(path: Path, topic: Topic, times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which message of a topic is that of each time."""
    if not len(topic):
        raise CorruptLogError(f"{path}: no images on {topic.name}")
    by_time = np.argsort(topic.times, kind="stable")
    rising = topic.times[by_time]
    place = np.searchsorted(rising, times)
    inside = place < len(rising)
    found = inside & (rising[np.minimum(place, len(rising) - 1)] == times)
    if not found.all():
        missing = times[~found]
        raise CorruptLogError(
            f"{path}: {len(missing)} records of {STEP_TOPIC} have no image on {topic.name}, the"
            f" first at log_time {missing[0]}"
        )
    if (np.diff(rising) == 0).any():
        raise CorruptLogError(f"{path}: {topic.name} has two images of one log_time")
    return by_time[place]

"""Where the recorded vehicle went, from what `/telemetry` tells of its place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.format.reading import McapReader, Topic
from mcaprl.recorder.record.display import TELEMETRY

Track = NDArray[np.float64]
PLACE = ("x_m", "y_m")


def tracks_of(dataset: Dataset) -> list[Track]:
    """The way of each episode, (T + 1, 2) x and y in metres; (0, 2) where it is not told.

    Raises:
        LogError: a file that the dataset came from is gone or damaged.
    """
    logs = [log for log in (_telemetry(path) for path in dataset.sources) if log is not None]
    return [_track(episode.log_time_ns, logs) for episode in dataset.episodes]


def _telemetry(path: Path) -> tuple[NDArray[np.int64], Track] | None:
    """Times (M,) and places (M, 2) of a log; None if it tells none."""
    topic = Topic(McapReader(path), TELEMETRY)
    if not len(topic) or not set(PLACE) <= set(topic.fields):
        return None
    columns = topic.read(list(PLACE))
    return topic.times, np.column_stack([columns[name] for name in PLACE]).astype(np.float64)


def _track(times: NDArray[np.int64], logs: Sequence[tuple[NDArray[np.int64], Track]]) -> Track:
    """The places at exactly these times: every topic of one step has the same."""
    for known, places in logs:
        start = int(np.searchsorted(known, times[0]))
        stop = start + len(times)
        if np.array_equal(known[start:stop], times):
            return places[start:stop]
    return np.empty((0, 2))

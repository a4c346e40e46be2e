"""Steps of an annotated log at which the TD error is large or a policy would act differently."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format.reading import Columns, McapReader, Topic
from mcaprl.recorder.format.schema import STEP_TOPIC
from mcaprl.recorder.record.layout import is_values_topic

_OF_ACTIONS = ("td_error", "advantage", "entropy", "agrees")
_OF_COMMANDS = ("td_error", "distance")
SHOWN = 5
"""Maximum number of steps for each kind of `Surprise` and each topic."""


@dataclass(frozen=True)
class Surprise:
    """A step with a large TD error, or with an action that a policy would not take.

    Attributes:
        file: Path of the log.
        topic: Topic of the policy's outputs.
        kind: `td_error` or `disagreement`.
        time_ns: log_time of the step.
        episode: Index of the episode in the log.
        step: Index of the step in the episode.
        value: For `td_error`, the TD error. For `disagreement`, the advantage of the logged action,
            or the policy's normalized entropy if the policy has no Q-values; for a Box action, the
            distance between the two commands.
    """

    file: str
    topic: str
    kind: Literal["td_error", "disagreement"]
    time_ns: int
    episode: int
    step: int
    value: float

    def __str__(self) -> str:
        """Return a one-line summary, with the log_time in seconds, as viewers display it."""
        seconds, rest_ns = divmod(self.time_ns, 10**9)
        return (
            f"{self.topic} {self.kind} {self.value:+.3g} in episode {self.episode}, step"
            f" {self.step}, at {seconds}.{rest_ns:09d}"
        )


def moments_of(path: Path) -> list[Surprise]:
    """Return the largest TD errors and strongest disagreements of each policy in a log."""
    reader = McapReader(path)
    topics = sorted({c.topic for c in reader.channels.values() if is_values_topic(c.topic)})
    if not topics:
        return []
    places = _places(Topic(reader, STEP_TOPIC))
    found = []
    for name in topics:
        topic = Topic(reader, name)
        is_finite = "agrees" in topic.fields
        columns = topic.read(_OF_ACTIONS if is_finite else _OF_COMMANDS)
        for kind, row, value in (*_surprises(columns), *_disagreements(columns)):
            time_ns = int(topic.times[row])
            episode, step = places.get(time_ns, (-1, -1))
            found.append(Surprise(str(path), name, kind, time_ns, episode, step, value))
    return found


_Ranked = tuple[Literal["td_error", "disagreement"], int, float]


def _surprises(columns: Columns) -> Iterator[_Ranked]:
    errors = columns["td_error"]
    for row in _largest(np.abs(errors), np.isfinite(errors)):
        yield "td_error", row, float(errors[row])


def _disagreements(columns: Columns) -> Iterator[_Ranked]:
    """Yield the disagreements with the lowest advantage; without Q-values, the lowest entropy.

    Of Box actions, which hardly ever agree, yield those with the largest distance.
    """
    if "agrees" not in columns:
        distances = columns["distance"]
        for row in _largest(distances, distances > 0):
            yield "disagreement", row, float(distances[row])
        return
    differs = ~columns["agrees"].astype(bool)
    has_values = bool(np.isfinite(columns["advantage"]).any())
    numbers = columns["advantage"] if has_values else columns["entropy"]
    for row in _largest(-numbers, differs & np.isfinite(numbers)):
        yield "disagreement", row, float(numbers[row])


def _largest(numbers: NDArray[Any], chosen: NDArray[np.bool_]) -> list[int]:
    rows = np.flatnonzero(chosen)
    order = np.argsort(-numbers[rows], kind="stable")[:SHOWN]
    return [int(row) for row in rows[order]]


def _places(steps: Topic) -> dict[int, tuple[int, int]]:
    """Return a dict that maps each log_time to an episode index and a step index."""
    times = steps.times
    order = np.argsort(times, kind="stable")
    step = steps.read(("step",))["step"][order]
    episode = np.cumsum(step == 0) - 1
    pairs = zip(episode.tolist(), step.tolist(), strict=True)
    return dict(zip(times[order].tolist(), pairs, strict=True))

"""What `/rl/episode` reports of an episode, and how its rewards are added up."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format import messages

INTERRUPTED = "interrupted"
"""Why an episode ended that the recorder, not the environment, broke off."""


class EpisodeSummary(NamedTuple):
    """What `/rl/episode` tells of one episode.

    Attributes:
        episode: counted from 0 in its log.
        length: transitions.
        total_reward: sum of rewards, in the order they came.
        terminated: whether the last transition ended in a terminal state.
        truncated: whether it was cut off.
        start_time_ns: log_time of the first record.
        end_time_ns: log_time of the final record.
        reason: why it ended.
        policy: who acted.
        epsilon: its exploration; NaN if unknown.
        seed: given to reset(); None if none was.
        options: reset()'s options as JSON; empty if none were given.
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
        """As `mcaprl_msgs/msg/Episode`, in CDR."""
        return messages.episode_message(**self._asdict())

    def log_lines(self) -> list[tuple[int, str]]:
        """Its start and its end in words, each with its log_time."""
        acting = f", {self.policy} acts" if self.policy else ""
        return [
            (self.start_time_ns, f"episode {self.episode} begins{acting}"),
            (
                self.end_time_ns,
                f"episode {self.episode} ends after {self.length} steps: {self.reason},"
                f" return {self.total_reward:.4g}",
            ),
        ]


def add_up(rewards: NDArray[np.float64], start: float = 0.0) -> float:
    """The sum in order, the same on every machine; `sum` and `np.sum` add in other ways."""
    if start:
        rewards = np.concatenate([[start], rewards])
    return add_up_each(rewards, [0], [len(rewards)])[0]


def add_up_each(
    rewards: NDArray[np.float64], starts: Iterable[int], stops: Iterable[int]
) -> list[float]:
    """The sums, likewise, of several spans of rewards."""
    with np.errstate(all="ignore"):
        # Of nothing but -0.0, too, the sum from 0.0 on is 0.0.
        return [
            float(np.add.accumulate(rewards[start:stop])[-1] + 0.0) if start < stop else 0.0
            for start, stop in zip(starts, stops, strict=True)
        ]

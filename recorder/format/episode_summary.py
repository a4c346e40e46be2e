"""Summary of an episode on `/rl/episode`, and sums of rewards."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import SpaceError
from mcaprl.files import as_type
from mcaprl.limits import MAX_TIME_NS
from mcaprl.recorder.format import messages
from mcaprl.texts import counted

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
        return messages.episode_message(**self._asdict())

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
    if found.seed is not None and not 0 <= found.seed <= messages.MAX_SEED:
        raise SpaceError(f"an episode is damaged: a log cannot store the seed {found.seed}")
    if not all(0 <= each < MAX_TIME_NS for each in (found.start_time_ns, found.end_time_ns)):
        raise SpaceError("an episode is damaged: its times are impossible")
    return found


def begin_line(episode: int, policy: str) -> str:
    """Return the log line of an episode's start."""
    return f"episode {episode} begins" + (f", {policy} acts" if policy else "")


def add_up(rewards: NDArray[np.float64], start: float = 0.0) -> float:
    """Add up rewards in order, with bit-identical results on every machine.

    `np.sum` adds pairwise, and `sum` compensates rounding errors since Python 3.12.

    Args:
        rewards: (T,) rewards.
        start: Sum of all earlier rewards.
    """
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

"""What recorders of one environment and of many share: a log that grows by whole episodes."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.errors import UsageError
from mcaprl.recorder.display import Display
from mcaprl.recorder.layout import LAYOUT_NAME, layout_of
from mcaprl.recorder.log_writer import EpisodeSummary, LogWriter
from mcaprl.recorder.metadata import LogMetadata


@dataclass
class OpenEpisode:
    """An episode that is being recorded.

    Attributes:
        policy: who acts.
        epsilon: its exploration.
        seed: given to reset().
        options: given to reset().
        steps: transitions that are wholly in the columns.
    """

    policy: str
    epsilon: float
    seed: int | None = None
    options: dict[str, Any] | None = None
    steps: int = 0


class Recording:
    """A log whose episodes are numbered, and whose times rise from one to the next.

    Attributes:
        log: what is written to.
        step_ns: simulated time between two records.
        next_start_ns: log_time of the next episode's first record.
        episodes: how many there are, which is the next one's number.
    """

    def __init__(
        self,
        path: str | Path,
        description: LogMetadata,
        *,
        compression: str,
        overwrite: bool,
        start_time_ns: int | None,
    ) -> None:
        """Create the file; see `RecordMcap`, whose arguments these are.

        Raises:
            UsageError: the times would not rise.
            SpaceError, OutputExistsError, LogError: as `LogWriter`.
        """
        self._description = description
        self.step_ns = description.step_duration_ns
        self.next_start_ns = time.time_ns() if start_time_ns is None else start_time_ns
        if self.step_ns < 1 or self.next_start_ns < 0:
            raise UsageError(
                f"a step of {self.step_ns} ns from {self.next_start_ns} ns on: times must rise"
                " from 0 or later; give step_duration_s and start_time_ns"
            )
        self.episodes = 0
        self.log = LogWriter(path, description, compression=compression, overwrite=overwrite)

    @property
    def closed(self) -> bool:
        """Whether the log takes no more."""
        return self.log.mcap.closed

    def check_can_begin(self, seeds: Iterable[int | None]) -> None:
        """Make sure that episodes with these seeds can be recorded.

        Raises:
            UsageError: the recording is closed, or a seed does not fit 63 bits.
        """
        if self.closed:
            raise UsageError(f"{self.log.mcap.path} is closed; record another episode elsewhere")
        for seed in seeds:
            if seed is not None and not 0 <= seed < 2**63:
                raise UsageError(f"seed {seed}: a log holds seeds from 0 to 2**63 - 1")

    def show(self, display: Display, policy: str) -> None:
        """Begin the next episode for viewers; with the first one comes the layout."""
        start_ns = self.next_start_ns
        if display.begin(start_ns, self.step_ns, self.episodes, policy):
            layout = layout_of(
                self._description, display.topics, display.telemetry_names, display.follow_frame
            )
            self.log.mcap.add_attachment(
                LAYOUT_NAME, "application/json", json.dumps(layout).encode(), start_ns
            )

    def summary(
        self,
        episode: OpenEpisode,
        *,
        total_reward: float,
        terminated: bool,
        truncated: bool,
        reason: str,
    ) -> EpisodeSummary:
        """What is to be told of an episode that ends now, as the next one of the log."""
        return EpisodeSummary(
            episode=self.episodes,
            length=episode.steps,
            total_reward=total_reward,
            terminated=terminated,
            truncated=truncated,
            start_time_ns=self.next_start_ns,
            end_time_ns=self.next_start_ns + episode.steps * self.step_ns,
            reason=reason,
            policy=episode.policy,
            epsilon=episode.epsilon,
            seed=episode.seed,
            options="" if episode.options is None else _json(episode.options),
        )

    def advance(self, summary: EpisodeSummary) -> None:
        """Count an episode that is wholly written."""
        self.next_start_ns = summary.end_time_ns + self.step_ns
        self.episodes += 1


def reason_of(told: Any, terminated: bool) -> str:
    """Why an episode ended, in the environment's words if it has any."""
    return told if isinstance(told, str) and told else "terminated" if terminated else "time_limit"


def _json(options: dict[str, Any]) -> str:
    try:
        return json.dumps(options, default=_plain)
    except (TypeError, ValueError):
        return json.dumps(repr(options))


def _plain(value: Any) -> Any:
    """What json cannot write by itself: NumPy's numbers and arrays; anything else by its repr."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else repr(value)

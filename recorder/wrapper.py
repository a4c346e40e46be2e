"""Records an environment while it runs: a Gymnasium wrapper over preallocated columns.

Row k of `/rl/step` holds observation k and the action taken there with what it brought; the row
behind an episode's last transition holds its last observation and is `final`. Only what differs
from row to row is written per step; times, counters and constants are filled in by whole columns
when a chunk is written. Rows are copies, so the environment may reuse its buffers.
"""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np

from mcaprl.errors import SpaceError
from mcaprl.recorder.display import Display
from mcaprl.recorder.layout import LAYOUT_NAME, layout_of
from mcaprl.recorder.log_writer import EpisodeSummary, LogWriter
from mcaprl.recorder.metadata import LogMetadata
from mcaprl.recorder.rows import ImageColumn, StepColumns, leaf_writers


class RecordMcap(gym.Wrapper[Any, Any, Any, Any]):
    """Records every transition of an environment to an MCAP file.

    Each finished episode is on disk when `step` returns its end. An episode that is broken off by
    `reset` or `close` is kept and marked truncated, with the reason `interrupted`.

    Attributes:
        behavior_prob: set it before `step` to the probability of the action under the policy that
            chose it; NaN, meaning unknown, after each step.
        policy: name of who acts, for `/rl/episode`; may be changed between episodes.
        epsilon: its exploration, likewise; NaN if unknown.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        path: str | Path,
        *,
        policy: str = "",
        epsilon: float = math.nan,
        seed: int | None = None,
        compression: str = "zstd",
        overwrite: bool = False,
        scene: bool = True,
        camera: bool = False,
        step_duration_s: float | None = None,
        start_time_ns: int | None = None,
    ) -> None:
        """Wrap `env` and create the file.

        Args:
            env: with a Box, Discrete, MultiDiscrete or MultiBinary action space, and observations
                of these or of a Dict of them.
            path: of the file to write.
            policy: name of who acts.
            epsilon: probability of a random action; NaN if unknown.
            seed: of the recording, for the metadata.
            compression: `zstd`, `lz4` or `none`.
            overwrite: replace a file that is there.
            scene: record what viewers show, where the environment describes it.
            camera: record the environment's metric depth image, too.
            step_duration_s: simulated seconds between two observations; default: the environment's
                `step_duration_s`, or one over its `render_fps`, or 0.1.
            start_time_ns: log_time of the first record, since the Unix epoch; default: now.

        Raises:
            SpaceError: a log cannot hold the environment's spaces.
            OutputExistsError, LogError: the file cannot be created.
        """
        super().__init__(env)
        self.policy, self.epsilon, self.behavior_prob = policy, epsilon, math.nan
        metadata = LogMetadata.of_env(
            env,
            step_duration_s=step_duration_s,
            policy=policy,
            epsilon="" if math.isnan(epsilon) else repr(epsilon),
            seed="" if seed is None else str(seed),
        )
        self._step_ns = metadata.step_duration_ns
        self._log = LogWriter(path, metadata, compression=compression, overwrite=overwrite)
        self._display = Display(self._log, env.unwrapped, scene=scene, camera=camera)
        self._log_metadata = metadata
        self._next_start_ns = time.time_ns() if start_time_ns is None else start_time_ns
        self._columns = StepColumns(self._log)
        images = {
            leaf: ImageColumn(self._log, leaf.topic, leaf.shape, leaf.encoding)
            for leaf in self._log.image_leaves
        }
        self._images = list(images.values())
        self._writers = leaf_writers(metadata.observation_space, self._columns, images)
        self._episode = -1
        self._open = self._has_layout = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and begin an episode in the log."""
        self._interrupt()
        observation, info = super().reset(seed=seed, options=options)
        self._episode += 1
        self._step, self._total_reward, self._open = 0, 0.0, True
        self._start_ns = self._next_start_ns
        self._seed = seed
        self._options = "" if options is None else json.dumps(options, default=_plain)
        self._columns.begin(self._episode, self._start_ns, self._step_ns)
        self._observe(observation, self._start_ns)
        self._display.begin(self._start_ns, self._episode, self.policy)
        if not self._has_layout:
            self._attach_layout()
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the environment and log the transition."""
        if not self._open:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is open")
        # Before the environment can change it.
        self._columns.act(action, self.behavior_prob)
        observation, reward, terminated, truncated, info = self.env.step(action)
        reward_ = float(reward)
        self._columns.reward(reward_)
        self.behavior_prob = math.nan
        time_ns = self._start_ns + (self._step + 1) * self._step_ns
        self._observe(observation, time_ns)
        self._total_reward += reward_
        self._step += 1
        self._display.observe(time_ns)
        if terminated or truncated:
            reason = str(info.get("reason") or ("terminated" if terminated else "time_limit"))
            self._end(bool(terminated), bool(truncated), reason)
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Finish the log and close the environment. Closing twice is harmless."""
        if not self._log.mcap.closed:
            self._interrupt()
            self._log.close()
        super().close()

    def _observe(self, observation: Any, time_ns: int) -> None:
        """Log an observation; one that does not fit leaves the rows as they were."""
        self._columns.next_row()
        for image in self._images:
            image.next_row(time_ns)
        try:
            for write in self._writers:
                write(observation)
        except SpaceError:
            self._columns.step_back()
            for image in self._images:
                image.step_back()
            raise

    def _attach_layout(self) -> None:
        """Attach it once the first reset has shown which topics there are."""
        display = self._display
        layout = layout_of(
            self._log_metadata, display.topics, display.telemetry_names, display.follow_frame
        )
        self._log.mcap.add_attachment(
            LAYOUT_NAME, "application/json", json.dumps(layout).encode(), self._start_ns
        )
        self._has_layout = True

    def _interrupt(self) -> None:
        """Keep an episode that is broken off; one without a transition leaves no trace."""
        if self._open and self._step > 0:
            self._end(False, True, "interrupted")
        elif self._open:
            self._columns.clear()
            for image in self._images:
                image.clear()
            self._display.clear()
            self._episode -= 1
        self._open = False

    def _end(self, terminated: bool, truncated: bool, reason: str) -> None:
        end_ns = self._start_ns + self._step * self._step_ns
        summary = EpisodeSummary(
            episode=self._episode,
            length=self._step,
            total_reward=self._total_reward,
            terminated=terminated,
            truncated=truncated,
            start_time_ns=self._start_ns,
            end_time_ns=end_ns,
            reason=reason,
            policy=self.policy,
            epsilon=self.epsilon,
            seed=self._seed,
            options=self._options,
        )
        for image in self._images:
            image.flush()
        self._display.end(summary)
        self._log.write_episodes([summary])
        self._columns.end(terminated, truncated)
        self._next_start_ns = end_ns + self._step_ns
        self._open = False


def _plain(value: Any) -> Any:
    """What json cannot write by itself: NumPy's numbers and arrays; anything else by its repr."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else repr(value)

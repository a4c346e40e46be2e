"""A Gymnasium wrapper that records an environment while it runs.

Row k of `/rl/step` contains observation k, the action that follows it and the resulting reward. The
`final` row, after an episode's last transition, contains the last observation. Each step stores
only the values that change; times, counters and constants are filled in as whole columns when a
chunk is written. Values are copied, so the environment may reuse its buffers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np

from mcaprl.errors import SpaceError
from mcaprl.recorder.format.behavior import behavior_field
from mcaprl.recorder.format.log_writer import InfoTopics
from mcaprl.recorder.format.messages import INTERRUPTED
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import action_leaf
from mcaprl.recorder.format.writing import HoldSignals
from mcaprl.recorder.record.camera import rendering_env
from mcaprl.recorder.record.display import Display
from mcaprl.recorder.record.recordable import EpisodeInfos, check_single, recorded_space
from mcaprl.recorder.record.session import EpisodeLog, FinishesAtExit, OpenEpisode, reason_of
from mcaprl.recorder.record.step_rows import (
    ImageColumn,
    StepColumns,
    observation_store,
    reward_number,
)

_UNKNOWN = math.nan


class RecordMcap(FinishesAtExit, gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper that records every transition of an environment to an MCAP file.

    An episode is on disk when the `step` that ends it returns. An episode interrupted by `reset`,
    `close` or an error is recorded as truncated, with the reason `interrupted`. Make this wrapper
    the outermost one: the effects of wrappers around it, such as a TimeLimit, are not recorded.
    Without a call of `close`, the log is finished when the wrapper is deleted or Python exits.

    Attributes:
        policy: Name of the policy, for `/rl/episode`; may be changed between episodes.
        epsilon: Exploration rate of the policy; NaN if unknown. May be changed between episodes.
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
        append: bool = False,
        max_file_bytes: int | None = None,
        scene: bool = True,
        camera: bool | str = False,
        infos: bool | Sequence[str] = False,
        keys: Sequence[str] | None = None,
        step_duration_s: float | None = None,
        start_time_ns: int | None = None,
    ) -> None:
        """Wrap `env` and create the file.

        Args:
            env: Environment with a Box, Discrete, MultiDiscrete or MultiBinary action space. Its
                observation space is one of these, or a Dict or Tuple of them. A Tuple is recorded
                as a Dict with the keys `0`, `1`, ...; a text in a Dict or Tuple, such as the
                mission of MiniGrid, as the info `observation.mission`.
            path: File to write.
            policy: Name of the policy.
            epsilon: Probability of a random action; NaN if unknown.
            seed: Seed to store in the log's metadata.
            compression: Compression of chunks: `zstd`, `lz4` or `none`.
            overwrite: Whether to replace an existing file.
            append: Whether to append episodes to an existing file. The file must be a recording of
                an environment with the same id, arguments and spaces.
            max_file_bytes: File size from which the next episode begins a new file. `lane.mcap`
                becomes `lane-00000.mcap`, `lane-00001.mcap` and so on. Each file contains whole
                episodes; `mcaprl.open` reads the folder of the files as one dataset.
            scene: Whether to record shapes, frames and telemetry for viewers, if the environment
                provides them.
            camera: Whether to record the environment's metric depth image; or `h264` to record what
                an environment with `render_mode="rgb_array"` renders, as video for viewers, at up
                to 30 images per simulated second. Video needs the extra `video`.
            infos: Whether to record the infos that the environment returns, or the names of the
                infos to record; `episode` includes `episode.r`. Values other than numbers, flags,
                strings and arrays are not recorded and cause a warning.
            keys: Keys of the parts of a Dict or Tuple observation to record, such as `joints`, or
                `joints/q` for a part of a part; default: all. The agent still receives all parts.
            step_duration_s: Simulated seconds between two observations; default: the environment's
                `step_duration_s`, else 1 / `render_fps`, else 0.1.
            start_time_ns: log_time of the first message, in nanoseconds since the Unix epoch;
                default: now.

        Raises:
            SpaceError: The log format does not support the environment's spaces.
            UnknownNameError: The observation has no such key.
            UsageError: Timestamps would not increase, the observation has no keys, `env` is not an
                environment of Gymnasium, or does not render images for a video.
            OutputExistsError, LogError: The file cannot be created or appended to.
        """
        check_single(env)
        rendering = rendering_env(env, camera)
        recorded = recorded_space(env.observation_space, keys)
        action_leaf(env.action_space)
        super().__init__(env)
        self.policy, self.epsilon, self._behavior = policy, epsilon, _UNKNOWN
        self._field = behavior_field(env.action_space)
        description = LogMetadata.of_env(
            env,
            step_duration_s=step_duration_s,
            policy=policy,
            epsilon="" if math.isnan(epsilon) else repr(epsilon),
            seed="" if seed is None else str(seed),
        )
        self._recording = EpisodeLog(
            path,
            replace(description, observation_space=recorded.space),
            compression=compression,
            overwrite=overwrite,
            append=append,
            max_file_bytes=max_file_bytes,
            start_time_ns=start_time_ns,
        )
        log = self._recording.log
        wanted, self._recorded = recorded.infos(infos), recorded
        self._infos = EpisodeInfos(InfoTopics(log), wanted) if wanted else None
        self._display = Display(
            log, env.unwrapped, scene=scene, camera=camera is True, rendering=rendering
        )
        self._columns = columns = StepColumns(log)
        self._shows_steps = self._display.shows_steps
        self._take_action, self._store_reward = columns.take_action, columns.store_reward
        images = {
            leaf: ImageColumn(log, leaf.topic, leaf.shape, leaf.encoding)
            for leaf in log.image_leaves
        }
        self._images = list(images.values())
        self._store_observation = observation_store(recorded, columns, images)
        self._full_at = 0
        self._open: OpenEpisode | None = None
        self._watch()

    @property
    def episodes(self) -> int:
        """Number of finished episodes in the log, including episodes of earlier recordings."""
        return self._recording.episodes

    @property
    def behavior_prob(self) -> float:
        """Probability of the next action under the behavior policy.

        Set it before each `step`, which resets it to NaN (unknown). Actions of floats have
        densities instead: set `behavior_log_prob`.
        """
        return self._field.probs(self._behavior, "behavior_log_prob")

    @behavior_prob.setter
    def behavior_prob(self, prob: float) -> None:
        self._behavior = self._field.probs(prob, "behavior_log_prob")

    @property
    def behavior_log_prob(self) -> float:
        """Natural logarithm of the probability of the next action, or of its density.

        For actions of floats it is the density in the action's own units. Set it as
        `behavior_prob`.
        """
        return float(self._field.log_probs(np.array(self._behavior, np.float32)))

    @behavior_log_prob.setter
    def behavior_log_prob(self, log_prob: float) -> None:
        self._behavior = self._field.from_log_probs(log_prob)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and begin an episode in the log.

        Raises:
            SpaceError: The observation does not fit its space.
            UsageError: The recording is closed, or the seed is too large.
        """
        self._recording.check_can_begin([seed])
        self._interrupt()
        observation, info = self.env.reset(seed=seed, options=options)
        with HoldSignals():
            self._begin(OpenEpisode(self.policy, self.epsilon, seed, options), observation)
        if self._infos is not None:
            self._infos.begin(self._recorded.info(info, observation))
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the environment and log the transition.

        Raises:
            ResetNeeded: No episode is open.
            UsageError: `behavior_prob` is not in (0, 1], or `behavior_log_prob` is not finite; the
                environment is not stepped.
            SpaceError: The action does not fit its space (the environment is not stepped), or the
                observation does not fit its space. An error in the environment or in its results
                ends the episode, which is recorded up to the previous transition.
        """
        episode = self._open
        if episode is None:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is open")
        step = episode.steps + 1
        behavior, field = self._behavior, self._field
        # Call `check` only for invalid values, because a comparison is faster than a call.
        if behavior is not _UNKNOWN:
            try:
                is_possible = field.low <= behavior <= field.high
            except (TypeError, ValueError):
                is_possible = False
            if not is_possible:
                field.check(behavior, field.name)
        try:
            # Copy the action before the environment can change it.
            try:
                self._take_action(action)
            except (TypeError, OverflowError):
                self._columns.store_action(action)
            if behavior is not _UNKNOWN:
                self._columns.store_behavior(behavior)
                self._behavior = _UNKNOWN
        except SpaceError:
            raise
        except BaseException:
            self._interrupt()
            raise
        try:
            transition = self.env.step(action)
            observation, reward, terminated, truncated, info = transition
            self._store_observation(observation)
            if self._infos is not None:
                self._infos.add(step, self._recorded.info(info, observation))
            try:
                self._store_reward(reward)
                number = reward
            except TypeError:
                number = reward_number(reward)
                self._store_reward(number)
            has_ended = terminated or truncated
            if has_ended or step >= self._full_at:
                reason = reason_of(info.get("reason"), bool(terminated)) if has_ended else ""
                # A signal must not interrupt the writes and the update of the step counter.
                with HoldSignals():
                    self._make_room(step)
                    self._count(episode, step, float(number))
                    if has_ended:
                        self._end(bool(terminated), bool(truncated), reason)
            elif self._shows_steps:
                self._count(episode, step, float(number))
            else:
                episode.steps = step
        except BaseException:
            # The log may lack the last step of the environment, so the episode cannot continue.
            self._interrupt()
            raise
        return transition

    def close(self) -> None:
        """Finish the log and close the environment; a second call has no effect."""
        try:
            self._finish()
        finally:
            super().close()

    def _finish(self) -> None:
        with HoldSignals():
            if not self._recording.closed:
                self._interrupt()
                self._recording.close()

    def _begin(self, episode: OpenEpisode, observation: Any) -> None:
        recording = self._recording
        start_ns, step_ns = recording.next_start_ns, recording.step_ns
        self._columns.begin(recording.episodes, start_ns, step_ns)
        for image in self._images:
            image.begin(start_ns, step_ns)
        self._full_at = self._next_full()
        self._store_observation(observation)
        recording.begin(self._display)
        self._count(episode, 0, 0.0)
        self._open = episode

    def _make_room(self, step: int) -> None:
        if step >= self._columns.full_at:
            self._columns.make_room(step)
        for image in self._images:
            if step >= image.full_at:
                image.flush(step)
        self._full_at = self._next_full()

    def _next_full(self) -> int:
        """Return the first step whose observation does not fit the buffers."""
        return min([self._columns.full_at, *(image.full_at for image in self._images)])

    def _count(self, episode: OpenEpisode, step: int, reward: float) -> None:
        if self._shows_steps:
            self._display.observe(step, reward)
        episode.steps = step

    def _interrupt(self) -> None:
        """Record an unfinished episode as truncated, or drop it if it has no transition."""
        # After a write error the log is closed and contains the finished episodes.
        if self._open is not None and self._open.steps > 0 and not self._recording.closed:
            with HoldSignals():
                self._end(False, True, INTERRUPTED)
        self._display.clear()
        self._open = None

    def _end(self, terminated: bool, truncated: bool, reason: str) -> None:
        episode = self._open
        assert episode is not None
        # Set this before writing, so that an error does not cause a second write of the episode.
        self._open = None
        summary = self._recording.summary(
            episode,
            total_reward=self._columns.total_reward(episode.steps),
            terminated=terminated,
            truncated=truncated,
            reason=reason,
        )
        for image in self._images:
            image.flush(episode.steps + 1)
        self._display.end(summary)
        if self._infos is not None:
            recording = self._recording
            self._infos.end(episode.steps, recording.next_start_ns, recording.step_ns)
        self._recording.log.write_episodes([summary], log_lines=True)
        self._columns.end(episode.steps, terminated, truncated)
        self._recording.advance(summary)
        if self._infos is not None:
            self._infos.warn()


# Reprs and pickles contain this public import path.
RecordMcap.__module__ = "mcaprl"

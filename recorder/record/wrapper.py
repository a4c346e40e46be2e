"""Records an environment while it runs: a Gymnasium wrapper over preallocated columns.

Row k of `/rl/step` holds observation k and the action taken there with what it brought; the row
behind an episode's last transition holds its last observation and is `final`. Only what differs
from row to row is written per step; times, counters and constants are filled in by whole columns
when a chunk is written. Rows are copies, so the environment may reuse its buffers.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym

from mcaprl.errors import SpaceError, UsageError
from mcaprl.recorder.format.episode_summary import INTERRUPTED
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.writing import HoldSignals
from mcaprl.recorder.record.display import Display
from mcaprl.recorder.record.session import OpenEpisode, Recording, reason_of
from mcaprl.recorder.record.step_rows import ImageColumn, StepColumns, observation_keeper

_UNKNOWN = math.nan


class RecordMcap(gym.Wrapper[Any, Any, Any, Any]):
    """Records every transition of an environment to an MCAP file.

    Each finished episode is on disk when `step` returns its end. An episode that is broken off by
    `reset`, `close` or an error is kept and marked truncated, with the reason `interrupted`. Wrap
    last: what other wrappers outside of this one do (a TimeLimit, say) is not seen here.

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
        append: bool = False,
        max_file_bytes: int | None = None,
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
            append: go on behind the last episode of a file that is there, which must have been
                recorded from an environment of the same id, arguments and spaces.
            max_file_bytes: begin another file behind the episode that made one as large as this.
                `lane.mcap` then is `lane-00000.mcap`, `lane-00001.mcap` and so on, each a log of
                whole episodes; `mcaprl.open` reads their folder as one.
            scene: record what viewers show, where the environment describes it.
            camera: record the environment's metric depth image, too.
            step_duration_s: simulated seconds between two observations; default: the environment's
                `step_duration_s`, or one over its `render_fps`, or 0.1.
            start_time_ns: log_time of the first record, since the Unix epoch; default: now.

        Raises:
            SpaceError: a log cannot hold the environment's spaces.
            UsageError: the times would not rise.
            OutputExistsError, LogError: the file cannot be created, or appended to.
        """
        if isinstance(env, gym.vector.VectorEnv):
            raise UsageError(
                "RecordMcap wraps single environments; RecordVecMcap wraps vector ones"
            )
        super().__init__(env)
        self.policy, self.epsilon, self.behavior_prob = policy, epsilon, math.nan
        description = LogMetadata.of_env(
            env,
            step_duration_s=step_duration_s,
            policy=policy,
            epsilon="" if math.isnan(epsilon) else repr(epsilon),
            seed="" if seed is None else str(seed),
        )
        self._recording = Recording(
            path,
            description,
            compression=compression,
            overwrite=overwrite,
            append=append,
            max_file_bytes=max_file_bytes,
            start_time_ns=start_time_ns,
        )
        log = self._recording.log
        self._display = Display(log, env.unwrapped, scene=scene, camera=camera)
        self._columns = columns = StepColumns(log)
        # Looked up at each step.
        self._shows_steps = self._display.shows_steps
        self._take_action, self._keep_reward = columns.take_action, columns.keep_reward
        images = {
            leaf: ImageColumn(log, leaf.topic, leaf.shape, leaf.encoding)
            for leaf in log.image_leaves
        }
        self._images = list(images.values())
        self._keep_observation = observation_keeper(env.observation_space, self._columns, images)
        self._full_at = 0
        self._open: OpenEpisode | None = None

    @property
    def episodes(self) -> int:
        """Finished episodes of the log, with those that it had before it was appended to."""
        return self._recording.episodes

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and begin an episode in the log.

        Raises:
            SpaceError: the observation does not fit its space.
            UsageError: the recording is closed, or the seed does not fit 63 bits.
        """
        self._recording.check_can_begin([seed])
        self._interrupt()
        observation, info = self.env.reset(seed=seed, options=options)
        with HoldSignals():
            self._begin(OpenEpisode(self.policy, self.epsilon, seed, options), observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the environment and log the transition.

        Raises:
            ResetNeeded: no episode is open.
            SpaceError: the action does not fit its space, and is not taken; or the observation
                does not fit. As after any error behind the action, the episode is over then, and
                kept up to the transition before.
        """
        episode = self._open
        if episode is None:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is open")
        step = episode.steps + 1
        try:
            # Before the environment can change it.
            try:
                self._take_action(action)
            except (TypeError, OverflowError):
                self._columns.keep_action(action)
            if self.behavior_prob is not _UNKNOWN:
                self._columns.keep_behavior_prob(self.behavior_prob)
                self.behavior_prob = _UNKNOWN
        except SpaceError:
            raise
        except BaseException:
            self._interrupt()
            raise
        try:
            observation, reward, terminated, truncated, info = self.env.step(action)
            self._keep_observation(observation)
            self._keep_reward(reward)
            if terminated or truncated or step >= self._full_at:
                # Nothing may come between the writes, nor between them and what counts the steps.
                with HoldSignals():
                    self._make_room(step)
                    self._count(episode, step, float(reward))
                    if terminated or truncated:
                        reason = reason_of(info.get("reason"), bool(terminated))
                        self._end(bool(terminated), bool(truncated), reason)
            elif self._shows_steps:
                self._count(episode, step, float(reward))
            else:
                episode.steps = step
        except BaseException:
            # The environment may be a step ahead of the log: nothing may be joined to it.
            self._interrupt()
            raise
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Finish the log and close the environment. Closing twice is harmless."""
        try:
            with HoldSignals():
                if not self._recording.closed:
                    self._interrupt()
                    self._recording.close()
        finally:
            super().close()

    def _begin(self, episode: OpenEpisode, observation: Any) -> None:
        recording = self._recording
        start_ns, step_ns = recording.next_start_ns, recording.step_ns
        self._columns.begin(recording.episodes, start_ns, step_ns)
        for image in self._images:
            image.begin(start_ns, step_ns)
        self._full_at = self._next_full()
        self._keep_observation(observation)
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
        """The first step for whose observation there is no room."""
        return min([self._columns.full_at, *(image.full_at for image in self._images)])

    def _count(self, episode: OpenEpisode, step: int, reward: float) -> None:
        if self._shows_steps:
            self._display.observe(step, reward)
        # From here on the step counts.
        episode.steps = step

    def _interrupt(self) -> None:
        """Keep an episode that is broken off; one without a transition leaves no trace."""
        if self._open is not None and self._open.steps > 0:
            with HoldSignals():
                self._end(False, True, INTERRUPTED)
        self._display.clear()
        self._open = None

    def _end(self, terminated: bool, truncated: bool, reason: str) -> None:
        episode = self._open
        assert episode is not None
        # Whatever goes wrong now, this episode is not written a second time.
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
        self._display.end(episode.steps)
        self._recording.log.write_episodes([summary], log_lines=True)
        self._columns.end(episode.steps, terminated, truncated)
        self._recording.advance(summary)


# The public path, for reprs and pickles.
RecordMcap.__module__ = "mcaprl"

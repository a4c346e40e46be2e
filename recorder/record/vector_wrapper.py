"""Records a vector of environments while it runs, each episode whole and in order.

Episodes of many environments grow side by side. Each one's rows wait in memory until it ends; then
they are written as if it had been recorded alone, behind the one that ended before it. So the file
is the same as a single environment's: a reader cannot tell, and simulated time runs on from episode
to episode. What waits is lost if the process is killed, one open episode of each environment.

Viewers are shown no scene, since there is no single one to show; a single environment that replays
the seeds and actions has it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mcaprl.errors import SpaceError, UsageError
from mcaprl.recorder.format.episode_summary import INTERRUPTED, add_up
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import action_leaf, observation_leaves
from mcaprl.recorder.format.writing import HoldSignals
from mcaprl.recorder.record.display import Display
from mcaprl.recorder.record.session import OpenEpisode, Recording, reason_of
from mcaprl.recorder.record.step_rows import as_declared, converters
from mcaprl.recorder.record.vector_rows import OpenRows, OpenSteps


class RecordVecMcap(gym.vector.VectorWrapper[Any, Any, Any, Any, Any]):
    """Records every transition of a vector environment to an MCAP file.

    Each finished episode is on disk when `step` returns its end, whatever the autoreset mode. An
    episode that is broken off by `reset`, `close` or an error is kept and marked truncated, with
    the reason `interrupted`. Wrap last: what other wrappers outside of this one do is not seen.

    Attributes:
        behavior_probs: set it before `step` to the (N,) probabilities of the actions under the
            policy that chose them; NaN, meaning unknown, after each step.
        policy: name of who acts, for `/rl/episode`; may be changed at any time, and each episode
            tells the one of its start.
        epsilon: its exploration, likewise; NaN if unknown.
        policy_version: how many updates the policy has seen. If it is given at the beginning,
            `/rl/learner` tells it and `epsilon` for each step, as they are when `step` is called.
    """

    def __init__(
        self,
        env: gym.vector.VectorEnv[Any, Any, Any],
        path: str | Path,
        *,
        policy: str = "",
        epsilon: float = math.nan,
        policy_version: int | None = None,
        seed: int | None = None,
        compression: str = "zstd",
        overwrite: bool = False,
        append: bool = False,
        max_file_bytes: int | None = None,
        step_duration_s: float | None = None,
        start_time_ns: int | None = None,
    ) -> None:
        """Wrap `env` and create the file.

        Args:
            env: whose single environments could be recorded by `RecordMcap`; its metadata name
                the autoreset mode.
            path: of the file to write.
            policy: name of who acts.
            epsilon: probability of a random action; NaN if unknown.
            policy_version: how many updates the policy has seen; None leaves out `/rl/learner`.
            seed: of the recording, for the metadata.
            compression: `zstd`, `lz4` or `none`.
            overwrite: replace a file that is there.
            append: go on behind the last episode of a file that is there, which must have been
                recorded from an environment of the same id, arguments and spaces.
            max_file_bytes: begin another file behind the episode that made one as large as this.
                `lane.mcap` then is `lane-00000.mcap`, `lane-00001.mcap` and so on, each a log of
                whole episodes; `mcaprl.open` reads their folder as one.
            step_duration_s: simulated seconds between two observations; default: as `RecordMcap`.
            start_time_ns: log_time of the first record, since the Unix epoch; default: now.

        Raises:
            SpaceError: a log cannot hold the environments' spaces.
            UsageError: the times would not rise, or the autoreset mode is not known.
            OutputExistsError, LogError: the file cannot be created, or appended to.
        """
        if not isinstance(env, gym.vector.VectorEnv):
            raise UsageError(
                "RecordVecMcap wraps vector environments; RecordMcap wraps single ones"
            )
        super().__init__(env)
        self._autoreset = _autoreset_mode(env)
        self.policy, self.epsilon, self.policy_version = policy, epsilon, policy_version
        self.behavior_probs: Any = math.nan
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
        log, count = self._recording.log, self.num_envs
        self._display = Display(log, None, scene=False, camera=False)
        self._columns = OpenSteps(log.step_rows(), count, log.write_steps)
        self._images = {
            leaf: OpenRows(
                log.add_image_topic(leaf.topic, leaf.shape, leaf.encoding or ""),
                count,
                log.write_images,
            )
            for leaf in log.image_leaves
        }
        self._learner: OpenRows | None = None
        if policy_version is not None:
            self._learner = OpenRows(log.learner_rows(), count, log.write_steps)
        self._take_spaces()
        self._every = np.arange(count)
        self._open = [OpenEpisode("", math.nan) for _ in range(count)]
        # Transitions of each environment's open episode, and whether it has one.
        self._steps = np.zeros(count, np.int64)
        self._running = np.zeros(count, np.bool_)
        # Which environments reset themselves in the next step.
        self._due = np.zeros(count, np.bool_)
        self._full_at = 0

    @property
    def episodes(self) -> int:
        """Finished episodes of the log, with those that it had before it was appended to."""
        return self._recording.episodes

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Reset all environments, or those of `options["reset_mask"]`, and begin their episodes.

        Args:
            seed: of the first one, the others count up from it; or a list with one for each.
            options: as the environments take them.

        Raises:
            SpaceError: an observation does not fit its space.
            UsageError: the recording is closed, or a seed does not fit 63 bits.
        """
        count = self.num_envs
        seeds = [seed + k for k in range(count)] if isinstance(seed, int) else seed
        seeds = [None] * count if seeds is None else list(seeds)
        self._recording.check_can_begin(seeds)
        # Kept now: environments take the mask out of the options.
        told = {key: value for key, value in (options or {}).items() if key != "reset_mask"}
        numbers = np.flatnonzero((options or {}).get("reset_mask", np.ones(count, np.bool_)))
        self._interrupt(numbers)
        observations, infos = self.env.reset(seed=seed, options=options)
        values = [convert(observations) for convert in self._converters]
        with HoldSignals():
            for number in numbers.tolist():
                episode = OpenEpisode(self.policy, self.epsilon, seeds[number], told or None)
                self._begin(number, values, episode)
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments and log the transitions.

        The action of an environment that resets itself in this step is not taken, nor logged.

        Raises:
            ResetNeeded: an environment has no open episode.
            SpaceError: the actions do not fit their space, and are not taken; or an observation
                does not fit. As after any error behind the actions, all episodes are over then, and
                kept up to the transition before.
        """
        if not (self._running | self._due).all():
            idle = np.flatnonzero(~(self._running | self._due)).tolist()
            raise gym.error.ResetNeeded(
                f"call reset() before step(): environments {idle} have no open episode"
            )
        self._act(actions)
        try:
            observations, rewards, terminated, truncated, infos = self.env.step(actions)
            self._columns.put("reward", self._every, self._steps, np.asarray(rewards, np.float64))
            values = [convert(observations) for convert in self._converters]
            ended = self._running & np.logical_or(terminated, truncated)
            if ended.any() or self._due.any() or self._steps.max() + 1 >= self._full_at:
                # Nothing may come between the writes, nor between them and what counts the steps.
                with HoldSignals():
                    self._make_room()
                    self._observe(values)
                    self._begin_due(values)
                    self._end_some(np.flatnonzero(ended), values, terminated, truncated, infos)
            else:
                self._observe(values)
        except BaseException:
            # The environments may be a step ahead of the log: nothing may be joined to it.
            self._interrupt(self._every)
            raise
        return observations, rewards, terminated, truncated, infos

    def close(self, **kwargs: Any) -> None:
        """Finish the log and close the environments. Closing twice is harmless."""
        try:
            with HoldSignals():
                if not self._recording.closed:
                    self._interrupt(self._every)
                    self._recording.close()
        finally:
            super().close(**kwargs)

    def _take_spaces(self) -> None:
        """Prepare how values are taken out of observations and actions, and where they go."""
        leaves = observation_leaves(self.single_observation_space)
        self._places = [
            (self._images[leaf], "data") if leaf in self._images else (self._columns, leaf.name)
            for leaf in leaves
        ]
        self._converters = converters(self.observation_space)
        self._converters_of_one = converters(self.single_observation_space)
        self._action_leaf = action_leaf(self.action_space)

    def _act(self, actions: Any) -> None:
        """Put the actions, before the environments can change them."""
        every, steps = self._every, self._steps
        probs = np.asarray(self.behavior_probs, np.float32)
        if probs.shape not in ((), steps.shape):
            raise SpaceError(f"behavior_probs has shape {probs.shape}, expected {steps.shape}")
        self._columns.put("action", every, steps, as_declared(actions, self._action_leaf))
        self._columns.put("behavior_prob", every, steps, probs)
        self.behavior_probs = math.nan
        if self._learner is not None:
            version = -1 if self.policy_version is None else self.policy_version
            self._learner.put("epsilon", every, steps, self.epsilon)
            self._learner.put("policy_version", every, steps, version)

    def _make_room(self) -> None:
        tables = [self._columns, *self._images.values()]
        tables += [self._learner] if self._learner else []
        for table in tables:
            table.make_room(int(self._steps.max()) + 1)
        self._full_at = min(table.capacity for table in tables)

    def _observe(self, values: list[NDArray[Any]]) -> None:
        """Put each environment's observation; from here on the transition to it counts."""
        self._put(self._every, self._steps + self._running, values)
        self._steps += self._running

    def _put(self, environments: Any, steps: Any, values: list[NDArray[Any]]) -> None:
        for (table, field), value in zip(self._places, values, strict=True):
            table.put(field, environments, steps, value)

    def _begin_due(self, values: list[NDArray[Any]]) -> None:
        for number in np.flatnonzero(self._due).tolist():
            self._begin(number, values, OpenEpisode(self.policy, self.epsilon))

    def _begin(self, number: int, values: list[NDArray[Any]], episode: OpenEpisode) -> None:
        """Begin an episode of one environment with its row of the observations."""
        self._put(number, 0, [value[number] for value in values])
        self._open[number], self._steps[number] = episode, 0
        self._running[number], self._due[number] = True, False

    def _end_some(
        self,
        numbers: NDArray[np.int64],
        values: list[NDArray[Any]],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
        infos: dict[str, Any],
    ) -> None:
        """End episodes, in the order of their environments, and begin those that follow at once."""
        same_step = self._autoreset is AutoresetMode.SAME_STEP
        told = infos.get("final_info", {}) if same_step else infos
        for number in numbers.tolist():
            if same_step:
                self._put(number, int(self._steps[number]), self._final_observation(infos, number))
            is_terminal = bool(terminated[number])
            reason = reason_of(_of_env(told, "reason", number), is_terminal)
            self._end(number, is_terminal, bool(truncated[number]), reason)
            self._due[number] = self._autoreset is AutoresetMode.NEXT_STEP
            if same_step:
                self._begin(number, values, OpenEpisode(self.policy, self.epsilon))

    def _final_observation(self, infos: dict[str, Any], number: int) -> list[NDArray[Any]]:
        """Where an episode ended; the observation that was returned is the next one's first."""
        final = _of_env(infos, "final_obs", number)
        if final is None:
            raise SpaceError(
                f"environment {number} was reset in its episode's last step, but infos['final_obs']"
                " does not tell where the episode ended"
            )
        return [convert(final) for convert in self._converters_of_one]

    def _interrupt(self, numbers: NDArray[np.int64]) -> None:
        """Keep episodes that are broken off; one without a transition leaves no trace."""
        with HoldSignals():
            for number in numbers.tolist():
                if self._running[number] and self._steps[number] and not self._recording.closed:
                    self._end(number, False, True, INTERRUPTED)
            self._running[numbers] = self._due[numbers] = False
            self._steps[numbers] = 0
            self._display.clear()

    def _end(self, number: int, terminated: bool, truncated: bool, reason: str) -> None:
        """Write an episode as if it had been recorded alone, behind the last one."""
        recording, episode, fields = self._recording, self._open[number], self._columns.fields
        steps = episode.steps = int(self._steps[number])
        # Whatever goes wrong now, this episode is not written a second time.
        self._running[number], self._steps[number] = False, 0
        summary = recording.summary(
            episode,
            total_reward=add_up(fields["reward"][number, :steps]),
            terminated=terminated,
            truncated=truncated,
            reason=reason,
        )
        start_ns, step_ns = summary.start_time_ns, recording.step_ns
        recording.begin(self._display)
        for table in self._images.values():
            table.write(number, steps + 1, start_ns, step_ns)
        self._display.end(steps)
        recording.log.write_episodes([summary], log_lines=True)
        if self._learner is not None:
            self._learner.write(number, steps, start_ns, step_ns)
        self._columns.end(number, summary, step_ns)
        recording.advance(summary)


# The public path, for reprs and pickles.
RecordVecMcap.__module__ = "mcaprl"


def _autoreset_mode(env: gym.vector.VectorEnv[Any, Any, Any]) -> AutoresetMode:
    told = env.metadata.get("autoreset_mode")
    try:
        return AutoresetMode(told)
    except ValueError:
        known = ", ".join(mode.value for mode in AutoresetMode)
        raise UsageError(
            f"{env} does not say how it resets: its metadata['autoreset_mode'] is {told!r};"
            f" known are {known}"
        ) from None


def _of_env(infos: dict[str, Any], key: str, number: int) -> Any:
    """What one environment has told; None if it has not."""
    found = infos.get(key)
    return found[number] if isinstance(found, np.ndarray | list | tuple) else None

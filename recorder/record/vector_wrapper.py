"""A Gymnasium wrapper that records a vector environment episode by episode.

The rows of an open episode stay in memory. When the episode ends, they are appended to the file.
The file has the same form as a recording of a single environment, and simulated time increases from
episode to episode. If the process is killed, the open episode of each environment is lost.

No scene is recorded. To get a scene, replay the seeds and actions in a single environment.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mcaprl.errors import SpaceError
from mcaprl.recorder.format.behavior import behavior_field
from mcaprl.recorder.format.log_writer import InfoTopics
from mcaprl.recorder.format.messages import INTERRUPTED, EpisodeSummary
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.schema import TopicRows
from mcaprl.recorder.format.spaces import action_leaf
from mcaprl.recorder.format.writing import HoldSignals
from mcaprl.recorder.record.display import Display
from mcaprl.recorder.record.recordable import (
    EpisodeInfos,
    as_array,
    as_arrays,
    autoreset_mode,
    check_vector,
    final_info,
    final_observation,
    info_of,
    info_reason,
    one_each,
    recorded_space,
)
from mcaprl.recorder.record.session import EpisodeLog, FinishesAtExit, OpenEpisode, reason_of
from mcaprl.recorder.record.step_rows import OpenRows, OpenSteps, converter, converters

if TYPE_CHECKING:
    VectorWrapper = gym.vector.VectorWrapper[Any, Any, Any, Any, Any]
else:
    # This class is generic only since version 1.4 of Gymnasium.
    VectorWrapper = gym.vector.VectorWrapper


class _Ended(NamedTuple):
    """An environment whose episode has ended, and how."""

    number: int
    terminated: bool
    truncated: bool
    reason: str


class _Now(NamedTuple):
    """State of the open episodes."""

    # Row of the latest observations in the buffers. The next step sets its actions and rewards.
    row: int
    returns: NDArray[np.float64]  # (N,) sum of the rewards so far, added from the first to the last


class RecordVecMcap(FinishesAtExit, VectorWrapper):
    """A wrapper that records every transition of a vector environment to an MCAP file.

    An episode is on disk when the `step` that ends it returns, in every autoreset mode. An episode
    interrupted by `reset`, `close` or an error is recorded as truncated, with the reason
    `interrupted`. Make this wrapper the outermost one: the effects of wrappers around it are not
    recorded. Without a call of `close`, the log is finished when the wrapper is deleted or Python
    exits.

    Attributes:
        policy: Name of the policy, for `/rl/episode`; may be changed at any time. Each episode
            records the name that is set when the episode begins.
        epsilon: Exploration rate of the policy; NaN if unknown. May be changed at any time.
        policy_version: Number of updates of the policy so far. If passed to the constructor,
            `/rl/learner` records `policy_version` and `epsilon` at each `step`.
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
        infos: bool | Sequence[str] = False,
        keys: Sequence[str] | None = None,
        step_duration_s: float | None = None,
        start_time_ns: int | None = None,
    ) -> None:
        """Wrap `env` and create the file; for the other arguments, see `RecordMcap`.

        `env` must have spaces that `RecordMcap` supports and declare its autoreset mode. It may
        return arrays of NumPy, PyTorch, JAX and others; `step` and `reset` return them unchanged.
        The observations of episodes that end in same-step mode are read from `infos["final_obs"]`
        or `infos["final_observation"]`: one item for each environment, or a Dict of such arrays. If
        `policy_version` is None, the log has no `/rl/learner`. Episodes that end in the same step
        share chunks. With `max_file_bytes`, episodes that end in the same step are in the same file
        as long as their uncompressed rows have at most this size.

        Raises:
            SpaceError: The log format does not support the environments' spaces.
            UnknownNameError: The observation has no such key.
            UsageError: Timestamps would not increase, the autoreset mode is unknown, or `env` is
                not a vector environment of Gymnasium.
            OutputExistsError, LogError: The file cannot be created or appended to.
        """
        check_vector(env)
        recorded = recorded_space(env.single_observation_space, keys)
        action_leaf(env.single_action_space)
        super().__init__(env)
        self._autoreset = autoreset_mode(env)
        self.policy, self.epsilon, self.policy_version = policy, epsilon, policy_version
        self._behavior: Any = math.nan
        self._field = behavior_field(env.single_action_space)
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
        log, count = self._recording.log, self.num_envs
        self._display = Display(log, None, scene=False, camera=False)
        fields = [leaf.name for leaf in recorded.leaves if not leaf.encoding]
        self._columns = OpenSteps(
            log.step_rows(), count, ["action", "reward", self._field.name, *fields]
        )
        self._images = {
            leaf: OpenRows(log.image_rows(leaf.topic, leaf.shape, leaf.encoding), count, ["data"])
            for leaf in log.image_leaves
        }
        self._learner: OpenRows[TopicRows] | None = None
        if policy_version is not None:
            self._learner = OpenRows(log.learner_rows(), count, ["epsilon", "policy_version"])
        topics = InfoTopics(log)
        wanted, self._recorded = recorded.infos(infos), recorded
        self._infos = [EpisodeInfos(topics, wanted) for _ in range(count)] if wanted else []
        self._places = [
            (self._images[leaf], "data") if leaf in self._images else (self._columns, leaf.name)
            for leaf in recorded.leaves
        ]
        self._converters = converters(recorded, count)
        self._converters_of_one = converters(recorded)
        self._action_of = converter(action_leaf(self.action_space))
        self._every = np.arange(count)
        self._open = [OpenEpisode("", math.nan) for _ in range(count)]
        self._now = _Now(0, np.zeros(count))
        # For each environment: row of the first observation of its open episode, and whether an
        # episode is open.
        self._first = np.zeros(count, np.int64)
        self._running = np.zeros(count, np.bool_)
        # For each environment: whether it resets itself in the next step.
        self._due = np.zeros(count, np.bool_)
        # Whether every environment can make a step, and whether any resets itself in the next step.
        self._ready = self._any_due = False
        # First row for which the buffers may have to grow.
        self._full_at = 0
        self._watch()

    @property
    def episodes(self) -> int:
        """Number of finished episodes in the log, including episodes of earlier recordings."""
        return self._recording.episodes

    @property
    def behavior_probs(self) -> Any:
        """(N,) probabilities of the next actions under the behavior policy.

        Set them before each `step`, which resets them to NaN (unknown). Actions of floats have
        densities instead: set `behavior_log_probs`.
        """
        return self._field.probs(self._behavior)

    @behavior_probs.setter
    def behavior_probs(self, probs: Any) -> None:
        self._behavior = self._field.probs(probs)

    @property
    def behavior_log_probs(self) -> Any:
        """(N,) natural logarithms of the probabilities of the next actions, or of their densities.

        For actions of floats they are densities in the action's own units. Set them as
        `behavior_probs`.
        """
        return self._field.log_probs(as_array(self._behavior))

    @behavior_log_probs.setter
    def behavior_log_probs(self, log_probs: Any) -> None:
        self._behavior = self._field.from_log_probs(as_array(log_probs))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Reset environments and begin their episodes.

        The option `reset_mask` selects the environments; by default, all environments are reset.

        Args:
            seed: Seed of the first environment (environment k uses seed + k), or a list of seeds.
            options: Options of the environments.

        Raises:
            SpaceError: An observation does not fit its space.
            UsageError: The recording is closed, or a seed is too large.
        """
        count = self.num_envs
        seeds = [seed + k for k in range(count)] if isinstance(seed, int) else seed
        seeds = [None] * count if seeds is None else list(seeds)
        self._recording.check_can_begin(seeds)
        # The options are read before the reset, because environments remove the mask from them.
        given = {key: value for key, value in (options or {}).items() if key != "reset_mask"}
        mask = (options or {}).get("reset_mask", np.ones(count, np.bool_))
        numbers = np.flatnonzero(as_array(mask))
        self._interrupt(numbers)
        observations, infos = self.env.reset(seed=seed, options=options)
        values = [convert(observations) for convert in self._converters]
        with HoldSignals():
            self._put(self._now.row, [value[numbers] for value in values], numbers)
            self._begin(numbers, infos, observations)
            for number in numbers.tolist():
                self._open[number].seed, self._open[number].options = seeds[number], given or None
            self._update_flags()
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments and log the transitions.

        The action of an environment that resets itself in this step is neither taken nor logged.
        An error in an environment or in its results ends all episodes, which are recorded up to the
        previous transition.

        Raises:
            ResetNeeded: An environment has no open episode.
            UsageError: One of `behavior_probs` is not in (0, 1], or one of `behavior_log_probs` is
                not finite; the environments are not stepped.
            SpaceError: The actions do not fit their space (the environments are not stepped), or an
                observation does not fit its space.
        """
        if not self._ready:
            idle = np.flatnonzero(~(self._running | self._due)).tolist()
            raise gym.error.ResetNeeded(
                f"call reset() before step(): environments {idle} have no open episode"
            )
        self._act(actions)
        try:
            transition = self.env.step(actions)
            observations, rewards, terminated, truncated, infos = transition
            if not (type(rewards) is type(terminated) is type(truncated) is np.ndarray):
                rewards, terminated, truncated = map(as_array, (rewards, terminated, truncated))
            rewards_64 = one_each("reward", rewards, self.num_envs).astype(np.float64, copy=False)
            self._columns.put("reward", self._now.row, rewards_64)
            values = [convert(observations) for convert in self._converters]
            over = one_each("end flag", np.logical_or(terminated, truncated), self.num_envs)
            ended = self._running & over
            if self._infos:
                infos = as_arrays(infos)
                self._add_infos(infos, observations, ended)
            any_ended = np.count_nonzero(ended)
            if any_ended or self._any_due or self._now.row + 1 >= self._full_at:
                # A signal must not interrupt the writes and the update of the row.
                with HoldSignals():
                    self._make_room()
                    self._observe(values, rewards_64)
                    if self._any_due:
                        self._begin(np.flatnonzero(self._due), infos, observations)
                    if any_ended:
                        flags = terminated, truncated
                        self._end_some(np.flatnonzero(ended), observations, values, flags, infos)
                    self._update_flags()
            else:
                self._observe(values, rewards_64)
        except BaseException:
            # The environments may have made a step that the log lacks, so all episodes end here.
            self._interrupt(self._every)
            raise
        return transition

    def close(self, **kwargs: Any) -> None:
        """Finish the log and close the environments; a second call has no effect."""
        try:
            self._finish()
        finally:
            super().close(**kwargs)

    def _finish(self) -> None:
        with HoldSignals():
            if not self._recording.closed:
                self._interrupt(self._every)
                self._recording.close()

    def _act(self, actions: Any) -> None:
        """Store the actions before the environments can change them."""
        row = self._now.row
        # The checks take longer than storing the values, and most recordings have no probabilities.
        behavior = self._checked_behavior() if self._behavior is not math.nan else math.nan
        self._columns.put("action", row, self._action_of(actions))
        self._columns.put(self._field.name, row, behavior)
        self._behavior = math.nan
        if self._learner is not None:
            version = -1 if self.policy_version is None else self.policy_version
            self._learner.put("epsilon", row, self.epsilon)
            self._learner.put("policy_version", row, version)

    def _checked_behavior(self) -> NDArray[np.float32]:
        """Return the probabilities or log densities as an array, () or (N,)."""
        given, shape, field = as_array(self._behavior), (self.num_envs,), self._field
        with np.errstate(over="ignore"):
            values = given.astype(np.float32)
        if values.shape not in ((), shape):
            raise SpaceError(f"{field.plural} has shape {values.shape}, expected {shape}")
        # An environment that is reset in this step ignores its action, so the value is not checked.
        for number in np.flatnonzero(field.is_impossible(values) & self._running):
            value = float(np.broadcast_to(given, shape)[number])
            field.check(value, f"{field.plural}[{number}]")
        return values

    def _tables(self) -> list[OpenRows[Any]]:
        learner = [self._learner] if self._learner is not None else []
        return [self._columns, *self._images.values(), *learner]

    def _make_room(self) -> None:
        """Grow the buffers that the next row does not fit into."""
        row = self._now.row
        first = int(self._first[self._running].min(initial=row))
        for table in self._tables():
            if row + 2 - first > table.capacity:
                table.make_room(row + 2 - first, row)
        self._full_at = first + min(table.capacity for table in self._tables())

    def _observe(self, values: list[NDArray[Any]], rewards: NDArray[np.float64]) -> None:
        """Store each environment's observation in the next row, which becomes the current one."""
        row = self._now.row + 1
        self._put(row, values)
        with np.errstate(all="ignore"):
            returns = self._now.returns + rewards
        # One assignment, because signals are not delayed in most steps.
        self._now = _Now(row, returns)

    def _put(self, row: int, values: list[NDArray[Any]], environments: Any = ...) -> None:
        for (table, field), value in zip(self._places, values, strict=True):
            table.put(field, row, value, environments)

    def _add_infos(
        self, infos: dict[str, Any], observations: Any, ended: NDArray[np.bool_]
    ) -> None:
        """Store the infos of the environments that made a step."""
        same_step = self._autoreset is AutoresetMode.SAME_STEP
        for number in np.flatnonzero(self._running).tolist():
            is_final = same_step and ended[number]
            source = final_info(infos) if is_final else infos
            step = self._now.row + 1 - int(self._first[number])
            info = info_of(source, number, self.num_envs)
            if is_final and self._recorded.texts:
                info = self._recorded.info(info, self._final(infos, number))
            else:
                info = self._recorded.info(info, observations, number)
            self._infos[number].add(step, info)

    def _begin(self, numbers: NDArray[np.int64], infos: dict[str, Any], observations: Any) -> None:
        """Begin an episode of each of these environments, whose first observations are stored."""
        for number in numbers.tolist():
            self._open[number] = OpenEpisode(self.policy, self.epsilon)
            if self._infos:
                info = info_of(infos, number, self.num_envs)
                self._infos[number].begin(self._recorded.info(info, observations, number))
        self._first[numbers], self._now.returns[numbers] = self._now.row, 0.0
        self._running[numbers], self._due[numbers] = True, False

    def _end_some(
        self,
        numbers: NDArray[np.int64],
        observations: Any,
        values: list[NDArray[Any]],
        flags: tuple[NDArray[np.bool_], NDArray[np.bool_]],
        infos: dict[str, Any],
    ) -> None:
        """End these environments' episodes, and in same-step mode begin their next ones."""
        terminated, truncated = flags
        same_step = self._autoreset is AutoresetMode.SAME_STEP
        infos_of_ended = final_info(infos) if same_step else infos
        ended: list[_Ended] = []
        try:
            for number in numbers.tolist():
                if same_step:
                    final = self._final(infos, number)
                    values_of_one = [convert(final) for convert in self._converters_of_one]
                    self._put(self._now.row, values_of_one, number)
                is_terminal = bool(terminated[number])
                reason = reason_of(info_reason(infos_of_ended, number), is_terminal)
                ended.append(_Ended(number, is_terminal, bool(truncated[number]), reason))
        finally:
            self._end(ended)
        if same_step:
            self._put(self._now.row, [value[numbers] for value in values], numbers)
            self._begin(numbers, infos, observations)
        self._due[numbers] = self._autoreset is AutoresetMode.NEXT_STEP

    def _final(self, infos: dict[str, Any], number: int) -> Any:
        """Return an episode's last observation from the infos of same-step mode."""
        space = self.single_observation_space
        final = final_observation(infos, number, self.num_envs, space)
        if final is None:
            raise SpaceError(
                f"environment {number} was reset in its episode's last step, but infos['final_obs']"
                " does not contain the episode's last observation"
            )
        return final

    def _update_flags(self) -> None:
        """Update the flags that the next step checks; call this after episodes began or ended."""
        self._ready = bool((self._running | self._due).all())
        self._any_due = bool(self._due.any())

    def _interrupt(self, numbers: NDArray[np.int64]) -> None:
        """Record unfinished episodes as truncated, and drop episodes without a transition."""
        with HoldSignals():
            try:
                if not self._recording.closed:
                    has_steps = self._first[numbers] < self._now.row
                    unfinished = numbers[self._running[numbers] & has_steps].tolist()
                    self._end([_Ended(each, False, True, INTERRUPTED) for each in unfinished])
            finally:
                self._running[numbers] = self._due[numbers] = False
                self._update_flags()
                self._display.clear()

    def _end(self, ended: list[_Ended]) -> None:
        """Append ended episodes to the log."""
        for group in self._groups(ended):
            self._write(group)
        if self._infos:
            self._infos[0].warn()

    def _groups(self, ended: list[_Ended]) -> Iterator[list[_Ended]]:
        """Group the episodes that are written to the same file."""
        limit = self._recording.max_file_bytes
        most = math.inf if limit is None else limit
        row_bytes = sum(table.row_bytes for table in self._tables())
        group: list[_Ended] = []
        size = 0
        for one in ended:
            added = row_bytes * (self._now.row + 1 - int(self._first[one.number]))
            if group and size + added > most:
                yield group
                group, size = [], 0
            group.append(one)
            size += added
        if group:
            yield group

    def _write(self, ended: list[_Ended]) -> None:
        """Write ended episodes, one after the other, with the chunks of `/rl/step` last."""
        recording, step_ns = self._recording, self._recording.step_ns
        numbers = [one.number for one in ended]
        firsts: list[int] = self._first[numbers].tolist()
        lengths = [self._now.row - first for first in firsts]
        returns = (self._now.returns[numbers] + 0.0).tolist()
        # Set this before writing, so that an error does not cause a second write of the episodes.
        self._running[numbers] = False
        recording.begin(self._display)
        summaries: list[EpisodeSummary] = []
        for one, length, total in zip(ended, lengths, returns, strict=True):
            episode = self._open[one.number]
            episode.steps = length
            summary = recording.summary(
                episode,
                total_reward=total,
                terminated=one.terminated,
                truncated=one.truncated,
                reason=one.reason,
                after=summaries[-1] if summaries else None,
            )
            summaries.append(summary)
        starts = np.array([summary.start_time_ns for summary in summaries])
        for table in self._images.values():
            table.write(numbers, firsts, [length + 1 for length in lengths], starts, step_ns)
        if self._infos:
            for number, summary in zip(numbers, summaries, strict=True):
                self._infos[number].end(summary.length, summary.start_time_ns, step_ns)
        recording.log.write_episodes(summaries, log_lines=True)
        if self._learner is not None:
            self._learner.write(numbers, firsts, lengths, starts, step_ns)
        self._columns.end(numbers, firsts, summaries, step_ns)
        recording.advance(summaries[-1])


# Reprs and pickles contain this public import path.
RecordVecMcap.__module__ = "mcaprl"

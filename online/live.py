"""Live view of training: episodes of one environment, and the learner's values for them.

The view skips some episodes, but training runs all of them. The results of training are
bit-identical with and without viewers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.frames import rows_of
from mcaprl.offline.estimate.values import command_columns
from mcaprl.online.task import Task, check_spaces
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.record.session import reason_of
from mcaprl.recorder.record.vector_wrapper import VectorWrapper
from mcaprl.recorder.viewer.foxglove_server import DEFAULT_PORT
from mcaprl.recorder.viewer.live_stream import DEFAULT_SPEED, LiveStep, LiveStream, Pace
from mcaprl.sims import make_sim
from mcaprl.sims.vehicle.batched import BatchedEnv
from mcaprl.sims.vehicle.env import VehicleEnv

TRAINING_LABELS = {
    "mean_return": "mean return of the last 100 episodes",
    "score": "score of the last evaluation",
    "loss": "loss of the last update",
    "epsilon": "epsilon, probability of a random action",
    "mean_q": "mean Q-value of the last batch",
    "learning_rate": "learning rate",
    "steps": "steps of all environments",
    "updates": "updates of the network",
}
"""Labels of the metrics in `/rl/training`, by name, the most important first."""
"""Names of the metrics in `/rl/training`."""
WATCHED = 0  # Index of the environment in the live view


class Shown(Protocol):
    """What the live view shows of an agent, at the step that it is about to take."""

    @property
    def epsilon(self) -> float:
        """Probability of a random action; NaN if the policy is stochastic."""

    @property
    def updates(self) -> int:
        """Number of updates of the network."""

    def probability(self) -> float:
        """Return the probability of the action of the watched environment."""

    def values(self, taken: NDArray[Any]) -> dict[str, Any]:
        """Return the fields of `values_schema` for the action of the watched environment."""

    def metrics(self) -> dict[str, float]:
        """Return the metrics of `TRAINING_LABELS` without the score."""


class LiveTraining:
    """Live view of a training run; it shows the seeds one after another."""

    def __init__(
        self,
        task: Task,
        *,
        port: int = DEFAULT_PORT,
        origins: Sequence[str] = (),
        speed: float = DEFAULT_SPEED,
        pace: Pace | None = None,
    ) -> None:
        """Listen for viewers at a port of 127.0.0.1, 0 for a free one."""
        self._task = task
        self._shown = env = make_sim(task.sim, **task.sim_options)
        try:
            check_spaces(task.algo, env.observation_space, env.action_space)
            env.reset(seed=0)
            self.stream = LiveStream(
                LogMetadata.of_env(self._shown, policy=task.algo),
                self._shown.unwrapped,
                TRAINING_LABELS,
                name=f"{task.algo} in {task.sim}",
                port=port,
                origins=origins,
                speed=speed,
                pace=pace,
            )
        except BaseException:
            self._shown.close()
            raise

    def watch(self, env: VectorEnv[Any, Any, Any]) -> WatchedBatch:
        """Wrap a batch of the task's environments to show one of them."""
        return WatchedBatch(env, self.stream, self._task.algo, self._source_of(env.unwrapped))

    def close(self) -> None:
        """Disconnect all viewers."""
        with closing(self._shown):
            self.stream.close()

    def _source_of(self, batch: Any) -> Callable[[object], object]:
        """Return a function from the last action (None: a reset) to the shown object or None."""
        single = self._shown.unwrapped
        if isinstance(batch, BatchedEnv) and isinstance(single, VehicleEnv):

            def imitate(action: object) -> object:
                single.imitate(batch.fleet, WATCHED, action)
                return single

            return imitate
        if isinstance(batch, SyncVectorEnv):
            return lambda action: batch.envs[WATCHED].unwrapped
        return lambda action: None


class WatchedBatch(VectorWrapper):
    """Wrapper of a batch of environments that shows the first one in the live view."""

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        stream: LiveStream,
        algo: str,
        source: Callable[[object], object],
    ) -> None:
        """Wrap `env`; `source` maps its last action, None after a reset, to the scene's object."""
        super().__init__(env)
        # Agent that trains in these environments; nothing is shown before it is set.
        self.shown: Shown | None = None
        self.score = math.nan  # Score of the last evaluation; NaN before the first one
        self._stream, self._algo, self._source = stream, algo, source
        self._observations: Any = None
        self._last_action: NDArray[Any] | None = None
        self._episode = -1
        self._begin_episode()

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Reset all environments. If viewers watch one of them, they see its new episode."""
        self._observations, infos = self.env.reset(seed=seed, options=options)
        self._begin_episode()
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments; show the watched transition if its episode is shown."""
        stream, shown = self._stream, self.shown
        if shown is not None:
            if self._step == 0:
                self._is_shown = stream.begin_episode(self._episode, self._algo)
            if stream.wants_metrics():
                stream.show_metrics({**shown.metrics(), "score": self.score})
        before = self._before_step(actions) if self._is_shown else {}
        result = self.env.step(actions)
        observations, rewards, terminated, truncated, infos = result
        ends = bool(terminated[WATCHED]), bool(truncated[WATCHED])
        if self._is_shown:
            step = LiveStep(
                episode=self._episode,
                step=self._step,
                reward=float(rewards[WATCHED]),
                terminated=ends[0],
                truncated=ends[1],
                **before,
            )
            self._is_shown = stream.show(step)
        self._observations, self._last_action = observations, np.copy(actions[WATCHED])
        self._step += 1
        self._return_so_far += float(rewards[WATCHED])
        if any(ends):
            if self._is_shown:
                self._show_end(*ends, infos)
            self._begin_episode()
        return result

    def _begin_episode(self) -> None:
        self._episode, self._step, self._return_so_far = self._episode + 1, 0, 0.0
        self._last_action = None
        self._is_shown = False

    def _before_step(self, actions: Any) -> dict[str, Any]:
        """Return the fields of a `LiveStep` that are known before the step."""
        shown = self.shown
        assert shown is not None
        is_shown = self._stream.look(self._source(self._last_action), self._return_so_far)
        values = shown.values(actions[WATCHED]) if is_shown else {}
        probability = shown.probability()
        self._stream.pause()
        return {
            "observation": rows_of(self._observations, WATCHED),
            "action": actions[WATCHED],
            "behavior": probability,
            "epsilon": shown.epsilon,
            "policy_version": shown.updates,
            "values": values,
        }

    def _show_end(self, terminated: bool, truncated: bool, infos: dict[str, Any]) -> None:
        reasons = infos.get("final_info", {}).get("reason")
        summary = EpisodeSummary(
            episode=self._episode,
            length=self._step,
            total_reward=self._return_so_far,
            terminated=terminated,
            truncated=truncated,
            # `LiveStream.end_episode` sets the start and end times.
            start_time_ns=0,
            end_time_ns=0,
            reason=reason_of(None if reasons is None else reasons[WATCHED], terminated),
            policy=self._algo,
            epsilon=math.nan if self.shown is None else self.shown.epsilon,
        )
        self._stream.end_episode(summary)


def numbered_values(q: Tensor, preference: Tensor, value: float, taken: int) -> dict[str, Any]:
    """Return the fields of `values_schema` for one of A actions."""
    best = int(preference.argmax())
    entropy = torch.special.entr(preference).sum() / math.log(max(len(preference), 2))
    return {
        "q": q.cpu().numpy(),
        "preference": preference.cpu().numpy(),
        "value": value,
        "advantage": float(q[taken]) - value,
        "td_error": math.nan,
        "entropy": float(entropy),
        "policy_action": best,
        "agrees": best == taken,
    }


def command_values(
    command: NDArray[Any],
    taken: NDArray[Any],
    space: spaces.Space[Any],
    *,
    log_prob: float,
    q: float = math.nan,
    value: float = math.nan,
) -> dict[str, Any]:
    """Return the fields of `values_schema` for one action of a Box."""
    columns = command_columns(command[None], taken[None], space)
    return {
        **{name: column[0] for name, column in columns.items()},
        **{"q": q, "value": value, "advantage": q - value, "log_prob": log_prob},
        "td_error": math.nan,
    }

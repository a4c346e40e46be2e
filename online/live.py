"""Shows training while it goes on: one of the environments, and what the learner makes of it.

Frames are dropped, never steps, and what is learnt is the same bits with and without viewers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy

from mcaprl.online.recording import behavior_probabilities, exploration
from mcaprl.online.task import Task
from mcaprl.recorder.format.episode_summary import EpisodeSummary
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.record.session import reason_of
from mcaprl.recorder.viewer.foxglove_server import DEFAULT_PORT
from mcaprl.recorder.viewer.live_stream import LiveStep, LiveStream, Pace
from mcaprl.sims import make_sim
from mcaprl.sims.vehicle.batched import BatchedEnv
from mcaprl.sims.vehicle.env import VehicleEnv
from mcaprl.sims.vehicle.fleet import Fleet

TRAINING_NAMES = (
    "loss",
    "epsilon",
    "mean_q",
    "mean_return",
    "score",
    "learning_rate",
    "steps",
    "updates",
)
"""The numbers in `/rl/training`."""
WATCHED = 0
"""Which of the environments is shown."""


class LiveTraining:
    """What a run shows, whichever of its seeds learns just now."""

    def __init__(self, task: Task, *, port: int = DEFAULT_PORT, pace: Pace | None = None) -> None:
        """Listen for viewers.

        Args:
            task: that is learnt.
            port: of 127.0.0.1; 0 takes any that is free.
            pace: when there is time for frames.

        Raises:
            MissingExtraError: foxglove-sdk is not installed.
            UsageError: the port is taken, or the environment cannot be made.
        """
        self._task = task
        self._shown = make_sim(task.sim, **task.sim_options)
        self._shown.reset(seed=0)
        try:
            self.stream = LiveStream(
                LogMetadata.of_env(self._shown, policy=task.algo),
                self._shown.unwrapped,
                TRAINING_NAMES,
                name=f"{task.algo} in {task.sim}",
                port=port,
                pace=pace,
            )
        except BaseException:
            self._shown.close()
            raise

    def watch(self, env: VectorEnv[Any, Any, Any]) -> WatchedBatch:
        """Wrap a batch of the task's environments, so that one of them is shown."""
        return WatchedBatch(env, self.stream, self._task.algo, self._source_of(env.unwrapped))

    def close(self) -> None:
        """Say goodbye to all viewers."""
        with closing(self._shown):
            self.stream.close()

    def _source_of(self, batch: Any) -> Callable[[], object]:
        """How to get an environment that describes what is to be seen of the watched one."""
        shown = self._shown.unwrapped
        if isinstance(batch, BatchedEnv) and isinstance(shown, VehicleEnv):
            mirror = _Mirror(batch.fleet, shown)
            return mirror.reflect
        if isinstance(batch, SyncVectorEnv):
            return lambda: batch.envs[WATCHED].unwrapped
        return lambda: None


class WatchedBatch(gym.vector.VectorWrapper[Any, Any, Any, Any, Any]):
    """A batch of environments that reset themselves at once; the first one is shown.

    Attributes:
        model: of SB3, in training in these environments; nothing is shown before it is set.
        score: of the last evaluation; NaN before.
        after_asking: called when the model's network was asked for what is shown.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        stream: LiveStream,
        algo: str,
        source: Callable[[], object],
    ) -> None:
        """Wrap `env`; `source` gives what describes the scene of the watched environment."""
        super().__init__(env)
        self.model: BaseAlgorithm | None = None
        self.score = math.nan
        self.after_asking: Callable[[], None] = lambda: None
        self._stream, self._algo, self._source = stream, algo, source
        self._observations: Any = None
        self._episode = -1
        self._loss = self._mean_q = math.nan
        self._begin_episode()

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Reset all; the watched environment begins an episode."""
        self._observations, infos = self.env.reset(seed=seed, options=options)
        self._begin_episode()
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all, and show the transition of one if there is time."""
        shown = self.model is not None and self._stream.due()
        before = self._look(actions) if shown else {}
        result = self.env.step(actions)
        observations, rewards, terminated, truncated, infos = result
        reward = float(rewards[WATCHED])
        is_over = bool(terminated[WATCHED] or truncated[WATCHED])
        if shown:
            step = LiveStep(
                episode=self._episode,
                step=self._step,
                reward=reward,
                terminated=bool(terminated[WATCHED]),
                truncated=bool(truncated[WATCHED]),
                **before,
            )
            self._stream.show(step)
        self._observations = observations
        self._step += 1
        self._return_so_far += reward
        if is_over:
            self._end_episode(bool(terminated[WATCHED]), bool(truncated[WATCHED]), infos)
            self._begin_episode()
        return result

    def _begin_episode(self) -> None:
        self._episode, self._step, self._return_so_far = self._episode + 1, 0, 0.0
        self._began_ns = time.time_ns()

    def _look(self, actions: NDArray[Any]) -> dict[str, Any]:
        """What is known before the step."""
        model = self.model
        assert model is not None
        self._stream.look(self._source(), self._return_so_far)
        values = _values(model, actions[WATCHED : WATCHED + 1])
        epsilon = exploration(model)
        probability = behavior_probabilities(model, actions)[WATCHED]
        self.after_asking()
        told = model.logger.name_to_value
        self._loss = told.get("train/loss", told.get("train/value_loss", self._loss))
        self._mean_q = told.get("train/mean_q", self._mean_q)
        returns = [episode["r"] for episode in model.ep_info_buffer or ()]
        training = {
            "loss": self._loss,
            "epsilon": epsilon,
            "mean_q": self._mean_q,
            "mean_return": float(np.mean(returns)) if returns else math.nan,
            "score": self.score,
            "learning_rate": model.policy.optimizer.param_groups[0]["lr"],
            "steps": model.num_timesteps,
            "updates": cast(Any, model)._n_updates,
        }
        return {
            "observation": _row(self._observations, WATCHED),
            "action": actions[WATCHED],
            "behavior_prob": float(probability),
            "epsilon": epsilon,
            "policy_version": cast(Any, model)._n_updates,
            "values": values,
            "training": training,
        }

    def _end_episode(self, terminated: bool, truncated: bool, infos: dict[str, Any]) -> None:
        reasons = infos.get("final_info", {}).get("reason")
        summary = EpisodeSummary(
            episode=self._episode,
            length=self._step,
            total_reward=self._return_so_far,
            terminated=terminated,
            truncated=truncated,
            start_time_ns=self._began_ns,
            end_time_ns=time.time_ns(),
            reason=reason_of(None if reasons is None else reasons[WATCHED], terminated),
            policy=self._algo,
            epsilon=math.nan if self.model is None else exploration(self.model),
        )
        self._stream.end_episode(summary)


class _Mirror:
    """A single vehicle that is made the same as one of a fleet, to be looked at."""

    def __init__(self, fleet: Fleet, single: VehicleEnv[Any, Any]) -> None:
        self._fleet, self._single = fleet, single

    def reflect(self) -> object:
        """Take over the state."""
        self._single.fleet.imitate(0, self._fleet, WATCHED)
        # Frames are far apart: there is no trail to draw.
        self._single._trail.clear()
        return self._single


def _values(model: BaseAlgorithm, action: NDArray[Any]) -> dict[str, Any]:
    """What the learner thinks of the watched environment: fields of `schema.values_schema`."""
    observation = _row(model._last_obs, slice(WATCHED, WATCHED + 1))
    tensor: Any = model.policy.obs_to_tensor(observation)[0]
    start = int(cast(spaces.Discrete, model.action_space).start)
    with torch.inference_mode():
        if isinstance(model, DQN):
            q = model.q_net(tensor)[0]
            preference, value = q.softmax(0), float(q.max())
        else:
            policy = cast(ActorCriticPolicy, model.policy)
            preference = cast(Any, policy.get_distribution(tensor).distribution).probs[0]
            q, value = torch.full_like(preference, torch.nan), float(policy.predict_values(tensor))
    best, taken = int(preference.argmax()), int(action[0]) - start
    entropy = torch.special.entr(preference).sum() / math.log(max(len(preference), 2))
    return {
        "q": q.cpu().numpy(),
        "preference": preference.cpu().numpy(),
        "value": value,
        "advantage": float(q[taken]) - value,
        "td_error": math.nan,
        "entropy": float(entropy),
        "policy_action": best + start,
        "agrees": best == taken,
    }


def _row(observations: Any, which: int | slice) -> Any:
    """One environment's part of observations."""
    if isinstance(observations, dict):
        return {key: part[which] for key, part in observations.items()}
    return observations[which]

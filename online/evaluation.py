"""Evaluation during training, in separate environments.

Scores are scaled so that random actions have the score 0 and the sim's pilot has the score 1.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import ConvertCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from mcaprl.frames import mapped, rows_of
from mcaprl.limits import STEP_LIMIT
from mcaprl.online.curves import CurvePoint
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.record.vector_wrapper import VectorWrapper
from mcaprl.sims.evaluation.evaluate import Scale, evaluate
from mcaprl.sims.evaluation.pilots import has_pilot, make_pilot

SELECTION_SEED: Final = 3_000_000
"""Seed of the episodes that select the best checkpoint and form the curve."""
FRESH_SEED: Final = 1_000_000
"""Seed of the episodes of the final score, and the default seed of `mcaprl evaluate`."""


def measure_scale(env: gym.Env[Any, Any], *, episodes: int, seed: int) -> Scale:
    """Return the mean returns of random actions and of the pilot, on the same episodes."""

    def mean_return(policy: Any) -> float:
        score = evaluate(env, [policy], name="", episodes=episodes, seed=seed)
        return score.mean_return

    pilot = mean_return(make_pilot(env)) if has_pilot(env) else math.nan
    return Scale(mean_return(None), pilot)


class Evaluation(EvalCallback):
    """SB3's EvalCallback, with the same episodes each time, so that checkpoints are comparable.

    All episodes run at the same time, one in each environment of a separate batch.
    """

    def __init__(
        self,
        env: VecEnv,
        *,
        interval: int,
        training_envs: int,
        scale: Scale,
        on_new_best: Callable[[], None],
        on_point: Callable[[CurvePoint], None],
    ) -> None:
        """Prepare the evaluations."""

        def new_best(*_: Any) -> bool:
            on_new_best()
            return True

        super().__init__(
            env,
            callback_on_new_best=ConvertCallback(new_best),
            n_eval_episodes=env.num_envs,
            eval_freq=max(interval // training_envs, 1),
            verbose=0,
            warn=False,
        )
        self._scale = scale
        self._on_point = on_point
        self._returns: list[float] = []
        self._lengths: list[int] = []
        self._progress_m: list[float] = []
        self._cuts = 0
        self._has_warned = False

    def resume(self, calls: int, best_mean_return: float) -> None:
        """Resume after `calls` steps of the training batch, with the best mean return so far."""
        self.n_calls, self.best_mean_reward = calls, best_mean_return

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq:
            return True
        self.eval_env.seed(SELECTION_SEED)
        self._returns, self._lengths, self._progress_m = [], [], []
        self._cuts = 0
        best_before = self.best_mean_reward
        going_on = super()._on_step()
        point = CurvePoint(
            step=self.num_timesteps,
            mean_return=self.last_mean_reward,
            score=self._scale.score(self.last_mean_reward),
            lowest_return=min(self._returns),
            highest_return=max(self._returns),
            mean_length=float(np.mean(self._lengths)),
            mean_progress_m=float(np.mean(self._progress_m)),
            best=self.best_mean_reward > best_before,
        )
        self._on_point(point)
        if self._cuts and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"{self._cuts} of {len(self._lengths)} episodes of the evaluation at step"
                f" {self.num_timesteps} reached the limit of {max(self._lengths)} steps and were"
                " truncated; set another limit with `max_steps=N`",
                stacklevel=2,
            )
        return going_on

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        """Store the result of an ended episode. SB3 calls this after each evaluation step."""
        super()._log_success_callback(locals_, globals_)
        if locals_["done"]:
            episode = locals_["info"]["episode"]
            self._returns.append(episode["r"])
            self._lengths.append(episode["l"])
            self._progress_m.append(locals_["info"].get("progress_m", math.nan))
            self._cuts += locals_["info"].get("reason") == STEP_LIMIT


class _Step(NamedTuple):
    """One step of the K environments whose first episode is unfinished."""

    environments: NDArray[np.int64]
    observations: Any
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    next_observations: Any


class FirstEpisodes(VectorWrapper):
    """Recorder of each environment's first episode since the last reset.

    Environments reset themselves in the step that ends an episode. Their later episodes are not
    recorded, because they would overrepresent short episodes.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], env_id: str) -> None:
        """Wrap `env`; `env_id` is stored in the log."""
        super().__init__(env)
        self._env_id = env_id
        self._open = np.ones(env.num_envs, dtype=np.bool_)
        self._steps: list[_Step] = []
        self._observations: Any = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Reset all environments and drop the recorded episodes."""
        self._observations, infos = self.env.reset(seed=seed, options=options)
        self._open[:] = True
        self._steps = []
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments; record each environment until its first episode ends."""
        result = self.env.step(actions)
        observations, rewards, terminated, truncated, infos = result
        numbers = np.flatnonzero(self._open)
        if len(numbers):
            following = rows_of(observations, numbers)
            ended = terminated[numbers] | truncated[numbers]
            for row in np.flatnonzero(ended).tolist():
                last = infos["final_obs"][numbers[row]]
                mapped(partial(_put, row), following, last)
            step = _Step(
                numbers,
                rows_of(self._observations, numbers),
                np.asarray(actions)[numbers],
                rewards[numbers],
                terminated[numbers],
                truncated[numbers],
                following,
            )
            self._steps.append(step)
            self._open[numbers[ended]] = False
        self._observations = observations
        return result

    def dataset(self) -> Dataset:
        """Return the episodes, ordered by environment.

        Behavior probabilities are 1, because the actions are greedy.
        """
        environments = np.concatenate([step.environments for step in self._steps])
        order = np.argsort(environments, kind="stable")
        columns = {
            name: mapped(
                lambda *parts: np.concatenate(parts)[order],
                *(getattr(step, name) for step in self._steps),
            )
            for name in _Step._fields[1:]
        }
        return Dataset.from_arrays(
            **columns,
            behavior_probs=np.ones(len(order)),
            env_id=self._env_id,
            observation_space=self.single_observation_space,
            action_space=self.single_action_space,
        )


def _put(row: int, values: NDArray[Any], value: Any) -> None:
    values[row] = value

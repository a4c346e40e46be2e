"""Evaluation during training, in separate environments.

Scores are scaled so that random actions have the score 0 and the sim's pilot has the score 1.
"""

from __future__ import annotations

import math
import warnings
from typing import Any, Final, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy
from mcaprl.frames import mapped, rows_of
from mcaprl.limits import STEP_LIMIT
from mcaprl.online.curves import CurvePoint
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.record.vector_wrapper import VectorWrapper
from mcaprl.sims.evaluation.evaluate import Scale, evaluate, has_pilot, make_pilot
from mcaprl.sims.evaluation.rollout import batch_rollout, episode_seed

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


class Evaluation:
    """Evaluations of one agent, each on the same episodes, which run at the same time."""

    def __init__(self, env: FirstEpisodes, scale: Scale) -> None:
        """Evaluate in `env`, with these mean returns for the scores 0 and 1."""
        self.env, self._scale = env, scale
        self._has_warned = False

    def point(self, policy: BasePolicy, step: int, best_before: float) -> CurvePoint:
        """Evaluate the greedy policy after `step` steps; `best_before` is a mean return."""
        policy.begin()
        seeds = [episode_seed(SELECTION_SEED, i) for i in range(self.env.num_envs)]
        results = batch_rollout(self.env, policy, seeds)
        returns = [result.total_reward for result in results]
        lengths = [result.length for result in results]
        self._warn_of_cuts(sum(result.reason == STEP_LIMIT for result in results), lengths, step)
        mean_return = float(np.mean(returns))
        return CurvePoint(
            step=step,
            mean_return=mean_return,
            score=self._scale.score(mean_return),
            lowest_return=min(returns),
            highest_return=max(returns),
            mean_length=float(np.mean(lengths)),
            mean_progress_m=float(np.mean(self.env.progress_m)),
            best=mean_return > best_before,
        )

    def _warn_of_cuts(self, cuts: int, lengths: list[int], step: int) -> None:
        if cuts and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"{cuts} of {len(lengths)} episodes of the evaluation at step {step} reached the"
                f" limit of {max(lengths)} steps and were truncated; set another limit with"
                " `max_steps=N`",
                stacklevel=2,
            )


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
    """Recorder of each environment's first episode since the last reset."""

    # Environments reset themselves in the step after the one that ends an episode. Their later
    # episodes are not recorded, because they would overrepresent short episodes.

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], env_id: str) -> None:
        """Wrap `env`; `env_id` is stored in the log."""
        super().__init__(env)
        self._env_id = env_id
        self._open = np.ones(env.num_envs, dtype=np.bool_)
        # (N,) distance along the path in the first episodes, meters; NaN if unknown.
        self.progress_m = np.full(env.num_envs, math.nan)
        self._steps: list[_Step] = []
        self._observations: Any = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Reset all environments and drop the recorded episodes."""
        self._observations, infos = self.env.reset(seed=seed, options=options)
        self._open[:], self.progress_m[:] = True, math.nan
        self._steps = []
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments; record each environment until its first episode ends."""
        result = self.env.step(actions)
        observations, rewards, terminated, truncated, infos = result
        numbers = np.flatnonzero(self._open)
        if len(numbers):
            step = _Step(
                numbers,
                rows_of(self._observations, numbers),
                np.asarray(actions)[numbers],
                rewards[numbers],
                terminated[numbers],
                truncated[numbers],
                rows_of(observations, numbers),
            )
            self._steps.append(step)
            ended = numbers[step.terminated | step.truncated]
            self._open[ended] = False
            if "progress_m" in infos:
                known = ended[infos["_progress_m"][ended]]
                self.progress_m[known] = infos["progress_m"][known]
        self._observations = observations
        return result

    def dataset(self) -> Dataset:
        """Return the episodes by environment."""
        # Their actions are greedy: probability 1, no density.
        environments = np.concatenate([step.environments for step in self._steps])
        order = np.argsort(environments, kind="stable")
        columns = {
            name: mapped(
                lambda *parts: np.concatenate(parts)[order],
                *(getattr(step, name) for step in self._steps),
            )
            for name in _Step._fields[1:]
        }
        is_box = isinstance(self.single_action_space, spaces.Box)
        return Dataset.from_arrays(
            **columns,
            behavior_probs=None if is_box else np.ones(len(order)),
            env_id=self._env_id,
            observation_space=self.single_observation_space,
            action_space=self.single_action_space,
        )

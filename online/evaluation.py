"""Evaluation beside training, on an environment of its own, on the scale random = 0, pilot = 1."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from mcaprl.errors import UnknownNameError
from mcaprl.online.curve import CurvePoint
from mcaprl.sims.evaluation.evaluate import evaluate
from mcaprl.sims.evaluation.pilots import make_pilot

SELECTION_SEED: Final = 3_000_000
"""Of the episodes that choose the best checkpoint and make the curve."""
FRESH_SEED: Final = 1_000_000
"""Of those that give the final score; `mcaprl evaluate` has the same ones."""


@dataclass(frozen=True)
class Scale:
    """What acting at random and the sim's pilot get, each on the same episodes.

    Attributes:
        random: mean return.
        pilot: mean return; NaN where the sim has no pilot.
    """

    random: float
    pilot: float

    def score(self, mean_return: float) -> float:
        """0 as random, 1 as the pilot; NaN without one."""
        span = self.pilot - self.random
        return (mean_return - self.random) / span if span else math.nan


def measure_scale(env: gym.Env[Any, Any], *, episodes: int, seed: int) -> Scale:
    """Run the random policy and the pilot through the episodes of a seed."""

    def mean_return(policy: Any) -> float:
        score = evaluate(env, [policy], name="", episodes=episodes, seed=seed)
        return score.mean_return

    try:
        pilot = mean_return(make_pilot(env))
    except UnknownNameError:
        pilot = math.nan
    return Scale(mean_return(None), pilot)


class Evaluation(EvalCallback):
    """SB3's EvalCallback on the same episodes each time, so that checkpoints can be compared.

    It runs them all at once, one in each environment of its own batch. The best model is handed to
    a callback, and every evaluation to another.
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
        """Prepare.

        Args:
            env: with an environment for each episode.
            interval: training steps between two evaluations.
            training_envs: environments that are trained in at once.
            scale: of the scores.
            on_new_best: called when the mean return is higher than ever.
            on_point: called with each evaluation, after `on_new_best`.
        """
        super().__init__(
            env,
            callback_on_new_best=_Call(on_new_best),
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

    def resume(self, calls: int, best_mean_return: float) -> None:
        """Go on as after so many steps of all environments."""
        self.n_calls, self.best_mean_reward = calls, best_mean_return

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq:
            return True
        self.eval_env.seed(SELECTION_SEED)
        self._returns, self._lengths, self._progress_m = [], [], []
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
        return going_on

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        """Called by SB3 after each step of the evaluation."""
        super()._log_success_callback(locals_, globals_)
        if locals_["done"]:
            episode = locals_["info"]["episode"]
            self._returns.append(episode["r"])
            self._lengths.append(episode["l"])
            self._progress_m.append(locals_["info"].get("progress_m", math.nan))


class _Call(BaseCallback):
    """A plain function as SB3's callback."""

    def __init__(self, function: Callable[[], None]) -> None:
        super().__init__()
        self._function = function

    def _on_step(self) -> bool:
        self._function()
        return True

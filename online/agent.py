"""Training of one seed: environments, log, evaluations, curve, best policy and checkpoints.

The loop differs: `online.learning` has that of this package's learners, and `online.sb3` that of
Stable-Baselines3's models.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from safetensors import SafetensorError
from torch import Tensor

from mcaprl.base_policy import BasePolicy
from mcaprl.errors import TrainingError
from mcaprl.files import subfolder, write_atomically
from mcaprl.frames import mapped
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.online.curves import CurvePoint, write_curve
from mcaprl.online.evaluation import Evaluation, FirstEpisodes
from mcaprl.online.live import LiveTraining, Shown
from mcaprl.online.recording import recorded
from mcaprl.online.scalars import ScalarsWriter
from mcaprl.online.task import Task
from mcaprl.progress import ProgressCallback, TrainingProgress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import CHECKPOINT_NAME, CURVE_NAME, broken_checkpoint, writing
from mcaprl.sims.evaluation.evaluate import Scale
from mcaprl.storage.tensor_files import read_tensors

LOG_INTERVAL = 1_000
"""Number of environment steps between two rows of scalars, and between two progress reports."""
EVALUATIONS_NAME = "evaluations"
CENTERING_STEPS = 2_000
"""Number of random steps before training; their images determine the image normalization."""
BROKEN = (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError, IndexError)
"""Errors of a checkpoint that cannot be read."""


class Agent(ABC):
    """Agent of one seed, with its training and evaluation environments.

    Attributes:
        best_files: Names of the files of the best policy.
        resumed_at: Number of steps done by earlier sessions.
        points: All evaluations, including those of earlier sessions.
    """

    best_files: ClassVar[tuple[str, ...]]

    def __init__(
        self,
        task: Task,
        env_id: str,
        folder: Path,
        seed: int,
        scale: Scale,
        *,
        record: Path | None = None,
        episodes: int | None = None,
        live: LiveTraining | None = None,
    ) -> None:
        """Create the environments, and the log.

        Args:
            task: Algorithm, settings and environment.
            env_id: Gymnasium id of the environment.
            folder: Existing folder of this seed, RUN/seed-K.
            seed: Seed of the agent.
            scale: Mean returns that define the scores 0 and 1.
            record: Log to write; None records neither training nor evaluations.
            episodes: Number of episodes that the log had at the checkpoint from which this session
                continues, to which it appends; -1 for all of the log. None for a new log.
            live: Live view of the training.

        Raises:
            SpaceError, OutputExistsError, LogError: The log cannot be written.
        """
        self.points: list[CurvePoint] = []
        self.resumed_at = 0
        self._task, self._env_id, self._folder, self._seed = task, env_id, folder, seed
        self._score, self._reported_at = math.nan, -1
        self._began_s = 0.0
        self._scalars: ScalarsWriter | None = None
        with ExitStack() as stack:
            self.env: Any = stack.enter_context(closing(task.batch(task.config.envs)))
            self._recorder = None
            if record is not None:
                self.env = self._recorder = recorded(
                    self.env, record, algo=task.algo, seed=seed, episodes=episodes
                )
                stack.callback(self._recorder.close)
            self._watched = None
            if live is not None:
                self.env = self._watched = live.watch(self.env)
            evaluated = FirstEpisodes(task.evaluation_batch(task.config.eval_episodes), env_id)
            self._evaluation = Evaluation(stack.enter_context(closing(evaluated)), scale)
            self._envs = stack.pop_all()

    @property
    @abstractmethod
    def steps(self) -> int:
        """Number of finished environment steps, summed over all environments."""

    @property
    @abstractmethod
    def policy(self) -> BasePolicy:
        """Greedy policy with the current weights."""

    @abstractmethod
    def best_policy(self) -> BasePolicy:
        """Read the policy with the best evaluation."""

    @abstractmethod
    def start_from(self, data: Dataset | None, policy: Any) -> None:
        """Fill the replay buffer with logged transitions, copy a policy's weights, or do both.

        With data, the agent takes no random steps before learning. With a policy, the agent always
        explores with the final epsilon, and takes `learning_starts` steps before learning.

        Args:
            data: Logged transitions, if any.
            policy: Policy with Q-values, if any.

        Raises:
            UsageError: The algorithm cannot start from data or policies.
            SpaceError: The spaces differ.
            PolicyError: The policy's network differs from the agent's.
        """

    @abstractmethod
    def scalars(self) -> dict[str, float]:
        """Return the scalars of a row of `progress.csv`, under the names of SB3."""

    @abstractmethod
    def _train(self, report: ProgressCallback) -> None:
        """Train until all steps are done."""

    @abstractmethod
    def _save_policy(self) -> None:
        """Write the current policy to `best_files`."""

    def close(self) -> None:
        """Close the environments and the log."""
        self._envs.close()

    def learn(self, report: ProgressCallback) -> None:
        """Train and evaluate until all steps are done.

        Args:
            report: Callback for progress, called every `LOG_INTERVAL` steps.

        Raises:
            TrainingError: The loss is not finite, or a file cannot be written.
        """
        self.resumed_at = self.steps
        if self.steps >= self._task.config.steps:
            return
        self._began_s = time.perf_counter()
        with closing(ScalarsWriter(self._folder, self.steps)) as self._scalars:
            self._train(report)
            if self.steps > self._reported_at:
                self._report(report)

    def _after_step(self, before: int, report: ProgressCallback) -> None:
        """Evaluate and report if this is due after a step that began at `before` steps."""
        config, now = self._task.config, self.steps
        if is_due(before, now, min(config.eval_interval, config.steps)):
            self._evaluate()
        if is_due(before, now, LOG_INTERVAL):
            self._report(report)

    def _evaluate(self) -> None:
        """Add a point to the curve; keep the policy if it is the best so far."""
        best = max((point.mean_return for point in self.points), default=-math.inf)
        point = self._evaluation.point(self.policy, self.steps, best)
        if point.best:
            self._save_policy()
        self.points.append(point)
        self._score = point.score
        if self._watched is not None:
            self._watched.score = point.score
        write_curve(self._folder / CURVE_NAME, self.points)
        scalars = {
            "eval/mean_reward": point.mean_return,
            "eval/mean_ep_length": point.mean_length,
            "eval/score": point.score,
        }
        assert self._scalars is not None
        self._scalars.write(point.step, scalars)
        if self._recorder is not None:
            folder = self._folder / EVALUATIONS_NAME
            with writing(folder):
                subfolder(folder)
            path = folder / f"step-{point.step:09d}.mcap"
            self._evaluation.env.dataset().save(path, overwrite=True)

    def _report(self, report: ProgressCallback) -> None:
        """Write a row of scalars, and report the progress."""
        self._reported_at = self.steps
        seconds = time.perf_counter() - self._began_s
        speed = (self.steps - self.resumed_at) / max(seconds, 1e-9)
        times = {"time/time_elapsed": seconds, "time/fps": float(int(speed))}
        assert self._scalars is not None
        self._scalars.write(self.steps, {**times, **self.scalars()})
        terms = {"score": math.nan, "mean_return": math.nan}
        if self.points:
            last = self.points[-1]
            terms = {"score": last.score, "mean_return": last.mean_return}
        report(TrainingProgress(self._seed, self.steps, self._task.config.steps, terms))

    def _show(self, shown: Shown) -> None:
        """Show this agent in the live view, if there is one."""
        if self._watched is not None:
            self._watched.shown = shown

    @property
    def _checkpoint(self) -> Path:
        return self._folder / CHECKPOINT_NAME

    def _best_content(self) -> dict[str, Tensor]:
        """Return the contents of `best_files`; empty before the first evaluation."""
        if not self.points:
            return {}
        return {
            f"best.{name}": torch.from_numpy(
                np.frombuffer((self._folder / name).read_bytes(), np.uint8).copy()
            )
            for name in self.best_files
        }

    def _restore_best(self, tensors: dict[str, Tensor], points: list[dict[str, Any]]) -> None:
        """Restore the curve and the best policy of a checkpoint.

        The files may be newer than the checkpoint; the evaluations after it are repeated.
        """
        self.points = [CurvePoint(**point) for point in points]
        for name in self.best_files if self.points else ():
            content = tensors[f"best.{name}"].numpy().tobytes()
            write_atomically(self._folder / name, content, TrainingError)


def is_due(before: int, now: int, interval: int) -> bool:
    """Return whether a multiple of the interval was reached."""
    return now // interval > before // interval


def read_checkpoint(path: Path, task: Task) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the checkpoint of a task: tensors, and a description."""
    try:
        tensors, description = read_tensors(path)
        task.identity.check_same(description, path)
        if "episodes_in_log" not in description:
            raise TrainingError(
                f"cannot resume: {path} was written by an earlier version of mcaprl; resume it with"
                " that version, or train into another folder"
            )
        return tensors, description
    except BROKEN as error:
        raise broken_checkpoint(path, error) from error


def center_images(encoder: ObservationEncoder, task: Task, seed: int) -> None:
    """Normalize images to the statistics of `CENTERING_STEPS` random steps."""
    with closing(task.batch(task.config.envs)) as envs:
        envs.action_space.seed(seed)
        seen = [envs.reset(seed=seed)[0]]
        while len(seen) * task.config.envs < CENTERING_STEPS:
            seen.append(envs.step(envs.action_space.sample())[0])
    whole = mapped(lambda *parts: np.concatenate(parts), *seen)
    encoder.center_images(encoder.arranged(whole))

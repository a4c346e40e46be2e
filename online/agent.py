"""Training of one seed: environments, log, evaluations, curve, best policy and checkpoints.

The loop differs: `online.learning` has that of this package's learners, and `online.sb3` that of
Stable-Baselines3's models.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from contextlib import ExitStack, closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import torch
from safetensors import SafetensorError
from torch import Tensor

from mcaprl.base_policy import BasePolicy
from mcaprl.errors import TrainingError
from mcaprl.files import subfolder, write_atomically
from mcaprl.frames import mapped
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.offline.training.metrics import ScalarsWriter
from mcaprl.online.curves import CurvePoint, write_curve
from mcaprl.online.evaluation import Evaluation, FirstEpisodes
from mcaprl.online.live import LiveTraining, Shown
from mcaprl.online.recording import recorded
from mcaprl.online.task import Task
from mcaprl.progress import ProgressCallback, TrainingProgress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import CHECKPOINT_NAME, CURVE_NAME, broken_checkpoint, writing
from mcaprl.sims.evaluation.evaluate import Scale
from mcaprl.storage.tensor_files import read_tensors, write_tensors
from mcaprl.texts import counted

LOG_INTERVAL = 1_000
"""Number of environment steps between two rows of scalars, and between two progress reports."""
EVALUATIONS_NAME = "evaluations"
PROGRESS_NAME = "progress.csv"
STEPS_COLUMN = "time/total_timesteps"
CENTERING_STEPS = 2_000
"""Number of random steps before training; their images determine the image normalization."""
_BROKEN = (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError, IndexError)
"""Errors of a checkpoint that cannot be read."""


class Agent(ABC):
    """Agent of one seed, with its training and evaluation environments."""

    best_files: ClassVar[tuple[str, ...]]  # Names of the files of the best policy
    # Whether a resumed run repeats the steps after its checkpoint to the same bits, so that they
    # are removed from the log.
    repeats_steps: ClassVar[bool]

    def __init__(
        self,
        task: Task,
        env_id: str,
        folder: Path,
        seed: int,
        scale: Scale,
        *,
        record: Path | None = None,
        resume: bool = False,
        live: LiveTraining | None = None,
    ) -> None:
        """Create an agent with new weights, or of the checkpoint; its environments, and its log."""
        self.points: list[CurvePoint] = []  # All evaluations, including those of earlier sessions
        # Number of steps done by earlier sessions.
        self.resumed_at, self._reported_at, self._began_s = 0, -1, 0.0
        self._task, self._env_id, self._folder, self._seed = task, env_id, folder, seed
        self._scalars: ScalarsWriter | None = None
        self._checkpoint = folder / CHECKPOINT_NAME
        found = self._read_checkpoint() if resume and self._checkpoint.exists() else None
        kept = None
        if resume:
            kept = found[1]["episodes_in_log"] if found else 0 if self.repeats_steps else -1
        with ExitStack() as stack:
            self.env: Any = stack.enter_context(closing(task.batch(task.config.envs)))
            self._recorder = None
            if record is not None:
                self.env = self._recorder = recorded(
                    self.env, record, algo=task.algo, seed=seed, episodes=kept
                )
                stack.callback(self._recorder.close)
            self._watched = None
            if live is not None:
                self.env = self._watched = live.watch(self.env)
            evaluated = FirstEpisodes(task.evaluation_batch(task.config.eval_episodes), env_id)
            self._evaluation = Evaluation(stack.enter_context(closing(evaluated)), scale)
            if found is None:
                self._prepare(None)
            else:
                self._restore(*found)
            if self._watched is not None:
                self._watched.shown = cast(Shown, self)
            self._envs = stack.pop_all()

    @abstractmethod
    def _prepare(self, tensors: dict[str, Tensor] | None) -> None:
        """Create what is trained; `tensors` are those of the checkpoint, if there is one."""

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
        """Fill the replay buffer with logged transitions, copy a policy's weights, or do both."""
        # With data, the agent takes no random steps before learning. With a policy, it explores
        # with the final epsilon, and takes `learning_starts` steps before learning.

    @abstractmethod
    def scalars(self) -> dict[str, float]:
        """Return the scalars of a row of `progress.csv`, under the names of SB3."""

    @abstractmethod
    def _train(self, report: ProgressCallback) -> None:
        """Train until all steps are done."""

    @abstractmethod
    def save_policy(self, folder: Path) -> None:
        """Write the current policy to the `best_files` in a folder."""

    @abstractmethod
    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return the state for a checkpoint, as tensors and as JSON values."""

    @abstractmethod
    def _load(self, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
        """Restore what `_state` returned."""

    def close(self) -> None:
        """Close the environments and the log."""
        self._envs.close()

    def learn(self, report: ProgressCallback) -> None:
        """Train and evaluate to the end; report each `LOG_INTERVAL` steps and each evaluation."""
        self.resumed_at = self.steps
        if self.steps >= self._task.config.steps:
            return
        self._began_s = time.perf_counter()
        if self.resumed_at:
            report(TrainingProgress(self._seed, self.resumed_at, self._task.config.steps, {}))
        else:
            self.tell(report, "preparing")
        path = self._folder / PROGRESS_NAME
        with closing(ScalarsWriter(path, STEPS_COLUMN, self.steps)) as self._scalars:
            self._train(report)
            if self.steps > self._reported_at:
                self._report(report)

    def _after_step(self, before: int, report: ProgressCallback) -> None:
        """Evaluate and report if this is due after a step that began at `before` steps."""
        config, now = self._task.config, self.steps
        if is_due(before, now, min(config.eval_interval, config.steps)):
            self.tell(report, f"evaluating on {counted(config.eval_episodes, 'episode')}")
            self._evaluate()
            self.tell(report)
        if is_due(before, now, LOG_INTERVAL):
            self._report(report)

    def _evaluate(self) -> None:
        """Add a point to the curve; keep the policy if it is the best so far."""
        best = max((point.mean_return for point in self.points), default=-math.inf)
        point = self._evaluation.point(self.policy, self.steps, best)
        if point.best:
            self.save_policy(self._folder)
        self.points.append(point)
        if self._watched is not None:
            self._watched.score = point.score
        write_curve(self._folder / CURVE_NAME, self.points)
        scalars = {
            "eval/mean_reward": point.mean_return,
            "eval/mean_ep_length": point.mean_length,
            "eval/score": point.score,
        }
        self._write(scalars)
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
        self._write({**times, **self.scalars()})
        self.tell(report)

    def tell(self, report: ProgressCallback, activity: str = "") -> None:
        """Report the steps, the results of the last evaluation, and what is done meanwhile."""
        last = self.points[-1] if self.points else None
        terms = {
            "score": last.score if last else math.nan,
            "mean_return": last.mean_return if last else math.nan,
        }
        report(TrainingProgress(self._seed, self.steps, self._task.config.steps, terms, activity))

    def _write(self, scalars: dict[str, float]) -> None:
        """Write a row of scalars, without those that are NaN."""
        assert self._scalars is not None
        known = {name: value for name, value in scalars.items() if not math.isnan(value)}
        known.pop(STEPS_COLUMN, None)
        self._scalars.write_row(self.steps, known)

    def _save(self) -> None:
        """Replace the checkpoint."""
        tensors, description = self._state()
        for name in self.best_files if self.points else ():
            content = np.frombuffer((self._folder / name).read_bytes(), np.uint8)
            tensors[f"best.{name}"] = torch.from_numpy(content.copy())
        recorder = self._recorder if self.repeats_steps else None
        description |= {
            **self._task.identity.parts,
            "episodes_in_log": -1 if recorder is None else recorder.episodes,
            "points": [asdict(point) for point in self.points],
        }
        write_tensors(self._checkpoint, tensors, description)

    def _restore(self, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
        """Restore a checkpoint; evaluations after it are repeated."""
        try:
            self._prepare(tensors)
            self._load(tensors, description)
            self.points = [CurvePoint(**point) for point in description["points"]]
            best = {name: tensors[f"best.{name}"] for name in self.best_files if self.points}
        except _BROKEN as error:
            raise broken_checkpoint(self._checkpoint, error) from error
        for name, content in best.items():
            write_atomically(self._folder / name, content.numpy().tobytes(), TrainingError)

    def _read_checkpoint(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Read the tensors and the description of the checkpoint."""
        path = self._checkpoint
        try:
            tensors, description = read_tensors(path)
        except _BROKEN as error:
            raise broken_checkpoint(path, error) from error
        self._task.identity.check_same(description, path)
        if "episodes_in_log" not in description:
            raise TrainingError(
                f"cannot resume: {path} was written by an earlier version of mcaprl; resume it with"
                " that version, or train into another folder"
            )
        return tensors, description


def is_due(before: int, now: int, interval: int) -> bool:
    """Return whether a multiple of the interval was reached."""
    return now // interval > before // interval


def center_images(encoder: ObservationEncoder, task: Task, seed: int) -> None:
    """Normalize images to the statistics of `CENTERING_STEPS` random steps."""
    with closing(task.batch(task.config.envs)) as envs:
        envs.action_space.seed(seed)
        seen = [envs.reset(seed=seed)[0]]
        while len(seen) * task.config.envs < CENTERING_STEPS:
            seen.append(envs.step(envs.action_space.sample())[0])
    whole = mapped(lambda *parts: np.concatenate(parts), *seen)
    encoder.center_images(encoder.arranged(whole))

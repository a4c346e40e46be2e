"""Agent of one seed: training, evaluation, recording and checkpoints."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.common.vec_env import VecEnv

from mcaprl.errors import TrainingError
from mcaprl.files import subfolder, write_atomically
from mcaprl.frames import parts_of, parts_of_space
from mcaprl.online.algorithms import make_model, own_architecture
from mcaprl.online.checkpoint import load_checkpoint, save_checkpoint
from mcaprl.online.config import DQNConfig
from mcaprl.online.curves import CurvePoint, write_curve
from mcaprl.online.evaluation import Evaluation, FirstEpisodes
from mcaprl.online.features import channels_first, inputs_of, normalize_images
from mcaprl.online.live import LiveTraining
from mcaprl.online.recording import ActionDescriber, recorded
from mcaprl.online.task import Task
from mcaprl.online.vec_env import BatchedVecEnv, StackedVecEnv
from mcaprl.online.warm_start import fill_buffer, take_weights
from mcaprl.online.zip_file import describe_run, save_policy
from mcaprl.progress import ProgressCallback, TrainingProgress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import BEST_NAME, CHECKPOINT_NAME, CURVE_NAME, writing
from mcaprl.sims.evaluation.evaluate import Scale
from mcaprl.sims.evaluation.rollout import episode_seed

LOG_INTERVAL = 1_000
"""Number of environment steps between two rows of scalars, and between two progress reports."""
EVALUATIONS_NAME = "evaluations"
CENTERING_STEPS = 2_000
"""Number of random steps before training; their images determine the image normalization."""


class Agent:
    """Agent of one seed, with its training and evaluation environments.

    Attributes:
        model: Model of SB3.
        resumed_at: Number of steps done by earlier sessions.
        points: All evaluations, including those of earlier sessions.
    """

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
        """Create an agent with new weights, its environments, and its log.

        Args:
            task: Algorithm, settings and environment.
            env_id: Gymnasium id of the environment.
            folder: Existing folder of this seed, RUN/seed-K.
            seed: Seed of the agent.
            scale: Mean returns that define the scores 0 and 1.
            record: Log to write; None records neither training nor evaluations.
            resume: Whether to resume from the folder's checkpoint and append to the log, if they
                exist.
            live: Live view of the training.

        Raises:
            SpaceError, OutputExistsError, LogError: The log cannot be written.
        """
        self.points: list[CurvePoint] = []
        self.resumed_at = 0
        self._has_pretrained_weights = False
        self._task, self._folder, self._seed, self._scale = task, folder, seed, scale
        self._resumes = resume
        with ExitStack() as stack:
            batch = stack.enter_context(closing(task.batch(task.config.envs)))
            recorder = None
            if record is not None:
                recorder = recorded(batch, record, algo=task.algo, seed=seed, resume=resume)
            self._watched = live.watch(recorder or batch) if live is not None else None
            recorded_env = self._watched or recorder or batch
            env = stack.enter_context(closing(BatchedVecEnv(recorded_env)))
            self._evaluated = FirstEpisodes(
                task.evaluation_batch(task.config.eval_episodes), env_id
            )
            eval_env = stack.enter_context(closing(BatchedVecEnv(self._evaluated)))
            self._eval_env = _stacked(eval_env, task.config.frame_stack)
            stacked = _stacked(env, task.config.frame_stack)
            self.model: BaseAlgorithm = make_model(task.algo, task.config, stacked, seed)
            architecture = own_architecture(task.config, self.model.observation_space)
            if architecture is not None and task.config.center_images:
                center_images(self.model, task, seed)
            self._describer = None
            if recorder is not None:
                self._describer = env.before_step = ActionDescriber(recorder, self.model)
            if self._watched is not None:
                self._watched.model = self.model
                if self._describer is not None:
                    self._watched.after_forward = self._describer.reset
            self._envs = stack.pop_all()
        self._description = describe_run(
            task.algo,
            task.config.hidden,
            batch.single_observation_space,
            batch.single_action_space,
            env_id,
            task.sim_options,
            task.config.frame_stack,
            architecture,
        )

    def start_from(self, data: Dataset | None, policy: Any) -> None:
        """Fill the replay buffer with logged transitions, copy a policy's weights, or do both.

        With data, the agent takes no random steps before learning. With a policy, the agent always
        explores with the final epsilon, and takes `learning_starts` steps before learning.

        Args:
            data: Logged transitions, if any.
            policy: Policy with Q-values, if any.

        Raises:
            UsageError: The algorithm cannot start from the given data or policy.
            SpaceError: The spaces differ.
            PolicyError: The policy's network differs from the agent's.
        """
        model: Any = self.model
        if data is not None:
            fill_buffer(model, data)
            model.learning_starts = 0
        if policy is not None:
            take_weights(model, policy, self._evaluated.single_observation_space)
            model.learning_starts = cast(DQNConfig, self._task.config).learning_starts
            model.exploration_rate = model.exploration_final_eps
            self._use_final_exploration()

    def close(self) -> None:
        """Close the environments and the log."""
        self._envs.close()

    def learn(self, report: ProgressCallback) -> None:
        """Train and evaluate until all steps are done.

        Args:
            report: Callback for progress, called every `LOG_INTERVAL` steps.

        Raises:
            TrainingError: The checkpoint belongs to another task, or is broken.
        """
        config = self._task.config
        evaluation = Evaluation(
            BaseAlgorithm._wrap_env(self._eval_env, 0),
            interval=min(config.eval_interval, config.steps),
            training_envs=config.envs,
            scale=self._scale,
            on_new_best=self._keep_best,
            on_point=self._add_point,
        )
        if self._resumes and self._checkpoint.exists():
            self._load(evaluation)
        done = self.resumed_at = self.model.num_timesteps
        if done >= config.steps:
            return
        callbacks: list[BaseCallback] = [
            evaluation,
            _EveryInterval(LOG_INTERVAL, partial(self._report, report)),
            _BetweenRollouts(config.checkpoint_interval, self._save),
        ]
        if isinstance(config, DQNConfig) and config.target_update_episodes:
            callbacks.append(_TargetUpdateByEpisodes(config.target_update_episodes))
        with writing(self._folder):
            self.model.set_logger(_logger(self._folder, done))
        try:
            self.model.learn(
                config.steps - done,
                callback=callbacks,
                log_interval=sys.maxsize,
                reset_num_timesteps=done == 0,
            )
        finally:
            with writing(self._folder):
                self.model.logger.close()
        self._save()

    @property
    def _checkpoint(self) -> Path:
        return self._folder / CHECKPOINT_NAME

    def _save(self) -> None:
        points = [asdict(point) for point in self.points]
        extra = {"points": points, "began_with_policy": self._has_pretrained_weights}
        best = self._folder / BEST_NAME
        content = best.read_bytes() if self.points and best.exists() else b""
        save_checkpoint(self._checkpoint, self.model, self._task, extra, content)

    def _load(self, evaluation: Evaluation) -> None:
        extra, best = load_checkpoint(self._checkpoint, self.model, self._task)
        if best:
            # The best policy's file may be newer than the checkpoint. Restore the older content,
            # because the evaluations after the checkpoint are repeated.
            write_atomically(self._folder / BEST_NAME, best, TrainingError)
        self.points = [CurvePoint(**point) for point in extra["points"]]
        if extra["began_with_policy"]:
            self._use_final_exploration()
        done, envs = self.model.num_timesteps, self._task.config.envs
        evaluation.resume(
            done // envs, max((p.mean_return for p in self.points), default=-math.inf)
        )
        # The states of the environments cannot be restored. The new seed prevents the environments
        # from repeating the first episodes.
        assert self.model.env is not None
        self.model.env.seed(episode_seed(self._seed, done))

    def _use_final_exploration(self) -> None:
        self._has_pretrained_weights = True
        model: Any = self.model
        model.skips_random_steps = True
        model.exploration_schedule = ConstantSchedule(model.exploration_final_eps)

    def _keep_best(self) -> None:
        save_policy(self._folder / BEST_NAME, self.model, self._description)

    def _add_point(self, point: CurvePoint) -> None:
        self.points.append(point)
        if self._watched is not None:
            self._watched.score = point.score
        write_curve(self._folder / CURVE_NAME, self.points)
        self.model.logger.record("eval/score", point.score)
        with writing(self._folder):
            self.model.logger.dump(point.step)
        if self._describer is not None:
            self._describer.reset()
            folder = self._folder / EVALUATIONS_NAME
            with writing(folder):
                subfolder(folder)
            path = folder / f"step-{point.step:09d}.mcap"
            self._evaluated.dataset().save(path, overwrite=True)

    def _report(self, report: ProgressCallback) -> None:
        model: Any = self.model
        with writing(self._folder):
            model.dump_logs()
        terms = {"score": math.nan, "mean_return": math.nan}
        if self.points:
            last = self.points[-1]
            terms = {"score": last.score, "mean_return": last.mean_return}
        steps = self._task.config.steps
        report(TrainingProgress(self._seed, model.num_timesteps, steps, terms))


class _EveryInterval(BaseCallback):
    """Callback that calls a function every `interval` environment steps, and at the end."""

    def __init__(self, interval: int, function: Callable[[], None]) -> None:
        super().__init__()
        self._interval = interval
        self._function = function
        self._called_at = -1

    def _on_training_start(self) -> None:
        self._called_at = self.num_timesteps

    def _on_step(self) -> bool:
        if self.num_timesteps // self._interval > self._called_at // self._interval:
            self._call()
        return True

    def _on_training_end(self) -> None:
        if self.num_timesteps > self._called_at:
            self._call()

    def _call(self) -> None:
        self._called_at = self.model.num_timesteps
        self._function()


class _TargetUpdateByEpisodes(BaseCallback):
    """Callback that updates a DQN's target network every `episodes` finished episodes."""

    def __init__(self, episodes: int) -> None:
        super().__init__()
        self._episodes = episodes
        self._finished = 0

    def _on_step(self) -> bool:
        before = self._finished
        self._finished += int(np.sum(self.locals["dones"]))
        if self._finished // self._episodes > before // self._episodes:
            model = cast(DQN, self.model)
            model.q_net_target.load_state_dict(model.q_net.state_dict())
        return True


class _BetweenRollouts(_EveryInterval):
    """Callback that calls a function between rollouts, when all steps have been processed."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps - self._called_at >= self._interval:
            self._call()

    def _on_training_end(self) -> None:
        pass


def center_images(model: BaseAlgorithm, task: Task, seed: int) -> None:
    """Set a model's image normalization to the statistics of `CENTERING_STEPS` random steps."""
    with closing(task.batch(task.config.envs)) as envs:
        envs.action_space.seed(seed)
        seen = [envs.reset(seed=seed)[0]]
        while len(seen) * task.config.envs < CENTERING_STEPS:
            seen.append(envs.step(envs.action_space.sample())[0])
    space = envs.single_observation_space
    vectors = inputs_of(channels_first(space))[0]
    frames = {}
    for key, part in parts_of_space(space).items():
        if key not in vectors:
            images = np.concatenate([parts_of(each)[key] for each in seen])
            frames[key] = np.moveaxis(images, 1, -1) if channels_first(part) == part else images
    if frames:
        normalize_images(model.policy, frames, task.config.frame_stack)


def _stacked(env: VecEnv, count: int) -> VecEnv:
    return env if count == 1 else StackedVecEnv(env, count)


def _logger(folder: Path, done: int) -> Logger:
    """Return an SB3 logger that writes scalars to TensorBoard and to one CSV per session."""
    suffix = f"-from-{done}" if done else ""
    formats = [make_output_format(name, str(folder), suffix) for name in ("csv", "tensorboard")]
    return Logger(folder=str(folder), output_formats=formats)

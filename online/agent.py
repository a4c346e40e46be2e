"""One agent at work: it acts, learns, is evaluated, recorded, and kept."""

from __future__ import annotations

import math
import sys
from contextlib import ExitStack, closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, cast

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.common.vec_env import VecEnv

from mcaprl.online.algorithms import make_model
from mcaprl.online.callbacks import BetweenRollouts, CopyTargetByEpisodes, EveryInterval
from mcaprl.online.checkpoint import CHECKPOINT_NAME, load_checkpoint, save_checkpoint
from mcaprl.online.config import DQNConfig
from mcaprl.online.curve import CURVE_NAME, CurvePoint, write_curve
from mcaprl.online.evaluation import Evaluation, Scale
from mcaprl.online.first_episodes import FirstEpisodes
from mcaprl.online.frames import StackedVecEnv
from mcaprl.online.live import LiveTraining
from mcaprl.online.policy import describe_run, save_policy
from mcaprl.online.recording import ActionDescriber, recorded
from mcaprl.online.task import Task
from mcaprl.online.vec_env import BatchedVecEnv
from mcaprl.online.warm_start import fill_buffer, take_weights
from mcaprl.progress import ProgressCallback, TrainingProgress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import BEST_NAME
from mcaprl.sims.evaluation.rollout import episode_seed

LOG_INTERVAL = 1_000
"""Environment steps between two rows of scalars, and two signs of life."""
EVALUATIONS_NAME = "evaluations"


class Agent:
    """An agent of a run, with its environments.

    Attributes:
        model: of SB3.
        resumed_at: steps that an earlier session had done.
        points: all evaluations, those of earlier sessions included.
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
        """Make an agent with fresh weights, its environments, and its log.

        Args:
            task: what is to be learnt, and how.
            env_id: Gymnasium's id of the environment.
            folder: of this seed, RUN/seed-K; it exists.
            seed: of the agent.
            scale: of scores.
            record: log to write; None records nothing, neither training nor evaluations.
            resume: go on from the folder's checkpoint and behind the log's last episode, where
                there are such.
            live: shows what happens, to whoever connects.

        Raises:
            SpaceError, OutputExistsError, LogError: the log cannot be written.
        """
        self.points: list[CurvePoint] = []
        self.resumed_at = 0
        self._began_with_policy = False
        self._task, self._folder, self._seed, self._scale = task, folder, seed, scale
        self._resumes = resume
        with ExitStack() as stack:
            batch = stack.enter_context(closing(task.batch(task.config.envs)))
            recorder = None
            if record is not None:
                recorder = recorded(batch, record, algo=task.algo, seed=seed, resume=resume)
            self._watched = live.watch(recorder or batch) if live is not None else None
            acted_in = self._watched or recorder or batch
            env = stack.enter_context(closing(BatchedVecEnv(acted_in)))
            self._evaluated = FirstEpisodes(task.batch(task.config.eval_episodes), env_id)
            eval_env = stack.enter_context(closing(BatchedVecEnv(self._evaluated)))
            self._eval_env = _stacked(eval_env, task.config.frame_stack)
            seen = _stacked(env, task.config.frame_stack)
            self.model: BaseAlgorithm = make_model(task.algo, task.config, seen, seed)
            self._describer = None
            if recorder is not None:
                self._describer = env.before_step = ActionDescriber(recorder, self.model)
            if self._watched is not None:
                self._watched.model = self.model
                if self._describer is not None:
                    self._watched.after_asking = self._describer.forget
            self._envs = stack.pop_all()
        self._description = describe_run(
            task.algo,
            task.config.hidden,
            batch.single_observation_space,
            batch.single_action_space,
            env_id,
            task.sim_options,
            task.config.frame_stack,
        )

    def start_from(self, data: Dataset | None, policy: Any) -> None:
        """Begin with experience: logged transitions in the replay buffer, a policy's weights.

        Data make the random steps at the beginning needless. A policy's agent explores as it
        would at the end of its training, and learns once it has acted for as many steps as others
        act at random.

        Args:
            data: None has none.
            policy: with Q-values; None has none.

        Raises:
            UsageError: the algorithm cannot.
            SpaceError: the spaces differ.
            PolicyError: the policy's network is another.
        """
        model: Any = self.model
        if data is not None:
            fill_buffer(model, data)
            model.learning_starts = 0
        if policy is not None:
            take_weights(model, policy, self._evaluated.single_observation_space)
            model.learning_starts = cast(DQNConfig, self._task.config).learning_starts
            model.exploration_rate = model.exploration_final_eps
            self._explore_as_at_the_end()

    def close(self) -> None:
        """Close environments and log."""
        self._envs.close()

    def learn(self, report: ProgressCallback) -> None:
        """Train to the end, evaluating on the way.

        Args:
            report: told how far it is, each `LOG_INTERVAL` steps.

        Raises:
            TrainingError: the checkpoint is of another task, or broken.
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
            EveryInterval(LOG_INTERVAL, partial(self._report, report)),
            BetweenRollouts(config.checkpoint_interval, self._save),
        ]
        if isinstance(config, DQNConfig) and config.target_update_episodes:
            callbacks.append(CopyTargetByEpisodes(config.target_update_episodes))
        self.model.set_logger(_logger(self._folder, done))
        try:
            self.model.learn(
                config.steps - done,
                callback=callbacks,
                log_interval=sys.maxsize,
                reset_num_timesteps=done == 0,
            )
        finally:
            self.model.logger.close()
        self._save()

    @property
    def _checkpoint(self) -> Path:
        return self._folder / CHECKPOINT_NAME

    def _save(self) -> None:
        points = [asdict(point) for point in self.points]
        extra = {"points": points, "began_with_policy": self._began_with_policy}
        save_checkpoint(self._checkpoint, self.model, self._task, extra)

    def _load(self, evaluation: Evaluation) -> None:
        extra = load_checkpoint(self._checkpoint, self.model, self._task)
        self.points = [CurvePoint(**point) for point in extra["points"]]
        if extra["began_with_policy"]:
            self._explore_as_at_the_end()
        done, envs = self.model.num_timesteps, self._task.config.envs
        evaluation.resume(done // envs, max(p.mean_return for p in self.points))
        # The environments cannot go on where they were, but must not begin as they first did.
        assert self.model.env is not None
        self.model.env.seed(episode_seed(self._seed, done))

    def _explore_as_at_the_end(self) -> None:
        self._began_with_policy = True
        model: Any = self.model
        model.acts_at_once = True
        model.exploration_schedule = ConstantSchedule(model.exploration_final_eps)

    def _keep_best(self) -> None:
        save_policy(self._folder / BEST_NAME, self.model, self._description)

    def _add_point(self, point: CurvePoint) -> None:
        self.points.append(point)
        if self._watched is not None:
            self._watched.score = point.score
        write_curve(self._folder / CURVE_NAME, self.points)
        self.model.logger.record("eval/score", point.score)
        self.model.logger.dump(point.step)
        if self._describer is not None:
            self._describer.forget()
            folder = self._folder / EVALUATIONS_NAME
            folder.mkdir(exist_ok=True)
            path = folder / f"step-{point.step:09d}.mcap"
            self._evaluated.dataset().save(path, overwrite=True)

    def _report(self, report: ProgressCallback) -> None:
        model: Any = self.model
        model.dump_logs()
        score = self.points[-1].score if self.points else math.nan
        steps = self._task.config.steps
        report(TrainingProgress(self._seed, model.num_timesteps, steps, {"score": score}))


def _stacked(env: VecEnv, count: int) -> VecEnv:
    return env if count == 1 else StackedVecEnv(env, count)


def _logger(folder: Path, done: int) -> Logger:
    """SB3's scalars as CSV and for TensorBoard; each session has a CSV of its own."""
    suffix = f"-from-{done}" if done else ""
    formats = [make_output_format(name, str(folder), suffix) for name in ("csv", "tensorboard")]
    return Logger(folder=str(folder), output_formats=formats)

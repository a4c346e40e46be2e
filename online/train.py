"""Train one algorithm in one environment, with several seeds, into a run folder.

RUN/config.json             algorithm, settings, environment
RUN/seed-0/best_model.zip   SB3's model file of the checkpoint that evaluated best; see `policy`
RUN/seed-0/curve.csv        evaluations while training; see `curve`
RUN/seed-0/progress.csv     SB3's own scalars; the same for TensorBoard
RUN/seed-1/...
RUN/scores.json             each seed's best checkpoint on fresh episodes
RUN/curve.png               the curves of all seeds
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

from mcaprl.errors import OutputExistsError, TrainingError, UsageError
from mcaprl.files import write_json
from mcaprl.online.algorithms import check_spaces, find_algorithm, make_model
from mcaprl.online.callbacks import EveryInterval
from mcaprl.online.config import OnlineConfig
from mcaprl.online.curve import CURVE_NAME, CurvePoint, write_curve
from mcaprl.online.curve_picture import PICTURE_NAME, SCORES_NAME, curve_picture, read_run
from mcaprl.online.evaluation import FRESH_SEED, SELECTION_SEED, Evaluation, Scale, measure_scale
from mcaprl.online.policy import BEST_NAME, describe_run, load_policy, save_policy
from mcaprl.online.sim_settings import settings_for
from mcaprl.online.vec_env import BatchedVecEnv
from mcaprl.progress import ProgressCallback, TrainingProgress, terminal_progress
from mcaprl.sims import make_sim
from mcaprl.sims.evaluate import evaluate

CONFIG_NAME = "config.json"
LOG_INTERVAL = 1_000
"""Environment steps between two rows of scalars, and two signs of life."""


@dataclass(frozen=True)
class RunSummary:
    """How the training of one seed ended.

    Attributes:
        folder: with the policy, RUN/seed-K.
        seed: K.
        steps: environment steps done in all.
        seconds: wall time of this session.
        best_step: environment steps behind the best checkpoint.
        mean_return: of the best checkpoint over fresh episodes, by which nothing was chosen.
        score: the same where random is 0 and the pilot 1; NaN without a pilot.
        ends: those episodes by the reason they ended.
    """

    folder: Path
    seed: int
    steps: int
    seconds: float
    best_step: int
    mean_return: float
    score: float
    ends: dict[str, int]


def default_config(
    algo: str, sim: str, sim_options: Mapping[str, Any], given: Mapping[str, Any]
) -> OnlineConfig:
    """The settings of an algorithm for a sim.

    Args:
        algo: a key of `ALGORITHMS`.
        sim: short name or Gymnasium id.
        sim_options: arguments to the environment.
        given: settings that the user chose; they go first.

    Raises:
        UnknownNameError: there is no such algorithm.
        UsageError: a setting is outside its range.
    """
    config_type = find_algorithm(algo).config_type
    return config_type(**{**settings_for(config_type, sim, sim_options), **given})


def train(
    sim: str,
    algo: str,
    out: str | Path,
    *,
    config: OnlineConfig | None = None,
    sim_options: Mapping[str, Any] | None = None,
    seeds: int = 1,
    seed: int = 0,
    progress: ProgressCallback | None = None,
) -> list[RunSummary]:
    """Train in an environment; the same seed and machine give the same curve.

    Args:
        sim: short name or Gymnasium id.
        algo: `dqn`, `double-dqn`, `ppo` or `a2c`.
        out: the run's folder; it must not exist, or be empty.
        config: settings; None takes those that the sim was seen to be learnt with.
        sim_options: arguments to the environment.
        seeds: how many agents to train, one after the other.
        seed: of the first; the others count up from it.
        progress: called each `LOG_INTERVAL` steps; None shows a bar where stderr is a terminal.

    Returns:
        One summary for each seed.

    Raises:
        UnknownNameError: there is no such algorithm or sim.
        OutputExistsError: `out` is taken.
        SpaceError: the algorithm cannot learn with these observations or actions.
        TrainingError: `out` cannot be written.
    """
    if seeds < 1 or seed < 0:
        raise UsageError(f"seeds must be at least 1 and seed at least 0, got {seeds} and {seed}")
    options = dict(sim_options or {})
    config = config or default_config(algo, sim, options, {})
    run = _Run(Path(out), sim, options, algo, config)
    with closing(make_sim(sim, **options)) as env:
        check_spaces(algo, env.observation_space, env.action_space)
        selection = measure_scale(env, episodes=config.eval_episodes, seed=SELECTION_SEED)
        fresh = measure_scale(env, episodes=config.final_episodes, seed=FRESH_SEED)
        run.open()
        shown = terminal_progress("steps", "score")
        with nullcontext(progress) if progress else shown as report:
            summaries = [
                run.train_seed(env, number, selection, fresh, report)
                for number in range(seed, seed + seeds)
            ]
    run.conclude(summaries, fresh)
    return summaries


@dataclass(frozen=True)
class _Run:
    """A run folder, and what every seed in it shares."""

    folder: Path
    sim: str
    sim_options: dict[str, Any]
    algo: str
    config: OnlineConfig

    def open(self) -> None:
        """Make the folder and say in it what it is."""
        if self.folder.is_file() or (self.folder.is_dir() and any(self.folder.iterdir())):
            raise OutputExistsError(f"{self.folder} exists: choose another folder")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(self.folder / CONFIG_NAME, self.to_json())
        except OSError as error:
            raise TrainingError(f"cannot write {self.folder}: {error.strerror}") from error

    def conclude(self, summaries: Sequence[RunSummary], fresh: Scale) -> None:
        """Write the scores of all seeds, and their curves as a picture."""
        seeds = {
            summary.folder.name: {
                "best_step": summary.best_step,
                "mean_return": summary.mean_return,
                "score": _number(summary.score),
                "ends": summary.ends,
            }
            for summary in summaries
        }
        scale = {"random": fresh.random, "pilot": _number(fresh.pilot)}
        written = {"episodes": self.config.final_episodes, "scale": scale, "seeds": seeds}
        write_json(self.folder / SCORES_NAME, written)
        if find_spec("matplotlib") is not None:
            curve = read_run(self.folder)
            curve_picture(self.folder / PICTURE_NAME, [curve], f"{self.algo} in {self.sim}")

    def to_json(self) -> dict[str, Any]:
        """As plain JSON types."""
        settings = {
            k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self.config).items()
        }
        return {
            "algo": self.algo,
            "sim": self.sim,
            "sim_options": self.sim_options,
            "config": settings,
        }

    def batch(self, count: int) -> BatchedVecEnv:
        """So many environments, stepped as one."""
        make_one = partial(make_sim, self.sim, **self.sim_options)
        return BatchedVecEnv(
            SyncVectorEnv([make_one] * count, autoreset_mode=AutoresetMode.SAME_STEP)
        )

    def train_seed(
        self,
        env: gym.Env[Any, Any],
        seed: int,
        selection: Scale,
        fresh: Scale,
        report: ProgressCallback,
    ) -> RunSummary:
        """Train one agent and score its best checkpoint."""
        folder = self.folder / f"seed-{seed}"
        folder.mkdir(exist_ok=True)
        began_s = time.perf_counter()
        with closing(self.batch(self.config.envs)) as training_env:
            session = _Session(
                self, folder, seed, make_model(self.algo, self.config, training_env, seed)
            )
            session.learn(env, selection, report)
        score = evaluate(
            env,
            [load_policy(folder / BEST_NAME)],
            name=self.algo,
            episodes=self.config.final_episodes,
            seed=FRESH_SEED,
        )
        return RunSummary(
            folder=folder,
            seed=seed,
            steps=session.model.num_timesteps,
            seconds=time.perf_counter() - began_s,
            best_step=max(point.step for point in session.points if point.best),
            mean_return=score.mean_return,
            score=fresh.score(score.mean_return),
            ends=score.ends,
        )


class _Session:
    """One agent at work."""

    def __init__(self, run: _Run, folder: Path, seed: int, model: BaseAlgorithm) -> None:
        self.run = run
        self.folder = folder
        self.seed = seed
        self.model = model
        self.points: list[CurvePoint] = []

    def learn(self, env: gym.Env[Any, Any], scale: Scale, report: ProgressCallback) -> None:
        """Train to the end, evaluating on the way."""
        config = self.run.config
        spec_id = env.spec.id if env.spec else self.run.sim
        self._description = describe_run(
            self.run.algo,
            config.hidden,
            env.observation_space,
            env.action_space,
            spec_id,
            self.run.sim_options,
        )
        self.model.set_logger(configure(str(self.folder), ["csv", "tensorboard"]))
        with closing(self.run.batch(config.eval_episodes)) as eval_env:
            evaluation = Evaluation(
                self.model._wrap_env(eval_env, 0),
                interval=min(config.eval_interval, config.steps),
                training_envs=config.envs,
                scale=scale,
                on_new_best=self._keep_best,
                on_point=self._add_point,
            )
            callbacks: list[BaseCallback] = [
                evaluation,
                EveryInterval(LOG_INTERVAL, partial(self._report, report)),
            ]
            self.model.learn(config.steps, callback=callbacks, log_interval=sys.maxsize)
        self.model.logger.close()

    def _keep_best(self) -> None:
        save_policy(self.folder / BEST_NAME, self.model, self._description)

    def _add_point(self, point: CurvePoint) -> None:
        self.points.append(point)
        write_curve(self.folder / CURVE_NAME, self.points)
        self.model.logger.record("eval/score", point.score)
        self.model.logger.dump(point.step)

    def _report(self, report: ProgressCallback) -> None:
        self.model.dump_logs()
        score = self.points[-1].score if self.points else float("nan")
        report(
            TrainingProgress(
                self.seed, self.model.num_timesteps, self.run.config.steps, {"score": score}
            )
        )


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return None if math.isnan(value) else value

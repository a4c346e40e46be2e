"""Train one algorithm in one environment, with several seeds, into a run folder.

RUN/config.json                         algorithm, settings, environment
RUN/seed-0/best_model.zip               SB3's model file of the best checkpoint; see `policy`
RUN/seed-0/checkpoint.safetensors       to resume from; see `checkpoint`
RUN/seed-0/curve.csv                    evaluations while training; see `curve`
RUN/seed-0/evaluations/step-K.mcap      the episodes of each evaluation, if training is recorded
RUN/seed-0/progress.csv                 SB3's own scalars; the same for TensorBoard
RUN/seed-1/...
RUN/scores.json                         each seed's best checkpoint on fresh episodes
RUN/curve.png                           the curves of all seeds
RUN/foxglove-layout.json                for who watches, if it is shown while it trains
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym

from mcaprl.errors import OutputExistsError, TrainingError, UsageError
from mcaprl.files import write_json
from mcaprl.online.agent import Agent
from mcaprl.online.algorithms import check_spaces
from mcaprl.online.curve_picture import PICTURE_NAME, SCORES_NAME, curve_picture, read_run
from mcaprl.online.evaluation import FRESH_SEED, SELECTION_SEED, Scale, measure_scale
from mcaprl.online.live import LiveTraining
from mcaprl.online.policy import read_policy
from mcaprl.online.recording import log_paths
from mcaprl.online.task import CONFIG_NAME, Task, read_config
from mcaprl.progress import ProgressCallback, terminal_progress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.record.layout import LAYOUT_NAME
from mcaprl.runs import BEST_NAME
from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.evaluate import evaluate


@dataclass(frozen=True)
class RunSummary:
    """How the training of one seed ended.

    Attributes:
        folder: with the policy, RUN/seed-K.
        seed: K.
        steps: environment steps done in all.
        resumed_at: steps that an earlier session had done; 0 for a fresh start.
        seconds: wall time of this session.
        best_step: environment steps behind the best checkpoint.
        mean_return: of the best checkpoint over fresh episodes, by which nothing was chosen.
        score: the same where random is 0 and the pilot 1; NaN without a pilot.
        ends: those episodes by the reason they ended.
    """

    folder: Path
    seed: int
    steps: int
    resumed_at: int
    seconds: float
    best_step: int
    mean_return: float
    score: float
    ends: dict[str, int]


def train(
    task: Task,
    out: str | Path,
    *,
    seeds: int = 1,
    seed: int = 0,
    record: str | Path | None = None,
    data: Dataset | None = None,
    policy: Any = None,
    resume: bool = False,
    live: LiveTraining | None = None,
    progress: ProgressCallback | None = None,
) -> list[RunSummary]:
    """Train in an environment; the same seed and machine give the same curve.

    Args:
        task: such as `Task.for_sim("lane")`.
        out: the run's folder; it must not exist, or be empty.
        seeds: how many agents to train, one after the other.
        seed: of the first; the others count up from it.
        record: log of every transition, written while it happens; with several seeds a folder.
        data: logged transitions to begin the replay buffer with.
        policy: a trained one with Q-values, whose weights to begin with; of several, each seed
            takes another.
        resume: go on from the last checkpoints in `out`. What is not there yet starts afresh.
        live: shows the training to whoever connects; its layout is written into `out`.
        progress: called now and then; None shows a bar where stderr is a terminal.

    Returns:
        One summary for each seed.

    Raises:
        UnknownNameError: there is no such sim.
        OutputExistsError: `out` or `record` is taken.
        SpaceError: the algorithm cannot learn with these observations or actions.
        PolicyError: `policy` has another network than the agent.
        TrainingError: `out` cannot be written, or has a run of another task.
    """
    if seeds < 1 or seed < 0:
        raise UsageError(f"seeds must be at least 1 and seed at least 0, got {seeds} and {seed}")
    numbers = range(seed, seed + seeds)
    logs = log_paths(Path(record), numbers, resume) if record is not None else {}
    config = task.config
    with closing(make_sim(task.sim, **task.sim_options)) as env:
        check_spaces(task.algo, env.observation_space, env.action_space)
        run = _Run(Path(out), task, env, logs, data, policy, live, seed)
        run.open(resume)
        selection = measure_scale(env, episodes=config.eval_episodes, seed=SELECTION_SEED)
        fresh = measure_scale(env, episodes=config.final_episodes, seed=FRESH_SEED)
        shown = terminal_progress("steps", "score")
        with nullcontext(progress) if progress else shown as report:
            summaries = [
                run.train_seed(number, selection, fresh, report, resume) for number in numbers
            ]
    run.conclude(summaries, fresh)
    return summaries


@dataclass(frozen=True)
class _Run:
    """A run folder, and what every seed in it shares."""

    folder: Path
    task: Task
    env: gym.Env[Any, Any]
    logs: dict[int, Path]
    data: Dataset | None
    policy: Any
    live: LiveTraining | None
    first_seed: int

    def open(self, resume: bool) -> None:
        """Make the folder, or make sure that it is this run's."""
        self._open(resume)
        if self.live is not None:
            write_json(self.folder / LAYOUT_NAME, self.live.stream.layout())

    def _open(self, resume: bool) -> None:
        if resume and (self.folder / CONFIG_NAME).exists():
            self.task.check_same(read_config(self.folder), self.folder / CONFIG_NAME)
            return
        if self.folder.is_file() or (self.folder.is_dir() and any(self.folder.iterdir())):
            hint = "it holds no run to resume" if resume else "or resume the run in it (--resume)"
            raise OutputExistsError(f"{self.folder} exists: choose another folder; {hint}")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for path in self.logs.values():
                path.parent.mkdir(parents=True, exist_ok=True)
            write_json(self.folder / CONFIG_NAME, self.task.to_json())
        except OSError as error:
            raise TrainingError(f"cannot write {error.filename}: {error.strerror}") from error

    def train_seed(
        self, seed: int, selection: Scale, fresh: Scale, report: ProgressCallback, resume: bool
    ) -> RunSummary:
        """Train one agent and score its best checkpoint."""
        folder = self.folder / f"seed-{seed}"
        folder.mkdir(exist_ok=True)
        began_s = time.perf_counter()
        env_id = self.env.spec.id if self.env.spec else self.task.sim
        agent = Agent(
            self.task,
            env_id,
            folder,
            seed,
            selection,
            record=self.logs.get(seed),
            resume=resume,
            live=self.live,
        )
        with closing(agent):
            agent.start_from(self.data, self._policy_of(seed))
            agent.learn(report)
        score = evaluate(
            self.env,
            [read_policy(folder / BEST_NAME)],
            name=self.task.algo,
            episodes=self.task.config.final_episodes,
            seed=FRESH_SEED,
        )
        return RunSummary(
            folder=folder,
            seed=seed,
            steps=agent.model.num_timesteps,
            resumed_at=agent.resumed_at,
            seconds=time.perf_counter() - began_s,
            best_step=max(point.step for point in agent.points if point.best),
            mean_return=score.mean_return,
            score=fresh.score(score.mean_return),
            ends=score.ends,
        )

    def _policy_of(self, seed: int) -> Any:
        if not isinstance(self.policy, Sequence):
            return self.policy
        return self.policy[(seed - self.first_seed) % len(self.policy)]

    def conclude(self, summaries: Sequence[RunSummary], fresh: Scale) -> None:
        """Write the scores of all seeds, and their curves as a picture."""
        seeds = {
            summary.folder.name: {
                "best_step": summary.best_step,
                "mean_return": summary.mean_return,
                "score": summary.score,
                "ends": summary.ends,
            }
            for summary in summaries
        }
        scale = {"random": fresh.random, "pilot": fresh.pilot}
        written = {"episodes": self.task.config.final_episodes, "scale": scale, "seeds": seeds}
        write_json(self.folder / SCORES_NAME, written)
        if find_spec("matplotlib") is not None:
            title = f"{self.task.algo} in {self.task.sim}"
            curve_picture(self.folder / PICTURE_NAME, [read_run(self.folder)], title)

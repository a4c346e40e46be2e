"""Train one algorithm in one environment, with several seeds, into a run folder.

`mcaprl.runs` lists the files of a run folder; an online run also writes

    RUN/seed-K/evaluations/step-N.mcap      episodes of each evaluation, if training is recorded
    RUN/seed-K/progress.csv                 scalars, which TensorBoard files also contain
    RUN/scores.json                         score of each seed's best checkpoint on new episodes
    RUN/curve.png                           curves of all seeds
    RUN/foxglove-layout.json                layout for live viewers
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym

from mcaprl.errors import TrainingError, UsageError
from mcaprl.files import check_log_name, write_json
from mcaprl.online.agent import Agent
from mcaprl.online.curves import IMAGE_NAME, SCORES_NAME, draw_curves, read_run
from mcaprl.online.evaluation import FRESH_SEED, SELECTION_SEED, measure_scale
from mcaprl.online.live import LiveTraining
from mcaprl.online.recording import log_paths
from mcaprl.online.task import Task, check_spaces
from mcaprl.progress import ProgressCallback, terminal_progress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.record.layout import LAYOUT_NAME
from mcaprl.runs import (
    CHECKPOINT_NAME,
    CONFIG_NAME,
    RunSummary,
    choose_seeds,
    locked_run,
    open_run,
    run_to_resume,
    seed_folder,
    writing,
)
from mcaprl.sims.evaluation.evaluate import Scale, evaluate
from mcaprl.sims.evaluation.rollout import warn_of_cuts
from mcaprl.texts import counted

_SOURCES = "sources"
"""Key of `config.json`. Seeds without a checkpoint start from these paths when a run is resumed."""
_SEEDS = 2**32  # Number of seeds that Stable-Baselines3 accepts


@dataclass(frozen=True)
class OnlineSummary(RunSummary):
    """Outcome of training one seed online.

    Attributes:
        best_step: Number of environment steps before the best checkpoint.
        mean_return: Mean return of the best checkpoint on new episodes.
        score: Mean return on a scale with the random policy at 0 and the pilot at 1; NaN without a
            pilot.
        ends: Number of the new episodes that ended for each reason.
    """

    best_step: int
    mean_return: float
    score: float
    ends: dict[str, int]


def train(
    task: Task,
    out: str | Path,
    *,
    seeds: int | None = None,
    seed: int | None = None,
    record: str | Path | None = None,
    data: Dataset | None = None,
    policy: Any = None,
    sources: Sequence[str] = (),
    resume: bool = False,
    live: LiveTraining | None = None,
    progress: ProgressCallback | None = None,
) -> list[OnlineSummary]:
    """Train in an environment; the same seed and machine produce the same curve."""
    # The arguments, results and errors are those of `mcaprl.train_online`. `data` fills the replay
    # buffer; `policy` has weights for all agents, or one for each seed; `sources` are the paths of
    # both, for `sources_to_resume`.
    folder = Path(out)
    numbers = choose_seeds(folder, seeds, seed, resume)
    if numbers.stop > _SEEDS:
        raise UsageError(f"seed {numbers[-1]}: Stable-Baselines3 needs seeds below 2**32")
    if record is not None and len(numbers) == 1:
        check_log_name(record)
    logs = log_paths(Path(record), numbers, resume) if record is not None else {}
    config = task.config
    with locked_run(folder, resume), closing(task.evaluation_env()) as env:
        check_spaces(task.algo, env.observation_space, env.action_space)
        run = _Run(folder, task, env, logs, data, policy, list(sources), live, numbers)
        run.open(resume)
        bar = terminal_progress("steps", "score", "mean_return")
        with nullcontext(progress) if progress else bar as report:
            selection = measure_scale(env, episodes=config.eval_episodes, seed=SELECTION_SEED)
            fresh = measure_scale(env, episodes=config.final_episodes, seed=FRESH_SEED)
            summaries = [
                run.train_seed(number, selection, fresh, report, resume) for number in numbers
            ]
        run.conclude(summaries, fresh)
    return summaries


def sources_to_resume(folder: Path, seeds: range) -> list[str]:
    """Return the paths of the logs and the policy of seeds that have no checkpoint yet."""
    places = (folder / f"seed-{seed}" / CHECKPOINT_NAME for seed in seeds)
    return [] if all(path.exists() for path in places) else _sources_of(folder)


def _sources_of(folder: Path) -> list[str]:
    """Return the paths of the logs and the policy from which the agents of a run started."""
    found = run_to_resume(folder).get(_SOURCES, [])
    if not (isinstance(found, list) and all(isinstance(each, str) for each in found)):
        raise TrainingError(f"{folder / CONFIG_NAME}: {_SOURCES} is not a list of paths")
    return found


def make_agent(task: Task, *arguments: Any, **options: Any) -> Agent:
    """Create the agent of a task; the other arguments are those of `LearningAgent`."""
    if task.is_sb3:
        from mcaprl.online.sb3 import ModelAgent

        return ModelAgent(task, *arguments, **options)
    from mcaprl.online.learning import LearningAgent

    return LearningAgent(task, *arguments, **options)


@dataclass(frozen=True)
class _Run:
    """Run folder, and the state that all seeds share."""

    folder: Path
    task: Task
    env: gym.Env[Any, Any]
    logs: dict[int, Path]
    data: Dataset | None
    policy: Any
    sources: list[str]
    live: LiveTraining | None
    seeds: range

    def open(self, resume: bool) -> None:
        """Create the run folder, or check that it belongs to this run; create the log folders."""
        sources = self.sources or (_sources_of(self.folder) if resume else [])
        kept = {_SOURCES: sources} if sources else {}
        open_run(self.folder, self.task.identity, resume, self.seeds, **kept)
        for path in self.logs.values():
            with writing(path.parent):
                path.parent.mkdir(parents=True, exist_ok=True)
        if self.live is not None:
            write_json(self.folder / LAYOUT_NAME, self.live.stream.layout(), TrainingError)

    def train_seed(
        self, seed: int, selection: Scale, fresh: Scale, report: ProgressCallback, resume: bool
    ) -> OnlineSummary:
        """Train one agent and evaluate its best checkpoint."""
        folder = seed_folder(self.folder, seed)
        began_s = time.perf_counter()
        env_id = self.env.spec.id if self.env.spec else self.task.sim
        agent = make_agent(
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
        episodes = self.task.config.final_episodes
        agent.tell(report, f"evaluating the best checkpoint on {counted(episodes, 'new episode')}")
        score = evaluate(
            self.env,
            [agent.best_policy()],
            name=self.task.algo,
            episodes=episodes,
            seed=FRESH_SEED,
        )
        warn_of_cuts(itertools.chain(*score.results), str(folder), self.task.sim)
        return OnlineSummary(
            folder=folder,
            algo=self.task.algo,
            seed=seed,
            steps=agent.steps,
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
        return self.policy[self.seeds.index(seed) % len(self.policy)]

    def conclude(self, summaries: Sequence[OnlineSummary], fresh: Scale) -> None:
        """Write the scores of all seeds, and the image of their curves."""
        write_scores(self.folder, summaries, fresh, self.task.config.final_episodes)
        if find_spec("matplotlib") is not None:
            title = f"{self.task.algo} in {self.task.sim}"
            draw_curves(self.folder / IMAGE_NAME, [read_run(self.folder)], title)


def write_scores(
    folder: Path, summaries: Sequence[OnlineSummary], scale: Scale, episodes: int
) -> None:
    """Write the scores of all seeds on new episodes into a run folder."""
    seeds = {
        summary.folder.name: {
            "best_step": summary.best_step,
            "mean_return": summary.mean_return,
            "score": summary.score,
            "ends": summary.ends,
        }
        for summary in summaries
    }
    ends = {"random": scale.random, "pilot": scale.pilot}
    written = {"episodes": episodes, "scale": ends, "seeds": seeds}
    write_json(folder / SCORES_NAME, written, TrainingError)

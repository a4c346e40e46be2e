"""Double DQN in which sims, replay buffer and networks of all seeds stay on one device.

The loop is that of `mcaprl.online`, with all seeds at once. Each seed has its own environments and
transitions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, nullcontext
from pathlib import Path
from typing import Any, Final

import torch

from mcaprl.errors import TrainingError, UsageError
from mcaprl.offline.algorithms.learner import NotFiniteError
from mcaprl.offline.batches.buffer import choose_device
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.offline.policy import read_policy, save_policy
from mcaprl.offline.training.metrics import MetricsWriter
from mcaprl.online.collector import DeviceEnvironments
from mcaprl.online.config import DoubleDQNConfig
from mcaprl.online.engine import Agents
from mcaprl.online.evaluation import FRESH_SEED, measure_scale
from mcaprl.online.task import Task
from mcaprl.online.train import OnlineSummary, write_scores
from mcaprl.progress import ProgressCallback, TrainingProgress, terminal_progress
from mcaprl.runs import locked_run, open_run, seed_folder
from mcaprl.sims import DeviceSims, make_device_sims
from mcaprl.sims.evaluation.evaluate import Scale, evaluate
from mcaprl.texts import counted

SETTINGS: Final[dict[str, Any]] = {
    "envs": 2_048,
    "steps": 8_388_608,
    "steps_per_update": 128,
    "batch_size": 512,
    "buffer_size": 524_288,
    "learning_starts": 65_536,
    "target_update_interval": 65_536,
}
"""Settings that replace those of `SIM_SETTINGS`; steps are those of one seed."""
_UNUSED: Final = (
    "alpha",
    "center_images",
    "channels",
    "checkpoint_interval",
    "encoder",
    "eval_episodes",
    "eval_interval",
    "exploration_decay",
    "frame_stack",
    "image_shift",
    "target_update_episodes",
)
"""Settings that this training does not use."""
_ROWS: Final = 100  # Number of rows of metrics
_ROWS_PER_SAVE: Final = 10
"""Number of rows of metrics between two times that the policies are saved."""


def device_task(sim: str, sim_options: Mapping[str, Any] | None = None, **settings: Any) -> Task:
    """Return a task with the settings of the sim and this module, except those given."""
    for name in settings:
        if name in _UNUSED:
            raise UsageError(f"`{name}=` has no effect with `device=`: omit it")
    return Task.for_sim(sim, "double-dqn", sim_options, **{**SETTINGS, **settings})


def train(
    task: Task,
    out: str | Path,
    *,
    device: str,
    seeds: int = 1,
    seed: int = 0,
    progress: ProgressCallback | None = None,
) -> list[OnlineSummary]:
    """Train K agents at once, and score their last policies on new episodes."""
    # The run folder contains the policy and metrics of each seed, as of offline runs, and
    # `scores.json`; nothing is recorded. Agent k has initial weights of seed + k; starts,
    # exploration and batches depend on `seed` and the number of agents.
    place = choose_device(device)
    folder = Path(out)
    config = task.config
    assert isinstance(config, DoubleDQNConfig)
    sims = make_device_sims(
        task.sim, seeds * config.envs, device=device, seed=seed, **task.sim_options
    )
    with locked_run(folder, False), closing(task.evaluation_env()) as env:
        numbers = range(seed, seed + seeds)
        open_run(folder, task.identity, False, numbers, device=device)
        agents = make_agents(sims, config, numbers, place)
        began_s = time.perf_counter()
        env_id = env.spec.id if env.spec else task.sim

        def save() -> None:
            for number in agents.learner.seeds:
                mine = seed_folder(folder, number)
                save_policy(mine, agents.learner, number, env_id, task.sim_options)

        bar = terminal_progress("steps", "mean_reward")
        with nullcontext(progress) if progress else bar as report:
            with fast_products():
                _train(agents, folder, report, save)
            seconds = time.perf_counter() - began_s
            activity = f"evaluating on {counted(config.final_episodes, 'new episode')}"
            report(TrainingProgress(numbers[-1], agents.steps, config.steps, {}, activity))
            scale = measure_scale(env, episodes=config.final_episodes, seed=FRESH_SEED)
            summaries = [
                _summary(
                    env, task, seed_folder(folder, number), number, agents.steps, seconds, scale
                )
                for number in numbers
            ]
        write_scores(folder, summaries, scale, config.final_episodes)
    return summaries


@contextmanager
def fast_products() -> Iterator[None]:
    """Context manager that allows matrix products on GPUs in TF32, which are faster."""
    before = torch.get_float32_matmul_precision()
    if torch.cuda.is_available():
        torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def make_agents(
    sims: DeviceSims, config: DoubleDQNConfig, seeds: range, device: torch.device
) -> Agents:
    """Create agents with new weights, and start their environments."""
    encoder = ObservationEncoder(sims.single_observation_space, int(sims.single_action_space.n))
    agents = Agents(config, encoder, sims.single_action_space, seeds, device)
    agents.connect(DeviceEnvironments(sims, device))
    agents.collector.begin(seeds[0])
    return agents


def _train(
    agents: Agents, folder: Path, report: ProgressCallback, save: Callable[[], None]
) -> None:
    """Train until all steps are done; write `_ROWS` rows of metrics, and save the policies."""
    learner, config = agents.learner, agents.config
    seeds, row = learner.seeds, 0
    with ExitStack() as stack:
        writers = [
            stack.enter_context(closing(MetricsWriter(seed_folder(folder, seed), 1)))
            for seed in seeds
        ]
        while agents.steps < config.steps:
            row += 1
            try:
                means = _rewards_until(agents, config.steps * row // _ROWS)
            except NotFiniteError as error:
                raise TrainingError(
                    f"update {error.update} of {folder}: {error}; lower the learning rate"
                ) from error
            rate = agents.learning_rate
            for seed, writer, mean in zip(seeds, writers, means, strict=True):
                values = {"mean_reward": mean, "epsilon": agents.epsilon, "steps": agents.steps}
                writer.write(learner.step, rate, values)
                report(TrainingProgress(seed, agents.steps, config.steps, values))
            if row % _ROWS_PER_SAVE == 0 or agents.steps >= config.steps:
                save()


def _rewards_until(agents: Agents, stop: int) -> list[float]:
    """Step each environment at least once, until `stop`; return each agent's mean reward."""
    rewards, count = agents.step().rewards.clone(), 1
    while agents.steps < stop:
        rewards += agents.step().rewards
        count += 1
    means: list[float] = (rewards / count).view(len(agents.learner.seeds), -1).mean(1).tolist()
    return means


def _summary(
    env: Any, task: Task, folder: Path, seed: int, steps: int, seconds: float, scale: Scale
) -> OnlineSummary:
    """Score the saved policy of a seed on new episodes."""
    score = evaluate(
        env,
        [read_policy(folder)],
        name=task.algo,
        episodes=task.config.final_episodes,
        seed=FRESH_SEED,
    )
    return OnlineSummary(
        folder=folder,
        algo=task.algo,
        seed=seed,
        steps=steps,
        resumed_at=0,
        seconds=seconds,
        best_step=steps,
        mean_return=score.mean_return,
        score=scale.score(score.mean_return),
        ends=score.ends,
    )

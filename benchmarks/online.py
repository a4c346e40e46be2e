"""What recording costs beside learning: `python -m benchmarks.online`.

The same training runs with and without a log, in turns, by CPU time; the best of several counts.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from contextlib import closing
from pathlib import Path

import torch

from mcaprl.online.agent import Agent
from mcaprl.online.evaluation import Scale
from mcaprl.online.task import Task
from mcaprl.progress import TrainingProgress


def training_s(task: Task, folder: Path, *, recorded: bool) -> float:
    """CPU seconds of a training, its one evaluation included."""
    folder.mkdir()
    path = folder / "log.mcap" if recorded else None
    agent = Agent(task, "mcaprl/LaneKeeping-v0", folder, 0, Scale(0.0, 1.0), record=path)
    with closing(agent):
        began_s = time.process_time()
        agent.learn(_silent)
        return time.process_time() - began_s


def _silent(_: TrainingProgress) -> None:
    """Show nothing."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    steps = arguments.steps
    task = Task.for_sim(
        "lane", steps=steps, eval_interval=steps, eval_episodes=1, checkpoint_interval=2 * steps
    )
    best = {True: float("inf"), False: float("inf")}
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(arguments.rounds):
            for recorded in best:
                taken_s = training_s(task, Path(folder) / f"{turn}-{recorded}", recorded=recorded)
                best[recorded] = min(best[recorded], taken_s)
    added = best[True] / best[False] - 1
    print(
        f"lane, {steps} steps of Double DQN: recording adds {added:.1%} of the training's CPU time"
    )


if __name__ == "__main__":
    main()

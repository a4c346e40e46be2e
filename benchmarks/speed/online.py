"""Measure what recording and the live view add to a training: `python -m benchmarks.speed.online`.

The same training runs in turns: alone, with a log, and with a viewer (Node, see tests/node). The
measure is the CPU time of all threads of the training, the best of several turns. By default, the
training is the complete training of the lane sim with its default settings. `--steps` shortens the
training. Recording then takes a larger share of the time: the first episodes have only about twenty
steps, and an episode is written when it ends.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from contextlib import closing, nullcontext
from pathlib import Path

import torch

from mcaprl.online import SIM_SETTINGS, LearningAgent, LiveTraining, Task
from mcaprl.progress import TrainingProgress
from mcaprl.sims import Scale

KINDS = ("plain", "recorded", "watched")
_VIEWER = Path(__file__).parent.parent.parent / "tests" / "node" / "watch.mjs"


def training_s(task: Task, folder: Path, kind: str) -> tuple[float, int]:
    """Return the CPU seconds of a training, and the number of frames that the viewer received."""
    folder.mkdir()
    path = folder / "log.mcap" if kind == "recorded" else None
    shown = LiveTraining(task, port=0) if kind == "watched" else nullcontext()
    with closing(shown) if isinstance(shown, LiveTraining) else shown as live:
        viewer = _viewer(live.stream.url) if live is not None else None
        scale = Scale(0.0, 1.0)
        agent = LearningAgent(
            task, "mcaprl/LaneKeeping-v0", folder, 0, scale, record=path, live=live
        )
        with closing(agent):
            began_s = time.process_time()
            agent.learn(_silent)
            taken_s = time.process_time() - began_s
    return taken_s, 0 if viewer is None else viewer.communicate()[0].count('"/rl/step","time"')


def _viewer(url: str) -> subprocess.Popen[str]:
    """Start a viewer that subscribes to all topics."""
    viewer = subprocess.Popen(["node", str(_VIEWER), url], stdout=subprocess.PIPE, text=True)
    assert viewer.stdout is not None
    viewer.stdout.readline()
    return viewer


def _silent(_: TrainingProgress) -> None:
    """Show nothing."""


def main() -> None:
    """Measure the trainings, and print what recording and a viewer add."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=SIM_SETTINGS["lane"]["steps"])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    steps = arguments.steps
    task = Task.for_sim(
        "lane", steps=steps, eval_interval=steps, eval_episodes=1, checkpoint_interval=2 * steps
    )
    best = dict.fromkeys(arguments.kinds, float("inf"))
    frames = 0
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(arguments.rounds):
            for kind in best:
                taken_s, seen = training_s(task, Path(folder) / f"{turn}-{kind}", kind)
                best[kind], frames = min(best[kind], taken_s), max(frames, seen)
                print(f"{kind}: {taken_s:.1f} s", file=sys.stderr, flush=True)
    print(f"lane, {steps} steps of Double DQN, relative to the training's CPU time:")
    if "recorded" in best:
        print(f"  recording adds {best['recorded'] / best['plain'] - 1:.1%}")
    if "watched" in best:
        added = best["watched"] / best["plain"] - 1
        print(f"  a viewer adds {added:.1%}, with {frames} frames")


if __name__ == "__main__":
    main()

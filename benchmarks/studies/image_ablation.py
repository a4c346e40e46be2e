"""Measure which settings matter for learning online from depth images.

    python -m benchmarks.studies.image_ablation FOLDER --sim powerline --steps 80000
    python -m benchmarks.studies.image_ablation FOLDER --sim lane --observation dashboard

Each variant differs from the sim's default settings in one respect. Every seed of every variant is
trained and then evaluated on fresh episodes. The table has the mean score over seeds (random 0,
pilot 1) with its range, the mean difference from the default of the same seeds with its standard
error, and the CPU time of the training. Finished seeds are kept in `image_ablation.json` beside
this file and are not repeated. Thus two processes with different `--seeds` can share the work.
"""

from __future__ import annotations

import argparse
import json
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from mcaprl.files import write_json
from mcaprl.online import FRESH_SEED, SELECTION_SEED, LearningAgent, Task, measure_scale
from mcaprl.sims import Scale, evaluate, make_sim

MIRRORED: Final = "half of each batch mirrored"
VARIANTS: Final[dict[str, dict[str, Any]]] = {
    "default": {},
    "nature encoder": {"encoder": "nature"},
    "images not centered": {"center_images": False},
    "a quarter of the updates": {"steps_per_update": 16},
    "dueling": {"dueling": True},
    "not dueling": {"dueling": False},
    "layer norm": {"layer_norm": True},
    "no layer norm": {"layer_norm": False},
    "target network every 1,000 steps": {"target_update_interval": 1_000},
    "target network every 8,000 steps": {"target_update_interval": 8_000},
    "n-step 1": {"n_steps": 1},
    "n-step 3": {"n_steps": 3},
    MIRRORED: {},
}
RESULTS: Final = Path(__file__).with_suffix(".json")
Result = dict[str, Any]
LANE_MIRROR: Final = (0, 1, 3, 2, 5, 4)
"""Mirror image of each action of the lane sim."""


class MirroredBuffer:
    """Replay buffer that mirrors every second transition of the lane sim from left to right."""

    def __init__(self, buffer: Any) -> None:
        """Wrap a buffer."""
        self._buffer = buffer

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the buffer."""
        return getattr(self._buffer, name)

    def batch(self, rows: torch.Tensor) -> Any:
        """Return transitions; rows 0, 2, 4, ... are mirrored."""
        batch = self._buffer.batch(rows)
        actions = batch.actions.clone()
        actions[::2] = torch.tensor(LANE_MIRROR)[actions[::2]]
        for observations in (batch.observations, batch.next_observations):
            for image in observations.images:
                image[::2] = image[::2].flip(2)
            # The numbers are speed, steering angle and direction of the next turn.
            observations.vector[::2, 1:] *= -1
        return replace(batch, actions=actions)


def differs(variant: str, task: Task, default: Task) -> bool:
    """Return whether to run a variant.

    Besides the default, only variants that change the training of this task are run.
    """
    if variant == MIRRORED:
        return task.sim == "lane"
    return variant == "default" or task.config != default.config


def run(variant: str, task: Task, seed: int, folder: Path, scales: tuple[Scale, Scale]) -> Result:
    """Train a seed into a folder, and evaluate it."""
    folder.mkdir(parents=True, exist_ok=True)
    began_s = time.process_time()
    with closing(LearningAgent(task, task.sim, folder, seed, scales[0])) as agent:
        if variant == MIRRORED:
            buffer: Any = MirroredBuffer(agent.agents.buffer)
            agent.agents.learner.buffer = buffer
        agent.learn(lambda _: None)
        points = [(point.step, point.score) for point in agent.points]
    seconds = time.process_time() - began_s
    with closing(make_sim(task.sim, **task.sim_options)) as env:
        score = evaluate(env, [agent.best_policy()], name="", episodes=100, seed=FRESH_SEED)
    fresh = scales[1].score(score.mean_return)
    return {"score": fresh, "curve": points, "cpu_minutes": seconds / 60, "ends": score.ends}


def read_results() -> dict[str, dict[str, dict[str, Result]]]:
    """Return the result of each seed of each variant of each task."""
    found: dict[str, dict[str, dict[str, Result]]] = json.loads(RESULTS.read_text())
    return found


def show(task: str) -> None:
    """Print a table with a row for each variant, the best first."""
    results = read_results()[task]
    rows = []
    for variant, seeds in results.items():
        scores = np.array([each["score"] for each in seeds.values()])
        default = results.get("default", {})
        changes = [each["score"] - default[k]["score"] for k, each in seeds.items() if k in default]
        change = "" if variant == "default" or not changes else f"{np.mean(changes):+.2f}"
        if change and len(changes) > 1:
            change += f" ({np.std(changes, ddof=1) / np.sqrt(len(changes)):.2f})"
        minutes = np.mean([each["cpu_minutes"] for each in seeds.values()])
        spread = f"{scores.min():.2f} to {scores.max():.2f}"
        row = (variant, f"{scores.mean():.2f}", spread, change, len(scores), f"{minutes:.1f}")
        rows.append((scores.mean(), f"| {' | '.join(map(str, row))} |"))
    print("| variant | mean score | range over seeds | change | seeds | CPU minutes per seed |")
    print("|---|---|---|---|---|---|")
    for _, text in sorted(rows, reverse=True):
        print(text)


def main() -> None:
    """Run the variants, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sim", default="powerline", choices=("powerline", "lane"))
    parser.add_argument("--observation", default="depth")
    parser.add_argument("--steps", type=int, default=80_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    given = parser.parse_args()
    torch.set_num_threads(1)
    options = {"observation": given.observation}
    name = f"{given.sim} {given.observation} {given.steps}"
    default = Task.for_sim(given.sim, None, options, steps=given.steps)
    with closing(make_sim(given.sim, **options)) as env:
        selection = measure_scale(env, episodes=default.config.eval_episodes, seed=SELECTION_SEED)
        fresh = measure_scale(env, episodes=100, seed=FRESH_SEED)
    for seed in given.seeds:
        for variant in given.variants:
            settings = {**VARIANTS[variant], "steps": given.steps}
            task = Task.for_sim(given.sim, None, options, **settings)
            finished = read_results().get(name, {}).get(variant, {})
            if differs(variant, task, default) and str(seed) not in finished:
                place = given.folder / name / variant / f"seed-{seed}"
                result = run(variant, task, seed, place, (selection, fresh))
                results = read_results()
                results.setdefault(name, {}).setdefault(variant, {})[str(seed)] = result
                write_json(RESULTS, results)
    show(name)


if __name__ == "__main__":
    main()

"""Train learners on the logs of the suite, score them, and write docs/benchmark.md.

    python -m benchmarks.suite                                         # missing cells of `tests`
    python -m benchmarks.suite --tier study --task lane --algo iql cql
    python -m benchmarks.suite --task CartPole --kind replay --algo my-algorithm
    python -m benchmarks.suite --task CartPole --kind replay --policies runs/mine

A cell is a learner on a log: all its seeds are trained with the same number of updates and the same
batches as those of other learners, and the networks after the last update are scored over 20
episodes, the same for all. benchmarks/suite/results has one file for each finished cell, so an
interrupted run continues. `--algo` accepts the algorithms of mcaprl and of installed packages,
`auto`, and d3rlpy's with the prefix `d3rlpy-`; `--policies` scores a run folder, whose training is
not part of the cell.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.suite import page
from benchmarks.suite.learners import RIVAL, is_box, learners_of, settings_of, train
from benchmarks.suite.tasks import TASKS, make_log, scale, score
from mcaprl.api import load_policies
from mcaprl.files import write_json

TIERS = ("tests", "study", "release")


def main() -> None:
    """Compute the requested missing cells, and write the page."""
    given = _parser().parse_args()
    torch.set_num_threads(1)
    tiers = [given.tier] if given.tier else TIERS if given.task else TIERS[:1]
    for tier in tiers:
        began_s, done = time.perf_counter(), 0
        for name, task in TASKS.items():
            if task.tier != tier or name not in (given.task or TASKS):
                continue
            if not task.is_installed:
                print(f"{name}: skipped, {task.needs} is not installed", flush=True)
                continue
            done += _run_task(name, given)
        if done:
            minutes = (time.perf_counter() - began_s) / 60
            print(f"tier {tier}: {done} cells in {minutes:.1f} minutes", flush=True)
    if not given.no_page:
        page.write(page.read_cells())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.suite")
    parser.add_argument("--tier", choices=TIERS, help="default: tests")
    parser.add_argument("--task", nargs="+", choices=TASKS)
    parser.add_argument("--kind", nargs="+", help="kinds of logs; default: all")
    parser.add_argument("--algo", nargs="+", help="learners; default: all that fit the task")
    parser.add_argument("--policies", type=Path, help="run folder to score instead of training")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--folder", type=Path, default=Path(".venv/suite"), help="logs and runs")
    parser.add_argument("--no-page", action="store_true", help="leave docs/benchmark.md unchanged")
    return parser


def _run_task(name: str, given: argparse.Namespace) -> int:
    """Compute the missing cells of a task; return their number."""
    task, done = TASKS[name], 0
    has_rivals = importlib.util.find_spec("d3rlpy") is not None
    for kind in given.kind or task.default_kinds:
        learners = given.algo or learners_of(task, with_rivals=has_rivals)
        if given.policies:
            learners = [f"policies {given.policies.name}"]
        for learner in learners:
            path = page.cell_path(name, kind, learner)
            if path.exists() and not given.policies:
                continue
            cell = _cell(name, kind, learner, given)
            if not given.policies:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_json(path, cell)
            shown = " ".join(f"{each:.2f}" for each in cell["scores"])
            print(f"{name}, {kind}, {learner}: {shown}; {cell['cpu_s']:.0f} s", flush=True)
            done += 1
    return done


def _cell(name: str, kind: str, learner: str, given: argparse.Namespace) -> dict[str, Any]:
    """Train and score the seeds of a learner on a log."""
    task = TASKS[name]
    data = make_log(name, kind, given.folder / "logs")
    if given.policies:
        policies, cpu_s = load_policies(given.policies), 0.0
    else:
        run = given.folder / "runs" / name / f"{kind}-{learner}"
        policies, cpu_s = train(task, data, learner, given.seeds, run)
    first, second = scale(name)
    returns = score(name, policies).returns
    is_rival = learner.startswith(RIVAL)
    return {
        "tier": task.tier,
        "task": name,
        "kind": kind,
        "learner": learner,
        "box": is_box(task),
        "settings": settings_of(task, learner.removeprefix(RIVAL)),
        "behavior": (data.statistics.mean_return - first) / (second - first),
        "scores": ((returns.mean(axis=1) - first) / (second - first)).tolist(),
        "returns": np.round(returns, 3).tolist(),
        "cpu_s": round(cpu_s, 1),
        "episodes_to_choose": 0,
        "versions": {
            package: importlib.metadata.version(package)
            for package in ("torch", "gymnasium", *(["d3rlpy"] if is_rival else ["mcaprl"]))
        },
    }


if __name__ == "__main__":
    main()

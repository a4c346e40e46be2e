"""Measure how well `auto` chooses a policy for Box actions, on logs that were not used to build it.

    python -m benchmarks.studies.box_selection FOLDER [--logs "lane, low noise;Pendulum, weak"]

The logs have other seeds, noise, mixtures, sizes and actions than those of `box_grid`, on which the
rule of `auto` was built. `auto` trains its portfolio on each log, with one seed and all candidates
as finalists, and chooses one policy by the log alone. The policies of all candidates are then
scored in the sim: the mean return over 30 episodes, normalized so that random is 0 and the pilot
is 1. The regret of a choice is the score of the best of these policies minus that of the chosen
one. FOLDER/results.json has each finished log, and a run of `auto` resumes, so an interrupted study
continues. After each log, the tables are written to docs/results.md.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

import mcaprl
from benchmarks.page import write_section
from benchmarks.studies.box_grid import SETTINGS
from benchmarks.studies.pendulum_data import PILOT, RANDOM, pendulum, returns_of
from benchmarks.studies.selection import regret_rows
from benchmarks.studies.sim_grid import run
from mcaprl.api import load_policies
from mcaprl.files import write_json
from mcaprl.sims import Policy, make_pilot, make_sim

Result = dict[str, Any]
SHARED: Final[dict[str, Any]] = {
    "updates": 3_000,
    "batch_size": 64,
    "log_interval": 500,
    "model_updates": 1_000,
    "finalists": "all",
    "survivors": 5,
}
"""Settings of `auto`: smaller batches than the default, and all candidates are finalists."""
MEDIUM_UPDATES = 300
"""Updates of the policy of a medium log."""
PENDULUM: Final = "Pendulum"


@dataclass(frozen=True)
class Kind:
    """Kind of a log.

    Attributes:
        sim: Name of the sim, or PENDULUM.
        parts: Behaviors of equal parts of the log, as arguments of `mcaprl.record`; for PENDULUM,
            the `kind` of `pendulum`.
        steps: Number of transitions.
        actions: Actions of the sim.
    """

    sim: str
    parts: tuple[dict[str, Any], ...]
    steps: int = 20_000
    actions: str = "continuous"


MEDIUM: Final[dict[str, Any]] = {"policy": "medium"}
LOGS: Final[dict[str, Kind]] = {
    "lane, low noise": Kind("lane", ({"noise": 0.05},)),
    "racer, half random": Kind("racer", ({"epsilon": 0.5},)),
    "powerline, increments": Kind("powerline", ({"noise": 0.2},), actions="increments"),
    "Pendulum, weak": Kind(PENDULUM, ({"kind": (0.5, 0.5)},)),
    "lane, drawn noise": Kind("lane", ({"noise": 0.2, "noise_per_episode": True},)),
    "racer, drawn noise": Kind("racer", ({"noise": 0.6, "noise_per_episode": True},)),
    "powerline, drawn noise": Kind("powerline", ({"noise": 0.2, "noise_per_episode": True},)),
    "lane, medium": Kind("lane", ({**MEDIUM, "noise": 0.1},)),
    "racer, short": Kind("racer", ({"noise": 0.3}, {"policy": "random"}), steps=8_000),
    "Pendulum, short": Kind(PENDULUM, ({"kind": (-1.0, 0.1)},), steps=8_000),
    "lane, half random": Kind("lane", ({"epsilon": 0.5},)),
    "powerline, increments, half random": Kind(
        "powerline", ({"epsilon": 0.5},), actions="increments"
    ),
    "racer, medium": Kind("racer", ({**MEDIUM, "noise": 0.3},)),
    "lane, short": Kind("lane", ({"noise": 0.1}, {"policy": "random"}), steps=8_000),
}
"""Logs in the order of the study."""


def main() -> None:
    """Measure the missing logs, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--logs", default=";".join(LOGS), help="names, separated by semicolons")
    given = parser.parse_args()
    torch.set_num_threads(1)
    path = given.folder / "results.json"
    for name in given.logs.split(";"):
        found: dict[str, Result] = json.loads(path.read_text()) if path.exists() else {}
        if name not in found:
            found[name] = measure(given.folder, name)
            write_json(path, found)
            print(name, found[name]["scores"], found[name]["choice"]["reason"], flush=True)
        write_section("box-selection", tables(found))


def measure(folder: Path, name: str) -> Result:
    """Record a log, let `auto` choose, and score all candidates."""
    kind = LOGS[name]
    here = folder / name.replace(", ", "-").replace(" ", "-")
    data = make_log(here, kind, seed=1_000 + list(LOGS).index(name))
    policies = choose(data, here / "run", SETTINGS.get(kind.sim, {"gamma": 0.98}))
    choice = json.loads((here / "run" / "choice.json").read_text())
    low, high = references(kind)
    means = [data.statistics.mean_return, *mean_returns(kind, list(policies.values()))]
    behavior, *scores = ((mean - low) / (high - low) for mean in means)
    found = dict(zip(policies, scores, strict=True))
    return {"behavior": behavior, "scores": found, "choice": choice}


def choose(data: mcaprl.Dataset, out: Path, settings: dict[str, Any]) -> dict[str, Policy]:
    """Let `auto` train its portfolio and choose; return the policies of all candidates."""
    if not (out / "choice.json").exists():
        mcaprl.train(
            data,
            out,
            algo="auto",
            resume=out.exists(),
            **SHARED,
            **settings,
        )
    return {path.name: load_policies(path)[0] for path in sorted(out.glob("candidates/*"))}


def make_log(folder: Path, kind: Kind, seed: int) -> mcaprl.Dataset:
    """Record a log, unless the folder has it."""
    if kind.sim == PENDULUM:
        return pendulum(episodes=kind.steps // 200, seed=seed, **kind.parts[0])
    part, log = folder / "log.part", folder / "log"
    if not log.exists():
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        for number, behavior in enumerate(kind.parts):
            policy = behavior.get("policy", "pilot")
            mcaprl.record(
                kind.sim,
                part / f"{number}.mcap",
                steps=kind.steps // len(kind.parts),
                seed=10 * seed + number,
                scene=False,
                actions=kind.actions,
                **{**behavior, "policy": medium(folder, kind) if policy == "medium" else policy},
            )
        part.rename(log)
    return mcaprl.open(log)


def medium(folder: Path, kind: Kind) -> Policy:
    """Return an early checkpoint of a clone of the noisy pilot."""
    log, out = folder / "noisy.mcap", folder / "medium"
    shutil.rmtree(out, ignore_errors=True)
    mcaprl.record(
        kind.sim, log, noise=0.1, steps=5_000, actions=kind.actions, scene=False, overwrite=True
    )
    mcaprl.train(log, out, algo="bc", updates=MEDIUM_UPDATES)
    policy: Policy = load_policies(out)[0]
    return policy


def mean_returns(kind: Kind, policies: Sequence[Policy | None]) -> list[float]:
    """Return the mean return of each policy; None is the random policy of a sim."""
    if kind.sim == PENDULUM:
        return [float(np.mean(returns_of(policy))) for policy in policies]
    found = run(kind.sim, policies, actions=kind.actions).returns
    return [float(mine.mean()) for mine in found]


def references(kind: Kind) -> tuple[float, float]:
    """Return the mean returns of the random policy and of the pilot, whose scores are 0 and 1."""
    if kind.sim == PENDULUM:
        return RANDOM, PILOT
    with closing(make_sim(kind.sim, actions=kind.actions)) as env:
        pilot = run(kind.sim, [make_pilot(env)], env, actions=kind.actions)
    return mean_returns(kind, [None])[0], pilot.mean_return


def tables(found: dict[str, Result]) -> str:
    """Return the scores and choices on all logs, and the regrets of the rules, as Markdown."""
    names = list(found[next(iter(found))]["scores"])
    lines = [
        f"| log (behavior) | {' | '.join(names)} | chosen | by |",
        "|---|" + "---|" * (len(names) + 2),
    ]
    regrets: dict[str, list[float]] = {}
    for log, result in found.items():
        scores, chosen, rule = result["scores"], *(result["choice"][k] for k in ("chosen", "rule"))
        cells = [f"{scores[name]:.2f}" for name in names]
        lines.append(
            f"| {log} ({result['behavior']:.2f}) | {' | '.join(cells)} | {chosen} | {rule} |"
        )
        best = max(scores.values())
        regrets.setdefault("auto", []).append(best - scores[chosen])
        for name in names:
            regrets.setdefault(f"always {name}", []).append(best - scores[name])
    rows = regret_rows({name: np.array(each) for name, each in regrets.items()})
    header = "| rule | mean regret | largest | on each log |\n|---|---|---|---|"
    return "\n".join([*lines, "", header, rows])


if __name__ == "__main__":
    main()

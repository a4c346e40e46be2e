"""Train the algorithms for Box actions on five logs of each sim with continuous actions.

    python -m benchmarks.studies.box_grid FOLDER [--sims lane,racer] [--data mixed] [--algos iql;bc]

The logs have about 20,000 transitions each:

    expert   the sim's pilot, without noise
    noisy    the pilot with Gaussian noise
    mixed    in equal parts: the pilot with a deviation that is drawn per episode, up to NOISE and
             up to three times as much; the pilot with 30 % random commands; random commands
    replay   all transitions of the online training of an agent without data (SAC of SB3)
    random   random commands

Each algorithm makes 5,000 updates with four seeds and its default settings except for the discount,
which is the same for all logs of a sim. The networks after the last update are scored, without
selection by scores in the sim. A score is the mean return over 30 episodes of each seed, normalized
so that random is 0 and the continuous pilot is 1, with a 95 % bootstrap interval over seeds and
episodes. FOLDER/SIM/box-scores.json has each finished cell, so an interrupted run resumes. After
each sim, the tables are written to docs/results.md, with a dash for each missing cell.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import torch

import mcaprl
from benchmarks.page import write_section
from benchmarks.studies.sim_grid import (
    SEEDS,
    Cell,
    cell_of,
    normalize_mean,
    read_cells,
    run,
    table,
)
from mcaprl.api import load_policies
from mcaprl.files import write_json
from mcaprl.sims import PolicyScore, make_pilot, make_sim

STEPS = 20_000
NAMES: Final = ("expert", "noisy", "mixed", "replay", "random")
NOISE: Final = {"lane": 0.1, "powerline": 0.1, "racer": 0.3}
"""Standard deviation of the noise by sim; .3 ends almost every episode of car and drone."""
SETTINGS: Final[dict[str, dict[str, Any]]] = {
    "lane": {"gamma": 0.97},
    "powerline": {"gamma": 0.97},
    "racer": {"gamma": 0.98},
}
ALGOS: Final[dict[str, dict[str, Any]]] = {
    "bc": {"algo": "bc"},
    "bc, best tenth": {"algo": "bc", "top": 0.1},
    "td3-bc": {"algo": "td3-bc"},
    "rebrac": {"algo": "rebrac"},
    "iql": {"algo": "iql"},
}
"""Algorithm and settings that differ from its defaults, by column."""
BOX: Final = {"actions": "continuous"}


def main() -> None:
    """Compute the requested missing cells, and write the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sims", default=",".join(NOISE))
    parser.add_argument("--data", default=",".join(NAMES))
    parser.add_argument("--algos", default=";".join(ALGOS), help="columns, separated by semicolons")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for sim in arguments.sims.split(","):
        folder = arguments.folder / sim
        names = arguments.data.split(",")
        for name in names:
            if not (folder / name).exists():
                make_log(folder, sim, name)
        _fill(folder, sim, names, arguments.algos.split(";"))
        found = {each: read_cells(arguments.folder / each / "box-scores.json") for each in NOISE}
        tables = [table(each, found[each], NAMES, ALGOS) for each in NOISE]
        write_section("box-grid", "\n".join(tables))


def make_log(folder: Path, sim: str, name: str) -> None:
    """Record a log, FOLDER/NAME/*.mcap."""
    part, noise = folder / f"{name}.part", NOISE[sim]
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    if name == "replay":
        _learn_online(sim, part / "log.mcap")
    else:
        drawn: dict[str, Any] = {"policy": "pilot", "noise_per_episode": True}
        behaviors: dict[str, list[dict[str, Any]]] = {
            "expert": [{"policy": "pilot"}],
            "noisy": [{"policy": "pilot", "noise": noise}],
            "mixed": [
                {**drawn, "noise": noise},
                {**drawn, "noise": 3 * noise},
                {"policy": "pilot", "epsilon": 0.3},
                {"policy": "random"},
            ],
            "random": [{"policy": "random"}],
        }
        each = behaviors[name]
        for number, behavior in enumerate(each):
            mcaprl.record(
                sim,
                part / f"{number}.mcap",
                steps=STEPS // len(each),
                seed=10 * NAMES.index(name) + number,
                scene=False,
                sim_options=BOX,
                **behavior,
            )
    part.rename(folder / name)


def _learn_online(sim: str, log: Path) -> None:
    """Train an agent that knows no data, and record its transitions."""
    from stable_baselines3 import SAC

    with closing(mcaprl.RecordMcap(make_sim(sim, **BOX), log, policy="sac", scene=False)) as env:
        model = SAC(
            "MlpPolicy",
            env,
            learning_rate=1e-3,
            batch_size=128,
            learning_starts=1_000,
            gamma=SETTINGS[sim]["gamma"],
            train_freq=2,
            policy_kwargs={"net_arch": [128, 128]},
            seed=0,
            device="cpu",
        )
        model.learn(STEPS)


def _fill(folder: Path, sim: str, names: Sequence[str], algos: Sequence[str]) -> None:
    """Compute the missing cells of a sim."""
    results = folder / "box-scores.json"
    with closing(make_sim(sim, **BOX)) as env:
        random, pilot = run(sim, [None], **BOX), run(sim, [make_pilot(env)], env, **BOX)
    for name in names:
        for algo in algos:
            cells = read_cells(results)
            row = cells.setdefault(name, {})
            if algo in row:
                continue
            data = mcaprl.open(folder / name)
            behavior = normalize_mean(data.statistics.mean_return, random, pilot)
            row["behavior"] = {"score": behavior, "transitions": len(data)}
            row[algo] = _learn(sim, data, algo, folder / "run", random, pilot)
            print(sim, name, f"behavior {behavior:.2f}", algo, row[algo], flush=True)
            write_json(results, cells)


def _learn(
    sim: str,
    data: mcaprl.Dataset,
    algo: str,
    out: Path,
    random: PolicyScore,
    pilot: PolicyScore,
) -> Cell:
    """Train all seeds on a log and score them."""
    shutil.rmtree(out, ignore_errors=True)
    settings = {"updates": 5_000, **SETTINGS[sim], **ALGOS[algo]}
    if settings["algo"] == "bc":
        del settings["gamma"]
    mcaprl.train(data, out, seeds=SEEDS, progress=lambda _: None, **settings)
    return cell_of(run(sim, load_policies(out), **BOX), random, pilot)


if __name__ == "__main__":
    main()

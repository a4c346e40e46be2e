"""Rates of `mcaprl info --quality`: planted faults that are found, and findings in clean data.

    python -m benchmarks.studies.quality

Clean data are episodes of sims and of Gymnasium, with other seeds each time. Into each, every
fault of tests/support/damage/planted.py for which the data are enough is planted at a random place.
Clean bags are those of a robot that drives and rests, with and without noise, and of the steps of
the sims; faults are those of tests/support/damage/planted_bags.py, and are found if their messages
are named exactly.
A finding in clean data is false if it is a problem; notes are not counted.
"""

from __future__ import annotations

import argparse
import copy
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import Any, Final

import numpy as np

import mcaprl
from tests.support.damage.planted import FAULTS, IMAGE_FAULTS, fits
from tests.support.damage.planted_bags import BAG_FAULTS, clean_robot
from tests.support.robots import Robot, Topic, write_mcap

CLEAN: Final[dict[str, dict[str, Any]]] = {
    f"{sim}{', continuous' if actions else ''}, {name}": {
        "sim": sim,
        "steps": 300 if sim == "highway-lane" else 2_000,
        **({"actions": "continuous"} if actions else {}),
        **behavior,
    }
    for sim, kinds in {
        "lane": (False, True),
        "racer": (False, True),
        "powerline": (False, True),
        "CartPole-v1": (False,),
        "Pendulum-v1": (False,),
        "highway-lane": (False,),
    }.items()
    for actions in kinds
    for name, behavior in {
        "pilot": {"policy": "pilot", "epsilon": 0.2},
        "random": {"policy": "random"},
    }.items()
    if name == "random" or "-v1" not in sim
}
IMAGES: Final = {"powerline, depth": {"sim": "powerline", "observation": "depth", "episodes": 3}}


def clean(name: str, seed: int, path: Path) -> mcaprl.Dataset:
    """Record clean data of one of the names of `CLEAN` and `IMAGES`."""
    request = dict((CLEAN | IMAGES)[name])
    if "continuous" in name and request.get("epsilon"):
        request["noise"] = request.pop("epsilon")
    sim = request.pop("sim")
    mcaprl.record(sim, path, seed=1000 * seed, scene=False, overwrite=True, **request)
    return mcaprl.open(path)


BAGS: Final = {"bag, robot": False, "bag, robot without noise": True}
TOGETHER: Final = (
    [each for each in BAG_FAULTS if each not in ("black, /camera", "frozen, /camera/compressed")],
    ["black, /camera", "frozen, /camera/compressed"],
)
"""Faults that are planted into a bag together, because they are in different topics."""


def steps_of(data: mcaprl.Dataset) -> Robot:
    """Return a robot with the observations and actions of a log as topics, 10 times a second."""
    rows = {"/action": data.actions, "/observation": data.observations}
    found = Robot([])
    for name, columns in rows.items():
        parts = columns.values() if isinstance(columns, dict) else [columns]
        table = np.concatenate([np.asarray(part).reshape(len(data), -1) for part in parts], axis=1)
        values = [(0.1 * k, {"data": row.tolist()}) for k, row in enumerate(table[:, :64] * 1.0)]
        found.topics.append(Topic(name, "std_msgs/msg/Float64MultiArray", values))
    return found


def bag_faults(seed: int, path: Path, *, is_sim: bool) -> tuple[list[Any], dict[str, bool]]:
    """Return the findings in a clean bag, and whether each planted fault is found."""
    robot, found = clean_robot(seed, is_sim=is_sim), dict[str, bool]()
    base = problems(write_mcap(robot, path))
    for names in TOGETHER:
        bag = copy.deepcopy(robot)
        planted = {name: BAG_FAULTS[name](bag, np.random.default_rng(seed)) for name in names}
        flaws = problems(write_mcap(bag, path))
        hits = {(one.kind, *place[:3]) for one in flaws for place in one.places}
        found |= {
            name: (name.partition(",")[0], *place) in hits
            for name, place in planted.items()
            if place is not None
        }
    return base, found


def problems(data: mcaprl.Dataset | Path) -> list[Any]:
    """Return the findings that are no notes."""
    return [flaw for flaw in mcaprl.info(data, quality=True).quality if flaw.severity == "problem"]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1, help="logs of each kind of clean data")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first log")
    parser.add_argument("--show", action="store_true", help="print each error")
    parser.add_argument("--data", default="", help="only kinds of data with this in their names")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    folder = tempfile.TemporaryDirectory()
    path = Path(folder.name) / "log.mcap"
    planted: Counter[str] = Counter()
    found: Counter[str] = Counter()
    print("| clean data | logs | false findings |")
    print("|---|---|---|")
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    for name in (one for one in BAGS if arguments.data in one):
        wrong = []
        for seed in seeds:
            base, hits = bag_faults(seed, path, is_sim=BAGS[name])
            wrong += base
            planted.update(f"{kind}, {name}" for kind in hits)
            found.update(f"{kind}, {name}" for kind, hit in hits.items() if hit)
            if arguments.show:
                print("  not found:", seed, [kind for kind, hit in hits.items() if not hit])
        print(f"| {name} | {arguments.seeds} | {len(wrong)} |", flush=True)
    for name in (one for one in CLEAN if arguments.data in f"bag of {one}"):
        robots = (steps_of(clean(name, seed, path)) for seed in seeds)
        wrong = [one for robot in robots for one in problems(write_mcap(robot, path))]
        print(f"| bag of {name} | {arguments.seeds} | {len(wrong)} |", flush=True)
        if arguments.show:
            print("  false:", *wrong, sep="\n")
    for name in (one for one in (*CLEAN, *IMAGES) if arguments.data in one):
        wrong = []
        for seed in seeds:
            data = clean(name, seed, path)
            base = problems(data)
            wrong += base
            for kind, plant in (IMAGE_FAULTS if name in IMAGES else FAULTS).items():
                if not fits(kind, data):
                    continue
                label = kind if name not in IMAGES else f"{kind}, camera"
                planted[label] += 1
                hit = {one.kind for one in problems(plant(data, np.random.default_rng(seed)))}
                found[label] += kind in hit
                if arguments.show and kind not in hit:
                    print(f"  not found: {kind} in {name}, {seed}: {hit}", flush=True)
        print(f"| {name} | {arguments.seeds} | {len(wrong)} |", flush=True)
        if arguments.show:
            for flaw in wrong:
                print("  false:", flaw, flush=True)
    print("\n| planted | found |")
    print("|---|---|")
    for kind, count in planted.items():
        print(f"| {kind} | {found[kind]} of {count} |")


if __name__ == "__main__":
    main()

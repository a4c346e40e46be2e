"""Rates of `mcaprl info --quality`: planted faults that are found, and findings in clean data.

    python -m benchmarks.studies.quality

Clean data are episodes of sims and of Gymnasium, with other seeds each time. Into each, every
fault of tests/support/damage/planted.py for which the data are enough is planted at a random place.
A finding in clean data is false if it is a problem; notes are not counted.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import Any, Final

import numpy as np

import mcaprl
from tests.support.damage.planted import FAULTS, IMAGE_FAULTS, fits

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


def problems(data: mcaprl.Dataset) -> list[Any]:
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
    for name in (one for one in (*CLEAN, *IMAGES) if arguments.data in one):
        wrong = []
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
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

"""Continue agents for Box actions online, from a log and from policies that were trained on it.

    python -m benchmarks.studies.warm_starts FOLDER --sim lane --data LOG [--steps 20000]

LOG has mixed behavior, such as FOLDER/lane/mixed of `benchmarks.studies.box_grid`; without
`--data`, such a log is recorded. The rows of the table:

    nothing            SAC without a log
    filled buffer      SAC whose replay buffer contains the log at the start; new steps replace it
    half of each batch SAC with the log beside the replay buffer (RLPD)
    iql                offline IQL, continued by SAC
    td3-bc, rebrac     offline TD3+BC and ReBRAC, continued by TD3
    ... and log        the same, with half of each batch from the log

Each offline training makes 5,000 updates, each online one 20,000 steps with the sim's default
settings. The columns are scores (random 0, the continuous pilot 1), as means over the seeds: the
first evaluation of a continued policy, which is before its first update; the lowest one on the way,
also as a fraction of the first; the mean of the last three; and that of the best checkpoint on 100
other episodes. An agent that continues well keeps at least .9 of its score.

FOLDER/SIM has the runs; finished ones are kept, and others are resumed.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

import mcaprl
from benchmarks.studies.box_grid import BOX, SETTINGS, make_log
from mcaprl.errors import TrainingError
from mcaprl.files import read_json
from mcaprl.runs import read_curves

UPDATES: Final = 5_000
OFFLINE: Final = {"iql": "sac", "td3-bc": "td3", "rebrac": "td3"}
"""Offline algorithms, and those that continue their policies."""
REBRAC: Final[dict[str, Any]] = {"hidden": (128, 128, 128), "critic_layer_norm": True}
"""Networks of ReBRAC's default settings."""
HEADER: Final = (
    "| start | first | lowest | lowest / first | last three | best, fresh |",
    "|---|---|---|---|---|---|",
)


def main() -> None:
    """Train what is missing, and print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sim", default="lane", choices=tuple(SETTINGS))
    parser.add_argument("--data", type=Path, help="log or folder of logs")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--only", help="rows, separated by semicolons")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    folder, sim = arguments.folder / arguments.sim, arguments.sim
    data = arguments.data or folder / "mixed"
    if not data.exists():
        make_log(folder, sim, "mixed")
    known = rows(folder, sim, data, arguments.seeds, arguments.only)
    lines = [*HEADER]
    for name, (algo, sources, settings) in known.items():
        out = folder / name.replace(" ", "-")
        shared = {"steps": arguments.steps, "eval_interval": 1_000, "seeds": arguments.seeds}
        if not (out / "scores.json").exists():
            mcaprl.train_online(
                sim,
                out,
                algo=algo,
                sources=sources,
                resume=out.exists(),
                sim_options=BOX,
                **shared,
                **settings,
            )
        lines.append(row(name, out, is_continued=name.removesuffix(" and log") in OFFLINE))
        print(lines[-1], flush=True)
    print("\n".join(lines))


def rows(
    folder: Path, sim: str, data: Path, seeds: int, only: str | None
) -> dict[str, tuple[str, list[Path], dict[str, Any]]]:
    """Return the algorithm, sources and settings of each row; train the offline policies."""
    found: dict[str, tuple[str, list[Path], dict[str, Any]]] = {
        "nothing": ("sac", [], {}),
        "filled buffer": ("sac", [data], {"data_fraction": 0.0, "critic_layer_norm": False}),
        "half of each batch": ("sac", [data], {}),
    }
    for offline, algo in OFFLINE.items():
        run, networks = folder / f"offline-{offline}", REBRAC if offline == "rebrac" else {}
        found[offline] = (algo, [run], networks)
        found[f"{offline} and log"] = (algo, [run, data], networks)
    chosen = {name: found[name] for name in (only.split(";") if only else found)}
    for offline in dict.fromkeys(name.removesuffix(" and log") for name in chosen):
        if offline in OFFLINE:
            run = folder / f"offline-{offline}"
            # A finished run only reads its summary.
            mcaprl.train(
                data,
                run,
                algo=offline,
                seeds=seeds,
                resume=run.exists(),
                updates=UPDATES,
                **SETTINGS[sim],
            )
    return chosen


def row(name: str, out: Path, *, is_continued: bool) -> str:
    """Return a row of the table."""
    curves = np.array([curve["score"] for curve in read_curves(out, "curve.csv")])
    seeds = read_json(out / "scores.json", TrainingError)["seeds"].values()
    best = np.mean([each["score"] for each in seeds])
    lowest, last = curves.min(1), curves[:, -3:].mean()
    first, kept = "-", "-"
    if is_continued:
        first = f"{curves[:, 0].mean():.2f}"
        kept = f"{(lowest / curves[:, 0]).mean():.2f}"
    return f"| {name} | {first} | {lowest.mean():.2f} | {kept} | {last:.2f} | {best:.2f} |"


if __name__ == "__main__":
    main()

"""Compare the time to load batches of transitions with that of LeRobot's dataset.

    make .venv/.lerobot && python -m benchmarks.speed.lerobot_items

LeRobot reads a dataset that mcaprl writes. It runs in a separate Python environment:
`.venv/lerobot`, or the environment of the interpreter that MCAPRL_LEROBOT_PYTHON names. The program
prints LeRobot's CPU time for each transition, relative to ours.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

import mcaprl.torch
from benchmarks.speed.workloads import vectors

TRANSITIONS, BATCH, LEROBOT_ITEMS = 20_000, 256, 5_120
_PROGRAM = """
import sys, time
import torch

torch.set_num_threads(1)
# This torchvision was built for another torch; the dataset does not use these operators.
library = torch.library.Library("torchvision", "DEF")
for name in ("nms", "qnms"):
    library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
from lerobot.datasets.lerobot_dataset import LeRobotDataset

folder, fps, count, batch = sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
data = LeRobotDataset("any/name", root=folder, delta_timestamps={"observation.state": [0, 1 / fps]})
part = torch.utils.data.Subset(data, range(count))
start = time.process_time()
for items in torch.utils.data.DataLoader(part, batch_size=batch, shuffle=True):
    assert len(items["action"])
print((time.process_time() - start) / count)
"""


def main() -> None:
    """Print LeRobot's CPU time per transition relative to ours."""
    torch.set_num_threads(1)
    data = vectors(TRANSITIONS)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "set"
        data.to_lerobot(path)
        python = os.environ.get("MCAPRL_LEROBOT_PYTHON", f"{sys.prefix}/lerobot/bin/python")
        arguments = [str(path), str(1e9 / int(data.metadata["step_duration_ns"]))]
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": folder}
        done = subprocess.run(
            [python, "-c", _PROGRAM, *arguments, str(LEROBOT_ITEMS), str(BATCH)],
            capture_output=True,
            text=True,
            check=True,
            env=environment,
        )
    theirs = float(done.stdout.splitlines()[-1])
    print("| transitions for training | CPU time, ours = 1 |\n|---|---|\n| mcaprl | 1 |")
    print(f"| LeRobot's dataset with next observations | {theirs / _ours(data):.3g} |")


def _ours(data: mcaprl.Dataset) -> float:
    loader = mcaprl.torch.TransitionDataset(data).loader(BATCH)
    best = float("inf")
    for _ in range(5):
        start = time.process_time()
        for batch in loader:
            assert len(batch["action"])
        best = min(best, time.process_time() - start)
    return best / len(data)


if __name__ == "__main__":
    main()

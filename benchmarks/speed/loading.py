"""Measure loading batches of transitions in PyTorch's training loops."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.utils.data

import mcaprl
import mcaprl.torch
from benchmarks.measure import OURS, Side, Table, compare

BATCH = 256
# Loaders that load one item at a time are timed on this fraction of the log.
SHARE = 0.02


class _Plain(torch.utils.data.Dataset[Any]):
    """Dataset that returns single transitions from arrays in memory, like most PyTorch datasets."""

    def __init__(self, data: mcaprl.Dataset, count: int) -> None:
        self._frames, self._rows, self._count = data.frames, data.frame_of_step, count
        self._actions, self._rewards, self._ends = data.actions, data.rewards, data.terminated

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: int) -> dict[str, Any]:
        row = self._rows[k]
        return {
            "observation": torch.from_numpy(self._frames[row]),
            "action": self._actions[k],
            "reward": np.float32(self._rewards[k]),
            "next_observation": torch.from_numpy(self._frames[row + 1]),
            "terminated": self._ends[k],
        }


def table(log: Path, data: mcaprl.Dataset) -> Table:
    """Measure an epoch of shuffled batches of a log, in one thread.

    Args:
        log: Log of the data.
        data: Transitions of the log.
    """
    torch.set_num_threads(1)
    ours = mcaprl.torch.TransitionDataset(data)
    stream = mcaprl.torch.TransitionStream(log, batch_size=BATCH)
    few = round(SHARE * len(data))
    plain = torch.utils.data.DataLoader(_Plain(data, few), batch_size=BATCH, shuffle=True)
    items = torch.utils.data.DataLoader(
        torch.utils.data.Subset(ours, range(few)), batch_size=BATCH, shuffle=True
    )
    return compare(
        "Batches of transitions for PyTorch, one shuffled epoch",
        [
            Side(OURS, lambda: _drain(ours.loader(BATCH))),
            Side("mcaprl's stream, from the file", lambda: _drain(stream)),
            Side("mcaprl, items one by one", lambda: _drain(items), SHARE),
            Side("arrays in memory, items one by one", lambda: _drain(plain), SHARE),
        ],
        goal="300,000 transitions a second a core; 100 times LeRobot's dataset",
    )


def _drain(batches: Iterable[Any]) -> None:
    for batch in batches:
        assert len(batch["reward"])

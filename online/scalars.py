"""Scalars of an online run: `progress.csv`, and the same values for TensorBoard."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TextIO

from torch.utils.tensorboard import SummaryWriter

from mcaprl.errors import TrainingError
from mcaprl.files import write_atomically
from mcaprl.runs import writing

PROGRESS_NAME = "progress.csv"
STEPS = "time/total_timesteps"
"""Column of the number of environment steps."""


class ScalarsWriter:
    """Writer of scalars under the names of Stable-Baselines3, one row for each call of `write`.

    A resumed run replaces the rows after its checkpoint.
    """

    def __init__(self, folder: Path, done: int) -> None:
        """Open both files in `folder`, after `done` steps."""
        self._path = folder / PROGRESS_NAME
        self._rows = [row for row in _read(self._path) if _steps_of(row) <= done]
        self._columns = list(dict.fromkeys(name for row in self._rows for name in row))
        self._rewrite()
        with writing(self._path):
            self._board = SummaryWriter(str(folder), purge_step=done + 1)

    def write(self, step: int, scalars: Mapping[str, float]) -> None:
        """Append a row after `step` steps. Values that are NaN are left out."""
        values = {name: value for name, value in scalars.items() if not math.isnan(value)}
        row = {STEPS: str(step), **{name: str(value) for name, value in values.items()}}
        self._rows.append(row)
        with writing(self._path):
            if set(row) <= set(self._columns):
                with self._path.open("a", newline="") as file:
                    self._writer(file).writerow(row)
            else:
                self._columns += sorted(set(row) - set(self._columns))
                self._rewrite()
            for name, value in values.items():
                self._board.add_scalar(name, value, step)

    def close(self) -> None:
        """Close the files."""
        with writing(self._path):
            self._board.close()

    def _rewrite(self) -> None:
        """Replace the file; it gets a column for each name that was written so far."""
        text = io.StringIO()
        writer = self._writer(text)
        writer.writeheader()
        writer.writerows(self._rows)
        write_atomically(self._path, text.getvalue().encode(), TrainingError)

    def _writer(self, file: TextIO) -> csv.DictWriter[str]:
        return csv.DictWriter(file, self._columns, lineterminator="\n")


def _read(path: Path) -> list[dict[str, str]]:
    """Return the rows of an earlier session, without empty values and without cut rows."""
    if not path.exists():
        return []
    with writing(path), path.open(newline="", errors="replace") as file:
        rows = list(csv.DictReader(file))
    return [{name: value for name, value in row.items() if name and value} for row in rows]


def _steps_of(row: Mapping[str, str]) -> float:
    """Return the steps of a row; infinity if it was cut."""
    number = row.get(STEPS, "")
    return int(number) if number.isascii() and number.isdecimal() and len(number) < 20 else math.inf

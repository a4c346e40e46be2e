"""The curve of a training run: `metrics.csv`, and the same scalars for TensorBoard."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from torch.utils.tensorboard import SummaryWriter

from mcaprl.files import write_atomically

METRICS_NAME = "metrics.csv"


class MetricsWriter:
    """Writes one row per call, and closes both files at the end of its `with` block.

    The CSV has columns `update`, `learning_rate` and the algorithm's terms. Values are of one
    batch, not averages, so the same seed gives the same file.
    """

    def __init__(self, folder: Path, first_update: int) -> None:
        """Open both files in `folder`.

        Args:
            folder: an existing folder.
            first_update: of this session, from 1; later rows of an earlier session are dropped.
        """
        path = folder / METRICS_NAME
        kept = _rows_before(path, first_update)
        write_atomically(path, "".join(kept).encode())
        self._file = path.open("a", newline="")
        self._rows = csv.writer(self._file, lineterminator="\n")
        self._has_header = bool(kept)
        self._board = SummaryWriter(str(folder), purge_step=first_update)

    def write(self, update: int, learning_rate: float, terms: Mapping[str, float]) -> None:
        """Append the values of one update."""
        scalars = {"learning_rate": learning_rate, **terms}
        if not self._has_header:
            self._rows.writerow(["update", *scalars])
            self._has_header = True
        self._rows.writerow([update, *scalars.values()])
        self._file.flush()
        for name, value in scalars.items():
            self._board.add_scalar(f"train/{name}", value, update)

    def __enter__(self) -> Self:
        """Return the writer itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close both files."""
        self._file.close()
        self._board.close()


def _rows_before(path: Path, update: int) -> list[str]:
    """The lines of the header and of earlier updates, without a row that a kill has torn."""
    if update == 1 or not path.exists():
        return []
    header, *rows = path.read_text().splitlines(keepends=True)
    whole = (row for row in rows if row.count(",") == header.count(","))
    return [header, *(row for row in whole if int(row.split(",")[0]) < update)]

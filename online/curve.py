"""Learning curves: the rows of `curve.csv`."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from mcaprl.errors import TrainingError
from mcaprl.files import write_atomically

CURVE_NAME = "curve.csv"


@dataclass(frozen=True)
class CurvePoint:
    """One evaluation while training.

    Attributes:
        step: environment steps done.
        mean_return: over the evaluation's episodes.
        score: the same where random is 0 and the pilot 1; NaN without a pilot.
        lowest_return: of an episode.
        highest_return: of an episode.
        mean_length: steps of an episode.
        mean_progress_m: along the path or line in an episode; NaN where the environment tells none.
        best: whether the mean return was higher than ever.
    """

    step: int
    mean_return: float
    score: float
    lowest_return: float
    highest_return: float
    mean_length: float
    mean_progress_m: float
    best: bool


def write_curve(path: Path, points: Sequence[CurvePoint]) -> None:
    """Replace a file by all points so far."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow([field.name for field in fields(CurvePoint)])
    rows.writerows([*astuple(point)[:-1], int(point.best)] for point in points)
    write_atomically(path, text.getvalue().encode())


def read_curve(path: Path) -> list[CurvePoint]:
    """Read what `write_curve` wrote.

    Raises:
        TrainingError: it cannot be read.
    """
    try:
        with path.open(newline="") as file:
            return [_point(row) for row in csv.DictReader(file)]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainingError(f"cannot read the curve in {path}: {error}") from error


def _point(row: Mapping[str, str]) -> CurvePoint:
    numbers = {field.name: float(row[field.name]) for field in fields(CurvePoint)[1:-1]}
    return CurvePoint(step=int(row["step"]), best=row["best"] == "1", **numbers)

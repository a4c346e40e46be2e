"""Pictures without a display: matplotlib figures, made and saved. Extra: `report`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mcaprl.errors import ReportError, import_extra

INK, PALE = "#1d2733", "#b9c2cc"
COLORS = ("#2f6fb7", "#d9622b", "#2a9d6f", "#8a63c9", "#b08d1e", "#c04a7c")


def new_figure(
    *, figsize: tuple[float, float], rows: int = 1, columns: int = 1
) -> tuple[Any, Any]:
    """A figure and its axes; it needs no display and leaves no global state.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = import_extra("matplotlib.figure", "report").Figure(figsize=figsize, dpi=130)
    return figure, figure.subplots(rows, columns)


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure, and the folder that it is to lie in.

    Raises:
        ReportError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, bbox_inches="tight", facecolor="white")
    except OSError as error:
        raise ReportError(f"cannot write {path}: {error.strerror}") from error

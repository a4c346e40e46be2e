"""Drawing without a display: figures with one look, as PNG or as SVG that follows a page's colors.

Extra: `report`.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Final

from mcaprl.errors import ReportError, import_extra

INK: Final = "#1d2733"
PALE: Final = "#b9c2cc"
COLORS: Final = ("#2f6fb7", "#d9622b", "#2a9d6f", "#8a63c9", "#b08d1e", "#c04a7c")
_STYLE: Final = {
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "font.size": 9,
}
_NO_METADATA: Final = dict.fromkeys(("Creator", "Date", "Format", "Type"))
_SVG_STYLE: Final = {"svg.fonttype": "none", "svg.hashsalt": "mcaprl"}


def new_figure(
    size: tuple[float, float], rows: int = 1, columns: int = 1, *, grid: bool = False
) -> tuple[Any, Any]:
    """A figure that needs no display and leaves no global state, and its axes.

    Args:
        size: width and height, inches.
        rows: of axes.
        columns: of axes.
        grid: give the axes as an array (rows, columns), whatever their number.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    matplotlib = import_extra("matplotlib", "report")
    figure_type = import_extra("matplotlib.figure", "report").Figure
    with matplotlib.rc_context(_STYLE):
        figure = figure_type(figsize=size, dpi=130, layout="constrained")
        return figure, figure.subplots(rows, columns, squeeze=not grid)


def save_png(figure: Any, path: Path) -> None:
    """Write a figure on white; folders above it are made.

    Raises:
        ReportError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, bbox_inches="tight", facecolor="white")
    except OSError as error:
        raise ReportError(f"cannot write {path}: {error.strerror}") from error


def to_svg(figure: Any) -> str:
    """A figure as an SVG element to stand in a page: ink has the text's color, pale is `--pale`."""
    matplotlib = import_extra("matplotlib", "report")
    text = io.StringIO()
    with matplotlib.rc_context(_SVG_STYLE):
        figure.savefig(text, format="svg", transparent=True, metadata=_NO_METADATA)
    element = text.getvalue()
    element = element[element.index("<svg") :]
    return element.replace(INK, "currentColor").replace(PALE, "var(--pale)")

"""Self-contained HTML reports, and Matplotlib figures in one style, drawn without a display.

The page adapts to small screens and follows the system's light or dark mode.

Extra: `report`.
"""

from __future__ import annotations

import io
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcaprl._version import __version__
from mcaprl.errors import ReportError, import_extra
from mcaprl.files import replacing, write_atomically
from mcaprl.texts import encodable, printable, shortened

INK: Final = "#1d2733"
PALE: Final = "#b9c2cc"
BACKGROUND: Final = "#fefefe"
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
# Texts from data may contain `$`, which must not begin a formula.
_LITERAL: Final = {"text.parse_math": False}
_MAX_LABEL: Final = 200
_MAX_TICK_LABEL: Final = 40
_PAGE_COLORS: Final = {INK: "currentColor", PALE: "var(--pale)", BACKGROUND: "var(--card)"}
_NO_METADATA: Final = dict.fromkeys(("Creator", "Date", "Format", "Type"))
_SVG_STYLE: Final = {"svg.fonttype": "none", "svg.hashsalt": "mcaprl"}


def new_figure(
    size: tuple[float, float], rows: int = 1, columns: int = 1, *, grid: bool = False
) -> tuple[Any, Any]:
    """Create a figure and its axes, without a display and without global state."""
    matplotlib = import_extra("matplotlib", "report")
    figure_type = import_extra("matplotlib.figure", "report").Figure
    with matplotlib.rc_context(_STYLE):
        figure = figure_type(figsize=size, dpi=130, layout="constrained")
        return figure, figure.subplots(rows, columns, squeeze=not grid)


def save_png(figure: Any, path: Path) -> None:
    """Write a figure on a white background; create the folder if needed."""
    matplotlib = import_extra("matplotlib", "report")
    _make_literal(figure)
    with replacing(path, ReportError) as unfinished, matplotlib.rc_context(_LITERAL):
        figure.savefig(unfinished, format="png", bbox_inches="tight", facecolor="white")


class Panel(NamedTuple):
    """Part of a report: a figure of its page, and one of several axes of an image."""

    caption: str
    draw: Callable[[Any], None]  # Function that draws on axes
    size: tuple[float, float] = (4.4, 2.6)  # Width and height of the figure, inches

    def figure(self) -> Any:
        """Draw the panel alone, without its caption."""
        figure, axes = new_figure(self.size)
        self.draw(axes)
        return figure


def save_panels(path: Path, panels: Sequence[Panel], title: str = "") -> None:
    """Write panels as one PNG with three columns."""
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    width, height = map(max, zip(*(panel.size for panel in panels), strict=True))
    figure, grid = new_figure((columns * width, rows * height), rows, columns, grid=True)
    for axes, panel in zip_longest(grid.flat, panels):
        if panel is None:
            axes.set_axis_off()
        else:
            panel.draw(axes)
            caption = panel.caption.replace(": ", "\n", 1)
            axes.set_title(caption, loc="left", fontsize=10)
    if title:
        figure.suptitle(title, x=0.02, ha="left", color=INK)
    save_png(figure, path)


def to_svg(figure: Any) -> str:
    """Convert a figure to SVG, with `INK`, `PALE` and `BACKGROUND` as colors of the page."""
    matplotlib = import_extra("matplotlib", "report")
    text = io.StringIO()
    _make_literal(figure)
    with matplotlib.rc_context(_SVG_STYLE | _LITERAL):
        figure.savefig(text, format="svg", transparent=True, metadata=_NO_METADATA)
    element = text.getvalue()
    element = element[element.index("<svg") :]
    for color, replacement in _PAGE_COLORS.items():
        element = element.replace(color, replacement)
    return element


def tick_labels(names: Iterable[str]) -> list[str]:
    """Shorten names from data for an axis, and escape their control characters."""
    return [shortened(printable(name), _MAX_TICK_LABEL) for name in names]


def _make_literal(figure: Any) -> None:
    """Turn off formulas in all texts of a figure, escape control characters, and shorten lines."""
    for text in figure.findobj(import_extra("matplotlib.text", "report").Text):
        text.set_parse_math(False)
        # A text may have several lines, each of which may be too long.
        lines = printable(text.get_text()).split("\n")
        text.set_text("\n".join(shortened(line, _MAX_LABEL) for line in lines))


PAGE_NAME = "index.html"  # Name of the page in the folder of a report
_NUMBER = re.compile(r"[-+]?\d[\d.,]*( to [-+]?\d[\d.,]*)?(%| [%a-zA-Z]{1,3})?")
_MAX_SHORT = 30


@dataclass(frozen=True)
class Figure:
    """Figure in a page."""

    caption: str  # Text above the figure
    svg: str

    @classmethod
    def of(cls, caption: str, figure: Any) -> Figure:
        """Convert a Matplotlib figure."""
        return cls(caption, to_svg(figure))


@dataclass(frozen=True)
class Table:
    """Rows of text."""

    columns: Sequence[str]  # Names of the columns; all empty for a table without a header
    rows: Sequence[Sequence[str]]  # Rows, each with one cell per column

    @property
    def kinds(self) -> list[str]:
        """Kind of each column: `number` (right-aligned), `short` (one line) or `text`."""
        cells = [[row[k] for row in self.rows if row[k]] for k in range(len(self.columns))]
        return list(map(_kind, cells))


@dataclass(frozen=True)
class Card:
    """Block with a thumbnail in a grid."""

    title: str
    text: str  # Text below the title
    svg: str = ""  # Thumbnail, an SVG element
    command: str = ""  # Shell command to show; empty if there is none


@dataclass(frozen=True)
class Section:
    """Section of a page; it shows its non-empty fields in the order of their definition."""

    title: str
    text: str = ""
    figures: Sequence[Figure] = ()
    table: Table | None = None
    cards: Sequence[Card] = ()


def _kind(cells: Sequence[str]) -> str:
    if cells and all(map(_NUMBER.fullmatch, cells)):
        return "number"
    return "short" if max(map(len, cells), default=0) <= _MAX_SHORT else "text"


def _origin() -> str:
    """Return the version, the date, and the command if there is one."""
    program, *arguments = sys.argv or [""]
    command = shlex.join(["mcaprl", *arguments]) if Path(program).stem == "mcaprl" else ""
    today = datetime.now(UTC).date().isoformat()
    return ", ".join(filter(None, (f"mcaprl {__version__}", today, command)))


def write_page(path: Path, title: str, lead: str, sections: Sequence[Section]) -> None:
    """Write a page; create the folder if needed."""
    jinja2 = import_extra("jinja2", "report")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(files("mcaprl").joinpath("page.html").read_text())
    text = template.render(title=title, lead=lead, sections=sections, origin=_origin())
    write_atomically(path, encodable(text).encode(), ReportError)

"""Self-contained HTML reports: sections of text, figures, tables and cards.

The page adapts to small screens and follows the system's light or dark mode. Extra: `report`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from mcaprl.errors import ReportError, import_extra
from mcaprl.figures import to_svg
from mcaprl.files import write_atomically
from mcaprl.texts import encodable

PAGE_NAME = "index.html"
"""Name of the page in the folder of a report."""
_NUMBER = re.compile(r"[-+]?\d[\d.,]*( to [-+]?\d[\d.,]*)?(%| [%a-zA-Z]{1,3})?")
_MAX_SHORT = 30


@dataclass(frozen=True)
class Figure:
    """Figure in a page.

    Attributes:
        caption: Text above the figure.
        svg: SVG element.
    """

    caption: str
    svg: str

    @classmethod
    def of(cls, caption: str, figure: Any) -> Figure:
        """Convert a Matplotlib figure."""
        return cls(caption, to_svg(figure))


@dataclass(frozen=True)
class Table:
    """Rows of text.

    Attributes:
        columns: Names of the columns; all empty for a table without a header.
        rows: Rows, each with one cell per column.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def kinds(self) -> list[str]:
        """Kind of each column: `number` (right-aligned), `short` (one line) or `text`."""
        cells = [[row[k] for row in self.rows if row[k]] for k in range(len(self.columns))]
        return list(map(_kind, cells))


@dataclass(frozen=True)
class Card:
    """Block with a thumbnail in a grid.

    Attributes:
        title: Title of the card.
        text: Text below the title.
        svg: Thumbnail, an SVG element.
        command: Shell command to show; empty if there is none.
    """

    title: str
    text: str
    svg: str = ""
    command: str = ""


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


def write_page(path: Path, title: str, lead: str, sections: Sequence[Section]) -> None:
    """Write a page; create the folder if needed."""
    jinja2 = import_extra("jinja2", "report")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(files("mcaprl").joinpath("page.html").read_text())
    text = template.render(title=title, lead=lead, sections=sections)
    write_atomically(path, encodable(text).encode(), ReportError)

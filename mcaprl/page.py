"""Reports as one HTML page that needs no network: sections of text, figures, tables and cards.

It is readable on a phone, and light or dark as the reader's system is. Extra: `report`.
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

_NUMBER = re.compile(r"[-+]?\d[\d.,]*( to [-+]?\d[\d.,]*)?( [%a-zA-Z]{1,3})?")


@dataclass(frozen=True)
class Figure:
    """A picture in a page.

    Attributes:
        caption: over it.
        svg: an SVG element.
    """

    caption: str
    svg: str

    @classmethod
    def of(cls, caption: str, figure: Any) -> Figure:
        """Of a matplotlib figure."""
        return cls(caption, to_svg(figure))


@dataclass(frozen=True)
class Table:
    """Rows of text.

    Attributes:
        columns: their names; all empty for none.
        rows: as many cells each.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def kinds(self) -> list[str]:
        """`number` for each column of numbers, which go to the right; else `text`."""
        cells = [[row[k] for row in self.rows if row[k]] for k in range(len(self.columns))]
        return ["number" if column and all(map(_is_number, column)) else "text" for column in cells]


@dataclass(frozen=True)
class Card:
    """Something small that stands beside others of its kind.

    Attributes:
        title: of the card.
        text: below.
        svg: a thumbnail, an SVG element.
        command: to type into a terminal; empty if there is none.
    """

    title: str
    text: str
    svg: str = ""
    command: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a page, with whatever of these it has, in this order."""

    title: str
    text: str = ""
    figures: Sequence[Figure] = ()
    table: Table | None = None
    cards: Sequence[Card] = ()


def write_page(path: Path, title: str, lead: str, sections: Sequence[Section]) -> None:
    """Write a page; folders above it are made.

    Raises:
        MissingExtraError: jinja2 is not installed.
        ReportError: the file cannot be written.
    """
    jinja2 = import_extra("jinja2", "report")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(files("mcaprl").joinpath("page.html").read_text())
    text = template.render(title=title, lead=lead, sections=sections)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ReportError(f"cannot write {path}: {error.strerror}") from error


def _is_number(text: str) -> bool:
    return _NUMBER.fullmatch(text) is not None

"""Write tables into docs/results.md, between the comments that mark their section."""

from __future__ import annotations

from pathlib import Path

from mcaprl.files import write_atomically

PAGE = Path(__file__).parent.parent / "docs" / "results.md"


def write_section(name: str, text: str, page: Path = PAGE) -> None:
    """Replace the text between `<!-- name -->` and `<!-- /name -->`.

    Raises:
        ValueError: The page does not contain both comments.
    """
    begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->"
    before, found, rest = page.read_text().partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"{page} has no section {name}: add {begin.strip()} and {end}")
    whole = f"{before}{begin}\n{text.strip()}\n\n{end}{after}"
    write_atomically(page, whole.encode())

"""Write the results of `make faults` into docs/reliability.md, as a table.

python -m tests.support.damage.fault_table FIGURES PAGE
"""

from __future__ import annotations

import sys
from pathlib import Path

BEGIN, END = "<!-- fault figures: begin -->\n", "<!-- fault figures: end -->\n"


def with_table(page: str, figures: str) -> str:
    """Return the page with the figures in its table. Each line of `figures` is `fault: result`."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    assert rest, "the page has no place for figures"
    pairs = [line.split(": ", 1) for line in figures.splitlines()]
    rows = "".join(f"| {fault} | {seen} |\n" for fault, seen in pairs)
    return f"{before}{BEGIN}\n| fault | result |\n|---|---|\n{rows}\n{END}{after}"


def main() -> None:
    """Write the page."""
    figures, page = map(Path, sys.argv[1:3])
    page.write_text(with_table(page.read_text(), figures.read_text()))


if __name__ == "__main__":
    main()

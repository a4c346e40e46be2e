"""Plot the learning curves of online runs in one image.

python examples/experiments/compare_curves.py RUN... --out curves.png [--value mean_progress_m]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mcaprl.online import VALUES, draw_curves, read_run


def main() -> None:
    """Read the runs and plot them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--title", default="")
    parser.add_argument("--value", choices=VALUES, help="value to plot; default: the score")
    arguments = parser.parse_args()
    runs = [read_run(folder) for folder in arguments.runs]
    draw_curves(arguments.out, runs, arguments.title, arguments.value)
    print(arguments.out)


if __name__ == "__main__":
    main()

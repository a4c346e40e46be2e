"""Plot the learning curves of online runs in one image.

python examples/compare_curves.py RUN... --out curves.png [--value mean_progress_m]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mcaprl.figures import save_png
from mcaprl.online import VALUES, curve_figure, read_run


def main() -> None:
    """Read the runs and plot them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--title", default="")
    parser.add_argument("--value", choices=VALUES, help="value to plot; default: the score")
    arguments = parser.parse_args()
    runs = [read_run(folder) for folder in arguments.runs]
    save_png(curve_figure(runs, arguments.title, arguments.value), arguments.out)
    print(arguments.out)


if __name__ == "__main__":
    main()

"""The figures of `.ci/ratchets.py` are those of a small tree, counted by hand."""

from __future__ import annotations

import runpy
from pathlib import Path

PROGRAM = Path(__file__).resolve().parents[1] / ".ci" / "ratchets.py"


def test_figures_of_a_small_tree(tmp_path: Path) -> None:
    (tmp_path / "sims").mkdir()
    (tmp_path / "tests").mkdir()
    (tmp_path / "mcaprl").mkdir()
    (tmp_path / "mcaprl" / "sims").symlink_to("../sims")
    long = "def long(self, a, *, b):\n    '''Text.'''\n" + "    a += b\n" * 51
    (tmp_path / "sims" / "long.py").write_text(long)
    many = ", ".join(f"p{k}" for k in range(13))
    (tmp_path / "sims" / "many.py").write_text(f"def many({many}): pass\n")
    (tmp_path / "tests" / "test_one.py").write_text("x = 1\n")
    figures = runpy.run_path(str(PROGRAM))["figures"]
    assert figures(tmp_path) == {
        "lines of source": 54,
        "files of source": 2,
        "lines of tests": 1,
        "functions of more than 50 lines without docstring": 1,
        "functions with more than 12 parameters": 1,
        "most parameters of a function": 13,
    }

"""Tests of the numbered examples.

The examples must be short and run without errors. Each notebook must contain the code of its
example and the output of this code.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(EXAMPLES.glob("[0-9]*.py"))
NOTEBOOKS = sorted(EXAMPLES.glob("[0-9]*.ipynb"))


def read_notebook(path: Path) -> Any:
    return pytest.importorskip("jupytext").read(path)


def cells(path: Path) -> list[tuple[str, str]]:
    return [(cell.cell_type, cell.source) for cell in read_notebook(path).cells]


def text_output(path: Path) -> str:
    outputs = [one for cell in read_notebook(path).cells for one in cell.get("outputs", [])]
    assert {one.output_type for one in outputs} == {"stream"}, f"{path.name}: not text"
    return "".join(one.text for one in outputs if one.name == "stdout")


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_an_example_has_at_most_60_lines(script: Path) -> None:
    assert len(script.read_text().splitlines()) <= 60


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_has_the_code_of_its_script(notebook: Path) -> None:
    assert cells(notebook) == cells(notebook.with_suffix(".py")), "stale: see examples/README.md"


@pytest.mark.filterwarnings("ignore:.*updates of the target network")
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_an_example_runs_and_prints_what_its_notebook_shows(script: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    run = [sys.executable, str(script)]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if (notebook := script.with_suffix(".ipynb")) in NOTEBOOKS:
        # Learned values differ in their last digits between computers.
        assert shape(done.stdout) == shape(text_output(notebook))


def shape(text: str) -> list[str]:
    """Return the lines of a text without numbers, and without words that depend on numbers."""
    lines = re.sub(r"refused.*|ok$|no interval.*", "verdict", text, flags=re.MULTILINE).splitlines()
    return [" ".join(re.sub(r"[-\d.]+( to [-\d.]+)?|\[.*\]", "", line).split()) for line in lines]


def test_both_notebooks_exist() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["02_learn", "03_estimate"]

"""Tests of the examples.

The examples are numbered and short, and run without errors. Each notebook contains the code of its
example and the output of this code. The experiments, which take minutes to hours, are run by
`make docs-test`; here their commands must be valid.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from mcaprl.cli import cli

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"
SHELL_SCRIPTS = sorted(EXAMPLES.rglob("*.sh"))
EXPERIMENTS = sorted((EXAMPLES / "experiments").glob("*.py"))
# The stand-ins for robots, which know nothing of this package.
ROBOT = {EXAMPLES / "05_robot_bag" / name for name in ("robot.py", "writers.py")}
ROBOT |= {EXAMPLES / "06_drive" / name for name in ("robot.py", "messages.py")}
ALL = sorted({*EXAMPLES.rglob("*.py"), *SHELL_SCRIPTS} - ROBOT)
SCRIPTS = sorted(EXAMPLES.glob("[0-9]*.py"))
NOTEBOOKS = sorted(EXAMPLES.glob("[0-9]*.ipynb"))
# A notebook has the code of its script, so only one of them is executed.
EXECUTED = [
    *NOTEBOOKS,
    *(path for path in SCRIPTS if path.with_suffix(".ipynb") not in NOTEBOOKS),
]
# Executes the code cells of a notebook.
EXECUTE = """
import json, sys
for cell in json.load(open(sys.argv[1]))["cells"]:
    if cell["cell_type"] == "code":
        exec("".join(cell["source"]))
"""
# Executes the imports of a script only.
IMPORT = """
import ast, sys
tree = ast.parse(open(sys.argv[1]).read())
tree.body = [part for part in tree.body if isinstance(part, ast.Import | ast.ImportFrom)]
exec(compile(tree, sys.argv[1], "exec"))
"""


def read_notebook(path: Path) -> Any:
    return pytest.importorskip("jupytext").read(path)


def cells(path: Path) -> list[tuple[str, str]]:
    return [(cell.cell_type, cell.source) for cell in read_notebook(path).cells]


def text_output(path: Path) -> str:
    outputs = [one for cell in read_notebook(path).cells for one in cell.get("outputs", [])]
    assert {one.output_type for one in outputs} == {"stream"}, f"{path.name}: not text"
    return "".join(one.text for one in outputs if one.name == "stdout")


def test_the_examples_are_numbered_and_listed() -> None:
    names = sorted(path.name for path in EXAMPLES.iterdir() if path.name != "__pycache__")
    numbered = [name for name in names if re.match(r"0\d_", name)]
    assert sorted({*names} - {*numbered}) == ["README.md", "demo.sh", "experiments"]
    listed = (EXAMPLES / "README.md").read_text()
    for path in (*numbered, *(path.name for path in SHELL_SCRIPTS)):
        assert path.removesuffix(".ipynb") in listed, path


@pytest.mark.parametrize("script", ALL, ids=lambda path: path.name)
def test_an_example_has_at_most_60_lines(script: Path) -> None:
    assert len(script.read_text().splitlines()) <= 60


@pytest.mark.parametrize("script", SHELL_SCRIPTS, ids=lambda path: path.name)
def test_the_commands_of_a_script_are_valid(script: Path, tmp_path: Path) -> None:
    # The programs that the script calls append their arguments to a file. A line is written at
    # once, since demo.sh runs two programs at a time.
    calls = tmp_path / "calls"
    for name in ("mcaprl", "python"):
        stub = tmp_path / name
        line = f'line=$(printf "%s\\t" {name} "$@")'
        stub.write_text(f'#!/bin/sh\n{line}\nprintf "%s\\n" "$line" >> "{calls}"\n')
        stub.chmod(0o755)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    out = str(tmp_path / "out")
    subprocess.run(["sh", str(script), out], env={**os.environ, "PATH": path}, check=True)
    called = [line.split("\t")[:-1] for line in calls.read_text().splitlines()]
    assert any(program == "mcaprl" for program, *_ in called)
    for program, *arguments in called:
        if program == "python":
            assert Path(arguments[0]).is_file(), arguments
            continue
        command = cli.commands[arguments[0]]
        command.make_context(arguments[0], arguments[1:], parent=cli.make_context("mcaprl", ["x"]))


@pytest.mark.parametrize("script", EXPERIMENTS, ids=lambda path: path.name)
def test_an_experiment_imports_what_exists(script: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{script.parent}"}
    subprocess.run([sys.executable, "-c", IMPORT, str(script)], env=environment, check=True)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_has_the_code_of_its_script(notebook: Path) -> None:
    assert cells(notebook) == cells(notebook.with_suffix(".py")), "stale: see examples/README.md"


@pytest.mark.filterwarnings("ignore:.*updates of the target network")
@pytest.mark.parametrize("script", EXECUTED, ids=lambda path: path.name)
def test_an_example_runs_and_prints_what_its_notebook_shows(script: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    code = ["-c", EXECUTE] if script in NOTEBOOKS else []
    run = [sys.executable, *code, str(script)]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if script in NOTEBOOKS:
        # Learned values differ in their last digits between computers.
        assert shape(done.stdout) == shape(text_output(script))


def shape(text: str) -> list[str]:
    """Return the lines of a text without numbers, and without words that depend on numbers."""
    lines = re.sub(r"refused.*|ok$|no interval.*", "verdict", text, flags=re.MULTILINE).splitlines()
    return [" ".join(re.sub(r"[-\d.]+( to [-\d.]+)?|\[.*\]", "", line).split()) for line in lines]


def test_both_notebooks_exist() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["02_learn", "03_estimate"]

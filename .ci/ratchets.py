"""Check that the size of the code does not grow unseen: `python .ci/ratchets.py [--write]`.

The limits are in `.ci/ratchets.json`. A figure above its limit is an error. `--write` lowers the
limits to today's figures; lines are rounded up, so that a mended line is not an error. Whoever has
to raise a limit edits the file, and reviewers see it.
"""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIMITS = ROOT / ".ci" / "ratchets.json"
SOURCE = ("mcaprl", "recorder", "sims", "offline", "online", "cli")
LONG_FUNCTION, MANY_PARAMETERS, LINES = 50, 12, 250


def main(*, write: bool) -> int:
    """Compare the figures with their limits, print them, and return the exit status."""
    limits = json.loads(LIMITS.read_text())
    found = figures(ROOT)
    for name, value in found.items():
        print(f"{name}: {value}, limit {limits[name]}{' EXCEEDED' * (value > limits[name])}")
    if write:
        lowered = {name: min(limits[name], _rounded(name, found[name])) for name in found}
        LIMITS.write_text(json.dumps(lowered, indent=2) + "\n")
    return any(value > limits[name] for name, value in found.items())


def _rounded(name: str, value: int) -> int:
    return -(-value // LINES) * LINES if name.startswith("lines") else value


def figures(root: Path) -> dict[str, int]:
    """Return the figures that may not rise."""
    paths = list(_modules(root, SOURCE))
    tests = list(_modules(root, ("tests",)))
    functions = [each for path in paths for each in _functions(path)]
    return {
        "lines of source": sum(map(_lines, paths)),
        "files of source": len(paths),
        "lines of tests": sum(map(_lines, tests)),
        f"functions of more than {LONG_FUNCTION} lines without docstring": sum(
            _body_lines(each) > LONG_FUNCTION for each in functions
        ),
        f"functions with more than {MANY_PARAMETERS} parameters": sum(
            _parameters(each) > MANY_PARAMETERS for each in functions
        ),
        "most parameters of a function": max(map(_parameters, functions)),
    }


def _modules(root: Path, folders: tuple[str, ...]) -> Iterator[Path]:
    """Yield the modules in folders, without those behind links and hidden or installed ones."""
    for folder in folders:
        for path in sorted((root / folder).rglob("*.py")):
            parts = path.relative_to(root).parts
            is_link = any(root.joinpath(*parts[:n]).is_symlink() for n in range(1, len(parts) + 1))
            if not is_link and "node_modules" not in parts:
                yield path


def _lines(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def _functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def _body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the lines of a function's statements, without signature and docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def _parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    arguments = function.args
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return sum(each.arg not in ("self", "cls") for each in every)


if __name__ == "__main__":
    sys.exit(main(write="--write" in sys.argv[1:]))

"""Programs in the environment of d3rlpy and of the benchmark's tasks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.conftest import need

ROOT = Path(__file__).parents[2]


def run_rivals(*arguments: object) -> str:
    """Run Python there at the root of the repository, and return what it prints.

    The test is skipped if the environment is not installed.
    """
    python = os.environ.get("MCAPRL_D3RLPY_PYTHON", f"{sys.prefix}/rivals/bin/python")
    need(Path(python).exists(), "d3rlpy is not installed: make .venv/.rivals")
    kept = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(
        [python, "-W", "ignore", *map(str, arguments)],
        env=kept,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout

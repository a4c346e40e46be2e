"""Runner of LeRobot, which has a separate environment."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Final

from tests.conftest import need

PROGRAM: Final = Path(__file__).with_name("run.py")


def run_lerobot(*arguments: object, folder: Path) -> None:
    """Run `run.py` in a folder; skip the test if LeRobot is not installed."""
    python = os.environ.get("MCAPRL_LEROBOT_PYTHON", f"{sys.prefix}/lerobot/bin/python")
    need(Path(python).exists(), "LeRobot is not installed: make .venv/.lerobot")
    kept = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    home = str(folder / "home")
    surroundings = {"HF_HOME": home, "HF_HUB_OFFLINE": "1", "HOME": home}
    done = subprocess.run(
        [python, "-W", "ignore", str(PROGRAM), *map(str, arguments)],
        env={**kept, **surroundings, "PYTHONPATH": str(PROGRAM.parents[3])},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-3000:]

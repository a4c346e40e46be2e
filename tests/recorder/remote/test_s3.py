"""Logs on an S3 server. The server and its client run in a separate environment."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import mcaprl
from tests.conftest import need


def test_logs_on_an_s3_server(log_path: Path) -> None:
    python = os.environ.get("MCAPRL_S3_PYTHON", f"{sys.prefix}/s3/bin/python")
    need(Path(python).exists(), "the S3 server is not installed: make .venv/.s3")
    mcaprl.record("lane", log_path, episodes=2, epsilon=0.3)
    program = Path(__file__).with_name("run_s3.py")
    done = subprocess.run(
        [python, str(program), str(log_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["fingerprint"] == mcaprl.open(log_path).fingerprint
    assert found["episodes"] == [2, 1]
    assert found["names"] == ["logs/drives/lane.mcap"]
    assert found["missing"] == "cannot read s3://logs/none.mcap: no such file"

"""A viewer of the Foxglove protocol."""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import Any

from tests.conftest import need
from tests.support.paths import NODE


class Watcher:
    """A viewer of the Foxglove protocol that subscribes to all topics."""

    def __init__(self, url: str) -> None:
        need(shutil.which("node") is not None, "node is not installed")
        installed = (NODE / "node_modules" / "@foxglove" / "ws-protocol").exists()
        need(installed, "run `npm ci` in tests/node")
        self._process = subprocess.Popen(
            ["node", str(NODE / "watch.mjs"), url], stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "watching\n"

    def seen(self) -> Any:
        """Return all received messages after the server has closed the connection."""
        return json.loads(self._process.communicate(timeout=30)[0])

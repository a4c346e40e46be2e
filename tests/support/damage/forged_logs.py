"""Small logs with metadata that no recorder would write."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import numpy as np
from gymnasium import spaces

from mcaprl.recorder.format.metadata import LogMetadata
from tests.support.recordings import record


def forged(path: Path, **strings: str) -> Path:
    """Record a log with other texts in its metadata.

    Args:
        path: Path of the log.
        **strings: Texts by the name of their field.
    """
    plain = LogMetadata.to_strings

    def to_strings(metadata: LogMetadata) -> dict[str, str]:
        return {**plain(metadata), **strings}

    vector = spaces.Box(-1, 1, (2,), np.float32)
    with mock.patch.object(LogMetadata, "to_strings", to_strings):
        record(path, vector, spaces.Discrete(2), [3, 4])
    return path

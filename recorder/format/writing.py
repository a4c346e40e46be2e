"""Names of the package `columns`, re-exported for packages that write MCAP files."""

from __future__ import annotations

from mcaprl.recorder.columns.cdr import ENCAPSULATION
from mcaprl.recorder.columns.message_rows import message_rows
from mcaprl.recorder.columns.signals import HoldSignals
from mcaprl.recorder.columns.summary import finished_state
from mcaprl.recorder.columns.valid_copy import recover_file
from mcaprl.recorder.columns.writer import COMPRESSIONS, McapWriter

__all__ = [
    "COMPRESSIONS",
    "ENCAPSULATION",
    "HoldSignals",
    "McapWriter",
    "finished_state",
    "message_rows",
    "recover_file",
]

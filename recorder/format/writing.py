"""Writing MCAP files: what the rooms above `format` use of `columns`."""

from __future__ import annotations

from mcaprl.recorder.columns.append import written_state
from mcaprl.recorder.columns.cdr import ENCAPSULATION
from mcaprl.recorder.columns.file_lock import refuse_if_taken
from mcaprl.recorder.columns.message_rows import message_rows
from mcaprl.recorder.columns.signals import HoldSignals
from mcaprl.recorder.columns.writer import COMPRESSIONS, McapWriter

__all__ = [
    "COMPRESSIONS",
    "ENCAPSULATION",
    "HoldSignals",
    "McapWriter",
    "message_rows",
    "refuse_if_taken",
    "written_state",
]

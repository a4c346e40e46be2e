"""Names of the package `columns`, re-exported for packages that write MCAP files."""

from __future__ import annotations

from mcaprl.recorder.columns.cdr import ENCAPSULATION
from mcaprl.recorder.columns.output import HoldSignals
from mcaprl.recorder.columns.records import message_rows
from mcaprl.recorder.columns.salvage import Damage, recover_file
from mcaprl.recorder.columns.summary import finished_state
from mcaprl.recorder.columns.writer import COMPRESSIONS, McapWriter

__all__ = [
    "COMPRESSIONS",
    "ENCAPSULATION",
    "Damage",
    "HoldSignals",
    "McapWriter",
    "finished_state",
    "message_rows",
    "recover_file",
]

"""Ctrl-C while the command-line program is imported: one line instead of a traceback.

`mcaprl` imports this module first. It has no effect if another program imports `mcaprl`.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

INTERRUPTED = 130
"""Exit code of the program after Ctrl-C, SIGTERM or SIGHUP."""


def _is_program() -> bool:
    """Return whether this process runs the program: `mcaprl` or `python -m mcaprl`."""
    name = os.path.basename(sys.argv[0]) if getattr(sys, "argv", None) else ""
    if name == "-m":
        # Python sets sys.argv[0] to "-m" while it imports the parent packages of any module.
        module = sys.orig_argv[sys.orig_argv.index("-m") + 1] if "-m" in sys.orig_argv else ""
        return module.partition(".")[0] == "mcaprl"
    return os.path.splitext(name)[0] == "mcaprl"


def _exit(number: int, frame: FrameType | None) -> None:
    # An exception could be lost or changed in the import of an extension module. At this time
    # nothing has been opened that must be closed.
    os.write(2, b"mcaprl: interrupted\n")
    os._exit(INTERRUPTED)


if _is_program() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _exit)

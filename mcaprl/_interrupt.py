"""Ctrl-C in the command-line program.

While the program is imported, Ctrl-C prints one line instead of a traceback: `mcaprl` imports this
module first. Afterwards it raises KeyboardInterrupt where this exception cannot be lost. Importing
this module has no effect in another program that imports `mcaprl`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from types import FrameType

INTERRUPTED = 130  # Exit code of the program after Ctrl-C, SIGTERM or SIGHUP
_RETRY_S, _LONGEST_S = 0.02, 5.0
_postponed_since: float | None = None


def raise_interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or postpone the signal; this is a signal handler."""
    if not is_postponed(number, frame):
        raise KeyboardInterrupt


def is_postponed(number: int, frame: FrameType | None) -> bool:
    """Return whether a signal handler must not raise now; the signal is then sent again later."""
    # In an import, an exception could be lost, changed, or leave a module incomplete; in a function
    # that llvmlite's C code calls, it would be lost. A signal is postponed for at most 5 s, because
    # an imported script may never end.
    global _postponed_since
    now = time.monotonic()
    since = _postponed_since or now
    _postponed_since = None
    while frame is not None and now - since < _LONGEST_S:
        name = frame.f_globals.get("__name__", "")
        if frame.f_code.co_filename.startswith("<frozen importlib") or name.startswith("llvmlite."):
            _postponed_since = since
            _send_later(number)
            return True
        frame = frame.f_back
    return False


def repeat_lost_interrupt(lost: sys.UnraisableHookArgs) -> None:
    """Send a signal again if its KeyboardInterrupt was lost; this is a `sys.unraisablehook`."""
    # Python ignores exceptions in finalizers and callbacks of C code.
    if lost.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(lost)
        return
    # A process in the background ignores SIGINT.
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is raise_interrupt:
            _send_later(number)
            return


def send_to_main_thread(number: int) -> None:
    """Send a signal to the main thread, also if it waits in a system call."""
    if sys.platform == "win32":
        signal.raise_signal(number)
    else:
        thread = threading.main_thread().ident
        assert thread is not None
        signal.pthread_kill(thread, number)


def _send_later(number: int) -> None:
    timer = threading.Timer(_RETRY_S, send_to_main_thread, (number,))
    timer.daemon = True
    timer.start()


def is_program() -> bool:
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


if is_program() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _exit)

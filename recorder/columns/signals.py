"""Keeps Ctrl-C, SIGTERM and a closed terminal from falling between writes that belong together."""

from __future__ import annotations

import inspect
import signal
import threading
from types import FrameType, TracebackType
from typing import Any, ClassVar

try:
    # What `signal` wraps, to make enums of numbers and handlers: that takes ten times as long, and
    # an episode's end holds signals twice.
    from _signal import getsignal  # type: ignore[import-not-found]
    from _signal import signal as set_handler
except ImportError:
    from signal import getsignal
    from signal import signal as set_handler

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
# Windows has no SIGHUP.
_HELD = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))


class HoldSignals:
    """A `with` block that lets signals wait; they are handled as usual when it ends.

    Only the main thread can hold them; in any other thread no handler runs anyway. A block within
    another adds nothing to it.
    """

    _is_held: ClassVar[bool] = False

    def __enter__(self) -> None:
        """Begin to hold."""
        self._handlers: dict[int, Any] = {}
        self._waiting: list[int] = []
        self._holds = threading.current_thread() is threading.main_thread() and not self._is_held
        if not self._holds:
            return
        try:
            HoldSignals._is_held = True
            for number in _HELD:
                handler = getsignal(number)
                # None: not installed from Python, so it cannot be put back.
                if handler is not None:
                    self._handlers[number] = handler
                    set_handler(number, self._note)
        except BaseException:
            self._restore()
            raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Handle what came in the meantime."""
        self._restore()
        for number in self._waiting:
            handler = self._handlers[number]
            if callable(handler):
                handler(number, inspect.currentframe())
            elif handler == signal.SIG_DFL:
                signal.raise_signal(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        # Not the frame: as long as it were kept, so would be all that was being worked on in it.
        self._waiting.append(number)

    def _restore(self) -> None:
        if self._holds:
            HoldSignals._is_held = False
        for number, handler in self._handlers.items():
            set_handler(number, handler)
